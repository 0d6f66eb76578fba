"""The whole package learns its first task: minutes of compiling and training, so marked slow."""

import jax
import numpy as np
import pytest

from sumajax import PredatorPrey, StateUpsampled, evaluate, make_learner, make_policy, preset
from sumajax.learning import parallel

PUBLISHED_STEPS = 8.97
"""Steps taken on 5x5 by CommNet, the best of the family in the HetNet paper's table."""


@pytest.mark.slow
def test_5x5_predator_prey_under_upsampling():
    env = StateUpsampled(PredatorPrey(size=5, num_predators=3, vision=1, max_steps=80), 10)
    policy = make_policy("ic3net", env)
    learner = make_learner(env, policy, preset("fast", "ic3net", anneal_epochs=50))
    mesh = parallel.make_mesh(2, learner.config.num_envs, 1)
    states, _ = parallel.make_train(learner, mesh, 20)(parallel.init_seeds(learner, [0, 1]))
    for seed in range(2):
        params = jax.tree.map(lambda x, seed=seed: np.asarray(x[seed]), states.params)
        result = evaluate(env, policy, params, jax.random.key(1))
        assert result.success.mean() > 0.99
        assert result.steps_taken.mean() < PUBLISHED_STEPS
