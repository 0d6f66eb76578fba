"""State tensors by what is not zero in them: memory grows with the cells, not with their square."""

from dataclasses import dataclass

import numpy as np

from sumajax.environments.types import Environment


@dataclass(frozen=True, eq=False)
class SparseStates:
    """S state tensors of a shape (channels, rows, columns), at most M entries of each not zero.

    Raises:
      ValueError: for arrays of other shapes, or a cell outside a state tensor.
    """

    cell: np.ndarray  # (S, M) int32: channel * rows * columns + row * columns + column
    value: np.ndarray  # (S, M) float32: what is there; 0 fills up
    shape: tuple[int, int, int]  # (channels, rows, columns) of one state tensor

    def __post_init__(self) -> None:
        if np.ndim(self.cell) != 2 or np.shape(self.cell) != np.shape(self.value):
            raise ValueError(
                "cell and value of sparse states have one shape (states, entries), got "
                f"{np.shape(self.cell)} and {np.shape(self.value)}."
            )
        if self.cell.size and not 0 <= self.cell.min() <= self.cell.max() < np.prod(self.shape):
            raise ValueError(
                f"cells of sparse states of shape {self.shape} lie in 0..{np.prod(self.shape) - 1},"
                f" got {self.cell.min()}..{self.cell.max()}."
            )

    def __len__(self) -> int:
        """S."""
        return len(self.cell)

    @classmethod
    def of(cls, states: np.ndarray) -> "SparseStates":
        """Those of dense state tensors (S, channels, rows, columns)."""
        flat = np.asarray(states, np.float32).reshape(len(states), -1)
        state, cell = np.nonzero(flat)
        count = np.bincount(state, minlength=len(flat))
        place = np.arange(len(state)) - np.repeat(np.cumsum(count) - count, count)
        sparse = np.zeros((2, len(flat), count.max(initial=0)), np.int32)
        sparse[0, state, place] = cell
        value = np.zeros(sparse.shape[1:], np.float32)
        value[state, place] = flat[state, cell]
        return cls(sparse[0], value, np.shape(states)[1:])

    def dense(self) -> np.ndarray:
        """(S, channels, rows, columns) float32."""
        flat = np.zeros((len(self), int(np.prod(self.shape))), np.float32)
        # What fills up adds 0 to a cell that may be another entry's.
        np.add.at(flat, (np.arange(len(self))[:, None], self.cell), self.value)
        return flat.reshape(len(self), *self.shape)

    def moved(self, cell: np.ndarray, parts: int, shape: tuple[int, int, int]) -> "SparseStates":
        """Each entry at (S, M, K) other cells of tensors of `shape`, divided by `parts`."""
        value = np.broadcast_to(self.value[..., None] / np.float32(parts), cell.shape)
        return SparseStates(cell.reshape(len(self), -1), value.reshape(len(self), -1), shape)

    def places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(S, M) int32 each: channel, row and column of every entry."""
        channel, row, column = np.unravel_index(self.cell, self.shape)
        return channel, row, column


def one_hot_states(shape: tuple[int, int]) -> SparseStates:
    """One state per cell of a grid (rows, columns), by flat index: 1 there, 0 elsewhere."""
    cells = np.arange(shape[0] * shape[1], dtype=np.int32)[:, None]
    return SparseStates(cells, np.ones(cells.shape, np.float32), (1, *shape))


def listed_states(env: Environment) -> SparseStates | None:
    """Every state tensor that `env` can show, by `state_index`; None where it cannot list them.

    From `sparse_states` where the task has it, else from `state_table`. A class that overrides only
    the table of the class it derives from means the table.
    """
    if goes_with(type(env), "sparse_states", "state_table"):
        sparse: SparseStates | None = env.sparse_states()  # type: ignore[attr-defined]
        return sparse
    table = env.state_table()
    return None if table is None else SparseStates.of(np.asarray(table))


def goes_with(cls: type, optional: str, required: str) -> bool:
    """Whether `cls` has a function `optional` that is of the class that defines `required`, or of
    one derived from it: where only `required` is defined anew, the other no longer says the same.
    """
    defines = [vars(base) for base in cls.__mro__]
    return any(
        optional in names and not any(required in newer for newer in defines[:place])
        for place, names in enumerate(defines)
    )
