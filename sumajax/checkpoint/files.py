"""Files of a checkpoint: which there are, their digests, and onto the disk with them."""

import hashlib
import os
import stat
from pathlib import Path

from sumajax.checkpoint.format import DESCRIPTION, DamagedError, Description


def sync(path: Path) -> None:
    """Onto the disk itself, so that a power cut cannot undo what a rename promised."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def verify_files(path: Path, description: Description) -> None:
    """Refuses a checkpoint in which any file is not the one that was written."""
    found = files_below(path)
    found.pop(DESCRIPTION, None)
    for name in sorted(description.files.keys() | found.keys()):
        if name not in found:
            raise DamagedError(f"{path} is damaged (its file {name} is missing)")
        if name not in description.files:
            raise DamagedError(f"{path} is damaged (its file {name} does not belong to it)")
        status = os.lstat(found[name])
        if not stat.S_ISREG(status.st_mode):
            raise DamagedError(f"{path} is damaged ({name} is not a regular file)")
        size, digest = description.files[name]
        if status.st_size != size:
            raise DamagedError(
                f"{path} is damaged (its file {name} has {status.st_size} bytes instead of {size})"
            )
        if file_digest(found[name]) != digest:
            raise DamagedError(f"{path} is damaged (the content of its file {name} was altered)")


def files_below(path: Path) -> dict[str, Path]:
    """All files below `path`, links not followed, by their names relative to it."""
    found = {}
    for folder, folders, names in os.walk(path):
        links = [name for name in folders if (Path(folder) / name).is_symlink()]
        for name in [*names, *links]:
            file = Path(folder) / name
            found[file.relative_to(path).as_posix()] = file
    return found


def file_digest(file: Path) -> str:
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
