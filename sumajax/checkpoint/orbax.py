"""Orbax, in this one place.

Imported where it is used: it takes a second, which a program without checkpoints need not wait.

Orbax finds some of its files with a glob over their whole path, and TensorStore takes a backslash
for a separator and wants UTF-8, so that a folder called `pp[seed0]` is written and cannot be read.
Both are therefore shown paths of harmless characters alone, through a link where need be.
"""

import contextlib
import logging
import re
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sumajax import hosts
from sumajax.checkpoint.files import files_below
from sumajax.checkpoint.format import DamagedError
from sumajax.checkpoint.leaves import named_leaves, nested
from sumajax.description import CheckpointError

HARMLESS = re.compile(r"[\w./ +=@,-]+")
"""Paths without these take a detour; none of them means anything to a glob, JSON or an address."""


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


@contextlib.contextmanager
def harmless(folder: Path) -> Iterator[Path]:
    """`folder`, by a path that holds no character with a meaning to anybody."""
    if HARMLESS.fullmatch(str(folder)):
        yield folder
        return
    with _link_folder() as place:
        (place / "folder").symlink_to(folder.absolute(), target_is_directory=True)
        yield place / "folder"


@contextlib.contextmanager
def only(folder: Path, names: Iterable[str]) -> Iterator[Path]:
    """`folder`, by a harmless path, without any files but those of the given `names`.

    Whatever else lies in it might be taken by Orbax for its own.
    """
    names = set(names)
    if names == files_below(folder).keys():
        with harmless(folder) as path:
            yield path
        return
    with _link_folder() as place:
        for name in names:
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).symlink_to(folder.absolute() / name)
        yield place


@contextlib.contextmanager
def _link_folder() -> Iterator[Path]:
    """An empty temporary folder with a harmless path."""
    with tempfile.TemporaryDirectory(prefix="sumajax-") as place:
        if not HARMLESS.fullmatch(place):
            raise CheckpointError(
                f"the folder for temporary files {place} has characters in its path that Orbax "
                "does not take literally; set TMPDIR to one of letters and digits."
            )
        yield Path(place)


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes `path`, whose parent is there."""
    # Orbax refuses arrays without elements; their shape and dtype in the description say it all.
    stored = nested({name: array for name, array in arrays.items() if array.size})
    with _orbax() as ocp, harmless(path.parent) as folder:
        if hosts.several():
            _save_alone(folder / path.name, stored)
        else:
            ocp.save(folder / path.name, stored)


def _save_alone(path: Path, stored: dict[str, Any]) -> None:
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


def load_arrays(
    path: Path, files: Iterable[str], stored: dict[str, tuple[tuple[int, ...], np.dtype]]
) -> dict[str, np.ndarray]:
    """The named arrays from `files` below `path`, whatever else lies there.

    Their sizes on disk are compared with `stored` before any is read.
    """
    if not stored:
        return {}
    with _orbax() as ocp, only(path, files) as folder:
        on_disk = named_leaves(ocp.metadata(folder.absolute()).metadata)
        for name, (shape, dtype) in stored.items():
            there = on_disk.get(name)
            if there is None or (tuple(there.shape), there.dtype) != (shape, dtype):
                raise DamagedError(f"{path} is damaged (leaf {name} is not as described)")
        context = _alone(ocp)
        context.pytree.loading.partial_load = True
        with context:
            wanted = nested({name: on_disk[name] for name in stored})
            return named_leaves(ocp.load(folder.absolute(), wanted))
