"""State and view tensors -> features; the same for every policy (algorithms.md 5.2, our decision).

The paper says only "convolutional and fully-connected layers". `flat` reads positions exactly
because it flattens; `lab_gap` is the encoder of the authors' later public branch, which pools over
the grid and so cannot tell most inner cells of a native grid apart; `linear` has no convolution.
"""

from typing import Literal, get_args

import chex
import jax.numpy as jnp
import numpy as np
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
        starts, width = range(side - kernel + 1), channels * kernel**2
        patches = jnp.stack(
            [
                view[..., a : a + kernel, b : b + kernel].reshape(*view.shape[:-3], width)
                for a in starts
                for b in starts
            ],
            axis=-2,
        )
        x = nn.relu(Dense(VIEW_FEATURES, name="conv")(patches))
        x = x.reshape(*view.shape[:-3], len(starts) ** 2 * VIEW_FEATURES)
        return nn.relu(Dense(VIEW_FEATURES, name="dense")(x))


class ObservationEncoder(nn.Module):
    """State and view -> (..., N, features): one dense layer on [state features | view features].

    It has no activation, as the originals' input layer, so it is kept as its two halves and the
    state's half is computed once per cell.
    """

    features: int
    kind: EncoderKind = "flat"

    def setup(self) -> None:
        fan_in = STATE_FEATURES + VIEW_FEATURES
        self.state_encoder = StateEncoder(self.kind)
        self.view_encoder = ViewEncoder()
        self.merge_state = Dense(self.features, fan_in=fan_in)
        self.merge_view = Dense(self.features, use_bias=False, fan_in=fan_in)

    def encode_states(self, states: chex.Array) -> chex.Array:
        """(S, 1, rows, columns) -> (S, features)."""
        return self.merge_state(self.state_encoder(states))

    def __call__(
        self, state_features: chex.Array, view: chex.Array, sighted: np.ndarray
    ) -> chex.Array:
        """(..., N, features) of `encode_states`, view (..., N, c, m, m), sighted (N,) bool."""
        seen = self.view_encoder(view)
        if not sighted.all():
            seen = seen * jnp.asarray(sighted, seen.dtype)[:, None]
        return state_features + self.merge_view(seen)
