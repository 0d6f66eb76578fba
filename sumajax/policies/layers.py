"""Layers with the originals' parameters and initialisation.

See docs/reference/policies.md, First values.

The published programs are PyTorch: dense, convolution and LSTM tensors start uniform within
+-1/sqrt(fan_in), and an LSTM has two bias vectors, which matters to RMSprop: their sum moves at
twice the learning rate.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, TypeVar

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax.nn.initializers import Initializer, zeros

ArrayT = TypeVar("ArrayT", np.ndarray, chex.Array)

HE_GAIN = 6**0.5
"""Bound of a uniform distribution of variance 2, for inputs of which ReLU lets half through."""


def uniform_fan_in(fan_in: float) -> Initializer:
    """U(-1/sqrt(fan_in), 1/sqrt(fan_in)), the default of the originals' layers."""
    bound = fan_in**-0.5

    def init(key: Any, shape: Any, dtype: Any = None, out_sharding: Any = None) -> chex.Array:
        return jax.random.uniform(key, shape, dtype or jnp.float32, -bound, bound)

    return init


def lift(x: ArrayT, ndim: int) -> ArrayT:
    """x with axes of 1 in front, `ndim` in all: broadcasting written out.

    A program may have forbidden JAX to do it unasked (`jax_numpy_rank_promotion="raise"`).
    """
    return x.reshape((1,) * (ndim - x.ndim) + x.shape)


def add_bias(y: chex.Array, bias: chex.Array) -> chex.Array:
    """y (..., O) + bias (O,)."""
    return y + lift(bias, y.ndim)


def product(x: chex.Array, kernel: chex.Array) -> chex.Array:
    """x (..., I) @ kernel (I, O) -> (..., O), as one product of two matrices.

    With more leading axes than one XLA transposes the cotangent in memory before it multiplies it
    for the kernel's derivative: a tenth of an LSTM's time.
    """
    rows = math.prod(x.shape[:-1])
    return (x.reshape(rows, x.shape[-1]) @ kernel).reshape(*x.shape[:-1], kernel.shape[-1])


class Dense(nn.Module):
    """x @ kernel + bias, initialised as in the originals.

    Attributes:
      fan_in: of the initialisation, where the input is a part of what is added up, or mostly 0.
      before_relu: initialise as He et al. 2015 instead, variance 2 / fan_in and no bias, so that a
        stack of such layers neither loses its input nor hides it behind a constant.
    """

    features: int
    use_bias: bool = True
    fan_in: int | None = None
    before_relu: bool = False

    def __call__(self, x: chex.Array) -> chex.Array:
        kernel, bias = self.weights(x.shape[-1])
        y = product(x, kernel)
        return y if bias is None else add_bias(y, bias)

    @nn.compact
    def weights(self, in_features: int) -> tuple[chex.Array, chex.Array | None]:
        """kernel (in_features, features) and bias (features,)."""
        fan_in = self.fan_in or in_features
        init = uniform_fan_in(fan_in / HE_GAIN**2 if self.before_relu else fan_in)
        bias_init = partial(zeros, dtype=jnp.float32) if self.before_relu else init
        kernel = self.param("kernel", init, (in_features, self.features))
        return kernel, self.param("bias", bias_init, (self.features,)) if self.use_bias else None


def side_by_side(layers: Sequence[Dense], x: chex.Array) -> list[chex.Array]:
    """What each of `layers` makes of x, computed as one matrix product."""
    weights = [layer.weights(x.shape[-1]) for layer in layers]
    kernel = jnp.concatenate([kernel for kernel, _ in weights], axis=-1)
    bias = jnp.concatenate([bias for _, bias in weights if bias is not None], axis=-1)
    widths = [layer.features for layer in layers]
    return jnp.split(add_bias(product(x, kernel), bias), np.cumsum(widths)[:-1].tolist(), axis=-1)


class LSTMCell(nn.Module):
    """z = x w_ih + b_ih + h w_hh + b_hh in blocks i, f, g, o."""

    features: int
    in_features: int

    def setup(self) -> None:
        init, gates = uniform_fan_in(self.features), 4 * self.features
        self.w_ih = self.param("w_ih", init, (self.in_features, gates))
        self.w_hh = self.param("w_hh", init, (self.features, gates))
        self.b_ih = self.param("b_ih", init, (gates,))
        self.b_hh = self.param("b_hh", init, (gates,))

    def __call__(
        self, carry: tuple[chex.Array, chex.Array], x: chex.Array
    ) -> tuple[chex.Array, chex.Array]:
        """carry (h, s), each (..., H), and x (..., U) -> the next (h, s); one matrix product."""
        weights = jnp.concatenate([self.w_ih, self.w_hh])
        return self.step_folded(carry, lift(self.b_ih + self.b_hh, x.ndim), x, weights)

    def project_input(self, x: chex.Array) -> chex.Array:
        """x (..., U) -> (..., 4H): its share of z and both biases, for `step_projected`."""
        return add_bias(product(x, self.w_ih), self.b_ih + self.b_hh)

    def step_projected(
        self, carry: tuple[chex.Array, chex.Array], projected: chex.Array
    ) -> tuple[chex.Array, chex.Array]:
        """`__call__` with the input already through `project_input`: half the work per step."""
        h, s = carry
        return lstm_gates(projected + product(h, self.w_hh), s)

    def fold(self, kernel: chex.Array) -> chex.Array:
        """(I + H, 4H) for `step_folded`, of an input that is y @ kernel (I, H)."""
        return jnp.concatenate([kernel @ self.w_ih, self.w_hh])

    def step_folded(
        self,
        carry: tuple[chex.Array, chex.Array],
        projected: chex.Array,
        y: chex.Array,
        folded: chex.Array,
    ) -> tuple[chex.Array, chex.Array]:
        """`__call__` with x = constant + y @ kernel, from `project_input(constant)` and `fold`."""
        h, s = carry
        return lstm_gates(projected + product(jnp.concatenate([y, h], axis=-1), folded), s)


@jax.custom_vjp
def lstm_gates(z: chex.Array, s: chex.Array) -> tuple[chex.Array, chex.Array]:
    """Pre-activations (..., 4H) in blocks i, f, g, o and cell (..., H) -> the next (h, s).

    Its derivative is written out, so that a scan keeps six arrays for the way back instead of a
    dozen, and has only products left to do there.
    """
    return _lstm_gates_forward(z, s)[0]


def _sigmoid(z: chex.Array) -> chex.Array:
    """By the hyperbolic tangent, which XLA makes of fewer instructions than an exponential."""
    return 0.5 * jnp.tanh(0.5 * z) + 0.5


def _lstm_gates_forward(z: chex.Array, s: chex.Array) -> tuple[Any, Any]:
    i, f, g, o = jnp.split(z, 4, axis=-1)
    i, f, g, o = _sigmoid(i), _sigmoid(f), jnp.tanh(g), _sigmoid(o)
    next_s = f * s + i * g
    squashed = jnp.tanh(next_s)
    slopes = (g * i * (1 - i), s * f * (1 - f), i * (1 - g**2), squashed * o * (1 - o))
    return (o * squashed, next_s), (*slopes, f, o * (1 - squashed**2))


def _lstm_gates_backward(kept: Any, cotangents: Any) -> tuple[chex.Array, chex.Array]:
    (slope_i, slope_f, slope_g, slope_o, f, through), (d_h, d_next_s) = kept, cotangents
    d_s = d_next_s + d_h * through
    d_z = [d_s * slope_i, d_s * slope_f, d_s * slope_g, d_h * slope_o]
    return jnp.concatenate(d_z, axis=-1), d_s * f


lstm_gates.defvjp(_lstm_gates_forward, _lstm_gates_backward)


def straight_through_bit(logits: chex.Array, noise: chex.Array) -> chex.Array:
    """Hard binary Gumbel-softmax at temperature 1: component 1 of two-class logits (..., 2).

    The difference of two Gumbel variables is logistic, so one number per bit, `noise` (...,), says
    all: 1 where logits[1] - logits[0] + noise > 0, else 0. The derivative is that of the sigmoid of
    the same number.
    """
    z = logits[..., 1] - logits[..., 0] + noise
    soft = jax.nn.sigmoid(z)
    # hard + (soft - soft), in this order: exactly 0 or 1 in any precision.
    return (z > 0).astype(soft.dtype) + (soft - jax.lax.stop_gradient(soft))
