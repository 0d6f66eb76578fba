"""Tiny tasks whose right value, action, memory and message are known, and `learn` to learn them.

After rejax's and earlier authors' probe environments: each asks one thing of a learner, so that a
failure says what is broken.
"""

from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sumajax.environments.types import Observation, Transition
from sumajax.learning import make_learner, preset
from sumajax.learning.rollout import Trajectory, draw, rollout, start
from sumajax.policies import make_policy


@struct.dataclass
class ProbeState:
    """One episode in progress."""

    cue: chex.Array  # () int32, 0 or 1, drawn anew for every episode
    time: chex.Array  # () int32 steps taken so far


@dataclass(frozen=True)
class Probe:
    """A task that pays nothing and shows nothing; probes override what they ask.

    The agents choose between two actions, `max_steps` times; then the task is done, or without
    `terminates` the step limit is hit.
    """

    max_steps: int = 1
    num_agents: int = 1
    terminates: bool = True

    num_actions = 2
    state_shape = (1, 1, 2)
    view_shape = (2, 1, 1)
    sighted_classes = (True,)

    @property
    def agent_class(self) -> np.ndarray:
        return np.zeros(self.num_agents, np.int32)

    @property
    def action_mask(self) -> np.ndarray:
        return np.ones((self.num_agents, self.num_actions), bool)

    def reset(self, key: chex.PRNGKey) -> ProbeState:
        return ProbeState(jax.random.bernoulli(key).astype(jnp.int32), jnp.int32(0))

    def step(self, state: ProbeState, actions: chex.Array) -> tuple[ProbeState, Transition]:
        reward = jnp.broadcast_to(self.reward(state, actions), (self.num_agents,))
        time = state.time + 1
        end = time == self.max_steps
        transition = Transition(
            reward=reward.astype(jnp.float32),
            terminated=end & self.terminates,
            truncated=end & (not self.terminates),
            success=end & self.terminates,
            steps_taken=time,
        )
        return state.replace(time=time), transition

    def observe(self, state: ProbeState) -> Observation:
        return Observation(self.state_table()[self.state_index(state)], self.view(state))

    def view(self, state: ProbeState) -> chex.Array:
        """(N, 2, 1, 1): channel 0 shows `visible_cue`, channel 1 the time."""
        cue = jnp.broadcast_to(self.visible_cue(state), (self.num_agents,))
        time = jnp.full((self.num_agents,), state.time)
        return jnp.stack([cue, time], axis=-1)[..., None, None].astype(jnp.float32)

    def state_index(self, state: ProbeState) -> chex.Array:
        return jnp.zeros(self.num_agents, jnp.int32)

    def state_table(self) -> chex.Array:
        return jnp.eye(2)[:, None, None]

    def active(self, state: ProbeState) -> chex.Array:
        return jnp.ones(self.num_agents, bool)

    def reward(self, state: ProbeState, actions: chex.Array) -> chex.Array:
        """(N,) or ()."""
        return jnp.zeros(())

    def visible_cue(self, state: ProbeState) -> chex.Array:
        """(N,) or (): what the view shows of the cue, -1, 0 or 1."""
        return jnp.zeros(())


def signed(cue: chex.Array) -> chex.Array:
    """0, 1 -> -1, 1."""
    return 2 * cue - 1


@dataclass(frozen=True)
class ConstantReward(Probe):
    """Pays 1 at every step whatever is done: a value to learn and nothing else."""

    def reward(self, state: ProbeState, actions: chex.Array) -> chex.Array:
        return jnp.ones(())


@dataclass(frozen=True)
class LastStepReward(Probe):
    """Pays 1 at the last step: the value of earlier steps is its discount."""

    max_steps: int = 2

    def reward(self, state: ProbeState, actions: chex.Array) -> chex.Array:
        return state.time == self.max_steps - 1


@dataclass(frozen=True)
class ChooseOne(Probe):
    """Pays for action 1."""

    def reward(self, state: ProbeState, actions: chex.Array) -> chex.Array:
        return actions == 1


@dataclass(frozen=True)
class MatchView(Probe):
    """Pays for the action that the view shows."""

    def reward(self, state: ProbeState, actions: chex.Array) -> chex.Array:
        return actions == state.cue

    def visible_cue(self, state: ProbeState) -> chex.Array:
        return signed(state.cue)


@dataclass(frozen=True)
class MatchState(Probe):
    """Pays for the action that the state tensor shows."""

    def reward(self, state: ProbeState, actions: chex.Array) -> chex.Array:
        return actions == state.cue

    def state_index(self, state: ProbeState) -> chex.Array:
        return jnp.broadcast_to(state.cue, (self.num_agents,))


@dataclass(frozen=True)
class MatchUnlistedState(MatchState):
    """The same with a state of real numbers, too many to list: no `state_table`."""

    def observe(self, state: ProbeState) -> Observation:
        tensor = jnp.stack([signed(state.cue), 0.3 * state.cue + 0.1])
        states = jnp.broadcast_to(tensor, (self.num_agents, *self.state_shape))
        return Observation(states.astype(jnp.float32), self.view(state))

    def state_table(self) -> Any:
        return None

    def state_index(self, state: ProbeState) -> chex.Array:
        raise AssertionError("there is no table to index")


@dataclass(frozen=True)
class Remember(Probe):
    """Shows the cue at the first step only and pays at the last one for the action it named."""

    max_steps: int = 3

    def reward(self, state: ProbeState, actions: chex.Array) -> chex.Array:
        return (state.time == self.max_steps - 1) & (actions == state.cue)

    def visible_cue(self, state: ProbeState) -> chex.Array:
        return jnp.where(state.time == 0, signed(state.cue), 0)


@dataclass(frozen=True)
class Tell(Remember):
    """Only agent 0 sees the cue; the team is paid for what agent 1 does."""

    num_agents: int = 2

    def reward(self, state: ProbeState, actions: chex.Array) -> chex.Array:
        return super().reward(state, actions)[1]

    def visible_cue(self, state: ProbeState) -> chex.Array:
        return super().visible_cue(state) * jnp.array([1, 0])


@dataclass(frozen=True)
class Credit(Probe):
    """Agent 0 earns 1 by action 1, but by action 0 it earns 2 for the other agent."""

    num_agents: int = 2

    def reward(self, state: ProbeState, actions: chex.Array) -> chex.Array:
        return jnp.stack([actions[0] == 1, 2 * (actions[0] == 0)])


@dataclass(frozen=True, eq=False)
class OneOf(Probe):
    """The one of several probes that `kind` names, traced or not: one program learns them all."""

    probes: tuple[Probe, ...] = ()
    kind: chex.Numeric = 0

    def step(self, state: ProbeState, actions: chex.Array) -> tuple[ProbeState, Transition]:
        return jax.lax.switch(self.kind, [probe.step for probe in self.probes], state, actions)

    def view(self, state: ProbeState) -> chex.Array:
        return jax.lax.switch(self.kind, [probe.view for probe in self.probes], state)

    def state_index(self, state: ProbeState) -> chex.Array:
        return jax.lax.switch(self.kind, [probe.state_index for probe in self.probes], state)


def learn(
    *probes: Probe,
    policy: str,
    updates: int,
    seeds: int = 3,
    settings: str = "fast",
    hidden: int = 8,
    **changes: Any,
) -> list[Trajectory]:
    """What teams trained for so many updates do: leaves (seeds, T, E, N, ...) of 12 x 50 steps.

    The real learner with a real policy, made small; probes that share one program share all but
    what they show and pay.
    """
    longest = max(probe.max_steps for probe in probes)
    config = preset(settings, policy, **changes)

    def train_and_play(kind: chex.Array, seed: chex.Array) -> Trajectory:
        env = probes[0]
        if len(probes) > 1:
            env = OneOf(longest, env.num_agents, probes=probes, kind=kind)
        learner = make_learner(
            env, make_policy(policy, env, hidden=hidden, encoder="linear"), config
        )
        train_key, start_key, play_key = jax.random.split(jax.random.key(seed), 3)
        state = learner.init(train_key)
        state, _ = jax.lax.scan(lambda s, _: learner.update(s), state, length=updates)
        actors = start(env, learner.policy, jax.random.split(start_key, 50))
        draws = draw(env, learner.policy, jax.random.split(play_key, 50), 12)
        return rollout(env, learner.policy, state.params, actors, draws)[1]

    run = jax.vmap(jax.vmap(train_and_play, (None, 0)), (0, None))
    played = jax.jit(run)(jnp.arange(len(probes)), jnp.arange(seeds))
    played = jax.tree.map(np.asarray, played)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], played) for i in range(len(probes))]
