"""Parameters for tests that need some, and do not ask which."""

from typing import Any

import jax
import numpy as np

from sumajax.policies import Policy


def drawn(init: Any, *inputs: Any, seed: int = 0, **options: Any) -> Any:
    """What `init`(key, *inputs, **options) has the shapes of, at the size of initial parameters.

    Uniform up to 1 / sqrt(inputs of the layer), biases too. Drawn by NumPy: the program that draws
    HetNet's own takes longer to compile than most of what is done with it in a test. What policies
    start from is in policies/test_make_policy.py.
    """
    random = np.random.default_rng(seed)

    def leaf(like: Any) -> np.ndarray:
        bound = (like.shape[-2] if len(like.shape) > 1 else like.shape[0]) ** -0.5
        return random.uniform(-bound, bound, like.shape).astype(like.dtype)

    shapes = jax.eval_shape(lambda key: init(key, *inputs, **options), jax.random.key(0))
    return jax.tree.map(leaf, shapes)


def drawn_parameters(policy: Policy, seed: int = 0) -> Any:
    """Those of a policy."""
    return drawn(policy.init, seed=seed)
