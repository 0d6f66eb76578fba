"""Layers with the originals' parameters and initialisation (algorithms.md of the specification, 1.3).

The published programs are PyTorch: dense, convolution and LSTM tensors start uniform within
+-1/sqrt(fan_in), and an LSTM has two bias vectors, which matters to RMSprop: their sum moves at
twice the learning rate.
"""

from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn
from jax.nn.initializers import Initializer


def uniform_fan_in(fan_in: int) -> Initializer:
    """U(-1/sqrt(fan_in), 1/sqrt(fan_in)), the default of the originals' layers."""
    bound = fan_in**-0.5

    def init(key: chex.PRNGKey, shape: Any, dtype: Any = jnp.float32, **_: Any) -> chex.Array:
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return init


class Dense(nn.Module):
    """x @ kernel + bias, initialised as in the originals; `fan_in` where the input is a part."""

    features: int
    use_bias: bool = True
    fan_in: int | None = None

    @nn.compact
    def __call__(self, x: chex.Array) -> chex.Array:
        init = uniform_fan_in(self.fan_in or x.shape[-1])
        y = x @ self.param("kernel", init, (x.shape[-1], self.features))
        return y + self.param("bias", init, (self.features,)) if self.use_bias else y


class LSTMCell(nn.Module):
    """z = x w_ih + b_ih + h w_hh + b_hh in blocks i, f, g, o; both products as one."""

    features: int

    @nn.compact
    def __call__(
        self, carry: tuple[chex.Array, chex.Array], x: chex.Array
    ) -> tuple[chex.Array, chex.Array]:
        """carry (h, s), each (..., features), and x (..., U) -> the next (h, s)."""
        h, s = carry
        init, gates = uniform_fan_in(self.features), 4 * self.features
        w_ih = self.param("w_ih", init, (x.shape[-1], gates))
        w_hh = self.param("w_hh", init, (self.features, gates))
        bias = self.param("b_ih", init, (gates,)) + self.param("b_hh", init, (gates,))
        z = jnp.concatenate([x, h], axis=-1) @ jnp.concatenate([w_ih, w_hh]) + bias
        return lstm_gates(z, s)


def lstm_gates(z: chex.Array, s: chex.Array) -> tuple[chex.Array, chex.Array]:
    """Pre-activations (..., 4H) in blocks i, f, g, o and cell (..., H) -> the next (h, s)."""
    i, f, g, o = jnp.split(z, 4, axis=-1)
    s = jax.nn.sigmoid(f) * s + jax.nn.sigmoid(i) * jnp.tanh(g)
    return jax.nn.sigmoid(o) * jnp.tanh(s), s
