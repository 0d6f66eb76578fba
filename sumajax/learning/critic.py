"""A critic of its own, that is shown the true state.

A critic is needed while a policy is trained and never afterwards, so it need not make do with what
the agents know: `critic_features` of the task shows it where everything is, and `memory` of the
policy what each agent remembers. It shares no parameter with the policy, which stays as it was
brought while the critic learns a new task.

Source: Pinto et al. 2018 (asymmetric actor-critic); Lowe et al. 2017 (a critic of all agents).
"""

from typing import Any, cast

import chex
import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct

from sumajax.environments.types import Environment
from sumajax.learning.rollout import Actors
from sumajax.policies.layers import Dense
from sumajax.policies.types import Policy

HIDDEN = 64
"""Width of both hidden layers."""


@struct.dataclass
class CriticState:
    """What there is of a critic in training."""

    params: Any
    opt_state: Any


class StateCritic(nn.Module):
    """Two hidden layers, the same for every agent, so that its parameters fit any team and grid."""

    @nn.compact
    def __call__(self, features: chex.Array) -> chex.Array:
        """(..., N, F) of `shown` -> (..., N) float32, expected return of each agent."""
        hidden = nn.tanh(Dense(HIDDEN)(features))
        hidden = nn.tanh(Dense(HIDDEN)(hidden))
        return Dense(1)(hidden)[..., 0]


def check_has_features(env: Environment) -> None:
    """Raises a ValueError for a task that does not say what a critic is shown."""
    if not hasattr(env, "critic_features"):
        raise ValueError(
            f"critic 'state' needs a task that says what a critic is shown, and "
            f"{type(env).__name__} has no critic_features; use critic 'policy'."
        )


def init_critic(env: Environment, policy: Policy, actors: Actors, key: chex.PRNGKey) -> CriticState:
    """A fresh critic for such `actors`."""
    like = jax.eval_shape(lambda: shown(env, policy, actors))
    params = StateCritic().init(key, jnp.zeros(like.shape, like.dtype))
    return CriticState(params, optimiser().init(params))


def optimiser() -> optax.GradientTransformation:
    """Adam, before the rate: its steps have one size whatever the scale of the returns."""
    return optax.flatten(optax.scale_by_adam())


def values(env: Environment, policy: Policy, params: Any, actors: Actors) -> chex.Array:
    """(B, N) of actors with leaves (B, ...)."""
    return cast(chex.Array, StateCritic().apply(params, shown(env, policy, actors)))


def shown(env: Environment, policy: Policy, actors: Actors) -> chex.Array:
    """(B, N, F) all that a critic reads; no gradient goes back into the agents' memory."""
    features = jax.vmap(env.critic_features)(actors.env_state)  # type: ignore[attr-defined]
    chex.assert_rank(features, 3)
    memory = jax.lax.stop_gradient(policy.module.memory(actors.carry))
    return features if memory is None else jnp.concatenate([features, memory], axis=-1)
