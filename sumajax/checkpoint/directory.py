"""A directory of checkpoints: which are in it, which is the newest good one, what may go."""

import os
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from sumajax.checkpoint.files import remove
from sumajax.checkpoint.format import DESCRIPTION, DamagedError
from sumajax.description import CheckpointError, reason

NAME = re.compile(r"(\d{6,12})-step-(\d{1,18})")
SCRATCH = ".unfinished-"
"""Before the name that an unfinished checkpoint will have, and one to be removed has had."""
ORBAX_MARK = "_CHECKPOINT_METADATA"
"""A file that Orbax puts into each of its checkpoints."""


T = TypeVar("T")


def claim(root: Path) -> Path:
    """`root` as a directory to write checkpoints in, made if missing; what is in it stays.

    Files of others beside the checkpoints are ignored. What is a checkpoint itself is refused.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        for mark in (DESCRIPTION, ORBAX_MARK):
            if (root / mark).exists():
                raise CheckpointError(
                    f"{root} is not a directory for checkpoints but one itself (it holds {mark}); "
                    "choose another directory."
                )
        return root.resolve()
    except (OSError, ValueError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(
            f"checkpoints cannot be written to {root}: {reason(error)}; choose a directory that "
            "can be written."
        ) from error


def remove_unfinished(root: Path) -> None:
    """Removes what killed saves and checks left in `root`, for callers that alone write there."""
    for entry in os.listdir(root) if root.is_dir() else ():
        if entry.startswith(SCRATCH) and NAME.fullmatch(entry.removeprefix(SCRATCH)):
            remove(root / entry)


def next_serial(root: Path) -> int:
    """Higher than of anything that has a checkpoint's name, whatever it is."""
    names = filter(None, map(NAME.fullmatch, os.listdir(root)))
    return 1 + max((int(name[1]) for name in names), default=0)


def discard(path: Path) -> None:
    """Out of the way in one rename, so that a kill cannot leave half a checkpoint in its place."""
    doomed = path.with_name(SCRATCH + path.name)
    try:
        os.rename(path, doomed)
    except OSError as error:
        warnings.warn(f"old checkpoint {path} stays: {reason(error)}.", stacklevel=4)
    remove(doomed)


def checkpoints(root: Path) -> list[Path]:
    """Newest first, by serial number: after going back, a lower step may be the newer one."""
    try:
        with os.scandir(root) as entries:
            found = [
                root / entry.name
                for entry in entries
                if NAME.fullmatch(entry.name) and entry.is_dir()
            ]
    except (OSError, ValueError):  # a path with a zero character is a ValueError
        return []
    return sorted(found, key=serial, reverse=True)


def candidates(directory: Path) -> list[Path]:
    """Newest first: the checkpoints in `directory`, or itself if it is one."""
    return checkpoints(directory) or [directory] * os.path.isfile(directory / DESCRIPTION)


def serial(path: Path) -> int:
    return int(path.name.split("-")[0])


def newest_good(root: Path, read: Callable[[Path], T], say: Callable[[str], None] | None) -> T:
    """`read` of the newest checkpoint that is not damaged."""
    found_here = candidates(root)
    if not found_here:
        what = "holds no checkpoint of sumajax" if os.path.isdir(root) else "is no directory"
        raise CheckpointError(f"{root} {what}; give a directory that sumajax saved to.")
    damage: list[str] = []
    for path in found_here:
        try:
            found = read(path)
        except DamagedError as error:
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
