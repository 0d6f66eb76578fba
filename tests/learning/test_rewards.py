"""Rewards in one unit, whatever a task pays in."""

from dataclasses import dataclass, replace
from functools import cache

import jax
import numpy as np
import pytest
from beginnings import begun
from probes import Probe
from trajectories import TINY_TASK, tiny_learner

from sumajax.environments import TrafficJunction
from sumajax.learning import LearnerConfig, preset
from sumajax.learning.rewards import REFERENCE_REWARD, reward_scale
from sumajax.upsampling import StateUpsampled


@dataclass(frozen=True)
class Pays(Probe):
    """Pays the same in every step, and says so."""

    largest_reward: float | None = None
    max_steps: int = 3

    def reward(self, state, actions):
        return 8.0 * actions


@cache
def one_update(env):
    """State and figures after an update."""
    learner = tiny_learner(env, num_envs=10, rollout_length=4)
    return jax.jit(learner.update)(begun(learner))


def test_a_task_is_measured_by_its_largest_reward():
    config = LearnerConfig()
    junction = TrafficJunction()
    for env in (junction, StateUpsampled(junction, 14)):
        assert reward_scale(env, config) == REFERENCE_REWARD / 10
    assert reward_scale(junction, replace(config, scale_rewards=False)) == 1
    assert reward_scale(TINY_TASK, config) == 1


@pytest.mark.parametrize("policy", ["ic3net", "magic"])
def test_the_published_procedure_takes_rewards_as_they_are(policy):
    assert reward_scale(TrafficJunction(), preset("paper", policy)) == 1


def test_what_is_learnt_does_not_depend_on_what_a_task_pays_in():
    """Eight a step, said to be the largest, are learnt from as 0.05 are."""
    stated, _ = one_update(Pays(largest_reward=8.0))
    small = 8 / REFERENCE_REWARD

    class Small(Pays):
        def reward(self, state, actions):
            return super().reward(state, actions) / small

    same, _ = one_update(Small())
    other, _ = one_update(Pays())
    assert apart(stated.params, same.params) < 1e-6
    assert apart(stated.opt_state, same.opt_state) < 1e-6
    assert apart(stated.params, other.params) > 1e-4


def apart(a, b) -> float:
    """The largest difference of two numbers in the same place."""
    return max(
        jax.tree.leaves(jax.tree.map(lambda x, y: float(np.abs(np.subtract(x, y)).max()), a, b))
    )


def test_returns_are_reported_as_they_were_paid():
    """Greedy or not: sums of what the task paid, in the task's own unit."""
    (_, stated), (_, plain) = (one_update(Pays(largest_reward=x)) for x in (8.0, None))
    assert stated.episode_return == plain.episode_return
    assert stated.episode_return % 8 == 0
    assert stated.episode_return > 0
