"""Pieces of a segment that can be gone through side by side."""

from functools import cache

import jax
import numpy as np
import pytest

from sumajax.learning.windows import GAPS_IN_WINDOW, windows

ENVS = 5
SHAPES = [(1, 1), (7, 1), (40, 1), (41, 3), (100, 5), (9, 10), (699, 10)]
"""(steps, gap): one window, many, and a last one that is shorter."""


def random_begins(steps: int, gap: int) -> np.ndarray:
    """(T, E): starts 1 to `gap` steps apart, as short episodes and cuts of memory make them."""
    rng = np.random.default_rng(steps)
    begins = np.zeros((steps, ENVS), bool)
    for env in range(ENVS):
        at = np.cumsum(rng.integers(1, gap + 1, size=steps))
        begins[at[at < steps], env] = True
    begins[0] = True
    return begins


@cache
def cases(steps: int, gap: int) -> tuple:
    """Where memory is constant, the windows, and (T, E, 2) numbers: themselves, split, joined."""
    begins = random_begins(steps, gap)
    x = np.random.default_rng(0).normal(size=(steps, ENVS, 2)).astype(np.float32)

    @jax.jit
    def program(begins, x):
        pieces = windows(begins, gap)
        apart = pieces.split({"x": x})["x"]
        return pieces, apart, pieces.join(apart)

    pieces, apart, joined = jax.tree.map(np.asarray, program(begins, x))
    return begins, pieces, (x, apart, joined)


@pytest.mark.parametrize(("steps", "gap"), SHAPES)
def test_what_is_joined_is_what_was_split(steps, gap):
    _, pieces, (x, apart, joined) = cases(steps, gap)
    width, count, _ = pieces.step.shape
    assert apart.shape == (width, count * ENVS, 2)
    np.testing.assert_array_equal(joined, x)


@pytest.mark.parametrize(("steps", "gap"), SHAPES)
def test_all_that_memory_reaches_is_in_one_window_in_order(steps, gap):
    """From the last step at which memory was constant up to each step."""
    begins, pieces, _ = cases(steps, gap)
    step, window, place = pieces.step, pieces.window, pieces.place
    for env in range(ENVS):
        start = 0
        for t in range(steps):
            start = t if begins[t, env] else start
            back = np.arange(t - start + 1)
            assert place[t, env] >= back[-1]
            of_window = step[place[t, env] - back, window[t, env], env]
            np.testing.assert_array_equal(of_window, t - back)


@pytest.mark.parametrize(("steps", "gap"), SHAPES)
def test_every_window_starts_where_memory_is_constant(steps, gap):
    begins, pieces, _ = cases(steps, gap)
    first = pieces.step[0]
    used = np.array([(pieces.window == k).any(0) for k in range(len(first))])
    assert begins[first, np.arange(ENVS)][used].all()
    assert used[0].all()


def test_windows_are_some_gaps_long_and_one_more_for_the_overlap():
    """What is gone through twice is less than a gap per window."""
    _, pieces, _ = cases(699, 10)
    width, count, _ = pieces.step.shape
    assert (width, count) == (GAPS_IN_WINDOW * 10 + 9, -(-699 // (GAPS_IN_WINDOW * 10)))
