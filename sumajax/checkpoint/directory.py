"""A directory of checkpoints: which are in it, which is the newest good one, what may go."""

import os
import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from sumajax.checkpoint.format import DESCRIPTION, DamagedError
from sumajax.description import CheckpointError, reason

NAME = re.compile(r"(\d{6,12})-step-(\d{1,18})")
SCRATCH = ".unfinished-"


T = TypeVar("T")


def claim(root: Path) -> Path:
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
            if entry.startswith(SCRATCH):
                shutil.rmtree(root / entry)
    except OSError as error:
        raise CheckpointError(
            f"checkpoints cannot be written to {root}: {reason(error)}; choose a directory that "
            "can be written."
        ) from error
    return root.resolve()


def _is_ours(entry: str) -> bool:
    return entry.startswith(SCRATCH) or NAME.fullmatch(entry) is not None


def discard(path: Path) -> None:
    """Out of the way in one rename, so that a kill cannot leave half a checkpoint in its place."""
    doomed = path.with_name(SCRATCH + path.name)
    try:
        os.rename(path, doomed)
    except OSError as error:
        warnings.warn(f"old checkpoint {path} stays: {reason(error)}.", stacklevel=4)
    shutil.rmtree(doomed, ignore_errors=True)


def checkpoints(root: Path) -> list[Path]:
    """Newest first, by serial number: after going back, a lower step may be the newer one."""
    try:
        with os.scandir(root) as entries:
            found = [
                root / entry.name
                for entry in entries
                if NAME.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False)
            ]
    except OSError:
        return []
    return sorted(found, key=serial, reverse=True)


def candidates(directory: Path) -> list[Path]:
    """Newest first: the checkpoints in `directory`, or itself if it is one."""
    is_one = os.path.isfile(directory / DESCRIPTION)
    return [directory] if is_one else checkpoints(directory)


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
