"""State and view tensors -> features; the same for every policy (algorithms.md 5.2, our decision).

The paper says only "convolutional and fully-connected layers". `flat` reads positions exactly
because it flattens; `lab_gap` is the encoder of the authors' later public branch, which pools over
the grid and so cannot tell most inner cells of a native grid apart; `linear` has no convolution.
"""

from typing import Literal, get_args

import chex
import jax.numpy as jnp
from flax import linen as nn

from sumajax.policies.layers import Dense, uniform_fan_in

EncoderKind = Literal["flat", "lab_gap", "linear"]
ENCODERS = get_args(EncoderKind)

STATE_FEATURES = 128
VIEW_FEATURES = 32
VIEW_KERNEL = 3


def _conv(features: int, fan_in: int, kernel: int, padding: str, stride: int = 1) -> nn.Conv:
    init = uniform_fan_in(fan_in)
    return nn.Conv(
        features,
        (kernel, kernel),
        strides=(stride, stride),
        padding=padding,
        kernel_init=init,
        bias_init=init,
    )


class StateEncoder(nn.Module):
    """(S, 1, rows, columns) state tensors -> (S, 128)."""

    kind: EncoderKind = "flat"

    @nn.compact
    def __call__(self, states: chex.Array) -> chex.Array:
        x = jnp.moveaxis(states, -3, -1)
        if self.kind == "flat":
            x = nn.relu(_conv(8, fan_in=9, kernel=3, padding="SAME")(x))
            x = nn.relu(_conv(16, fan_in=72, kernel=3, padding="SAME", stride=2)(x))
        if self.kind == "lab_gap":
            x = nn.relu(_conv(64, fan_in=9, kernel=3, padding="VALID")(x))
            x = nn.relu(_conv(STATE_FEATURES, fan_in=256, kernel=2, padding="VALID")(x))
            return x.mean((-3, -2))
        return nn.relu(Dense(STATE_FEATURES, name="dense")(x.reshape(x.shape[0], -1)))


class ViewEncoder(nn.Module):
    """(..., c, m, m) views -> (..., 32): one valid convolution of at most 3x3, then a dense layer.

    The convolution is written as a product with all patches side by side: inside the scanned step
    that is one small matrix product, where XLA's CPU convolution has a cost of its own.
    """

    @nn.compact
    def __call__(self, view: chex.Array) -> chex.Array:
        channels, side = view.shape[-3], view.shape[-1]
        kernel = min(VIEW_KERNEL, side)
        starts = range(side - kernel + 1)
        patches = jnp.stack(
            [
                view[..., a : a + kernel, b : b + kernel].reshape(*view.shape[:-3], -1)
                for a in starts
                for b in starts
            ],
            axis=-2,
        )
        x = nn.relu(Dense(VIEW_FEATURES, name="conv", fan_in=channels * kernel**2)(patches))
        return nn.relu(Dense(VIEW_FEATURES, name="dense")(x.reshape(*view.shape[:-3], -1)))
