"""Orbax, in this one place.

Imported where it is used: it takes a second, which a program without checkpoints need not wait.
"""

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sumajax import hosts
from sumajax.checkpoint.format import DamagedError
from sumajax.checkpoint.leaves import named_leaves, nested


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


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    # Orbax refuses arrays without elements; their shape and dtype in the description say it all.
    stored = nested({name: array for name, array in arrays.items() if array.size})
    with _orbax() as ocp:
        if hosts.several():
            _save_alone(path, stored)
        else:
            ocp.save(path, stored)


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
    path: Path, stored: dict[str, tuple[tuple[int, ...], np.dtype]]
) -> dict[str, np.ndarray]:
    """The named arrays; their sizes on disk are compared with `stored` before any is read."""
    if not stored:
        return {}
    with _orbax() as ocp:
        on_disk = named_leaves(ocp.metadata(path.absolute()).metadata)
        for name, (shape, dtype) in stored.items():
            there = on_disk.get(name)
            if there is None or (tuple(there.shape), there.dtype) != (shape, dtype):
                raise DamagedError(f"{path} is damaged (leaf {name} is not as described)")
        context = _alone(ocp)
        context.pytree.loading.partial_load = True
        with context:
            wanted = nested({name: on_disk[name] for name in stored})
            return named_leaves(ocp.load(path.absolute(), wanted))
