"""Guards inside the compiled loop: an update that is not finite is not taken.

A refused update leaves everything as it was, the number of updates included. The next update is
then the same one over again and is refused again: the seed has stopped at its last good state, with
no flag to carry, and is still stopped when a run is resumed.
"""

from typing import TypeVar

import chex
import jax
import jax.numpy as jnp
import optax

T = TypeVar("T")

QUANTITIES = ("loss", "gradient", "parameters")

FAULTS = tuple(f"{name} became {how}" for name in QUANTITIES for how in ("NaN", "infinite"))
"""What can stop a seed, as the end of a sentence."""


def faults_of(loss: chex.Array, gradient_norm: chex.Array, params: chex.ArrayTree) -> chex.Array:
    """(FAULTS,) int32: one where the first of the quantities that is not finite has its place.

    A norm is finite only if every entry is, so three numbers stand for all.

    Args:
      loss, gradient_norm: () of the update.
      params: after the update.
    """
    values = jnp.stack([loss, gradient_norm, optax.tree.norm(params)])
    kinds = jnp.stack([jnp.isnan(values), jnp.isinf(values)], axis=-1)
    wrong = kinds.any(-1).astype(jnp.int32)
    earlier = jnp.cumsum(wrong, dtype=jnp.int32) - wrong
    return (kinds & (earlier == 0)[:, None]).reshape(-1).astype(jnp.int32)


def first_fault(faults: chex.Array) -> chex.Array:
    """() int32: 0 for none in the summed `faults` (FAULTS,), else 1 + its place in `FAULTS`."""
    return jnp.where(faults.any(), 1 + jnp.argmax(faults > 0), 0).astype(jnp.int32)


def unless(faults: chex.Array, new: T, old: T) -> T:
    """`new`, leaf by leaf, or where there are any faults `old`."""
    refused = faults.any()
    return jax.tree.map(lambda a, b: jnp.where(refused, b, a), new, old)
