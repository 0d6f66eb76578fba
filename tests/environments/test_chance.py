"""A domain with chance in its steps: its state keeps a key, which every step splits anew.

That is the pattern for domains of one's own; here it goes through all that steps an environment.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sumajax.compat.gymnax import AutoReset
from sumajax.compat.jaxmarl import JaxMARLEnv
from sumajax.environments import Environment, Observation, Transition
from sumajax.evaluation import evaluate
from sumajax.learning import LearnerConfig, make_learner
from sumajax.learning.rollout import draw, rollout, start
from sumajax.policies import make_policy
from sumajax.upsampling import StateUpsampled


@struct.dataclass
class LotteryState:
    key: jax.Array  # () of the steps still to come
    time: jax.Array  # () int32


@dataclass(frozen=True)
class Lottery:
    """Every step pays each of two agents what it draws; three steps, then the limit."""

    max_steps: int = 3

    num_agents = 2
    num_actions = 2
    sighted_classes = (True,)
    state_shape = (1, 1, 2)
    view_shape = (1, 1, 1)

    @property
    def agent_class(self):
        return np.zeros(2, np.int32)

    @property
    def action_mask(self):
        return np.ones((2, 2), bool)

    def reset(self, key):
        return LotteryState(key, jnp.int32(0))

    def step(self, state, actions):
        following, now = jax.random.split(state.key)
        time = state.time + 1
        return LotteryState(following, time), Transition(
            reward=jax.random.uniform(now, (2,)),
            terminated=jnp.zeros((), bool),
            truncated=time >= self.max_steps,
            success=jnp.zeros((), bool),
            steps_taken=time,
        )

    def observe(self, state):
        return Observation(self.state_table()[self.state_index(state)], self.view(state))

    def view(self, state):
        return jnp.zeros((2, 1, 1, 1))

    def state_index(self, state):
        return jnp.arange(2)

    def state_table(self):
        return jnp.eye(2).reshape(2, 1, 1, 2)

    def active(self, state):
        return jnp.ones(2, bool)

    def alive(self, state):
        return jnp.ones(2, bool)


ENV = Lottery()
STEPS, ENVS = 7, 4  # more than two episodes


def policy():
    return make_policy("iric", ENV, hidden=4, encoder="linear")


def all_differ(draws):
    return len(np.unique(draws)) == np.size(draws)


def test_it_is_an_environment():
    assert isinstance(ENV, Environment)


def test_in_a_rollout_steps_episodes_and_environments_draw_apart():
    made = policy()
    keys = jax.random.split(jax.random.key(0), ENVS)

    @jax.jit
    def play(params, keys):
        actors, draws = start(ENV, made, keys), draw(ENV, made, keys, STEPS)
        return rollout(ENV, made, params, actors, draws)[1].reward

    rewards = play(jax.jit(made.init)(jax.random.key(1)), keys)
    assert rewards.shape == (STEPS, ENVS, 2)
    assert all_differ(rewards)


def test_updates_go_on_drawing():
    learner = make_learner(ENV, policy(), LearnerConfig(num_envs=ENVS, rollout_length=5))
    update, state = jax.jit(learner.update), jax.jit(learner.init)(jax.random.key(0))
    returns = []
    for _ in range(3):
        state, tally = update(state)
        assert int(tally.updates) == 1
        returns.append(float(tally.episode_return))
    assert all_differ(returns)
    assert all_differ(jax.random.key_data(state.actors.env_state.key)[:, 1])


def test_held_out_episodes_draw_apart_and_are_the_same_for_every_policy():
    made = policy()
    first, other = (
        evaluate(ENV, made, jax.jit(made.init)(jax.random.key(seed)), jax.random.key(seed),
                 episodes=140).episode_return
        for seed in range(2)
    )  # fmt: skip
    assert all_differ(first)
    np.testing.assert_array_equal(first, other)


def test_upsampled_it_draws_the_same():
    small, large = (
        jax.jit(env.step)(env.reset(jax.random.key(0)), jnp.zeros(2, jnp.int32))[1].reward
        for env in (ENV, StateUpsampled(ENV, (2, 4)))
    )
    np.testing.assert_array_equal(small, large)


def test_under_gymnaxs_conventions():
    env = AutoReset(ENV)
    keys = jax.random.split(jax.random.key(0), STEPS + 1)
    states = jax.vmap(env.reset)(jax.random.split(keys[0], ENVS))[1]
    rewards = []
    for key in keys[1:]:
        step_keys = jax.random.split(key, ENVS)
        _, states, reward, *_ = jax.vmap(env.step)(step_keys, states, jnp.zeros((ENVS, 2), int))
        rewards.append(reward)
    assert all_differ(rewards)


def test_under_jaxmarls_conventions():
    env = JaxMARLEnv(ENV)
    keys = jax.random.split(jax.random.key(0), STEPS + 1)
    states = jax.vmap(env.reset)(jax.random.split(keys[0], ENVS))[1]
    stay, rewards = {agent: jnp.zeros(ENVS, int) for agent in env.agents}, []
    for key in keys[1:]:
        _, states, reward, *_ = jax.vmap(env.step)(jax.random.split(key, ENVS), states, stay)
        rewards.append(list(reward.values()))
    assert all_differ(rewards)
