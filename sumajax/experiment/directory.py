"""A run's directory: one run at a time, never another run's, never overwritten."""

import json
import os
import platform
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from sumajax import reporting
from sumajax.cli.transfer_config import WHERE, TransferConfig


@contextmanager
def claimed(config: TransferConfig) -> Iterator[Path]:
    """The run's directory, made or gone on with, and locked against a second run.

    Raises:
      ValueError: when it holds something else, a finished run, or one with other options.
      OSError: when it cannot be written.
    """
    directory = config.directory
    options = described(config)
    missing: list[Path] = []
    try:
        _check_directory(directory, options)  # before anything is written there
        missing = [path for path in (directory, *directory.parents) if not os.path.lexists(path)]
        directory.mkdir(parents=True, exist_ok=True)
        lock = FileLock(directory / ".lock")
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(
            f"{directory} is in use by another run; choose another --output."
        ) from None
    except OSError as error:
        for path in missing:
            with suppress(OSError):
                path.rmdir()
        raise OSError(
            f"cannot write to {directory} ({error.strerror}); choose another --output."
        ) from None
    try:
        _check_directory(directory, options)
        for path in directory.iterdir():
            if _LEFTOVER.fullmatch(path.name):
                path.unlink()
        reporting.write_json(
            directory / "config.json",
            {"command": sys.argv, "options": options, "versions": versions()},
        )
        yield directory
    finally:
        lock.release()


def described(config: TransferConfig) -> dict[str, Any]:
    """The options as config.json keeps them, without those of one host's place in the run."""
    options = {**asdict(config), "devices": config.num_devices}
    return plain({name: options[name] for name in options if name not in WHERE[1:]})


_LEFTOVER = re.compile(r"\..+\.\d+\.tmp")
"""What a writer that was killed leaves of a file."""


def _check_directory(directory: Path, described: dict[str, Any]) -> None:
    file = directory / "config.json"
    if not file.exists():
        is_there = directory.is_dir()
        others = sorted(path.name for path in directory.iterdir()) if is_there else []
        others = [name for name in others if name != ".lock" and not _LEFTOVER.fullmatch(name)]
        if others:
            raise ValueError(
                f"{directory} exists and holds {others[0]!r}, not a run; choose another --output."
            )
        return
    try:
        before = dict(json.loads(file.read_text())["options"])
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{file} is not readable; choose another --output.") from None
    changed = [
        name
        for name in described
        if name not in WHERE and described[name] != before.get(name, described[name])
    ]
    if changed:
        name = changed[0]
        raise ValueError(
            f"{directory} holds a run with {name} {before[name]}, not {described[name]}; "
            "choose another --output, or the same options to go on with it."
        )
    if (directory / "summary.json").exists():
        raise ValueError(f"{directory} holds a finished run; choose another --output or remove it.")


def plain(value: Any) -> Any:
    """`value` as JSON would read it back."""
    return json.loads(json.dumps(value, default=str))


def versions() -> dict[str, str]:
    packages = ("sumajax", "jax", "flax", "optax", "orbax-checkpoint", "numpy")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}
