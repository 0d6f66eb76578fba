"""A long segment as short pieces side by side, where no gradient passes from one to the next.

With `detach_gap` memory is a constant at the start of every so many steps of an episode. What comes
after such a step does not depend, to a gradient, on what came before: the pieces between can be
gone through at the same time, as if they were environments of their own.
"""

from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct

GAPS_IN_WINDOW = 8
"""Gaps that a window is long: longer ones leave fewer to work on at a time, shorter ones spend more
of their steps on the overlap. Measured; see benchmarks/README.md."""


@struct.dataclass
class Windows:
    """Where each step of T goes: K windows of W steps in each environment.

    A window starts where memory is constant and ends where the next one starts, or some steps
    before its last place; the places that are left over repeat steps of the next one.
    """

    step: chex.Array  # (W, K, E) int32 in 0..T-1
    window: chex.Array  # (T, E) int32 in 0..K-1
    place: chex.Array  # (T, E) int32 in 0..W-1: step[place, window] is the step itself

    def split(self, tree: Any) -> Any:
        """Leaves (T, E, ...) -> (W, K * E, ...)."""
        width, count, num_envs = self.step.shape

        def leaf(x: chex.Array) -> chex.Array:
            rows = x[self.step, jnp.arange(num_envs, dtype=jnp.int32)[None, None]]
            return rows.reshape(width, count * num_envs, *x.shape[2:])

        return jax.tree.map(leaf, tree)

    def join(self, tree: Any) -> Any:
        """Leaves (W, K * E, ...) -> (T, E, ...): the inverse of `split`."""
        width, count, num_envs = self.step.shape

        def leaf(x: chex.Array) -> chex.Array:
            rows = x.reshape(width, count, num_envs, *x.shape[2:])
            return rows[self.place, self.window, jnp.arange(num_envs, dtype=jnp.int32)[None]]

        return jax.tree.map(leaf, tree)


def windows(begins: chex.Array, gap: int) -> Windows:
    """Windows that start at the first step of `begins` at or after each so many gaps.

    Args:
      begins: (T, E) bool: memory is constant before the step. It is before the first one, and
        before at least one of any `gap` steps in a row.
    """
    length, num_envs = begins.shape
    shortest = min(GAPS_IN_WINDOW * gap, length)
    width = min(shortest + gap - 1, length)
    steps, lanes = (jnp.arange(n, dtype=jnp.int32) for n in (length, num_envs))
    following = jax.lax.cummin(jnp.where(begins, steps[:, None], length), reverse=True)
    starts = following[::shortest]  # (K, E)
    step = jnp.minimum(jnp.arange(width, dtype=jnp.int32)[:, None, None] + starts[None], length - 1)
    window = (starts[None] <= steps[:, None, None]).sum(1, dtype=jnp.int32) - 1
    place = steps[:, None] - starts[window, lanes[None]]
    return Windows(step=step, window=window, place=place)
