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

from sumajax.policies.layers import Dense

EncoderKind = Literal["flat", "lab_gap", "linear"]
ENCODERS = get_args(EncoderKind)

STATE_FEATURES = 128
VIEW_FEATURES = 32
VIEW_KERNEL = 3
LIT_PATCHES = 4
"""Places of `flat`'s last convolution that one cell reaches at least, whatever the grid's size.

The rest of a state is 0: with the whole grid as fan-in, where an agent is changed the features by
hundredths at first, and one seed in three never learnt Predator-Capture-Prey (docs/settings.md).
"""


def patches(
    x: chex.Array, kernel: int, stride: int = 1, padding: Literal["SAME", "VALID"] = "VALID"
) -> chex.Array:
    """(..., rows, columns, c) -> (..., rows', columns', kernel^2 c): what a convolution looks at.

    A convolution written as one product with these is a matrix product, forwards and back; XLA's
    own convolutions of a few channels took four times as long on a CPU.
    """
    out = []
    for axis in (-3, -2):
        side = x.shape[axis]
        steps = -(-side // stride) if padding == "SAME" else (side - kernel) // stride + 1
        missing = max((steps - 1) * stride + kernel - side, 0)
        widths = [(0, 0)] * x.ndim
        widths[axis] = (missing // 2, missing - missing // 2)
        x = jnp.pad(x, widths) if missing else x
        out.append((steps - 1) * stride + 1)
    return jnp.concatenate(
        [
            x[..., a : a + out[0] : stride, b : b + out[1] : stride, :]
            for a in range(kernel)
            for b in range(kernel)
        ],
        axis=-1,
    )


class Conv(nn.Module):
    """A convolution over (..., rows, columns, c), initialised as in the originals."""

    features: int
    kernel: int
    stride: int = 1
    padding: Literal["SAME", "VALID"] = "VALID"

    @nn.compact
    def __call__(self, x: chex.Array) -> chex.Array:
        seen = patches(x, self.kernel, self.stride, self.padding)
        return Dense(self.features, before_relu=True, name="dense")(seen)


class StateEncoder(nn.Module):
    """(S, 1, rows, columns) state tensors -> (S, 128)."""

    kind: EncoderKind = "flat"

    @nn.compact
    def __call__(self, states: chex.Array) -> chex.Array:
        x = jnp.moveaxis(states, -3, -1)
        if self.kind == "flat":
            x = nn.relu(Conv(8, kernel=3, padding="SAME", name="conv1")(x))
            x = nn.relu(Conv(16, kernel=3, stride=2, padding="SAME", name="conv2")(x))
        if self.kind == "lab_gap":
            x = nn.relu(Conv(64, kernel=3, name="conv1")(x))
            x = nn.relu(Conv(STATE_FEATURES, kernel=2, name="conv2")(x))
            return x.mean((-3, -2))
        reached = LIT_PATCHES * x.shape[-1] if self.kind == "flat" else None
        dense = Dense(STATE_FEATURES, fan_in=reached, before_relu=True, name="dense")
        return nn.relu(dense(x.reshape(x.shape[0], -1)))


class ViewEncoder(nn.Module):
    """(..., c, m, m) views -> (..., 32): a convolution of at most 3x3, then a dense layer."""

    @nn.compact
    def __call__(self, view: chex.Array) -> chex.Array:
        kernel = min(VIEW_KERNEL, view.shape[-1])
        x = nn.relu(Conv(VIEW_FEATURES, kernel, name="conv")(jnp.moveaxis(view, -3, -1)))
        x = x.reshape(*view.shape[:-3], x.shape[-3] * x.shape[-2] * x.shape[-1])
        return nn.relu(Dense(VIEW_FEATURES, before_relu=True, name="dense")(x))


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
