"""What the tests of checkpoints save, and how they look at it afterwards."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from sumajax import checkpoint

META = {"epoch": 1}


@struct.dataclass
class TrainState:
    """Of the same make as the learner's."""

    params: Any
    opt_state: Any
    key: Any
    counters: Any


def train_state(seed: int = 0, seeds: int = 3) -> TrainState:
    """Every kind of leaf that a state may have, with a leading axis of seeds on some."""
    values = np.random.default_rng(seed)
    params = {
        "dense": {"kernel": jnp.asarray(values.normal(size=(seeds, 4, 5)), jnp.float32)},
        "half": jnp.asarray(values.normal(size=7), jnp.bfloat16),
    }
    return TrainState(
        params=params,
        opt_state=optax.adam(1e-3).init(params),
        key=jax.random.split(jax.random.key(seed), seeds),
        counters={
            "updates": jnp.int32(seed),
            "env_steps": np.uint64(2**63 + seed),
            "alive": np.array([True, False, True]),
            "exact": np.array([np.pi, np.nan, -0.0, np.inf]),
            "phase": np.complex64(1 + 2j),
            "nothing_yet": jnp.zeros((0, 3)),
            "bytes": np.arange(256, dtype=np.uint8),
            "python": [seed, 0.5, True],
        },
    )


def bits(tree: Any) -> list[tuple[str, str, tuple[int, ...], bytes]]:
    """Names, dtypes, shapes and bytes: equal only if nothing at all differs."""
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        dtype = str(jnp.asarray(leaf).dtype if not hasattr(leaf, "dtype") else leaf.dtype)
        if dtype.startswith("key"):
            leaf = jax.random.key_data(leaf)
        leaf = np.asarray(leaf if hasattr(leaf, "dtype") else jnp.asarray(leaf))
        found.append((jax.tree_util.keystr(path), dtype, leaf.shape, leaf.tobytes()))
    return found


def abstract(leaf: Any) -> jax.ShapeDtypeStruct:
    leaf = leaf if hasattr(leaf, "dtype") else jnp.asarray(leaf)
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)


def listing(directory: Path) -> dict[str, str]:
    return {
        str(file.relative_to(directory)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in directory.rglob("*")
        if file.is_file()
    }


def sealed(path: Path, **changes: Any) -> None:
    """Changes the description of a checkpoint and seals it again, as nobody does by accident.

    The format as documented: the checksum is the SHA-256 of the rest as canonical JSON; sizes and
    digests of the files are made anew from what is there.
    """
    content = json.loads((path / "checkpoint.json").read_text())
    content.pop("checksum")
    content["files"] = {
        file.relative_to(path).as_posix(): {
            "bytes": file.stat().st_size,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }
        for file in path.rglob("*")
        if file.is_file() and file.name != "checkpoint.json"
    }
    content |= changes
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    content["checksum"] = hashlib.sha256(canonical.encode()).hexdigest()
    (path / "checkpoint.json").write_text(json.dumps(content))


def files_of(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file())


def environment(**more: str) -> dict[str, str]:
    root = str(Path(checkpoint.__file__).parents[2])
    return {**os.environ, "PYTHONPATH": root, "JAX_PLATFORMS": "cpu", **more}
