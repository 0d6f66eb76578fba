"""The verbs of a grid: place distinct cells, move, one-hot a position, look through a window.

Cells are (row, column) pairs, row 0 at the top; the flat index of a cell is row * columns + column.
Source of the rules: IC3Net's Predator-Prey (section 4 of its paper and its published program).
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from sumajax.plain import plain

UP, RIGHT, DOWN, LEFT, STAY, CAPTURE = range(6)

OUTSIDE = -1
"""What a window shows in every channel where it reaches over the edge of the grid."""

MAX_SIDE = 2**14 - 1
"""Cells along a side: `_number` tells the cells of a window apart up to there."""

NOWHERE = -(2**14)
"""Row and column of a cell that no window reaches, to fill up a list of entities."""


def grid_size(size: int | tuple[int, int], name: str = "size") -> tuple[int, int]:
    """`size` as (rows, columns): one number is the side of a square grid.

    Raises:
      ValueError: for anything but one or two positive whole numbers.
    """
    given = plain(size)
    given = given.tolist() if isinstance(given, np.ndarray) else given
    sides = tuple(given) if isinstance(given, (tuple, list)) else (given, given)
    whole = all(isinstance(side, int) and not isinstance(side, bool) for side in sides)
    if not whole or len(sides) != 2 or min(sides) < 1:
        raise ValueError(f"{name} must be a positive int or (rows, columns), got {size!r}.")
    return sides[0], sides[1]


def plain_size(size: int | tuple[int, int]) -> int | tuple[int, int]:
    """A checked size that compares, hashes and prints alike, whichever kind of numbers it had."""
    rows, columns = grid_size(size)
    return rows if isinstance(plain(size), int) else (rows, columns)


def place_distinct(key: chex.PRNGKey, count: int, size: tuple[int, int]) -> chex.Array:
    """(count, 2) int32 distinct cells, every ordered choice equally likely.

    A Fisher-Yates shuffle of the flat cells that is never written down: draw k picks a slot in
    k..cells-1, and only the slots that an earlier draw swapped hold something other than
    themselves, so walking the earlier swaps backwards finds the cell. `count` draws and
    `count - 1` vector operations, whatever the grid's size.
    """
    rows, columns = size
    order = np.arange(count, dtype=np.uint32)
    # `random.randint` would draw twice as many bits. Whole multiples of 8 vectorise.
    bits = jax.random.bits(key, (-(-count // 8) * 8,), jnp.uint32)[:count]
    slot = order + scale_to_range(bits, np.uint32(rows * columns) - order)
    cell = slot
    for earlier in reversed(range(count - 1)):
        cell = jnp.where((cell == slot[earlier]) & (order > earlier), np.uint32(earlier), cell)
    row = cell // columns
    return jnp.stack([row, cell - row * columns], axis=-1).astype(jnp.int32)


def scale_to_range(bits: chex.Array, bound: ArrayLike) -> chex.Array:
    """floor(bits * bound / 2**32), uint32: random bits as draws from 0..bound-1.

    Exact, from products of 16-bit halves because 64-bit integers are off by default. The
    probabilities of two draws differ by at most one part in 2**32 / bound.
    """
    bound = jnp.asarray(bound, jnp.uint32)
    high, low = bits >> 16, bits & 0xFFFF
    bound_high, bound_low = bound >> 16, bound & 0xFFFF
    middle = high * bound_low + ((low * bound_low) >> 16)
    return high * bound_high + (middle >> 16) + ((low * bound_high + (middle & 0xFFFF)) >> 16)


def move(position: chex.Array, action: chex.Array, size: tuple[int, int]) -> chex.Array:
    """(..., 2) cells after one action each; walking into the border is staying.

    Every action but the four directions, known or not, leaves the cell as it is.
    """
    down, up, right, left = (
        (action == way).astype(position.dtype) for way in (DOWN, UP, RIGHT, LEFT)
    )
    row = position[..., 0] + down - up
    column = position[..., 1] + right - left
    return jnp.stack([jnp.clip(row, 0, size[0] - 1), jnp.clip(column, 0, size[1] - 1)], axis=-1)


def cell_index(position: chex.Array, size: tuple[int, int]) -> chex.Array:
    """(...,) flat index of (..., 2) cells."""
    return position[..., 0] * size[1] + position[..., 1]


def one_hot_cells(size: tuple[int, int]) -> chex.Array:
    """(cells, 1, rows, columns) float32: the one-hot state tensor of every cell, by flat index."""
    rows, columns = size
    return jnp.eye(rows * columns, dtype=jnp.float32).reshape(rows * columns, 1, rows, columns)


def one_hot_position(position: chex.Array, size: tuple[int, int]) -> chex.Array:
    """(..., 1, rows, columns) float32: one at the cell of each (..., 2) position."""
    flat = jax.nn.one_hot(cell_index(position, size), size[0] * size[1], dtype=jnp.float32)
    return flat.reshape(*position.shape[:-1], 1, *size)


def window_offsets(vision: int) -> np.ndarray:
    """(m, m, 2) int32: what to add to an agent's cell to get each cell of its window."""
    reach = np.arange(-vision, vision + 1, dtype=np.int32)
    return np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1)


def window_outside(position: chex.Array, vision: int, size: tuple[int, int]) -> chex.Array:
    """(N, m, m) bool: cells of each agent's window that lie outside the grid."""
    reach = jnp.arange(-vision, vision + 1, dtype=jnp.int32)
    row = position[:, 0, None, None] + reach[None, :, None]
    column = position[:, 1, None, None] + reach[None, None, :]
    return (row < 0) | (row >= size[0]) | (column < 0) | (column >= size[1])


def window_count(position: chex.Array, entities: chex.Array, vision: int) -> chex.Array:
    """(N, c, m, m) int32: how many entities of each class stand on each cell of a window.

    Args:
      position: (N, 2) cells at the centres of the windows.
      entities: (c, M, 2) cells of each class, filled up with `NOWHERE`.
      vision: the window's side is m = 2 vision + 1.

    Counts are not clipped to one, and an agent that is one of the entities counts itself.
    """
    reach = jnp.arange(-vision, vision + 1, dtype=jnp.int32)
    offset = reach[:, None] * _ROW + reach[None]
    window = _number(position)[:, None, None] + offset[None]  # (N, m, m)
    # One elementwise comparison and one sum for all classes: several arrays put together, or a
    # choice between them, cost XLA's CPU code more than the counting.
    cell = _number(entities)[None, :, :, None, None]
    hits = window[:, None, None] == cell  # (N, c, M, m, m)
    return hits.sum(2, dtype=jnp.int32)


_ROW = 2**16


def _number(cell: chex.Array) -> chex.Array:
    """(...,) int32 that differ where the (..., 2) cells do, also those outside the grid.

    The number of a sum is the sum of the numbers, as long as sides stay below 2**14.
    """
    return cell[..., 0] * _ROW + cell[..., 1]
