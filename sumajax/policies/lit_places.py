"""The encoder `flat` on states that are known when a program is compiled, nearly all of them zeros.

A task lists the state tensors it can have, one per cell. Each has a block of lit cells and is empty
elsewhere, so all but a few places of a convolution see what they see on an empty grid. Those few
are computed; the dense layer that follows takes the empty grid's features and adds what differs.
On a 20x20 grid that is 3,600 places instead of 40,000, and a tenth of the products.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import chex
import jax.numpy as jnp
import numpy as np

from sumajax.environments.states import SparseStates


@dataclass(frozen=True)
class LitPlaces:
    """Where S states light P places of a second convolution, by place, filled up to M each."""

    seen: np.ndarray  # (P, M, K, k): the cells each of a place's K first-convolution places sees
    exists: np.ndarray  # (P, K) bool: that first-convolution place is inside the grid
    state: np.ndarray  # (P, M) int32: which state it is; S where there is none
    num_states: int  # S


Patches = Callable[[np.ndarray], np.ndarray]
"""(1, rows, columns, c) -> (1, rows', columns', c'): what a convolution looks at."""


def lit_places(states: SparseStates, first: Patches, second: Patches) -> LitPlaces:
    """The places of `second` after `first` at which states are not empty.

    Worked out from the entries of the states and what looks at each: no state is written out.
    """
    looks, exists = _looks(states.shape, first, second)
    num_places, num_states = len(looks), len(states)
    state, entry = np.nonzero(states.value)
    at, place, within = _lookers(states.cell[state, entry], looks.reshape(num_places, -1))
    # One slot for each place and state that lights it, by place, then by state.
    lit, slot = np.unique(place * num_states + state[at], return_inverse=True)
    of_place = lit // num_states
    count = np.bincount(of_place, minlength=num_places)
    rank = np.arange(len(lit)) - (np.cumsum(count) - count)[of_place]
    most = count.max(initial=1)
    seen = np.zeros((num_places, most, *looks.shape[1:]), np.float32)
    value = states.value[state, entry]
    np.add.at(seen.reshape(num_places, most, -1), (place, rank[slot], within), value[at])
    which = np.full((num_places, most), num_states, np.int32)
    which[of_place, rank] = lit % num_states
    return LitPlaces(seen=seen, exists=exists, state=which, num_states=num_states)


def _looks(
    shape: tuple[int, int, int], first: Patches, second: Patches
) -> tuple[np.ndarray, np.ndarray]:
    """What a place looks at: entries of a state of `shape`, through places of `first`.

    Returns:
      (P, K, k) int32 which entry each input is, from 1, 0 for none; (P, K) bool whether that place
      of `first` is inside the grid.
    """
    numbers = np.arange(1, 1 + math.prod(shape), dtype=np.int32).reshape(shape)
    once = first(np.moveaxis(numbers, 0, -1)[None])
    twice = second(once)[0]
    exists = second(np.ones((1, *once.shape[1:3], 1), bool))[0]
    inputs = once.shape[-1]
    looks = twice.reshape(-1, twice.shape[-1] // inputs, inputs)
    return looks, exists.reshape(len(looks), -1)


def _lookers(cell: np.ndarray, looks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Who looks at each of some entries, as (L,) int arrays: which of `cell`, place, input.

    Args:
      cell: (n,) numbers of entries, from 0.
      looks: (P, I) which entry each input of a place is, from 1; 0 for none.
    """
    inputs = looks.shape[1]
    order = np.argsort(looks.ravel(), kind="stable")
    ordered = looks.ravel()[order]
    begin, end = (np.searchsorted(ordered, cell + 1, side) for side in ("left", "right"))
    count = end - begin
    at = np.repeat(np.arange(len(cell)), count)
    number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    looker = order[begin[at] + number]
    return at, looker // inputs, looker % inputs


def sum_by_state(of_place: chex.Array, places: LitPlaces) -> chex.Array:
    """(P, M, F) -> (S, F): added up over the places of each state."""
    rows = of_place.reshape(-1, of_place.shape[-1])
    sums = jnp.zeros((places.num_states, rows.shape[-1]), rows.dtype)
    return sums.at[places.state.reshape(-1)].add(rows, mode="drop")
