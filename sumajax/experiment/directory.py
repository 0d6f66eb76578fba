"""A run's directory: one run at a time, never another run's, never overwritten."""

import json
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from sumajax import reporting
from sumajax.description import versions


@contextmanager
def claimed(
    directory: Path, plan: dict[str, Any], options: dict[str, Any] | None = None
) -> Iterator[Path]:
    """The run's directory, made or gone on with, and locked against a second run.

    Args:
      plan: what is run, from `plan.described`; a directory goes on with the same plan only.
      options: of the command line, kept beside it for `--config`.

    Raises:
      ValueError: when it holds something else, a finished run, or one with other options.
      OSError: when it cannot be written.
    """
    plan, options = plain(plan), plain(options or {})
    missing: list[Path] = []
    try:
        _check_directory(directory, plan, options)  # before anything is written there
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
        _check_directory(directory, plan, options)
        for path in directory.iterdir():
            if _LEFTOVER.fullmatch(path.name):
                path.unlink()
        reporting.write_json(
            directory / "config.json",
            {
                "command": sys.argv,
                "options": options,
                "experiment": plan,
                "versions": versions(),
            },
        )
        yield directory
    finally:
        lock.release()


_LEFTOVER = re.compile(r"\..+\.\d+\.tmp")
"""What a writer that was killed leaves of a file."""


def _check_directory(directory: Path, plan: dict[str, Any], options: dict[str, Any]) -> None:
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
        config = dict(json.loads(file.read_text()))
        before, now = dict(config["options"]), options
        if "experiment" in config:
            before, now = dict(config["experiment"]), plan
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{file} is not readable; choose another --output.") from None
    if changed := next(_differences(before, now), None):
        name, theirs, ours = changed
        raise ValueError(
            f"{directory} holds a run with {name} {theirs}, not {ours}; "
            "choose another --output, or the same options to go on with it."
        )
    if (directory / "summary.json").exists():
        raise ValueError(f"{directory} holds a finished run; choose another --output or remove it.")


_PLACES = ("output", "source_checkpoint", "devices", "log")
"""Options that change nothing of what a run is; compared are those of runs without a plan."""


def _differences(before: Any, now: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(name, value there, value here) of each setting that both have and that differs."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in before:
            if key in now and (name or key not in _PLACES):
                yield from _differences(before[key], now[key], f"{name} {key}".strip())
    elif _stages(before) and _stages(now):
        names = [[stage["name"] for stage in stages] for stages in (before, now)]
        if names[0] != names[1]:
            yield name, names[0], names[1]
        for theirs, ours in zip(before, now, strict=False):
            yield from _differences(theirs, ours, f"{theirs['name']}:")
    elif before != now and not (name.endswith("checkpoint") and now is None):
        yield name, before, now


def _stages(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(x, dict) for x in value)


def plain(value: Any) -> Any:
    """`value` as JSON would read it back."""
    return json.loads(json.dumps(value, default=str))
