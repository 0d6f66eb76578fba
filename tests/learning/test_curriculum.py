"""Tasks that become harder while they are learnt: which episodes are of which epoch."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beginnings import begin, begun, random_parameters
from flax import struct
from probes import Probe, ProbeState
from trajectories import tiny_learner

from sumajax.environments import TrafficJunction
from sumajax.evaluation import evaluate
from sumajax.learning import make_learner, preset
from sumajax.policies import make_policy
from sumajax.upsampling import StateUpsampled

LESSONS = [1, 2, 4]
"""Of epochs 0, 1 and all later ones."""
GOAL = 7


@struct.dataclass
class LessonState(ProbeState):
    """An episode of a lesson."""

    lesson: chex.Array  # () int32


@dataclass(frozen=True)
class Lessons(Probe):
    """Pays in each step what the lesson of the episode is."""

    max_steps: int = 3

    def reset(self, key: chex.PRNGKey) -> LessonState:
        return LessonState(jnp.int32(0), jnp.int32(0), jnp.int32(GOAL))

    def reset_in_epoch(self, key: chex.PRNGKey, epoch: chex.Numeric) -> LessonState:
        lesson = jnp.asarray(LESSONS, jnp.int32)[jnp.minimum(epoch, len(LESSONS) - 1)]
        return replace(self.reset(key), lesson=lesson)

    def reward(self, state: Any, actions: chex.Array) -> chex.Array:
        return state.lesson.astype(jnp.float32)


def raw(leaf):
    """Keys as numbers."""
    key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if key else leaf)


def in_epoch(learner, state, epoch):
    """`state` at the beginning of an epoch."""
    return replace(state, updates=jnp.int32(epoch * learner.config.updates_per_epoch))


@pytest.mark.parametrize("whole", [False, True])
def test_an_episode_is_of_the_epoch_in_which_it_began(whole):
    """Two steps an update of episodes of three: those under way keep what they began with."""
    learner = tiny_learner(Lessons(), num_envs=10, rollout_length=2, whole_episodes=whole)
    # The environments are at staggered ages, unless every update starts them afresh.
    init, params = jax.jit(learner.init_from), random_parameters(learner.policy)
    update, state = jax.jit(learner.update), init(params, jax.random.key(0))
    assert set(np.asarray(state.actors.env_state.lesson)) == {LESSONS[0]}
    state = in_epoch(learner, state, 1)
    under_way = np.asarray(state.actors.env_state.time)
    state, tally = update(state)
    lesson = np.asarray(state.actors.env_state.lesson)
    if whole:
        assert set(lesson) == {LESSONS[1]}
        assert tally.episode_return == Lessons.max_steps * LESSONS[1] * tally.episodes
    else:
        began_anew = under_way + 2 >= Lessons.max_steps
        np.testing.assert_array_equal(lesson, np.where(began_anew, LESSONS[1], LESSONS[0]))
        assert set(began_anew) == {False, True}
        # What ended in this update had begun before it.
        assert tally.episode_return == Lessons.max_steps * LESSONS[0] * tally.episodes


def test_training_goes_from_lesson_to_lesson():
    """What an epoch's episodes are paid says which lesson they were; the last one stays."""
    learner = tiny_learner(Lessons(), num_envs=200, rollout_length=20, whole_episodes=True)
    _, metrics = learner.train(begun(learner), 4)
    expected = [Lessons.max_steps * lesson for lesson in (*LESSONS, LESSONS[-1])]
    np.testing.assert_allclose(metrics.episode_return, expected)


def test_a_run_that_is_stopped_goes_on_with_its_lesson():
    """The state of training knows its epoch."""
    learner = tiny_learner(Lessons(), num_envs=200, rollout_length=20)
    state = begun(learner)
    whole, _ = learner.train(state, 2)
    first, _ = learner.train(state, 1)
    resumed, _ = learner.train(first, 1)
    jax.tree.map(np.testing.assert_array_equal, *jax.tree.map(raw, (whole, resumed)))


@pytest.mark.parametrize("wrapped", [False, True])
def test_evaluation_plays_what_training_leads_to(wrapped):
    env: Any = StateUpsampled(Lessons(), (1, 4)) if wrapped else Lessons()
    policy = make_policy("iric", env, encoder="linear", hidden=4)
    params = random_parameters(policy)
    result = evaluate(env, policy, params, jax.random.key(1), episodes=3)
    np.testing.assert_array_equal(result.episode_return, [Lessons.max_steps * GOAL] * 3)


def test_a_wrapped_task_is_learnt_in_lessons_too():
    learner = tiny_learner(StateUpsampled(Lessons(), (1, 4)), num_envs=200, rollout_length=20)
    state = in_epoch(learner, begun(learner), 2)
    state, _ = jax.jit(learner.update)(state)
    assert set(np.asarray(state.actors.env_state.lesson)) == {LESSONS[2]}


def test_the_junctions_rate_is_that_of_the_epoch():
    """Episodes of one step: after an update all are new. The README's curriculum of easy: 0.1 until
    epoch 298, a hundredth more every fifty epochs, 0.29 from 1200 on and never 0.3."""
    env = TrafficJunction(
        max_steps=1, arrival_rate=0.1, final_arrival_rate=0.3, rate_epochs=(250, 1250)
    )
    policy = make_policy("iric", env, encoder="linear", hidden=4)
    learner = make_learner(env, policy, preset("fast", "iric", num_envs=10))
    update, state = jax.jit(learner.update), begun(learner)
    published = {0: 0.1, 250: 0.1, 298: 0.1, 299: 0.11, 1149: 0.28, 1200: 0.29, 1300: 0.29}
    for epoch, rate in {**published, 50_000: 0.29}.items():
        following, _ = update(in_epoch(learner, state, epoch))
        rates = np.asarray(following.actors.env_state.arrival_rate)
        np.testing.assert_allclose(rates, np.full(10, rate), rtol=1e-6, err_msg=str(epoch))
        assert following.updates == epoch * learner.config.updates_per_epoch + 1


def test_nothing_is_computed_for_a_task_that_stays_as_it_is():
    """A rate that does not rise: the same program as without the hook, bit for bit."""

    class Constant(TrafficJunction):
        reset_in_epoch = None

    tasks = [kind("easy", num_cars=2, max_steps=3) for kind in (TrafficJunction, Constant)]

    def program(env):
        policy = make_policy("iric", env, encoder="linear", hidden=4)
        learner = make_learner(env, policy, preset("fast", "iric", num_envs=10))
        params, key = random_parameters(policy), jax.random.key(0)
        state = jax.eval_shape(partial(begin, learner), params, key)
        return jax.jit(learner.update).lower(state).compile().cost_analysis()

    assert program(tasks[0]) == program(tasks[1])
