"""The verbs of a grid: place distinct cells, move, one-hot a position, look through a window.

Cells are (row, column) pairs, row 0 at the top; the flat index of a cell is row * columns + column.
Source of the rules: IC3Net's Predator-Prey (section 4 of its paper and its published program).
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np

UP, RIGHT, DOWN, LEFT, STAY, CAPTURE = range(6)

OUTSIDE = -1.0
"""What a window shows in every channel where it reaches over the edge of the grid."""


def grid_size(size: int | tuple[int, int]) -> tuple[int, int]:
    """`size` as (rows, columns): an int is the side of a square grid."""
    return (size, size) if isinstance(size, int) else (size[0], size[1])


def place_distinct(key: chex.PRNGKey, count: int, size: tuple[int, int]) -> chex.Array:
    """(count, 2) int32 distinct cells, every ordered choice equally likely.

    A Fisher-Yates shuffle of the flat cells that is never written down: draw k picks a slot in
    k..cells-1, and only the slots that an earlier draw swapped hold something other than
    themselves, so walking the earlier swaps backwards finds the cell. `count` draws and
    `count - 1` vector operations, whatever the grid's size.
    """
    rows, columns = size
    order = jnp.arange(count)
    slot = jax.random.randint(key, (count,), order, rows * columns)
    cell = slot
    for earlier in reversed(range(count - 1)):
        cell = jnp.where((cell == slot[earlier]) & (order > earlier), earlier, cell)
    return jnp.stack([cell // columns, cell % columns], axis=-1).astype(jnp.int32)


def move(position: chex.Array, action: chex.Array, size: tuple[int, int]) -> chex.Array:
    """(..., 2) cells after one action each; walking into the border is staying.

    Every action but the four directions, known or not, leaves the cell as it is.
    """
    down = (action == DOWN).astype(jnp.int32) - (action == UP)
    right = (action == RIGHT).astype(jnp.int32) - (action == LEFT)
    limit = jnp.asarray(size, jnp.int32) - 1
    return jnp.clip(position + jnp.stack([down, right], axis=-1), 0, limit)


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
    cell = position[:, None, None, :] + window_offsets(vision)
    return ((cell < 0) | (cell >= jnp.asarray(size, jnp.int32))).any(-1)


def window_count(position: chex.Array, entities: chex.Array, vision: int) -> chex.Array:
    """(N, m, m) float32: how many of the (M, 2) `entities` stand on each window cell.

    Counts are not clipped to one, and an agent that is one of the entities counts itself.
    """
    side = 2 * vision + 1
    relative = entities[None, :, :] - position[:, None, :] + vision  # (N, M, 2)
    seen = ((relative >= 0) & (relative < side)).all(-1)
    window_cell = jnp.where(seen, relative[..., 0] * side + relative[..., 1], -1)  # (N, M)
    hits = window_cell[..., None] == jnp.arange(side * side)
    return hits.sum(1).astype(jnp.float32).reshape(-1, side, side)
