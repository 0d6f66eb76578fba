"""A rival of state upsampling that is a task: nobody is told where it stands."""

from dataclasses import dataclass
from typing import Any

import chex
import jax.numpy as jnp
import numpy as np

from sumajax.environments.states import SparseStates
from sumajax.environments.types import Observation
from sumajax.environments.wrapper import Wrapper


@dataclass(frozen=True)
class BlankState(Wrapper):
    """A task whose state tensors are one empty cell, whatever its grid: what views and messages
    carry alone. A policy of it fits every grid.
    """

    @property
    def state_shape(self) -> tuple[int, int, int]:
        return (self.env.state_shape[0], 1, 1)

    def observe(self, state: Any) -> Observation:
        seen = self.env.observe(state)
        blank = jnp.zeros((*seen.state.shape[:-2], 1, 1), seen.state.dtype)
        return seen.replace(state=blank)  # type: ignore[attr-defined]

    def state_table(self) -> chex.Array | None:
        """As many rows as the task has cells: how many there are is how large the task is."""
        table = self.env.state_table()
        return None if table is None else jnp.zeros((*table.shape[:-2], 1, 1), table.dtype)

    def sparse_states(self) -> SparseStates | None:
        table = self.state_table()
        if table is None:
            return None
        nothing = np.zeros((len(table), 1))
        return SparseStates(nothing.astype(np.int32), nothing.astype(np.float32), self.state_shape)
