"""What a checkpoint is on disk: names, limits, and the description under a checksum."""

import hashlib
import json
import math
import os
import re
import stat
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from sumajax.description import CheckpointError, reason

FORMAT = "sumajax checkpoint"
VERSION = 1
"""Of the description; a reader refuses a higher one. The checksum is made the same way in all."""

DESCRIPTION = "checkpoint.json"
ARRAYS = "state"

MAX_DESCRIPTION_BYTES = 4 * 2**20
MAX_STATE_BYTES = 8 * 2**30
"""Of all arrays together, and of all files together, in a checkpoint that will be read."""


PART = re.compile(r"[\w-]+")
WIDTHS = {"int": (8, 16, 32, 64), "uint": (8, 16, 32, 64), "float": (16, 32, 64)}
DTYPES = {"bool", "bfloat16", "complex64", "complex128"} | {
    f"{kind}{width}" for kind, widths in WIDTHS.items() for width in widths
}
KEYS = {"key<fry>": ("threefry2x32", 2), "key<rbg>": ("rbg", 4), "key<urbg>": ("unsafe_rbg", 4)}
"""Typed PRNG keys: dtype -> implementation, 32-bit words of a key."""


class DamagedError(CheckpointError):
    """This one checkpoint is not what was written; an earlier one may be."""


class Leaf(NamedTuple):
    """What a leaf is, apart from its values."""

    shape: tuple[int, ...]
    dtype: str

    def __str__(self) -> str:
        return f"{self.dtype}{list(self.shape)}"

    @property
    def stored(self) -> tuple[tuple[int, ...], np.dtype]:
        """Shape and dtype on disk: a typed key is stored as its words."""
        if self.dtype in KEYS:
            return (*self.shape, KEYS[self.dtype][1]), np.dtype(np.uint32)
        return self.shape, jnp.dtype(self.dtype)

    @property
    def nbytes(self) -> int:
        shape, dtype = self.stored
        return math.prod(shape) * dtype.itemsize


class Description(NamedTuple):
    """A checked `checkpoint.json`."""

    meta: dict[str, Any]
    leaves: dict[str, Leaf]
    digests: dict[str, str]  # SHA-256 by leaf
    files: dict[str, tuple[int, str]]  # bytes, SHA-256 by path below the checkpoint
    checksum: str  # of all this


def checksum(content: dict[str, Any]) -> str:
    """Of the content, whatever its layout; made the same way in every version of the format."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def read_description(path: Path) -> Description:
    file = path / DESCRIPTION
    try:
        content = json.loads(_read_bounded(file))
        is_intact = content.pop("checksum") == checksum(content)
    except FileNotFoundError as error:
        raise DamagedError(f"{path} is damaged (its file {DESCRIPTION} is missing)") from error
    except (OSError, ValueError, RecursionError, AttributeError, KeyError, TypeError) as error:
        raise DamagedError(f"{file} is damaged ({reason(error)})") from error
    if not is_intact:
        raise DamagedError(f"{file} is damaged (its checksum does not match its content)")
    if content.get("format") != FORMAT:
        raise CheckpointError(f"{file} is not of sumajax; give a directory that sumajax saved to.")
    version = content.get("version")
    if version != VERSION:
        raise CheckpointError(
            f"{path} is of checkpoint format {version} and this sumajax reads {VERSION}; use the "
            "sumajax it was saved with, or a newer one."
        )
    try:
        return checked(content)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise CheckpointError(
            f"{file} describes no state that sumajax saves: {reason(error)}; use another "
            "checkpoint."
        ) from error


def _read_bounded(file: Path) -> bytes:
    status = os.stat(file)
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("it is not a regular file")
    if status.st_size > MAX_DESCRIPTION_BYTES:
        raise ValueError(f"it is larger than {MAX_DESCRIPTION_BYTES} bytes")
    with open(file, "rb") as opened:
        return opened.read(MAX_DESCRIPTION_BYTES)


def checked(content: dict[str, Any]) -> Description:
    """The description as typed values; anything else in it raises."""
    leaves = {}
    for name, leaf in content["leaves"].items():
        shape, dtype = tuple(leaf["shape"]), leaf["dtype"]
        if dtype not in DTYPES and dtype not in KEYS:
            raise ValueError(f"leaf {name} has dtype {dtype!r}")
        if not all(type(side) is int and 0 <= side < 2**48 for side in shape) or len(shape) > 32:
            raise ValueError(f"leaf {name} has shape {shape}")
        if not all(map(PART.fullmatch, name.split("/"))):
            raise ValueError(f"leaf name {name!r}")
        leaves[name] = Leaf(shape, dtype)
    if sum(leaf.nbytes for leaf in leaves.values()) > MAX_STATE_BYTES:
        raise ValueError(f"its arrays would need more than {MAX_STATE_BYTES} bytes")
    if not isinstance(content["meta"], dict):
        raise TypeError("meta is no dictionary")
    digests = {name: str(leaf["sha256"]) for name, leaf in content["leaves"].items()}
    files = {k: (v["bytes"], str(v["sha256"])) for k, v in content["files"].items()}
    for name, (size, _) in files.items():
        if not set(name.split("/")).isdisjoint({"", ".", ".."}):
            raise ValueError(f"file {name!r} is not below the checkpoint")
        # Orbax keeps values in folders called d; the rest it reads whole, as JSON and the like.
        limit = MAX_STATE_BYTES if "/d/" in name else MAX_DESCRIPTION_BYTES
        if type(size) is not int or not 0 <= size <= limit:
            raise ValueError(f"file {name} has {size} bytes")
    if sum(size for size, _ in files.values()) > MAX_STATE_BYTES:
        raise ValueError(f"its files have more than {MAX_STATE_BYTES} bytes")
    return Description(content["meta"], leaves, digests, files, checksum(content))
