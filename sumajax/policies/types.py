"""The contract between policies and everything that uses them.

A policy is a Flax Linen module (`PolicyModule`) that says how one team step is computed; `Policy`
pairs it with the task's shapes and is what users and the learner hold. All parameters are shared by
the agents of a class and none depends on how many there are: the same parameters act for any N.
"""

import inspect
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any, ClassVar, cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import struct

from sumajax.environments.states import SparseStates, goes_with
from sumajax.environments.types import Environment, Observation, agents_leave
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
    )  # (..., N) float32 in [0, 1]: share of its means an agent used to talk in this step
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
    state_shape: tuple[int, int, int]  # (C, rows, columns)
    view_shape: tuple[int, int, int]  # (c, m, m)
    agents_leave: bool = False  # within an episode; others may take their places

    @classmethod
    def of(cls, env: Environment) -> "TeamSpec":
        return cls(
            agent_class=tuple(env.agent_class.tolist()),
            sighted_classes=env.sighted_classes,
            num_actions=env.num_actions,
            action_mask=tuple(tuple(row) for row in env.action_mask.tolist()),
            state_shape=env.state_shape,
            view_shape=env.view_shape,
            agents_leave=agents_leave(env),
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

    critic_parameters: ClassVar[frozenset[str]] = frozenset()
    """Names of modules and parameters that nothing but the value depends on: what can learn while
    the policy stays as it is (`LearnerConfig.critic_epochs`). Where none are named all parameters
    learn from the start."""

    @abstractmethod
    def encode_states(self, states: chex.Array) -> chex.Array:
        """(S, C, rows, columns) state tensors -> (S, F) features, whatever `__call__` expects.

        A module that defines `encode_listed(states)` beside it is given the `SparseStates` that a
        task lists as they are, and others what they stand for: of a large grid, the square of its
        cells.
        """

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

        Where `team.agents_leave`, a step has one more argument, `alive` (..., N) bool: who is not
        there neither speaks nor hears, whatever else is computed for its place.
        """

    @abstractmethod
    def initial_carry(self, batch_shape: tuple[int, ...]) -> Any:
        """Memory at the start of an episode, leading axes `batch_shape`."""

    @abstractmethod
    def sample_noise(self, key: chex.PRNGKey, batch_shape: tuple[int, ...]) -> Any:
        """All the random numbers of `__call__`, so that a rollout can draw them in one go."""

    def memory(self, carry: Any) -> chex.Array | None:
        """(..., N, H) float32: what each agent remembers, for a critic of its own
        (`learning.critic`); None where it is not said."""
        return None

    def encode_and_step(self, carry: Any, obs: Observation, noise: Any) -> tuple[Any, PolicyOutput]:
        """`__call__` on the state tensors themselves: the direct path, for any state."""
        flat = jnp.reshape(obs.state, (-1, *obs.state.shape[-3:]))
        features = self.encode_states(flat).reshape(*obs.state.shape[:-3], -1)
        return self(carry, features, obs.view, noise, *who_is_there(self, obs.alive))


def who_is_there(module: PolicyModule, alive: chex.Array | None) -> tuple[chex.Array, ...]:
    """`alive` as further arguments of a step: none where nobody ever leaves.

    Raises:
      ValueError: where agents leave, and nothing says who is there or the module does not ask.
    """
    if not module.team.agents_leave:
        return ()
    name = type(module).__name__
    if "alive" not in inspect.signature(type(module).__call__).parameters:
        raise ValueError(
            f"agents of this task come and go, but {name} has no argument `alive`; "
            f"give {name}.__call__ one, (..., N) bool."
        )
    if alive is None:
        raise ValueError(
            "agents of this task come and go, but nothing says who is there: "
            "set `alive` of the observation, (..., N) bool."
        )
    return (alive,)


@dataclass(frozen=True)
class Policy:
    """A named policy for a task; all methods are pure and can be traced."""

    name: str
    module: PolicyModule

    @property
    def team(self) -> TeamSpec:
        return self.module.team

    @property
    def fresh_memory(self) -> bool:
        """Whether an agent that takes another's place starts without its memory."""
        return bool(getattr(self.module, "fresh_memory", False))

    def shaped_for(self, env: Environment) -> "Policy":
        """This policy for another task or team, with the same settings; parameters still fit."""
        return Policy(self.name, self.module.clone(team=TeamSpec.of(env)))

    def init(self, key: chex.PRNGKey) -> Any:
        """Fresh parameters."""
        team = self.team
        obs = Observation(
            state=jnp.zeros((team.num_agents, *team.state_shape), jnp.float32),
            view=jnp.zeros((team.num_agents, *team.view_shape), jnp.float32),
            alive=jnp.ones(team.num_agents, bool) if team.agents_leave else None,
            entered=jnp.zeros(team.num_agents, bool) if team.agents_leave else None,
        )
        return self.module.init(
            key,
            self.initial_carry(),
            obs,
            self.greedy_noise(),
            method=self.module.encode_and_step,
        )

    def initial_carry(self, batch_shape: tuple[int, ...] = ()) -> Any:
        """Memory at the start of an episode."""
        return self.module.initial_carry(batch_shape)

    def apply(
        self, params: Any, carry: Any, obs: Observation, key: chex.PRNGKey
    ) -> tuple[Any, PolicyOutput]:
        """One team step: obs.state (..., N, C, rows, columns), obs.view (..., N, c, m, m)."""
        return self.apply_with(params, carry, obs, self.sample_noise(key, obs.view.shape[:-4]))

    @stated_precision
    def apply_with(
        self, params: Any, carry: Any, obs: Observation, noise: Any
    ) -> tuple[Any, PolicyOutput]:
        """`apply` with given random numbers; all zeros make every choice the likeliest.

        Raises:
          ValueError: where newcomers have no memory, and nothing says who has come.
        """
        chex.assert_shape(obs.state, (..., *self.team.state_shape))
        chex.assert_shape(obs.view, (..., *self.team.view_shape))
        if self.team.agents_leave and self.fresh_memory:
            carry = self.handed_on(carry, obs.entered)
        step = self.module.apply(params, carry, obs, noise, method=self.module.encode_and_step)
        return cast(tuple[Any, PolicyOutput], step)

    def handed_on(self, carry: Any, entered: chex.Array | None) -> Any:
        """What the agents go into a step with, of what was remembered in their places before.

        Args:
          entered: (..., N) bool: has come with the step before.

        Raises:
          ValueError: where newcomers have no memory, and nothing says who has come.
        """
        if not self.fresh_memory:
            return carry
        if entered is None:
            raise ValueError(
                f"policy {self.name!r} starts newcomers without memory, but nothing says who has "
                "come with the last step: set `entered` of the observation, (..., N) bool."
            )

        def leaf(fresh: chex.Array, kept: chex.Array) -> chex.Array:
            new = jnp.reshape(entered, (*entered.shape, *(1,) * (kept.ndim - entered.ndim)))
            return jnp.where(new, fresh, kept)

        return jax.tree.map(leaf, self.initial_carry(entered.shape[:-1]), carry)

    def only_critic(self, params: Any) -> Any:
        """bool for each leaf of `params`: whether nothing but the value depends on it."""
        names = self.module.critic_parameters

        def leaf(path: tuple[Any, ...], _: Any) -> bool:
            return any(key.key in names for key in path)

        return jax.tree_util.tree_map_with_path(leaf, params)

    @stated_precision
    def encode_states(self, params: Any, states: chex.Array) -> chex.Array:
        """(S, C, rows, columns) -> (S, F), for `step`; cheapest for a NumPy array."""
        return self.module.apply(params, states, method=self.module.encode_states)

    @stated_precision
    def encode_listed(self, params: Any, states: SparseStates) -> chex.Array:
        """(S, F) of the states a task lists, for `step`."""
        if goes_with(type(self.module), "encode_listed", "encode_states"):
            encode_listed = self.module.encode_listed
            return self.module.apply(params, states, method=encode_listed)
        return self.encode_states(params, states.dense())

    @stated_precision
    def prepare(self, params: Any) -> Any:
        """The parameters with all that does not change from step to step worked out, for `step`."""
        folded = self.module.apply(params, method=self.module.fold)
        return {**params, FOLDED: folded} if folded else params

    @stated_precision
    def step(
        self,
        params: Any,
        carry: Any,
        state_features: chex.Array,
        view: chex.Array,
        noise: Any,
        alive: chex.Array | None = None,
    ) -> tuple[Any, PolicyOutput]:
        """`apply` with the state already encoded and the random numbers already drawn."""
        there = who_is_there(self.module, alive)
        step = self.module.apply(params, carry, state_features, view, noise, *there)
        return cast(tuple[Any, PolicyOutput], step)

    def sample_noise(
        self, key: chex.PRNGKey, batch_shape: tuple[int, ...], greedy: chex.Numeric = False
    ) -> Any:
        """The random numbers of `batch_shape` steps.

        Args:
          greedy: those of `greedy_noise` instead; may be traced, so that both share a program.
        """
        noise = self.module.sample_noise(key, batch_shape)
        if greedy is False:
            return noise
        none = self.greedy_noise(batch_shape)
        return jax.tree.map(lambda zero, drawn: jnp.where(greedy, zero, drawn), none, noise)

    def greedy_noise(self, batch_shape: tuple[int, ...] = ()) -> Any:
        """What makes every choice of `batch_shape` steps the likeliest: zeros, of whatever type the
        policy draws."""
        like = jax.eval_shape(lambda: self.module.sample_noise(jax.random.key(0), batch_shape))
        return jax.tree.map(lambda drawn: jnp.zeros(drawn.shape, drawn.dtype), like)

    def check_fits(self, env: Environment) -> None:
        """Whether the policy was made for a team and grid such as that of `env`.

        Raises:
          ValueError: when it was shaped for another task; names what differs, and both values.
        """
        spec = TeamSpec.of(env)
        differ = [
            f"{field.name} {getattr(self.team, field.name)} against {getattr(spec, field.name)}"
            for field in fields(spec)
            if getattr(self.team, field.name) != getattr(spec, field.name)
        ]
        if differ:
            raise ValueError(
                f"the policy was made for another task: {'; '.join(differ)}; call make_policy with "
                "this environment (parameters of the same sizes still fit)."
            )

    def check_step(self, carry: Any, obs: Observation) -> None:
        """Whether `carry` and `obs` are of this policy's team.

        Raises:
          ValueError: for shapes of another team, grid or batch; names both.
        """
        batch, team = obs.view.shape[:-4], self.team
        shapes = {"state": team.state_shape, "view": team.view_shape}
        for name, shape in shapes.items():
            got, expected = jnp.shape(getattr(obs, name)), (*batch, team.num_agents, *shape)
            if got != expected:
                raise ValueError(
                    f"the observation's {name} has shape {got}, but the policy was made for "
                    f"{expected}; call make_policy with the task that is observed (parameters of "
                    "the same sizes still fit)."
                )
        like = jax.eval_shape(lambda: self.initial_carry(batch))
        got, expected = (jax.tree.map(jnp.shape, tree) for tree in (carry, like))
        if got != expected:
            raise ValueError(
                f"the carry has shapes {jax.tree.leaves(got, is_leaf=_is_shape)}, but the policy's "
                f"has {jax.tree.leaves(expected, is_leaf=_is_shape)} for this observation; start "
                f"an episode with initial_carry({batch})."
            )


def _is_shape(x: Any) -> bool:
    return isinstance(x, tuple)


def decide(logits: chex.Array, gumbel: chex.Array) -> Decision:
    """A categorical sample by the Gumbel-max trick; zero noise takes the likeliest choice."""
    choice = jnp.argmax(jax.lax.stop_gradient(logits) + gumbel, axis=-1)
    return Decision(logits=logits, choice=choice.astype(jnp.int32))


def mask_actions(logits: chex.Array, team: TeamSpec) -> chex.Array:
    """(..., N, num_actions) logits with the actions an agent does not have at `MASKED_LOGIT`."""
    mask = np.array(team.action_mask)
    return logits if mask.all() else jnp.where(lift(mask, logits.ndim), logits, MASKED_LOGIT)
