"""Agents that come and go within an episode: who counts, where returns end, what is remembered.

All on a rota of two places, written down beside it: who is there, who leaves, what is paid.
"""

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beginnings import begun
from flax import struct
from probes import ConstantReward, ProbeState, learn
from test_probes import values_by_step
from trajectories import Sum

from sumajax.environments.types import Observation, Transition
from sumajax.evaluation import Agent, evaluate
from sumajax.learning import LearnerConfig, losses, make_learner, preset
from sumajax.learning.learner import tally_of
from sumajax.learning.rollout import Trajectory, draw, rollout, start
from sumajax.policies import Policy, PolicyOutput, TeamSpec, make_policy
from sumajax.reporting.replay.recording import record

THERE = np.array([[0, 1], [1, 1], [1, 1], [1, 0], [1, 1], [1, 1]], bool)
"""Before each of five steps and after the last. Place 1 is left in step 2 and taken again in step
3; place 0 is taken in step 0, and in step 3 the one agent leaves and the next one comes."""
LEFT = np.array([[0, 0], [0, 0], [0, 1], [1, 0], [0, 0]], bool)
REWARD = np.array([[1.0, 2.0], [4.0, 8.0], [16.0, 32.0], [64.0, 128.0], [256.0, 512.0]])
STEPS = len(LEFT)


@struct.dataclass
class RotaState:
    time: chex.Array  # () int32 steps taken so far


@dataclass(frozen=True)
class Rota:
    """Two places, five steps; the state tensor of both agents is the time."""

    pays_actions: bool = False

    max_steps = STEPS
    num_agents = num_actions = 2
    state_shape = view_shape = (1, 1, 1)
    sighted_classes = (True,)
    agents_leave = True

    @property
    def agent_class(self) -> np.ndarray:
        return np.zeros(2, np.int32)

    @property
    def action_mask(self) -> np.ndarray:
        return np.ones((2, 2), bool)

    def reset(self, key: chex.PRNGKey) -> RotaState:
        return RotaState(jnp.int32(0))

    def step(self, state: RotaState, actions: chex.Array) -> tuple[RotaState, Transition]:
        paid = jnp.asarray(REWARD, jnp.float32)[state.time]
        time = state.time + 1
        return RotaState(time), Transition(
            reward=actions.astype(jnp.float32) if self.pays_actions else paid,
            terminated=jnp.bool_(False),
            truncated=time == STEPS,
            success=jnp.bool_(False),
            steps_taken=time,
            left=jnp.asarray(LEFT)[state.time],
        )

    def observe(self, state: RotaState) -> Observation:
        states = self.state_table()[self.state_index(state)]
        before = jnp.maximum(state.time - 1, 0)
        kept = jnp.asarray(THERE)[before] & ~jnp.asarray(LEFT)[before]
        entered = self.alive(state) & ~kept & (state.time > 0)
        return Observation(states, self.view(state), self.alive(state), entered)

    def view(self, state: RotaState) -> chex.Array:
        return jnp.zeros((2, 1, 1, 1))

    def state_index(self, state: RotaState) -> chex.Array:
        return jnp.full((2,), state.time)

    def state_table(self) -> chex.Array:
        return jnp.arange(STEPS + 1, dtype=jnp.float32)[:, None, None, None]

    def active(self, state: RotaState) -> chex.Array:
        return self.alive(state)

    def alive(self, state: RotaState) -> chex.Array:
        return jnp.asarray(THERE)[state.time]


class SumHere(Sum):
    """Remembers the sum of what it saw; action 1 once that is more than 2."""

    fresh_memory: bool = False

    def __call__(
        self, carry: Any, features: chex.Array, view: chex.Array, noise: Any, alive: chex.Array
    ) -> tuple[Any, PolicyOutput]:
        carry, output = super().__call__(carry, features, view, noise)
        enough = (carry > 2).astype(jnp.int32)
        action = output.decisions["action"].replace(choice=enough)
        return carry, output.replace(decisions={"action": action})


def rolled(x: Any, fresh_memory: bool, gap: int | None, episodes: int) -> Trajectory:
    """The trajectory of whole episodes of one environment, with parameters `x`."""
    env = Rota()
    module = SumHere(TeamSpec.of(env), states=STEPS + 1, fresh_memory=fresh_memory)
    policy, keys = Policy("sum", module), jax.random.split(jax.random.key(0), 1)
    draws = draw(env, policy, keys, episodes * STEPS)
    return rollout(env, policy, {"params": {"x": x}}, start(env, policy, keys), draws, gap)[1]


@cache
def played() -> Trajectory:
    """One episode."""
    return jax.jit(rolled, static_argnums=(1, 2, 3))(jnp.ones(STEPS + 1), False, None, 1)


@cache
def sloped(fresh_memory: bool, gap: int | None) -> tuple[Trajectory, np.ndarray]:
    """Two episodes, and the derivative (steps, places, x) of each value with respect to `x`."""

    def values(x: Any) -> tuple[Any, Trajectory]:
        trajectory = rolled(x, fresh_memory, gap, episodes=2)
        return trajectory.value[:, 0], trajectory

    slope, trajectory = jax.jit(jax.jacrev(values, has_aux=True))(jnp.ones(STEPS + 1))
    return trajectory, np.asarray(slope)


def test_who_was_there_before_and_after_each_step():
    """Also in the last step, after which the next episode begins."""
    presence = sloped(False, None)[0].presence
    np.testing.assert_array_equal(presence.before[:, 0], np.tile(THERE[:-1], (2, 1)))
    np.testing.assert_array_equal(presence.after[:, 0], np.tile(THERE[1:], (2, 1)))
    np.testing.assert_array_equal(presence.left[:, 0], np.tile(LEFT, (2, 1)))
    entered = [[1, 0], [0, 0], [0, 0], [1, 1], [0, 0]]
    np.testing.assert_array_equal(presence.entered[:, 0], np.tile(entered, (2, 1)))


MEMORY = {
    # What was summed up to each step; the place's, or that of who has it.
    False: [[1, 1], [2, 2], [3, 3], [4, 4], [5, 5]],
    True: [[1, 1], [1, 2], [2, 3], [3, 4], [1, 1]],
}


@pytest.mark.parametrize("gap", [None, 2, 100])
@pytest.mark.parametrize("fresh", MEMORY)
def test_memory_goes_with_the_place_or_with_the_agent(fresh, gap):
    trajectory, _ = sloped(fresh, gap)
    np.testing.assert_array_equal(trajectory.value[:, 0], np.tile(MEMORY[fresh], (2, 1)))


@pytest.mark.parametrize("fresh", MEMORY)
def test_memory_of_who_acts_on_observations_alone(fresh):
    """What is seen says who has come, so no transition is needed: an agent's `act`, a replay."""
    env = Rota()
    policy = Policy("sum", SumHere(TeamSpec.of(env), states=STEPS + 1, fresh_memory=fresh))
    params = {"params": {"x": jnp.ones(STEPS + 1)}}
    agent, state = Agent(env, policy, params), env.reset(jax.random.key(0))
    carry, remembered = agent.initial_carry(), []
    for _ in range(STEPS):
        carry, action = agent.act(carry, env.observe(state), jax.random.key(0))
        state, _ = env.step(state, action)
        remembered.append(carry)
    np.testing.assert_array_equal(remembered, MEMORY[fresh])
    recorded = record(env, policy, params, jax.random.key(0))
    np.testing.assert_array_equal(recorded.actions, np.array(MEMORY[fresh]) > 2)


def test_memory_needs_to_know_who_has_come():
    policy = Policy("sum", SumHere(TeamSpec.of(Rota()), states=STEPS + 1, fresh_memory=True))
    seen = replace(Rota().observe(RotaState(jnp.int32(1))), entered=None)
    params = {"params": {"x": jnp.ones(STEPS + 1)}}
    with pytest.raises(ValueError, match="nothing says who has come with the last step: set `ent"):
        policy.apply(params, policy.initial_carry(), seen, jax.random.key(0))


@pytest.mark.parametrize("gap", [None, 2, 100])
@pytest.mark.parametrize("fresh", MEMORY)
def test_gradients_end_where_memory_does(fresh, gap):
    """The value after step t is the sum of x_s over the steps s remembered; none past the gap."""
    _, slope = sloped(fresh, gap)
    for step, place in np.ndindex(2 * STEPS, 2):
        t = step % STEPS
        first = t + 1 - MEMORY[fresh][t][place]
        if gap is not None:
            first = max(first, t // gap * gap)
        expected = [first <= s <= t for s in range(STEPS + 1)]
        np.testing.assert_array_equal(slope[step, place], expected, err_msg=f"{step} {place}")


@pytest.mark.parametrize(("fresh", "paid"), [(False, 3 / 5), (True, 3 / 10)])
def test_memory_in_evaluation(fresh, paid):
    """Action 1, which is paid, is taken in the steps where more than 2 are remembered."""
    env = Rota(pays_actions=True)
    policy = Policy("sum", SumHere(TeamSpec.of(env), states=STEPS + 1, fresh_memory=fresh))
    params = {"params": {"x": jnp.ones(STEPS + 1)}}
    result = evaluate(env, policy, params, jax.random.key(0), episodes=3)
    np.testing.assert_allclose(result.episode_return, [paid * STEPS] * 3, rtol=1e-6)


PAPER = replace(preset("paper", "ic3net"), gamma=1.0)
FAST = LearnerConfig(gamma=1.0, gae_lambda=1.0, team_reward=0.0, bootstrap_timeouts=False)
OWN_AFTER = [[85, 42], [84, 40], [80, 32], [64, 640], [256, 512]]
"""Each step's rewards to come, up to where the place is left; with what the newcomer is paid."""
OWN_BEFORE = [[20, 42], [20, 40], [16, 32], [0, 512], [256, 512]]
"""The same without what a newcomer is paid in the step it came with."""
PLACES = [[341, 682], [340, 680], [336, 672], [320, 640], [256, 512]]
"""Rewards to come at each place, whoever has it."""


@pytest.mark.parametrize(
    ("config", "expected"), [(PAPER, OWN_AFTER), (FAST, OWN_BEFORE)], ids=["after", "before"]
)
def test_returns_end_where_a_place_is_handed_on(config, expected):
    trajectory = played()
    ours = losses.estimate_returns(trajectory, jnp.zeros((1, 2)), config)
    np.testing.assert_allclose(ours[:, 0], expected, rtol=1e-6)


@pytest.mark.parametrize("config", [PAPER, FAST], ids=["after", "before"])
def test_the_return_of_the_team_goes_on(config):
    """Its mean is over all places, as published."""
    ours = losses.estimate_returns(played(), jnp.zeros((1, 2)), replace(config, team_reward=1.0))
    mean = np.mean(PLACES, axis=-1, keepdims=True)
    np.testing.assert_allclose(ours[:, 0], np.broadcast_to(mean, (STEPS, 2)), rtol=1e-6)


def test_an_empty_place_is_worth_nothing_to_the_team():
    """Only the value of who is there stands for what is to come: 8 each, or 0."""
    trajectory = played()
    trajectory = trajectory.replace(value=jnp.full_like(trajectory.value, 8.0))
    one_step = replace(FAST, team_reward=1.0, gae_lambda=0.0, alive_mask="after")
    ours = losses.estimate_returns(trajectory, jnp.full((1, 2), 8.0), one_step)
    to_come = np.array([[8, 8], [8, 8], [8, 0], [8, 8], [0, 0]])  # nothing past the last step
    expected = (REWARD + to_come).mean(-1, keepdims=True)
    np.testing.assert_allclose(ours[:, 0], np.broadcast_to(expected, (STEPS, 2)), rtol=1e-6)


def test_a_step_limit_is_an_end_for_who_leaves_with_it():
    trajectory = played()
    presence = trajectory.presence
    left = presence.left.at[-1, 0, 1].set(True)
    trajectory = trajectory.replace(
        presence=presence.replace(left=left), value=jnp.full_like(trajectory.value, 8.0)
    )
    goes_on = replace(PAPER, bootstrap_timeouts=True)
    ours = losses.estimate_returns(trajectory, jnp.zeros((1, 2)), goes_on)
    np.testing.assert_allclose(ours[-1, 0], [256 + 8, 512])


@pytest.mark.parametrize(
    ("mask", "counts"), [("before", THERE[:-1]), ("after", THERE[1:])], ids=["before", "after"]
)
def test_who_counts_in_the_loss(mask, counts):
    """Nothing that is not counted moves the loss, and all that is does."""
    trajectory, valid = played(), jnp.ones((STEPS, 1), bool)
    config = replace(FAST, alive_mask=mask, mask_inactive=False, advantages="raw")
    np.testing.assert_array_equal(losses.counted(trajectory, valid, config)[:, 0], counts)

    def loss(value, logits):
        action = trajectory.decisions["action"].replace(logits=logits)
        seen = trajectory.replace(value=value, decisions={"action": action})
        return losses.actor_critic(seen, valid, jnp.zeros((1, 2)), config, 1.0)

    inputs = trajectory.value, trajectory.decisions["action"].logits
    (by_value, by_logits), parts = jax.jit(jax.grad(loss, (0, 1), has_aux=True))(*inputs)
    by_value, by_logits = np.asarray(by_value), np.asarray(by_logits)
    np.testing.assert_array_equal(by_value[:, 0] != 0, counts)
    np.testing.assert_array_equal(np.abs(by_logits[:, 0]).sum(-1) > 0, counts)
    assert parts.acting == counts.sum()
    valid = valid.at[2:].set(False)
    assert losses.counted(trajectory, valid, config).sum() == counts[:2].sum()


def test_figures_are_of_who_was_there():
    trajectory, valid = played(), jnp.ones((STEPS, 1), bool)
    talked = jnp.where(trajectory.presence.before, 0.5, 99.0)
    trajectory = trajectory.replace(communication=talked)
    parts = losses.LossParts(*jnp.zeros(4))
    tally = tally_of(trajectory, valid, parts)
    assert tally.agent_steps == THERE[:-1].sum()
    np.testing.assert_allclose(tally.communication / tally.env_steps, 0.5)


@dataclass(frozen=True)
class Relay(ConstantReward):
    """Pays 1 a step; after the first of three steps another agent takes over."""

    max_steps: int = 3

    agents_leave = True

    def step(self, state: ProbeState, actions: chex.Array) -> tuple[ProbeState, Transition]:
        following, transition = super().step(state, actions)
        return following, transition.replace(left=jnp.full(self.num_agents, state.time == 0))

    def alive(self, state: ProbeState) -> chex.Array:
        return jnp.ones(self.num_agents, bool)


def test_a_learner_values_what_an_agent_earns_itself():
    """What its successor earns is not its own.

    Half as wide a critic, at twice the rate for half as long, mixes the two up in one seed of ten.
    """
    small = {"num_envs": 25, "rollout_length": 4, "learning_rate": 5e-3, "gamma": 0.5}
    (trajectory,) = learn(
        Relay(),
        policy="tarmac-ic3net",
        updates=1_200,
        hidden=16,
        seeds=2,
        team_reward=0.0,
        alive_mask="after",
        **small,
    )
    np.testing.assert_allclose(values_by_step(trajectory, Relay()), [[1, 1.5, 1]] * 2, atol=0.05)


def test_a_loss_that_knows_no_leaving_is_refused():
    env = Rota()
    policy = make_policy("iric", env, hidden=4, encoder="linear")
    config = replace(preset("paper", "hetnet"), num_envs=1, clip_per_env=False)
    with pytest.raises(ValueError, match="no place for agents that come and go; use loss 'actor_c"):
        make_learner(env, policy, config)


@pytest.mark.parametrize(("policy", "settings"), [("magic", "fast"), ("tarmac-ic3net", "paper")])
def test_an_update_is_finite(policy, settings):
    env = Rota()
    hidden = {"hidden": 4} if policy != "magic" else {}
    made = make_policy(policy, env, encoder="linear", fresh_memory=True, **hidden)
    config = preset(settings, policy, num_envs=4, rollout_length=10)
    learner = make_learner(env, made, config)
    state, tally = jax.jit(learner.update)(begun(learner))
    assert not tally.faults.any()
    assert tally.agent_steps < 2 * tally.env_steps
    jax.tree.map(partial(chex.assert_tree_all_finite), state.params)
