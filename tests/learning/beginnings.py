"""States that training begins with, made without the programs that `Learner.init` compiles.

Drawing a policy's parameters and playing its environments to staggered ages takes longer to compile
than the update that a test is about. What `init` does itself is checked in test_learner.py.
"""

from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import chex
import jax
import numpy as np

from sumajax.learning import Learner, parallel
from sumajax.learning.learner import TrainState
from sumajax.policies import Policy

LARGEST_BIAS = 0.1


@lru_cache
def random_parameters(policy: Policy, seed: int = 0) -> Any:
    """Parameters of the size of initial ones, drawn by NumPy: kernels are uniform within
    +-1/sqrt(fan_in), vectors within +-`LARGEST_BIAS`, and no number is 0."""
    random = np.random.default_rng(seed)

    def drawn(leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        fan_in = np.prod(leaf.shape[:-1])
        bound = fan_in**-0.5 if leaf.ndim > 1 else LARGEST_BIAS
        return random.uniform(-bound, bound, leaf.shape).astype(leaf.dtype)

    return jax.tree.map(drawn, jax.eval_shape(policy.init, jax.random.key(0)))


def begin(learner: Learner, params: Any, key: chex.PRNGKey) -> TrainState:
    """The start of training from given parameters, all environments at the start of an episode."""
    together = replace(learner, config=replace(learner.config, whole_episodes=True))
    return together.init_from(params, key)


@lru_cache
def begun(learner: Learner, seed: int = 0) -> TrainState:
    """`begin` with `random_parameters`, compiled."""
    params = random_parameters(learner.policy, seed)
    return jax.jit(begin, static_argnums=0)(learner, params, jax.random.key(seed))


def begun_seeds(learner: Learner, seeds: list[int]) -> TrainState:
    """`begin` for several seeds, stacked along a leading axis as by `parallel.init_seeds`."""
    drawn = [random_parameters(learner.policy, seed) for seed in seeds]
    params = jax.tree.map(lambda *leaves: np.stack(leaves), *drawn)
    return _begin_all(learner, params, parallel.seed_keys(seeds))


@partial(jax.jit, static_argnums=0)
def _begin_all(learner: Learner, params: Any, keys: chex.PRNGKey) -> TrainState:
    return jax.vmap(partial(begin, learner))(params, keys)
