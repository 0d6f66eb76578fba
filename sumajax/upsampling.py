"""State upsampling: the operator phi and the task that it makes (paper sections IV-A and IV-B)."""

from dataclasses import dataclass
from typing import Any, Literal, get_args

import chex
import jax.numpy as jnp
import numpy as np

from sumajax.environments.grid import grid_size, plain_size
from sumajax.environments.states import SparseStates, listed_states
from sumajax.environments.types import Observation
from sumajax.environments.wrapper import Wrapper
from sumajax.plain import plain_fields

Scale = Literal["none", "mass"]
Fill = Literal["blocks", "corner"]
"""How a small state fills a large one."""


def upsample(state: chex.Array, factor: int | tuple[int, int]) -> chex.Array:
    """Nearest-neighbour upsampling: (..., p, p) -> (..., p*f, p*f), each cell a block of its value.

    Args:
      state: (..., rows, columns).
      factor: f >= 1 for both axes, or (row factor, column factor).

    Raises:
      ValueError: when the factor is not one or two positive whole numbers.

    Source: paper section IV-A, the operator phi.
    """
    down, right = grid_size(factor, name="the upsampling factor")
    return jnp.repeat(jnp.repeat(state, down, axis=-2), right, axis=-1)


@dataclass(frozen=True)
class StateUpsampled(Wrapper):
    """A task seen at another task's size: the SUMA-POMDP of paper section IV-B.

    N, O, A, T, r and gamma are those of `env`, any task; only the state tensor grows, each of its
    channels, from `env`'s grid to `size`. With `scale="mass"` a block sums to what its cell held
    (1/f^2 each), otherwise, as in the paper, each of its cells holds that value.

    With `fill="corner"` nothing is upsampled: the small state stands as it is in the first rows and
    columns of the large one, zeros around it. It is the control that tells what upsampling adds to
    a mere fit of the shapes.

    Raises:
      ValueError: when `size` is no size, or no whole multiple of the grid of `env`.
    """

    size: int | tuple[int, int]
    scale: Scale = "none"
    fill: Fill = "blocks"

    def __post_init__(self) -> None:
        plain_fields(self)
        object.__setattr__(self, "size", plain_size(self.size))
        for name, choices in (("scale", get_args(Scale)), ("fill", get_args(Fill))):
            value = getattr(self, name)
            if value not in choices:
                raise ValueError(
                    f"{name} {value!r} is unknown; choose one of {', '.join(choices)}."
                )
        rows, columns = grid_size(self.size)
        source_rows, source_columns = self.env.state_shape[1:]
        if rows % source_rows or columns % source_columns:
            raise ValueError(
                f"the target size {rows}x{columns} is not a whole multiple of the source size "
                f"{source_rows}x{source_columns}; choose sides that divide."
            )

    @property
    def factor(self) -> tuple[int, int]:
        """(row factor, column factor)."""
        rows, columns = grid_size(self.size)
        return rows // self.env.state_shape[1], columns // self.env.state_shape[2]

    @property
    def state_shape(self) -> tuple[int, int, int]:
        return (self.env.state_shape[0], *grid_size(self.size))

    def observe(self, state: Any) -> Observation:
        seen = self.env.observe(state)
        return seen.replace(state=self._transform(seen.state))  # type: ignore[attr-defined]

    def state_table(self) -> chex.Array | None:
        table = self.env.state_table()
        return None if table is None else self._transform(table)

    def sparse_states(self) -> SparseStates | None:
        small = listed_states(self.env)
        if small is None:
            return None
        channel, row, column = (place[..., None] for place in small.places())
        _, rows, columns = self.state_shape
        down, right = (1, 1) if self.fill == "corner" else self.factor
        block = np.arange(down * right)
        row, column = row * down + block // right, column * right + block % right
        cell = ((channel * rows + row) * columns + column).astype(np.int32)
        parts = down * right if self.scale == "mass" else 1
        return small.moved(cell, parts, self.state_shape)

    def _transform(self, state: chex.Array) -> chex.Array:
        if self.fill == "corner":
            around = [(0, n - m) for n, m in zip(self.state_shape, state.shape[-3:], strict=True)]
            return jnp.pad(state, [(0, 0)] * (state.ndim - 3) + around)
        large = upsample(state, self.factor)
        return large / (self.factor[0] * self.factor[1]) if self.scale == "mass" else large
