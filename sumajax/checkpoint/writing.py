"""Saving: complete under its name in one rename, or not at all."""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sumajax.checkpoint.directory import (
    SCRATCH,
    checkpoints,
    claim,
    discard,
    next_serial,
    remove_unfinished,
)
from sumajax.checkpoint.files import file_digest, files_below, remove, sync
from sumajax.checkpoint.format import (
    ARRAYS,
    DESCRIPTION,
    FORMAT,
    MAX_DESCRIPTION_BYTES,
    VERSION,
    DamagedError,
    Leaf,
    checked,
    checksum,
)
from sumajax.checkpoint.leaves import array_digest, host_arrays
from sumajax.checkpoint.orbax import save_arrays
from sumajax.checkpoint.reading import restore
from sumajax.description import CheckpointError, reason
from sumajax.plain import is_values, plain

ROOM, ROOM_PER_LEAF, ROOM_SHARE = 128 * 2**10, 2**10, 1 / 256
"""Bytes on disk beside the values: folders and part-filled blocks; the description of a leaf;
frames around values that cannot be compressed, as a share of them. 1.1 to 3 times what was seen."""
ZEROS = bytes(2**20)


def save(
    directory: str | os.PathLike[str],
    state: Any,
    meta: dict[str, Any],
    *,
    step: int | None = None,
    keep: int = 3,
) -> Path:
    """Writes `state` as the newest checkpoint of `directory` and returns where.

    The checkpoint appears under its name in one rename, when every byte of it is on disk and has
    been read back: a kill at any moment leaves the earlier ones as they were. Synchronous: nothing
    goes on afterwards.

    Args:
      directory: made if missing; what others have in it stays as it is.
      state: any pytree of arrays: JAX (on any devices), numpy, typed PRNG keys, Python scalars
        (saved as the arrays JAX makes of them). Names of its parts: letters, digits, _ and -.
      meta: what the state is, as JSON (tuples come back as lists); see `describe`.
      step: number in the name, for people; `meta["epoch"]` (or 0) if not given.
      keep: how many checkpoints stay, this one included.

    Raises:
      CheckpointError: for a directory that is a checkpoint itself or cannot be written, a full
        disk, a leaf that is no array, a `meta` that is no JSON, what cannot be read back.
    """
    try:
        meta = json.loads(json.dumps(plain(meta), default=_listed))
        step = meta.get("epoch", 0) if step is None else plain(step)
    except (TypeError, ValueError, RecursionError, AttributeError) as error:
        raise CheckpointError(f"meta must be a dictionary of JSON: {reason(error)}.") from error
    keep = plain(keep)
    for name, value, least in (("step", step, 0), ("keep", keep, 1)):
        is_whole = isinstance(value, int) and not isinstance(value, bool)
        if not is_whole or not least <= value < 10**18:
            raise CheckpointError(f"{name} must be a whole number from {least}, got {value!r}.")
    leaves, arrays = host_arrays(state)
    root = claim(Path(directory))
    earlier, final = checkpoints(root), root / f"{next_serial(root):06d}-step-{step}"
    scratch = root / f"{SCRATCH}{final.name}"
    with _explained(f"the checkpoint {final}"):
        remove_unfinished(root)
        try:
            _write(scratch, leaves, arrays, meta)
            os.rename(scratch, final)
            sync(root)
        finally:
            remove(scratch)
    for old in earlier[keep - 1 :]:
        discard(old)
    return final


def _listed(value: Any) -> Any:
    """Of an array; what else JSON cannot say, it is to refuse."""
    if not is_values(value):
        raise TypeError(f"{type(value).__name__} is no JSON")
    return value.tolist()


def check_directory(directory: str | os.PathLike[str]) -> None:
    """Whether `save` to `directory` will work, before hours of training depend on it.

    Saves and reads back a small checkpoint, and leaves everything as it was.

    Raises:
      CheckpointError: as `save` would.
    """
    root = Path(os.path.abspath(directory))
    made = [path for path in (root, *root.parents) if not _exists(path)]
    try:
        place = claim(root)
        # As long a name as any save needs.
        scratch = place / f"{SCRATCH}{0:012d}-step-{os.getpid():018d}"
        leaves, arrays = host_arrays({"a": np.ones(2), "b": np.arange(3)})
        with _explained(f"a checkpoint in {root}"):
            try:
                _write(scratch, leaves, arrays, {})
            finally:
                remove(scratch)
    finally:
        with contextlib.suppress(OSError, ValueError):
            for path in made:
                path.rmdir()


def _exists(path: Path) -> bool:
    with contextlib.suppress(OSError, ValueError):
        return path.exists()
    return False


@contextlib.contextmanager
def _explained(what: str) -> Iterator[None]:
    """Any error of writing as one sentence."""
    try:
        yield
    except DamagedError as error:
        raise CheckpointError(
            f"{what} was written but cannot be read back: {reason(error)}; choose another "
            "directory (the earlier checkpoints are as they were)."
        ) from error
    except CheckpointError:
        raise
    # Orbax and TensorStore report a full disk, a lost mount and the like by many types.
    except Exception as error:
        raise CheckpointError(
            f"{what} could not be written: {reason(error)}; free space or choose "
            "another directory (the earlier checkpoints are as they were)."
        ) from error


def _write(
    scratch: Path, leaves: dict[str, Leaf], arrays: dict[str, np.ndarray], meta: dict[str, Any]
) -> None:
    """A whole checkpoint, on disk and read back as a loader would."""
    scratch.mkdir()
    _reserve(scratch / "room", arrays)
    save_arrays(scratch / ARRAYS, arrays)
    _write_description(scratch, leaves, arrays, meta)
    restore(scratch, None, "")


def _reserve(file: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raises the system's error if the disk has no room for `arrays`, before Orbax meets it.

    Orbax gives up at the first array that cannot be written. TensorStore's threads, still at work
    on the others, then find its event loop closed, and each prints a traceback.
    """
    values = sum(array.nbytes for array in arrays.values())
    size = ROOM + ROOM_PER_LEAF * len(arrays) + int(values * (1 + ROOM_SHARE))
    try:
        with open(file, "wb") as opened:
            for written in range(0, size, len(ZEROS)):
                opened.write(ZEROS[: size - written])
            opened.flush()
    finally:
        file.unlink(missing_ok=True)


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
