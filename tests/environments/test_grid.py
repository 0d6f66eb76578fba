"""The verbs of a grid."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare

from sumajax.environments import grid
from sumajax.environments.grid import CAPTURE, DOWN, LEFT, NOWHERE, RIGHT, STAY, UP

keys = st.integers(0, 2**31 - 1).map(jax.random.key)
DRAWS = 1_000_000


def place_many(count: int, size: tuple[int, int], draws: int, seed: int = 0) -> np.ndarray:
    """(draws, count) flat cells."""
    key = jax.random.split(jax.random.key(seed), draws)
    cells = jax.jit(jax.vmap(lambda key: grid.place_distinct(key, count, size)))(key)
    return np.asarray(grid.cell_index(cells, size))


class TestPlaceDistinct:
    @pytest.mark.parametrize(
        ("count", "size"), [(1, (1, 1)), (4, (5, 5)), (6, (3, 2)), (12, (3, 4)), (11, (20, 20))]
    )
    @settings(deadline=None, max_examples=20)
    @given(key=keys)
    def test_cells_are_distinct_and_on_the_grid(self, count, size, key):
        cells = np.asarray(grid.place_distinct(key, count, size))
        assert cells.shape == (count, 2)
        assert cells.dtype == np.int32
        assert (cells >= 0).all()
        assert (cells < size).all()
        assert len(np.unique(cells, axis=0)) == count

    def test_each_entity_is_uniform_over_the_cells(self):
        cells = place_many(4, (5, 5), DRAWS)
        for entity in range(4):
            assert chisquare(np.bincount(cells[:, entity], minlength=25)).pvalue > 1e-3

    def test_each_ordered_pair_is_equally_likely(self):
        first, second, _ = place_many(3, (3, 2), DRAWS).T
        counts = np.bincount(6 * first + second, minlength=36).reshape(6, 6)
        assert not counts.diagonal().any()
        assert chisquare(counts[~np.eye(6, dtype=bool)]).pvalue > 1e-3

    def test_each_order_of_a_full_grid_is_equally_likely(self):
        cells = place_many(4, (2, 2), DRAWS)
        counts = np.bincount(cells @ [64, 16, 4, 1])
        counts = counts[counts > 0]
        assert len(counts) == 24
        assert chisquare(counts).pvalue > 1e-3

    @settings(deadline=None)
    @given(bits=st.integers(0, 2**32 - 1), bound=st.integers(1, 2**32 - 1))
    def test_random_bits_are_scaled_exactly(self, bits, bound):
        assert int(grid.scale_to_range(jnp.uint32(bits), np.uint32(bound))) == bits * bound >> 32


class TestMove:
    @pytest.mark.parametrize(
        ("action", "there"),
        [(UP, (1, 3)), (RIGHT, (2, 4)), (DOWN, (3, 3)), (LEFT, (2, 2)), (STAY, (2, 3))],
    )
    def test_directions_count_rows_from_the_top(self, action, there):
        assert grid.move(jnp.array([2, 3]), jnp.array(action), (5, 6)).tolist() == list(there)

    @pytest.mark.parametrize(
        ("corner", "actions"),
        [
            ((0, 0), (UP, LEFT)),
            ((0, 6), (UP, RIGHT)),
            ((3, 0), (DOWN, LEFT)),
            ((3, 6), (DOWN, RIGHT)),
        ],
    )
    def test_walking_into_the_border_is_staying(self, corner, actions):
        for action in actions:
            assert grid.move(jnp.array(corner), jnp.array(action), (4, 7)).tolist() == list(corner)

    @pytest.mark.parametrize("action", [CAPTURE, -1, 6, 99])
    def test_any_other_action_stays(self, action):
        assert grid.move(jnp.array([1, 1]), jnp.array(action), (3, 3)).tolist() == [1, 1]


def test_flat_index_runs_along_the_rows():
    cells = jnp.array([[0, 0], [0, 6], [1, 0], [3, 6]])
    assert grid.cell_index(cells, (4, 7)).tolist() == [0, 6, 7, 27]


def test_one_hot_position_is_the_row_of_the_table():
    size = (3, 4)
    cells = jnp.array([[0, 0], [1, 3], [2, 2]])
    one_hot = grid.one_hot_position(cells, size)
    assert one_hot.shape == (3, 1, 3, 4)
    assert one_hot.sum((1, 2, 3)).tolist() == [1, 1, 1]
    assert one_hot[1, 0, 1, 3] == 1
    table = grid.one_hot_cells(size)
    assert table.shape == (12, 1, 3, 4)
    np.testing.assert_array_equal(table[grid.cell_index(cells, size)], one_hot)


def naive_window(centre, entities, vision, size):
    """(m, m) lists of how many entities stand where, None outside, by looking at every cell."""
    reach = range(-vision, vision + 1)
    cells = [[(centre[0] + down, centre[1] + right) for right in reach] for down in reach]
    inside = lambda cell: 0 <= cell[0] < size[0] and 0 <= cell[1] < size[1]  # noqa: E731
    return [[entities.count(cell) if inside(cell) else None for cell in row] for row in cells]


class TestWindow:
    SIZE, VISION = (4, 6), 2
    cells = st.tuples(st.integers(0, SIZE[0] - 1), st.integers(0, SIZE[1] - 1))
    look = jax.jit(
        lambda position, entities: (
            grid.window_count(position, entities, 2),
            grid.window_outside(position, 2, (4, 6)),
        )
    )

    @settings(deadline=None)
    @given(
        position=st.lists(cells, min_size=3, max_size=3),
        classes=st.tuples(st.lists(cells, max_size=4), st.lists(cells, max_size=4)),
    )
    def test_it_counts_who_stands_where(self, position, classes):
        filled = [c + [(NOWHERE, NOWHERE)] * (4 - len(c)) for c in classes]
        counts, outside = TestWindow.look(jnp.array(position), jnp.array(filled))
        assert counts.shape == (3, 2, 5, 5)
        for agent, centre in enumerate(position):
            for kind, entities in enumerate(classes):
                seen = naive_window(centre, entities, self.VISION, self.SIZE)
                np.testing.assert_array_equal(
                    outside[agent], [[c is None for c in r] for r in seen]
                )
                np.testing.assert_array_equal(
                    counts[agent, kind], [[c or 0 for c in r] for r in seen]
                )

    def test_row_ends_do_not_touch(self):
        """The last cell of a row and the first of the next are neighbours only in memory."""
        counts = grid.window_count(jnp.array([[1, 5]]), jnp.array([[[2, 0]]]), 1)
        assert not counts.any()

    def test_without_vision_only_the_own_cell_is_seen(self):
        counts = grid.window_count(jnp.array([[1, 1], [1, 2]]), jnp.array([[[1, 1], [1, 1]]]), 0)
        assert counts.tolist() == [[[[2]]], [[[0]]]]

    def test_offsets_are_centred(self):
        offsets = grid.window_offsets(1)
        assert offsets.shape == (3, 3, 2)
        assert offsets[1, 1].tolist() == [0, 0]
        assert offsets[0, 2].tolist() == [-1, 1]


def test_a_size_is_rows_and_columns():
    assert grid.grid_size(5) == (5, 5)
    assert grid.grid_size((3, 7)) == (3, 7)
    assert grid.grid_size(np.int64(5)) == (5, 5)


@pytest.mark.parametrize("size", [0, -1, (3, 0), (5,), (3, 4, 5), 2.5, (3, 2.0), True, "5", None])
def test_anything_else_is_no_size(size):
    sentence = f"size must be a positive int or (rows, columns), got {size!r}."
    with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
        grid.grid_size(size)
