"""The check of a team's actions that every domain does."""

from typing import Protocol

import chex
import jax
import jax.numpy as jnp
import numpy as np


class Team(Protocol):
    """What is known of those who act."""

    @property
    def num_agents(self) -> int: ...

    @property
    def num_actions(self) -> int: ...


def is_traced(*arrays: chex.Array) -> bool:
    """Whether any value is not known yet, because a program is being made of it."""
    return any(isinstance(array, jax.core.Tracer) for array in arrays)


def checked_actions(env: Team, actions: chex.Array) -> chex.Array:
    """(N,) int32 actions as an array; concrete values are looked at, traced ones cannot be.

    Raises:
      ValueError: for a concrete action out of range, a wrong shape or no whole numbers.
    """
    actions = jnp.asarray(actions)
    if actions.shape != (env.num_agents,):
        raise ValueError(
            f"step needs one action per agent, shape ({env.num_agents},), got {actions.shape}."
        )
    if not jnp.issubdtype(actions.dtype, jnp.integer):
        raise ValueError(f"actions are whole numbers, got an array of {actions.dtype}.")
    if not is_traced(actions):
        wrong = (np.asarray(actions) < 0) | (np.asarray(actions) >= env.num_actions)
        if wrong.any():
            raise ValueError(
                f"action {np.asarray(actions)[wrong][0]} of agent {int(wrong.argmax())} is not one "
                f"of the {env.num_actions} actions 0..{env.num_actions - 1}."
            )
    return actions
