"""Random keys of numbers, where the package makes them itself."""

import chex
import jax

IMPLEMENTATION = "threefry2x32"
"""JAX's ordinary generator. A program that has chosen another one for its own keys
(`jax_default_prng_impl`) still gets the same training of the same seed, and the same held-out
starts; keys that it hands over itself are used as they are."""


def key_of(seed: chex.Numeric) -> chex.PRNGKey:
    """() key of a seed: the same one in every program."""
    return jax.random.key(seed, impl=IMPLEMENTATION)
