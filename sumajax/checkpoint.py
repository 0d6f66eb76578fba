"""Checkpoints: the state of a run on disk, written and read by Orbax in this one place.

A checkpoint directory holds the last few checkpoints of one training run, each a directory of its
own that is complete or absent, never half there:

    <directory>/000004-step-120/         serial number of the save, step (epoch) of the run
        checkpoint.json                  what it is: format, version, meta, leaves, files, checksum
        state/                           the arrays, as Orbax wrote them

`checkpoint.json` gives the shape, dtype and SHA-256 of every leaf and the size and SHA-256 of every
file, and is itself under a checksum, so whatever was truncated, altered or lost is found before
anything is trained on. Reading executes nothing from the directory, unpickles nothing, and is
bounded. One program at a time may write to a directory; any number may read.
"""

import contextlib
import hashlib
import json
import logging
import math
import os
import re
import shutil
import stat
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from sumajax import hosts
from sumajax.description import CheckpointError, check_compatible, describe, reason, rebuild

__all__ = [
    "CheckpointError",
    "check_compatible",
    "describe",
    "latest",
    "load",
    "load_params",
    "read_meta",
    "rebuild",
    "save",
]

FORMAT = "sumajax checkpoint"
VERSION = 1
"""Of the description; a reader refuses a higher one. The checksum is made the same way in all."""

DESCRIPTION = "checkpoint.json"
ARRAYS = "state"

MAX_DESCRIPTION_BYTES = 4 * 2**20
MAX_STATE_BYTES = 8 * 2**30
"""Of all arrays together, and of all files together, in a checkpoint that will be read."""

_NAME = re.compile(r"(\d{6,12})-step-(\d{1,18})")
_SCRATCH = ".unfinished-"
_PART = re.compile(r"[\w-]+")
_WIDTHS = {"int": (8, 16, 32, 64), "uint": (8, 16, 32, 64), "float": (16, 32, 64)}
_DTYPES = {"bool", "bfloat16", "complex64", "complex128"} | {
    f"{kind}{width}" for kind, widths in _WIDTHS.items() for width in widths
}
_KEYS = {"key<fry>": ("threefry2x32", 2), "key<rbg>": ("rbg", 4), "key<urbg>": ("unsafe_rbg", 4)}
"""Typed PRNG keys: dtype -> implementation, 32-bit words of a key."""

T = TypeVar("T")


class _DamagedError(CheckpointError):
    """This one checkpoint is not what was written; an earlier one may be."""


class _Leaf(NamedTuple):
    """What a leaf is, apart from its values."""

    shape: tuple[int, ...]
    dtype: str

    def __str__(self) -> str:
        return f"{self.dtype}{list(self.shape)}"

    @property
    def stored(self) -> tuple[tuple[int, ...], np.dtype]:
        """Shape and dtype on disk: a typed key is stored as its words."""
        if self.dtype in _KEYS:
            return (*self.shape, _KEYS[self.dtype][1]), np.dtype(np.uint32)
        return self.shape, jnp.dtype(self.dtype)

    @property
    def nbytes(self) -> int:
        shape, dtype = self.stored
        return math.prod(shape) * dtype.itemsize


class _Description(NamedTuple):
    """A checked `checkpoint.json`."""

    meta: dict[str, Any]
    leaves: dict[str, _Leaf]
    digests: dict[str, str]  # SHA-256 by leaf
    files: dict[str, tuple[int, str]]  # bytes, SHA-256 by path below the checkpoint


# --- Save and load ---------------------------------------------------------------------------


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
    leaves, arrays = _host_arrays(state)
    return _write(_claim(root), leaves, arrays, meta, step, keep)


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
    return _newest_good(Path(directory), lambda path: _restore(path, like, ""), say)


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
    found = _newest_good(
        Path(directory), lambda path: _restore(path, like_params, f"{field}/"), say
    )
    return found[0]


def read_meta(
    directory: str | os.PathLike[str], *, say: Callable[[str], None] | None = None
) -> dict[str, Any]:
    """What the newest good checkpoint is, without its arrays (their files are checked)."""

    def read(path: Path) -> dict[str, Any]:
        description = _read_description(path)
        _verify_files(path, description)
        return description.meta

    return _newest_good(Path(directory), read, say)


def latest(directory: str | os.PathLike[str]) -> Path | None:
    """Where the newest checkpoint lies, good or not; None when there is none to go on from."""
    root = Path(directory)
    return next(iter(_candidates(root)), None)


# --- Leaves ----------------------------------------------------------------------------------


def _named(tree: Any) -> dict[str, Any]:
    """Leaves by name, as `params/params/core/action/kernel`, in the tree's order."""
    named = {}
    try:
        leaves = jax.tree_util.tree_leaves_with_path(tree)
    except ValueError as error:
        raise CheckpointError(f"the state is no tree of named leaves: {reason(error)}.") from error
    for path, leaf in leaves:
        parts = [jax.tree_util.keystr((entry,), simple=True) for entry in path]
        name = "/".join(parts)
        if not parts or not all(map(_PART.fullmatch, parts)) or name in named:
            raise CheckpointError(
                f"a checkpoint cannot name the leaf {name!r}; use unique names of letters, "
                "digits, _ and - for the parts of the state."
            )
        named[name] = leaf
    return named


def _kind(name: str, leaf: Any) -> _Leaf:
    """Of an array, an abstract one or a Python scalar."""
    leaf = leaf if hasattr(leaf, "dtype") and hasattr(leaf, "shape") else jnp.asarray(leaf)
    kind = _Leaf(tuple(leaf.shape), str(leaf.dtype))
    if kind.dtype not in _DTYPES and kind.dtype not in _KEYS:
        raise CheckpointError(
            f"leaf {name} has dtype {kind.dtype}, which a checkpoint cannot hold; keep numbers, "
            "booleans and PRNG keys in the state."
        )
    return kind


def _host_arrays(state: Any) -> tuple[dict[str, _Leaf], dict[str, np.ndarray]]:
    """What each leaf is, and its values as they are stored."""
    leaves, arrays = {}, {}
    for name, leaf in _named(state).items():
        try:
            leaf = leaf if hasattr(leaf, "dtype") else jnp.asarray(leaf)
            leaves[name] = _kind(name, leaf)
            arrays[name] = np.asarray(
                jax.random.key_data(leaf) if leaves[name].dtype in _KEYS else leaf
            )
        except (TypeError, OverflowError, RuntimeError) as error:
            raise CheckpointError(
                f"leaf {name} is no array a checkpoint can hold: {reason(error)}."
            ) from error
    if not leaves:
        raise CheckpointError("the state to save holds no arrays; pass the learner's TrainState.")
    return leaves, arrays


def _nested(named: dict[str, Any]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name, leaf in named.items():
        *above, last = name.split("/")
        node = tree
        for part in above:
            node = node.setdefault(part, {})
        node[last] = leaf
    return tree


def _digest(array: np.ndarray) -> str:
    return hashlib.sha256(array.tobytes()).hexdigest()


def _compare(path: Path, saved: dict[str, _Leaf], wanted: dict[str, _Leaf]) -> None:
    """Refuses the first leaf that differs."""
    mend = "use the policy, settings and seeds it was saved with, or train anew"
    for name in wanted:
        if name not in saved:
            raise CheckpointError(
                f"{path} has no leaf {name}, which is {wanted[name]} in this program; {mend}."
            )
    for name, leaf in saved.items():
        if name not in wanted:
            raise CheckpointError(
                f"{path} has a leaf {name}, {leaf}, which this program does not; {mend}."
            )
        if leaf != wanted[name]:
            raise CheckpointError(
                f"leaf {name} is {leaf} in {path} but {wanted[name]} in this program; {mend}."
            )


# --- Writing ---------------------------------------------------------------------------------


def _claim(root: Path) -> Path:
    """`root` as a directory that is ours to write in, unfinished saves of a killed run removed."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        entries = os.listdir(root)
        if entries and not any(_is_ours(entry) for entry in entries):
            raise CheckpointError(
                f"{root} holds other things than checkpoints ({sorted(entries)[0]}); choose a new "
                "or empty directory."
            )
        for entry in entries:
            if entry.startswith(_SCRATCH):
                shutil.rmtree(root / entry)
    except OSError as error:
        raise CheckpointError(
            f"checkpoints cannot be written to {root}: {reason(error)}; choose a directory that "
            "can be written."
        ) from error
    return root.resolve()


def _is_ours(entry: str) -> bool:
    return entry.startswith(_SCRATCH) or _NAME.fullmatch(entry) is not None


def _write(
    root: Path,
    leaves: dict[str, _Leaf],
    arrays: dict[str, np.ndarray],
    meta: dict[str, Any],
    step: int,
    keep: int,
) -> Path:
    earlier = _checkpoints(root)
    serial = _serial(earlier[0]) + 1 if earlier else 1
    scratch, final = root / f"{_SCRATCH}{serial:06d}", root / f"{serial:06d}-step-{step}"
    try:
        scratch.mkdir()
        _orbax_save(scratch / ARRAYS, arrays)
        _write_description(scratch, leaves, arrays, meta)
        os.rename(scratch, final)
        _sync(root)
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
        _discard(old)
    return final


def _discard(path: Path) -> None:
    """Out of the way in one rename, so that a kill cannot leave half a checkpoint in its place."""
    doomed = path.with_name(_SCRATCH + path.name)
    try:
        os.rename(path, doomed)
    except OSError as error:
        warnings.warn(f"old checkpoint {path} stays: {reason(error)}.", stacklevel=4)
    shutil.rmtree(doomed, ignore_errors=True)


def _write_description(
    path: Path, leaves: dict[str, _Leaf], arrays: dict[str, np.ndarray], meta: dict[str, Any]
) -> None:
    content: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "meta": meta,
        "leaves": {
            name: {"shape": leaf.shape, "dtype": leaf.dtype, "sha256": _digest(arrays[name])}
            for name, leaf in leaves.items()
        },
        "files": {},
    }
    for name, file in _files(path).items():
        content["files"][name] = {"bytes": file.stat().st_size, "sha256": _file_digest(file)}
        _sync(file)
    # Through JSON once, so that the checksum is of what a reader will see.
    content = json.loads(json.dumps(content))
    _checked(content)  # nothing is written that the reader would refuse
    text = json.dumps({**content, "checksum": _checksum(content)}, indent=1)
    if len(text) > MAX_DESCRIPTION_BYTES:
        raise CheckpointError(
            f"the description of the checkpoint has {len(text)} bytes, more than the "
            f"{MAX_DESCRIPTION_BYTES} that are read; shorten meta."
        )
    (path / DESCRIPTION).write_text(text, encoding="utf-8")
    _sync(path / DESCRIPTION)
    for folder, _, _ in os.walk(path):
        _sync(Path(folder))


def _checksum(content: dict[str, Any]) -> str:
    """Of the content, whatever its layout; made the same way in every version of the format."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def _sync(path: Path) -> None:
    """Onto the disk itself, so that a power cut cannot undo what a rename promised."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# --- Reading ---------------------------------------------------------------------------------


def _checkpoints(root: Path) -> list[Path]:
    """Newest first, by serial number: after going back, a lower step may be the newer one."""
    try:
        with os.scandir(root) as entries:
            found = [
                root / entry.name
                for entry in entries
                if _NAME.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False)
            ]
    except OSError:
        return []
    return sorted(found, key=_serial, reverse=True)


def _candidates(directory: Path) -> list[Path]:
    """Newest first: the checkpoints in `directory`, or itself if it is one."""
    is_one = os.path.isfile(directory / DESCRIPTION)
    return [directory] if is_one else _checkpoints(directory)


def _serial(path: Path) -> int:
    return int(path.name.split("-")[0])


def _newest_good(root: Path, read: Callable[[Path], T], say: Callable[[str], None] | None) -> T:
    """`read` of the newest checkpoint that is not damaged."""
    candidates = _candidates(root)
    if not candidates:
        what = "holds no checkpoint of sumajax" if os.path.isdir(root) else "is no directory"
        raise CheckpointError(f"{root} {what}; give a directory that sumajax saved to.")
    damage: list[str] = []
    for path in candidates:
        try:
            found = read(path)
        except _DamagedError as error:
            damage.append(str(error))
            continue
        except OSError as error:
            damage.append(f"{path} cannot be read ({reason(error)})")
            continue
        if damage:
            _tell(f"{damage[0]}; going on from the earlier {path}.", say)
        return found
    rest = f" ({len(damage) - 1} earlier ones are damaged too)" if len(damage) > 1 else ""
    raise CheckpointError(f"{damage[0]}; restore it from a copy or train anew{rest}.")


def _tell(sentence: str, say: Callable[[str], None] | None) -> None:
    if say is None:
        warnings.warn(sentence, stacklevel=4)
    else:
        say(sentence)


def _restore(path: Path, like: Any, prefix: str) -> tuple[Any, dict[str, Any]]:
    """The part of the state whose names start with `prefix`, and meta."""
    description = _read_description(path)
    leaves = {k: leaf for k, leaf in description.leaves.items() if k.startswith(prefix)}
    if not leaves:
        raise CheckpointError(
            f"{path} holds no {prefix.rstrip('/')}; give a checkpoint of a training run."
        )
    wanted = {} if like is None else _named(like)
    if like is not None:
        _compare(path, leaves, {prefix + k: _kind(k, leaf) for k, leaf in wanted.items()})
    _verify_files(path, description)
    found = _read_arrays(path, leaves, description.digests)
    if like is None:
        return _nested({name.removeprefix(prefix): leaf for name, leaf in found.items()}), (
            description.meta
        )
    ordered = [found[prefix + name] for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), ordered), description.meta


def _read_description(path: Path) -> _Description:
    file = path / DESCRIPTION
    try:
        content = json.loads(_read_bounded(file))
        is_intact = content.pop("checksum") == _checksum(content)
    except FileNotFoundError as error:
        raise _DamagedError(f"{path} is damaged (its file {DESCRIPTION} is missing)") from error
    except (OSError, ValueError, RecursionError, AttributeError, KeyError, TypeError) as error:
        raise _DamagedError(f"{file} is damaged ({reason(error)})") from error
    if not is_intact:
        raise _DamagedError(f"{file} is damaged (its checksum does not match its content)")
    if content.get("format") != FORMAT:
        raise CheckpointError(f"{file} is not of sumajax; give a directory that sumajax saved to.")
    version = content.get("version")
    if version != VERSION:
        raise CheckpointError(
            f"{path} is of checkpoint format {version} and this sumajax reads {VERSION}; use the "
            "sumajax it was saved with, or a newer one."
        )
    try:
        return _checked(content)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise CheckpointError(
            f"{file} describes no state that sumajax saves: {reason(error)}; use another "
            "checkpoint."
        ) from error


def _read_bounded(file: Path) -> bytes:
    status = os.lstat(file)
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("it is not a regular file")
    if status.st_size > MAX_DESCRIPTION_BYTES:
        raise ValueError(f"it is larger than {MAX_DESCRIPTION_BYTES} bytes")
    with open(file, "rb") as opened:
        return opened.read(MAX_DESCRIPTION_BYTES)


def _checked(content: dict[str, Any]) -> _Description:
    """The description as typed values; anything else in it raises."""
    leaves = {}
    for name, leaf in content["leaves"].items():
        shape, dtype = tuple(leaf["shape"]), leaf["dtype"]
        if dtype not in _DTYPES and dtype not in _KEYS:
            raise ValueError(f"leaf {name} has dtype {dtype!r}")
        if not all(type(side) is int and 0 <= side < 2**48 for side in shape) or len(shape) > 32:
            raise ValueError(f"leaf {name} has shape {shape}")
        if not all(map(_PART.fullmatch, name.split("/"))):
            raise ValueError(f"leaf name {name!r}")
        leaves[name] = _Leaf(shape, dtype)
    if sum(leaf.nbytes for leaf in leaves.values()) > MAX_STATE_BYTES:
        raise ValueError(f"its arrays would need more than {MAX_STATE_BYTES} bytes")
    if not isinstance(content["meta"], dict):
        raise TypeError("meta is no dictionary")
    digests = {name: str(leaf["sha256"]) for name, leaf in content["leaves"].items()}
    files = {k: (v["bytes"], str(v["sha256"])) for k, v in content["files"].items()}
    for name, (size, _) in files.items():
        # Orbax keeps values in folders called d; the rest it reads whole, as JSON and the like.
        limit = MAX_STATE_BYTES if "/d/" in name else MAX_DESCRIPTION_BYTES
        if type(size) is not int or not 0 <= size <= limit:
            raise ValueError(f"file {name} has {size} bytes")
    if sum(size for size, _ in files.values()) > MAX_STATE_BYTES:
        raise ValueError(f"its files have more than {MAX_STATE_BYTES} bytes")
    return _Description(content["meta"], leaves, digests, files)


def _verify_files(path: Path, description: _Description) -> None:
    """Refuses a checkpoint in which any file is not the one that was written."""
    found = _files(path)
    found.pop(DESCRIPTION, None)
    for name in sorted(description.files.keys() | found.keys()):
        if name not in found:
            raise _DamagedError(f"{path} is damaged (its file {name} is missing)")
        if name not in description.files:
            raise _DamagedError(f"{path} is damaged (its file {name} does not belong to it)")
        status = os.lstat(found[name])
        if not stat.S_ISREG(status.st_mode):
            raise _DamagedError(f"{path} is damaged ({name} is not a regular file)")
        size, digest = description.files[name]
        if status.st_size != size:
            raise _DamagedError(
                f"{path} is damaged (its file {name} has {status.st_size} bytes instead of {size})"
            )
        if _file_digest(found[name]) != digest:
            raise _DamagedError(f"{path} is damaged (the content of its file {name} was altered)")


def _files(path: Path) -> dict[str, Path]:
    """All files below `path`, links not followed, by their names relative to it."""
    found = {}
    for folder, folders, names in os.walk(path):
        links = [name for name in folders if (Path(folder) / name).is_symlink()]
        for name in [*names, *links]:
            file = Path(folder) / name
            found[file.relative_to(path).as_posix()] = file
    return found


def _file_digest(file: Path) -> str:
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _read_arrays(path: Path, leaves: dict[str, _Leaf], digests: dict[str, str]) -> dict[str, Any]:
    """Values by name, each the very bytes that were saved."""
    stored = {name: leaf.stored for name, leaf in leaves.items() if leaf.nbytes}
    try:
        arrays = _orbax_load(path / ARRAYS, stored)
    except _DamagedError:
        raise
    # Whatever Orbax and TensorStore make of files that they cannot read.
    except Exception as error:
        raise _DamagedError(f"{path / ARRAYS} cannot be read ({reason(error)})") from error
    found: dict[str, Any] = {}
    for name, leaf in leaves.items():
        shape, dtype = leaf.stored
        array = np.asarray(arrays[name]) if name in stored else np.zeros(shape, dtype)
        if (array.shape, array.dtype) != (shape, dtype) or _digest(array) != digests[name]:
            raise _DamagedError(f"{path} is damaged (leaf {name} is not what was saved)")
        keys = _KEYS.get(leaf.dtype)
        found[name] = jax.random.wrap_key_data(jnp.asarray(array), impl=keys[0]) if keys else array
    return found


# --- Orbax -----------------------------------------------------------------------------------
# Imported where it is used: it takes a second, which a program without checkpoints need not wait.


@contextlib.contextmanager
def _orbax() -> Iterator[Any]:
    """Orbax's v1 interface, without the tracebacks it logs of errors that it also raises."""
    from orbax.checkpoint import v1 as ocp

    log = logging.getLogger("absl")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with _alone(ocp):
            yield ocp
    finally:
        log.setLevel(level)


def _alone(ocp: Any) -> Any:
    """Orbax not awaiting the other processes of a run: one of them reads and writes."""
    context = ocp.Context()
    if hosts.several():
        context.multiprocessing.primary_host = jax.process_index()
        context.multiprocessing.active_processes = {jax.process_index()}
    return context


def _orbax_save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    # Orbax refuses arrays without elements; their shape and dtype in the description say it all.
    stored = _nested({name: array for name, array in arrays.items() if array.size})
    with _orbax() as ocp:
        if hosts.several():
            _orbax_save_alone(path, stored)
        else:
            ocp.save(path, stored)


def _orbax_save_alone(path: Path, stored: dict[str, Any]) -> None:
    """By Orbax's older interface: the newer one has all processes agree on the path even so."""
    import orbax.checkpoint as ocp

    me = jax.process_index()
    only = ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix="sumajax"
    )
    handler = ocp.CompositeCheckpointHandler(
        composite_options=ocp.CompositeOptions(multiprocessing_options=only),
        pytree=ocp.PyTreeCheckpointHandler(multiprocessing_options=only),
    )
    with ocp.Checkpointer(handler, multiprocessing_options=only) as checkpointer:
        checkpointer.save(path.absolute(), ocp.args.Composite(pytree=ocp.args.PyTreeSave(stored)))


def _orbax_load(
    path: Path, stored: dict[str, tuple[tuple[int, ...], np.dtype]]
) -> dict[str, np.ndarray]:
    """The named arrays; their sizes on disk are compared with `stored` before any is read."""
    if not stored:
        return {}
    with _orbax() as ocp:
        on_disk = _named(ocp.metadata(path.absolute()).metadata)
        for name, (shape, dtype) in stored.items():
            there = on_disk.get(name)
            if there is None or (tuple(there.shape), there.dtype) != (shape, dtype):
                raise _DamagedError(f"{path} is damaged (leaf {name} is not as described)")
        context = _alone(ocp)
        context.pytree.loading.partial_load = True
        with context:
            wanted = _nested({name: on_disk[name] for name in stored})
            return _named(ocp.load(path.absolute(), wanted))
