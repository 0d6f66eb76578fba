"""State and view tensors -> features; the same for every policy.

The paper says only "convolutional and fully-connected layers" (section IV-C), the sizes are this
package's: docs/reference/policies.md, Encoders. `flat` reads positions exactly because it flattens;
`flat_published` is the same, started as the originals start their layers, and so says next to
nothing of a position at first; `lab_gap` is the encoder of the authors' later public branch, which
pools over the grid and so cannot tell most inner cells of a native grid apart; `linear` has no
convolution; `coordinates` reads where the state is lit, as a share of the grid's sides, and so is
of no grid's size.
"""

import math
from functools import partial
from typing import Any, Literal, get_args

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from sumajax.environments.states import SparseStates
from sumajax.policies.layers import Dense, lift
from sumajax.policies.lit_places import lit_places, sum_by_state

EncoderKind = Literal["flat", "flat_published", "lab_gap", "linear", "coordinates"]
ENCODERS = get_args(EncoderKind)
FLAT: tuple[EncoderKind, ...] = ("flat", "flat_published")
Resize = Literal["nearest", "bilinear"]

STATE_FEATURES = 128
VIEW_FEATURES = 32
VIEW_KERNEL = 3
PLACE_CELLS, PLACE_CHANNELS = 2, 16
"""Cells along a side, and channels, of a place of `flat`'s last convolution."""
LIT_PATCHES = 4
"""Places of `flat`'s last convolution that one cell reaches at least, whatever the grid's size.

The rest of a state is 0: with the whole grid as fan-in, where an agent is changed the features by
hundredths at first, and one seed in three never learnt Predator-Capture-Prey (docs/settings.md).
"""

FOURIER_BANDS = 2
"""Frequencies of `coordinates`: half a turn and a whole one from edge to edge.

On 5x5 neighbours are then a quarter of a turn apart. A third would turn by a half from cell to
cell: its sine is 0 everywhere on that grid, and its weights would come to a larger one untrained.
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
    """A convolution over (..., rows, columns, c), to be followed by a ReLU.

    Attributes:
      published: initialised as in the originals, not as He et al. 2015.
    """

    features: int
    kernel: int
    stride: int = 1
    padding: Literal["SAME", "VALID"] = "VALID"
    published: bool = False

    def setup(self) -> None:
        self.dense = Dense(self.features, before_relu=not self.published)

    def __call__(self, x: chex.Array) -> chex.Array:
        return self.dense(self.patches(x))

    def patches(self, x: chex.Array) -> chex.Array:
        return patches(x, self.kernel, self.stride, self.padding)


class StateEncoder(nn.Module):
    """(S, C, rows, columns) state tensors -> (S, 128).

    Sparse states and NumPy arrays are known when the program is compiled: `FLAT` then computes only
    what differs from an empty grid (`lit_places`), the same to rounding.
    """

    kind: EncoderKind = "flat"

    def setup(self) -> None:
        reached, published = None, self.kind == "flat_published"
        if self.kind in FLAT:
            conv = partial(Conv, kernel=3, padding="SAME", published=published)
            self.conv1 = conv(8)
            self.conv2 = conv(PLACE_CHANNELS, stride=PLACE_CELLS)
            reached = None if published else LIT_PATCHES * self.conv2.features
        if self.kind == "lab_gap":
            self.conv1 = Conv(64, kernel=3)
            self.conv2 = Conv(STATE_FEATURES, kernel=2)
        else:
            self.dense = Dense(STATE_FEATURES, fan_in=reached, before_relu=not published)

    def __call__(self, states: chex.Array | SparseStates) -> chex.Array:
        if self.kind in FLAT and isinstance(states, np.ndarray):
            states = SparseStates.of(states)
        if self.kind in FLAT and isinstance(states, SparseStates):
            return nn.relu(self._known(states))
        if self.kind == "coordinates":
            return nn.relu(self.dense(fourier_features(states)))
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


# --- What is of no grid's size -----------------------------------------------------------------


def lit_centres(states: chex.Array | SparseStates) -> tuple[chex.Array, chex.Array]:
    """Where states (S, C, rows, columns) are lit.

    Returns:
      (S, C, 2) row and column of the mean lit cell, 0 at the first and 1 at the last of the grid;
      (S, C) 1 where anything is lit, else 0.
    """
    rows, columns = states.shape[-2:]
    sides = [np.linspace(0, 1, side, dtype=np.float32) for side in (rows, columns)]
    if isinstance(states, SparseStates):
        channel, row, column = states.places()
        sums = np.zeros((3, len(states), states.shape[0]), np.float32)
        state = np.arange(len(states))[:, None]
        weights = (1.0, sides[0][row], sides[1][column])
        for total, weight in zip(sums, weights, strict=True):
            np.add.at(total, (state, channel), states.value * weight)
        mass, *moments = jnp.asarray(sums)
    else:
        mass = states.sum((-2, -1))
        moments = [states.sum(-1) @ sides[0], states.sum(-2) @ sides[1]]
    lit = (mass > 0).astype(jnp.float32)
    at = jnp.stack(moments, axis=-1) / (mass + 1 - lit)[..., None]
    return at, lit


def fourier_features(states: chex.Array | SparseStates) -> chex.Array:
    """(S, C, rows, columns) -> (S, 2 C (1 + 2 FOURIER_BANDS)): where each channel is lit; zeros
    where it is not.

    Row and column as they are, between -1 and 1, and as sines and cosines (Mildenhall et al. 2020,
    NeRF, equation 4; Tancik et al. 2020).
    """
    at, lit = lit_centres(states)
    turns = math.pi * 2.0 ** np.arange(FOURIER_BANDS, dtype=np.float32)
    angle = at[..., None] * turns.astype(np.float32)[None, None, None]
    features = [2 * at[..., None] - 1, jnp.sin(angle), jnp.cos(angle)]
    x = jnp.concatenate(features, axis=-1) * lit[..., None, None]
    return x.reshape(x.shape[0], math.prod(x.shape[1:]))


# --- The position table, and another grid ------------------------------------------------------


def table_grid(kind: EncoderKind, state_shape: tuple[int, int, int]) -> tuple[int, int, int]:
    """Rows, columns and channels of the position table: what the kernel of `dense` has a row for.

    Raises:
      ValueError: for an encoder that has none.
    """
    channels, rows, columns = state_shape
    if kind == "linear":
        return rows, columns, channels
    if kind in FLAT:
        return -(-rows // PLACE_CELLS), -(-columns // PLACE_CELLS), PLACE_CHANNELS
    raise ValueError(f"encoder {kind!r} has no position table to resize; use 'flat' or 'linear'.")


def resized_table(
    kernel: chex.Array,
    before: tuple[int, int, int],
    after: tuple[int, int, int],
    method: Resize,
) -> chex.Array:
    """A position table of one grid for another, as position embeddings of vision transformers are
    (Dosovitskiy et al. 2021, section 3.2).

    Args:
      kernel: (S, rows * columns * channels of `before`, F).

    Returns:
      (S, rows * columns * channels of `after`, F).

    With `linear` and the nearest row it encodes a small state as the small grid did, and a cell of
    the large grid as the cell of the small one that upsampling makes it a part of.
    """
    seeds, _, features = kernel.shape
    table = jnp.reshape(kernel, (seeds, *before, features))
    large = jax.image.resize(table, (seeds, *after, features), method)
    return large.reshape(seeds, math.prod(after), features)


class ViewEncoder(nn.Module):
    """(..., c, m, m) views -> (..., 32): a convolution of at most 3x3, then a dense layer.

    Attributes:
      kind: of the state's encoder; `flat_published` starts this one as the originals do too.
    """

    kind: EncoderKind = "flat"

    @nn.compact
    def __call__(self, view: chex.Array) -> chex.Array:
        kernel = min(VIEW_KERNEL, view.shape[-1])
        published = self.kind == "flat_published"
        conv = Conv(VIEW_FEATURES, kernel, published=published, name="conv")
        x = nn.relu(conv(jnp.moveaxis(view, -3, -1)))
        x = x.reshape(*view.shape[:-3], x.shape[-3] * x.shape[-2] * x.shape[-1])
        return nn.relu(Dense(VIEW_FEATURES, before_relu=not published, name="dense")(x))


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
        self.view_encoder = ViewEncoder(self.kind)
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
