"""The contract between policies and everything that uses them.

A policy is a Flax Linen module (`PolicyModule`) that says how one team step is computed; `Policy`
pairs it with the task's shapes and is what users and the learner hold. All parameters are shared by
the agents of a class and none depends on how many there are: the same parameters act for any N.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import struct

from sumajax.environments.types import Environment, Observation
from sumajax.policies.layers import lift
from sumajax.precision import stated_precision
from sumajax.records import exportable

FOLDED = "folded"
"""Name of the variables that `Policy.prepare` adds to the parameters."""
MASKED_LOGIT = -1e9
"""Logit of an action that an agent's class does not have: probability exactly 0 in float32."""


@exportable
@struct.dataclass
class Decision:
    """One sampled choice per agent, kept with what it was sampled from."""

    logits: chex.Array  # (..., N, K) float32, unnormalised log-probabilities
    choice: chex.Array  # (..., N) int32 in 0..K-1


@exportable
@struct.dataclass
class PolicyOutput:
    """What a team decided in one step."""

    decisions: dict[str, Decision]  # "action", and whatever else is learnt by policy gradient
    value: chex.Array  # (..., N) float32: expected return of each agent
    communication: (
        chex.Array
    )  # (..., N) float32 in [0, 1]: share of its means an agent used to talk
    attention: chex.Array  # (..., N, N) float32: weight of sender j (column) at receiver i (row)

    @property
    def action(self) -> chex.Array:
        """(..., N) int32."""
        return self.decisions["action"].choice

    @property
    def logits(self) -> chex.Array:
        """(..., N, num_actions) float32 of the action."""
        return self.decisions["action"].logits


@dataclass(frozen=True)
class TeamSpec:
    """The shapes and classes of a task, as hashable constants a policy is built from."""

    agent_class: tuple[int, ...]  # per agent
    sighted_classes: tuple[bool, ...]  # per class
    num_actions: int
    action_mask: tuple[tuple[bool, ...], ...]  # (N, num_actions)
    state_shape: tuple[int, int, int]  # (1, rows, columns)
    view_shape: tuple[int, int, int]  # (c, m, m)

    @classmethod
    def of(cls, env: Environment) -> "TeamSpec":
        return cls(
            agent_class=tuple(env.agent_class.tolist()),
            sighted_classes=env.sighted_classes,
            num_actions=env.num_actions,
            action_mask=tuple(tuple(row) for row in env.action_mask.tolist()),
            state_shape=env.state_shape,
            view_shape=env.view_shape,
        )

    @property
    def num_agents(self) -> int:
        return len(self.agent_class)

    @property
    def sighted(self) -> np.ndarray:
        """(N,) bool."""
        return np.array([self.sighted_classes[c] for c in self.agent_class], bool)

    def class_size(self, agent_class: int) -> int:
        return self.agent_class.count(agent_class)


class PolicyModule(nn.Module, ABC):
    """What a policy file implements. `...` stands for any batch axes, usually E environments."""

    team: TeamSpec

    @abstractmethod
    def encode_states(self, states: chex.Array) -> chex.Array:
        """(S, 1, rows, columns) state tensors -> (S, F) features, whatever `__call__` expects."""

    def fold(self) -> dict[str, Any]:
        """Products of weights that every step needs and that are the same at each, if any."""
        return {}

    def folded(self) -> dict[str, Any]:
        """What `fold` returns: as it was prepared for many steps, or anew."""
        prepared = self.variables.get(FOLDED)
        return self.fold() if prepared is None else dict(prepared)

    @abstractmethod
    def __call__(
        self, carry: Any, state_features: chex.Array, view: chex.Array, noise: Any
    ) -> tuple[Any, PolicyOutput]:
        """One team step.

        Args:
          carry: what the agents remember, from `initial_carry` or the step before.
          state_features: (..., N, F) rows of `encode_states`.
          view: (..., N, c, m, m).
          noise: from `sample_noise`; all zeros make every choice greedy.
        """

    @abstractmethod
    def initial_carry(self, batch_shape: tuple[int, ...]) -> Any:
        """Memory at the start of an episode, leading axes `batch_shape`."""

    @abstractmethod
    def sample_noise(self, key: chex.PRNGKey, batch_shape: tuple[int, ...]) -> Any:
        """All the random numbers of `__call__`, so that a rollout can draw them in one go."""

    def encode_and_step(self, carry: Any, obs: Observation, noise: Any) -> tuple[Any, PolicyOutput]:
        """`__call__` on the state tensors themselves: the direct path, for any state."""
        flat = jnp.reshape(obs.state, (-1, *obs.state.shape[-3:]))
        features = self.encode_states(flat).reshape(*obs.state.shape[:-3], -1)
        return self(carry, features, obs.view, noise)


@dataclass(frozen=True)
class Policy:
    """A named policy for a task; all methods are pure and can be traced."""

    name: str
    module: PolicyModule

    @property
    def team(self) -> TeamSpec:
        return self.module.team

    def shaped_for(self, env: Environment) -> "Policy":
        """This policy for another task or team, with the same settings; parameters still fit."""
        return Policy(self.name, self.module.clone(team=TeamSpec.of(env)))

    def init(self, key: chex.PRNGKey) -> Any:
        """Fresh parameters."""
        team = self.team
        obs = Observation(
            state=jnp.zeros((team.num_agents, *team.state_shape), jnp.float32),
            view=jnp.zeros((team.num_agents, *team.view_shape), jnp.float32),
        )
        draws = jax.eval_shape(lambda: self.sample_noise(key, ()))  # the key is for `init` alone
        noise = jax.tree.map(lambda draw: jnp.zeros(draw.shape, draw.dtype), draws)
        return self.module.init(
            key, self.initial_carry(), obs, noise, method=self.module.encode_and_step
        )

    def initial_carry(self, batch_shape: tuple[int, ...] = ()) -> Any:
        """Memory at the start of an episode."""
        return self.module.initial_carry(batch_shape)

    def apply(
        self, params: Any, carry: Any, obs: Observation, key: chex.PRNGKey
    ) -> tuple[Any, PolicyOutput]:
        """One team step: obs.state (..., N, 1, rows, columns), obs.view (..., N, c, m, m)."""
        return self.apply_with(params, carry, obs, self.sample_noise(key, obs.view.shape[:-4]))

    @stated_precision
    def apply_with(
        self, params: Any, carry: Any, obs: Observation, noise: Any
    ) -> tuple[Any, PolicyOutput]:
        """`apply` with given random numbers; all zeros make every choice the likeliest."""
        chex.assert_shape(obs.state, (..., *self.team.state_shape))
        chex.assert_shape(obs.view, (..., *self.team.view_shape))
        step = self.module.apply(params, carry, obs, noise, method=self.module.encode_and_step)
        return cast(tuple[Any, PolicyOutput], step)

    @stated_precision
    def encode_states(self, params: Any, states: chex.Array) -> chex.Array:
        """(S, 1, rows, columns) -> (S, F), for `step`; cheapest for a NumPy array."""
        return self.module.apply(params, states, method=self.module.encode_states)

    @stated_precision
    def prepare(self, params: Any) -> Any:
        """The parameters with all that does not change from step to step worked out, for `step`."""
        folded = self.module.apply(params, method=self.module.fold)
        return {**params, FOLDED: folded} if folded else params

    @stated_precision
    def step(
        self, params: Any, carry: Any, state_features: chex.Array, view: chex.Array, noise: Any
    ) -> tuple[Any, PolicyOutput]:
        """`apply` with the state already encoded and the random numbers already drawn."""
        step = self.module.apply(params, carry, state_features, view, noise)
        return cast(tuple[Any, PolicyOutput], step)

    def sample_noise(self, key: chex.PRNGKey, batch_shape: tuple[int, ...]) -> Any:
        """The random numbers of `batch_shape` steps."""
        return self.module.sample_noise(key, batch_shape)


def decide(logits: chex.Array, gumbel: chex.Array) -> Decision:
    """A categorical sample by the Gumbel-max trick; zero noise takes the likeliest choice."""
    choice = jnp.argmax(jax.lax.stop_gradient(logits) + gumbel, axis=-1)
    return Decision(logits=logits, choice=choice.astype(jnp.int32))


def mask_actions(logits: chex.Array, team: TeamSpec) -> chex.Array:
    """(..., N, num_actions) logits with the actions an agent does not have at `MASKED_LOGIT`."""
    mask = np.array(team.action_mask)
    return logits if mask.all() else jnp.where(lift(mask, logits.ndim), logits, MASKED_LOGIT)
