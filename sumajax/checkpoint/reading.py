"""Loading: the very bits that were saved, or a sentence."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sumajax.checkpoint.directory import candidates, newest_good
from sumajax.checkpoint.files import verify_files
from sumajax.checkpoint.format import (
    ARRAYS,
    KEYS,
    DamagedError,
    Description,
    Leaf,
    read_description,
)
from sumajax.checkpoint.leaves import array_digest, compare, leaf_kind, named_leaves, nested
from sumajax.checkpoint.orbax import load_arrays
from sumajax.description import CheckpointError, reason


def load(
    directory: str | os.PathLike[str],
    like: Any = None,
    *,
    say: Callable[[str], None] | None = None,
) -> tuple[Any, dict[str, Any]]:
    """The newest good checkpoint, as (state, meta).

    Leaves come back on the host, as numpy arrays (typed keys as key arrays), so a checkpoint does
    not care how many devices wrote it; place them with `jax.device_put` or pass them to a jitted
    function.

    Args:
      directory: what `save` was given, or one of the checkpoints in it.
      like: a pytree of arrays or of `jax.ShapeDtypeStruct` (`jax.eval_shape`) whose structure the
        state takes; names, shapes and dtypes are compared before any array is read. None: nested
        dicts named after the fields, keys and indices of what was saved.
      say: is told when a damaged checkpoint is passed over for an earlier one; None: a warning.

    Raises:
      CheckpointError: when there is no checkpoint, none is good, the newest was written by a newer
        sumajax, or it differs from `like`; names the leaf and both shapes.
    """
    return newest_good(Path(directory), lambda path: restore(path, like, ""), say)


def load_params(
    directory: str | os.PathLike[str],
    like_params: Any = None,
    *,
    field: str = "params",
    say: Callable[[str], None] | None = None,
) -> Any:
    """Only the parameters (or another `field` of the state) of the newest good checkpoint.

    Arguments, errors and what comes back as for `load`, for that part of the state alone.
    """
    found = newest_good(Path(directory), lambda path: restore(path, like_params, f"{field}/"), say)
    return found[0]


def read_meta(
    directory: str | os.PathLike[str], *, say: Callable[[str], None] | None = None
) -> dict[str, Any]:
    """What the newest good checkpoint is, without its arrays (their files are checked)."""

    return newest_good(Path(directory), _verified, say).meta


def identity(directory: str | os.PathLike[str], *, say: Callable[[str], None] | None = None) -> str:
    """What the newest good checkpoint is, wherever it lies: the SHA-256 of its description.

    The description holds the digest of every leaf and every file, so two checkpoints of one
    identity are copies of each other. Costs what `read_meta` costs.
    """
    return newest_good(Path(directory), _verified, say).checksum


def latest(directory: str | os.PathLike[str]) -> Path | None:
    """Where the newest checkpoint lies, good or not; None when there is none to go on from."""
    root = Path(directory)
    return next(iter(candidates(root)), None)


def _verified(path: Path) -> Description:
    description = read_description(path)
    verify_files(path, description)
    return description


def restore(path: Path, like: Any, prefix: str) -> tuple[Any, dict[str, Any]]:
    """The part of the state whose names start with `prefix`, and meta."""
    description = read_description(path)
    leaves = {k: leaf for k, leaf in description.leaves.items() if k.startswith(prefix)}
    if not leaves:
        raise CheckpointError(
            f"{path} holds no {prefix.rstrip('/')}; give a checkpoint of a training run."
        )
    wanted = {} if like is None else named_leaves(like)
    if like is not None:
        compare(path, leaves, {prefix + k: leaf_kind(k, leaf) for k, leaf in wanted.items()})
    verify_files(path, description)
    found = _read_arrays(path, leaves, description)
    if like is None:
        return nested({name.removeprefix(prefix): leaf for name, leaf in found.items()}), (
            description.meta
        )
    ordered = [found[prefix + name] for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), ordered), description.meta


def _read_arrays(path: Path, leaves: dict[str, Leaf], description: Description) -> dict[str, Any]:
    """Values by name, each the very bytes that were saved."""
    files = [k.removeprefix(f"{ARRAYS}/") for k in description.files if k.startswith(f"{ARRAYS}/")]
    stored = {name: leaf.stored for name, leaf in leaves.items() if leaf.nbytes}
    try:
        arrays = load_arrays(path / ARRAYS, files, stored)
    except CheckpointError:
        raise
    # Whatever Orbax and TensorStore make of files that they cannot read.
    except Exception as error:
        raise DamagedError(f"{path / ARRAYS} cannot be read ({reason(error)})") from error
    found: dict[str, Any] = {}
    for name, leaf in leaves.items():
        shape, dtype = leaf.stored
        array = np.asarray(arrays[name]) if name in stored else np.zeros(shape, dtype)
        if (array.shape, array.dtype) != (shape, dtype) or array_digest(array) != (
            description.digests[name]
        ):
            raise DamagedError(f"{path} is damaged (leaf {name} is not what was saved)")
        keys = KEYS.get(leaf.dtype)
        found[name] = jax.random.wrap_key_data(jnp.asarray(array), impl=keys[0]) if keys else array
    return found
