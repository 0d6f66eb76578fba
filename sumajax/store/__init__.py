"""Trained policies that come with the package: parameters in one byte each, and a card.

    policies/NAME.json    the card: what it is of, how it was made, what it reaches
    policies/NAME.npz     the parameters

All policies together are to stay below 4 MiB, so that everybody who installs the package gets them.
A matrix is therefore kept as whole numbers from -63 to 63 with a float32 scale for each of its
columns; everything smaller is float32. The card's figures are those of the parameters that come
back, not of the ones that training ended with. `python -m experiments.pretrained RUN` makes entries
of the stages of a finished run.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sumajax.checkpoint import CheckpointError
from sumajax.checkpoint.leaves import compare, leaf_kind, named_leaves, nested
from sumajax.checkpoint.npz import packed, unpacked
from sumajax.reporting.metrics import write_bytes, write_json

FOLDER = Path(__file__).parent / "policies"
LARGEST = 63
"""Of the whole numbers that an entry of a matrix is kept as: seven bits, the same either side of 0,
so that there is room for every kind of policy; what rounding costs: docs/pretrained.md."""
SCALE = "/scale"
"""After a leaf's name: what a one stands for in each of its columns."""


def names() -> tuple[str, ...]:
    """Of every trained policy of the package."""
    return tuple(sorted(file.stem for file in FOLDER.glob("*.json")))


def is_named(place: str | os.PathLike[str]) -> bool:
    """Whether `place` means a policy of the package: its name, where no such file is at hand."""
    return os.fspath(place) in names() and not os.path.lexists(place)


def card(name: str) -> dict[str, Any]:
    """What a policy of the package is, how it was made and what it reaches.

    Raises:
      ValueError: for an unknown name; lists the known.
    """
    return dict(entry(name).card)


def entry(name: str) -> "Entry":
    """A policy of the package by its name; errors as for `card`."""
    if name not in names():
        raise ValueError(
            f"the package has no trained policy {name!r}; it has {', '.join(names()) or 'none'}."
        )
    return Entry(name, json.loads((FOLDER / f"{name}.json").read_text()))


@dataclass(frozen=True)
class Entry:
    """A policy of the package; a `sumajax.sources.Source`."""

    name: str
    card: dict[str, Any]

    @property
    def meta(self) -> dict[str, Any]:
        """What a checkpoint of it would say (`sumajax.description.describe`)."""
        return dict(self.card["meta"])

    def identity(self) -> str:
        """SHA-256 of its parameters: the same for the same policy, whatever it is called."""
        return str(self.card["file"]["sha256"])

    def load(self, like: Any, field: str = "params") -> Any:
        """The parameters, compared with `like`.

        Args:
          like: a tree of arrays, or of abstract ones; a leading axis of one seed is added where it
            has one.

        Raises:
          CheckpointError: for a field but `params`, a damaged file, or parameters unlike `like`.
        """
        if field != "params":
            raise CheckpointError(
                f"{self.name} holds no {field}: the trained policies of the package are parameters "
                "alone; start from a run's checkpoints, or without it."
            )
        arrays = _arrays(self.name, self.identity())
        wanted = named_leaves(like)
        seeded = bool(wanted) and all(
            name in arrays and leaf.ndim == arrays[name].ndim + 1 for name, leaf in wanted.items()
        )
        if seeded:
            arrays = {name: array[None] for name, array in arrays.items()}
        kinds = {name: leaf_kind(name, array) for name, array in arrays.items()}
        compare(Path(self.name), kinds, {k: leaf_kind(k, leaf) for k, leaf in wanted.items()})
        return jax.tree.unflatten(jax.tree.structure(like), [arrays[name] for name in wanted])


@cache
def _arrays(name: str, digest: str) -> dict[str, np.ndarray]:
    """The parameters by name."""
    file = FOLDER / f"{name}.npz"
    content = file.read_bytes()
    if hashlib.sha256(content).hexdigest() != digest:
        raise CheckpointError(f"{file} is damaged; install the package again.")
    return restored(unpacked(content))


def write(name: str, card: Mapping[str, Any], params: Any, folder: Path = FOLDER) -> Path:
    """Adds a policy to the store, or renews it, and returns its card's file."""
    content = packed(rounded(params))
    digest = hashlib.sha256(content).hexdigest()
    write_bytes(folder / f"{name}.npz", content)
    file = folder / f"{name}.json"
    write_json(file, {**card, "file": {"bytes": len(content), "sha256": digest}})
    return file


# --- A byte per parameter ----------------------------------------------------------------------


def rounded(params: Any) -> dict[str, np.ndarray]:
    """Leaves by name as they are kept: a matrix as int8 with a scale for each of its columns."""
    kept: dict[str, np.ndarray] = {}
    for name, leaf in named_leaves(params).items():
        array = np.asarray(leaf)
        if array.ndim < 2 or array.dtype != np.float32:
            kept[name] = array
            continue
        most = np.abs(array).max(axis=tuple(range(array.ndim - 1)))
        # A column of zeros has no scale of its own.
        scale = np.where(most > 0, most / np.float32(LARGEST), np.float32(1.0)).astype(np.float32)
        kept[name] = np.rint(array / scale).astype(np.int8)
        kept[name + SCALE] = scale
    return kept


def restored(kept: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Leaves by name as float32, from what `rounded` made."""
    return {
        name: array * kept[name + SCALE] if name + SCALE in kept else array
        for name, array in kept.items()
        if not name.endswith(SCALE)
    }


def as_kept(params: Any) -> Any:
    """The parameters that come back from the store, in nested dictionaries."""
    return nested(restored(rounded(params)))
