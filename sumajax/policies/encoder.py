"""State and view tensors -> features; the same for every policy.

The paper says only "convolutional and fully-connected layers" (section IV-C), the sizes are this
package's: docs/reference/policies.md, Encoders. `flat` reads positions exactly because it flattens;
`lab_gap` is the encoder of the authors' later public branch, which pools over the grid and so
cannot tell most inner cells of a native grid apart; `linear` has no convolution.
"""

from typing import Any, Literal, get_args

import chex
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from sumajax.environments.states import SparseStates
from sumajax.policies.layers import Dense, lift
from sumajax.policies.lit_places import lit_places, sum_by_state

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
    own convolutions of a few channels took four times as long on a CPU. Of a NumPy array they are
    one too, and nothing is compiled for them.
    """
    xp: Any = np if isinstance(x, np.ndarray) else jnp
    out = []
    for axis in (-3, -2):
        side = x.shape[axis]
        steps = -(-side // stride) if padding == "SAME" else (side - kernel) // stride + 1
        missing = max((steps - 1) * stride + kernel - side, 0)
        widths = [(0, 0)] * x.ndim
        widths[axis] = (missing // 2, missing - missing // 2)
        x = xp.pad(x, widths) if missing else x
        out.append((steps - 1) * stride + 1)
    return xp.concatenate(
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

    def setup(self) -> None:
        self.dense = Dense(self.features, before_relu=True)

    def __call__(self, x: chex.Array) -> chex.Array:
        return self.dense(self.patches(x))

    def patches(self, x: chex.Array) -> chex.Array:
        return patches(x, self.kernel, self.stride, self.padding)


class StateEncoder(nn.Module):
    """(S, C, rows, columns) state tensors -> (S, 128).

    Sparse states and NumPy arrays are known when the program is compiled: `flat` then computes only
    what differs from an empty grid (`lit_places`), the same to rounding.
    """

    kind: EncoderKind = "flat"

    def setup(self) -> None:
        reached = None
        if self.kind == "flat":
            self.conv1 = Conv(8, kernel=3, padding="SAME")
            self.conv2 = Conv(16, kernel=3, stride=2, padding="SAME")
            reached = LIT_PATCHES * self.conv2.features
        if self.kind == "lab_gap":
            self.conv1 = Conv(64, kernel=3)
            self.conv2 = Conv(STATE_FEATURES, kernel=2)
        else:
            self.dense = Dense(STATE_FEATURES, fan_in=reached, before_relu=True)

    def __call__(self, states: chex.Array | SparseStates) -> chex.Array:
        if self.kind == "flat" and isinstance(states, np.ndarray):
            states = SparseStates.of(states)
        if self.kind == "flat" and isinstance(states, SparseStates):
            return nn.relu(self._known(states))
        if isinstance(states, SparseStates):
            states = states.dense()
        x = jnp.moveaxis(states, -3, -1)
        if self.kind != "linear":
            x = self._convolved(x)
        if self.kind == "lab_gap":
            return x.mean((-3, -2))
        return nn.relu(self.dense(x.reshape(x.shape[0], -1)))

    def _convolved(self, x: chex.Array) -> chex.Array:
        return nn.relu(self.conv2(nn.relu(self.conv1(x))))

    def _known(self, states: SparseStates) -> chex.Array:
        """`dense` of the convolutions of the states, by the places they light."""
        places = lit_places(states, self.conv1.patches, self.conv2.patches)
        channels, rows, columns = states.shape
        empty = self._convolved(jnp.zeros((1, rows, columns, channels), jnp.float32))
        inner = nn.relu(self.conv1.dense(places.seen))
        inner = inner * places.exists[:, None, :, None].astype(inner.dtype)
        lit = nn.relu(self.conv2.dense(inner.reshape(*places.state.shape, -1)))  # (P, M, channels)
        differs = lit - empty.reshape(-1, 1, lit.shape[-1])
        background = self.dense(empty.reshape(1, -1))
        kernel, _ = self.dense.weights(empty.size)
        of_place = differs @ kernel.reshape(*differs.shape[::2], -1)  # (P, M, features)
        return background + sum_by_state(of_place, places)


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

    def encode_states(self, states: chex.Array | SparseStates) -> chex.Array:
        """(S, C, rows, columns) -> (S, features)."""
        return self.merge_state(self.state_encoder(states))

    def __call__(
        self, state_features: chex.Array, view: chex.Array, sighted: np.ndarray
    ) -> chex.Array:
        """(..., N, features) of `encode_states`, view (..., N, c, m, m), sighted (N,) bool."""
        return state_features + self.merge_view(self.see(view, sighted))

    def see(self, view: chex.Array, sighted: np.ndarray) -> chex.Array:
        """(..., N, 32): the views, encoded; 0 for who does not see."""
        seen = self.view_encoder(view)
        if sighted.all():
            return seen
        return seen * lift(sighted[:, None], seen.ndim).astype(seen.dtype)

    def view_kernel(self) -> chex.Array:
        """(32, features): turns what is seen into its share of the merged features."""
        return self.merge_view.weights(VIEW_FEATURES)[0]
