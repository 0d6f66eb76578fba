"""Saving: complete under its name in one rename, or not at all."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from sumajax.checkpoint.directory import SCRATCH, checkpoints, claim, discard, serial
from sumajax.checkpoint.files import file_digest, files_below, sync
from sumajax.checkpoint.format import (
    ARRAYS,
    DESCRIPTION,
    FORMAT,
    MAX_DESCRIPTION_BYTES,
    VERSION,
    Leaf,
    checked,
    checksum,
)
from sumajax.checkpoint.leaves import array_digest, host_arrays
from sumajax.checkpoint.orbax import save_arrays
from sumajax.description import CheckpointError, reason


def save(
    directory: str | os.PathLike[str],
    state: Any,
    meta: dict[str, Any],
    *,
    step: int | None = None,
    keep: int = 3,
) -> Path:
    """Writes `state` as the newest checkpoint of `directory` and returns where.

    The checkpoint appears under its name in one rename, when every byte of it is on disk: a kill
    at any moment leaves the earlier ones as they were. Synchronous: nothing goes on afterwards.

    Args:
      directory: made if missing; if it holds anything, then checkpoints of ours.
      state: any pytree of arrays: JAX (on any devices), numpy, typed PRNG keys, Python scalars
        (saved as the arrays JAX makes of them). Names of its parts: letters, digits, _ and -.
      meta: what the state is, as JSON (tuples come back as lists); see `describe`.
      step: number in the name, for people; `meta["epoch"]` (or 0) if not given.
      keep: how many checkpoints stay, this one included.

    Raises:
      CheckpointError: for a directory that is not ours or cannot be written, a full disk, a leaf
        that is no array, a `meta` that is no JSON.
    """
    root = Path(directory)
    try:
        json.dumps(meta)
        step = meta.get("epoch", 0) if step is None else step
    except (TypeError, ValueError, RecursionError, AttributeError) as error:
        raise CheckpointError(f"meta must be a dictionary of JSON: {reason(error)}.") from error
    for name, value, least in (("step", step, 0), ("keep", keep, 1)):
        is_whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
        if not is_whole or not least <= value < 10**18:
            raise CheckpointError(f"{name} must be a whole number from {least}, got {value!r}.")
    leaves, arrays = host_arrays(state)
    return _write(claim(root), leaves, arrays, meta, step, keep)


def _write(
    root: Path,
    leaves: dict[str, Leaf],
    arrays: dict[str, np.ndarray],
    meta: dict[str, Any],
    step: int,
    keep: int,
) -> Path:
    earlier = checkpoints(root)
    number = serial(earlier[0]) + 1 if earlier else 1
    scratch, final = root / f"{SCRATCH}{number:06d}", root / f"{number:06d}-step-{step}"
    try:
        scratch.mkdir()
        save_arrays(scratch / ARRAYS, arrays)
        _write_description(scratch, leaves, arrays, meta)
        os.rename(scratch, final)
        sync(root)
    except CheckpointError:
        raise
    # Orbax and TensorStore report a full disk, a lost mount and the like by many types.
    except Exception as error:
        raise CheckpointError(
            f"the checkpoint {final} could not be written: {reason(error)}; free space or choose "
            "another directory (the earlier checkpoints are as they were)."
        ) from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    for old in earlier[keep - 1 :]:
        discard(old)
    return final


def _write_description(
    path: Path, leaves: dict[str, Leaf], arrays: dict[str, np.ndarray], meta: dict[str, Any]
) -> None:
    content: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "meta": meta,
        "leaves": {
            name: {"shape": leaf.shape, "dtype": leaf.dtype, "sha256": array_digest(arrays[name])}
            for name, leaf in leaves.items()
        },
        "files": {},
    }
    for name, file in files_below(path).items():
        content["files"][name] = {"bytes": file.stat().st_size, "sha256": file_digest(file)}
        sync(file)
    # Through JSON once, so that the checksum is of what a reader will see.
    content = json.loads(json.dumps(content))
    checked(content)  # nothing is written that the reader would refuse
    text = json.dumps({**content, "checksum": checksum(content)}, indent=1)
    if len(text) > MAX_DESCRIPTION_BYTES:
        raise CheckpointError(
            f"the description of the checkpoint has {len(text)} bytes, more than the "
            f"{MAX_DESCRIPTION_BYTES} that are read; shorten meta."
        )
    (path / DESCRIPTION).write_text(text, encoding="utf-8")
    sync(path / DESCRIPTION)
    for folder, _, _ in os.walk(path):
        sync(Path(folder))
