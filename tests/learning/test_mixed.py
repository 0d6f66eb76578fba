"""One policy on two tasks at once: whose gradient, whose figures, at what cost."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from sumajax.environments import PredatorPrey
from sumajax.experiment import Experiment, Stage
from sumajax.experiment.plan import described
from sumajax.learning import LearnerConfig, make_learner
from sumajax.learning.mixed import mixed_with
from sumajax.learning.optimiser import annealed
from sumajax.policies import make_policy
from sumajax.upsampling import StateUpsampled

LARGE = PredatorPrey(size=6, num_predators=3, max_steps=20)
SMALL = StateUpsampled(PredatorPrey(size=3, num_predators=2, max_steps=10), 6)
CONFIG = LearnerConfig(num_envs=20, rollout_length=10, anneal_epochs=2)
LEARNER = make_learner(LARGE, make_policy("ic3net", LARGE, hidden=8, encoder="linear"), CONFIG)
MIXED = mixed_with(LEARNER, SMALL)


@pytest.fixture(scope="module")
def state():
    return jax.jit(MIXED.init)(jax.random.key(0))


def test_half_of_the_environments_are_of_either_task(state):
    large, small = (actors.env_state.agents for actors in state.actors)
    assert (large.shape, small.shape) == ((10, 3, 2), (10, 2, 2))
    assert large.max() > 2
    assert small.max() <= 2


def test_the_gradient_is_the_sum_of_two_learners_and_the_figures_are_of_the_first(state):
    def parts(state):
        actors, draws = MIXED._inputs(state)
        both = MIXED._gradient(MIXED._weights(state), actors, draws, state.updates)
        each = [
            half._gradient(MIXED._weights(state), *own, 2 * state.updates)
            for half, *own in zip(MIXED.halves, actors, draws, strict=True)
        ]
        return both, each

    (gradient, (_, tally)), each = jax.jit(parts)(state)
    (first, (_, of_first)), (second, (_, of_second)) = each
    for whole, a, b in zip(*map(jax.tree.leaves, (gradient, first, second)), strict=True):
        np.testing.assert_allclose(whole, a + b, rtol=1e-4, atol=1e-5)
    assert any(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(second))
    assert tally.env_steps == CONFIG.num_envs * CONFIG.rollout_length
    assert tally.env_steps == of_first.env_steps + of_second.env_steps
    assert tally.agent_steps == of_first.agent_steps + of_second.agent_steps
    assert tally.episodes == of_first.episodes
    assert tally.steps_taken == of_first.steps_taken


def test_halves_anneal_as_the_whole_does():
    halfway = CONFIG.updates_per_epoch
    for half in MIXED.halves:
        assert annealed(half.config, 2 * halfway) == annealed(CONFIG, halfway) == 0.51


def test_an_odd_number_of_environments_has_no_halves():
    odd = replace(LEARNER, config=replace(CONFIG, num_envs=25))
    with pytest.raises(ValueError, match=r"num_envs must be even .* got 25"):
        mixed_with(odd, SMALL)


def test_a_plan_says_which_task_is_beside():
    stage = Stage("mixed", LARGE, 1, learner=CONFIG, beside=SMALL)
    (plan,) = described(Experiment((stage,)))["stages"]
    assert plan["task"]["fields"]["size"] == 6
    assert plan["beside"]["fields"]["env"]["fields"]["size"] == 3
    Experiment((stage,)).check()
    with pytest.raises(ValueError, match="grid differs: 3x3 in the task beside stage mixed"):
        Experiment((replace(stage, beside=SMALL.env),)).check()
