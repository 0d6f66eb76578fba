"""Files of a checkpoint: which there are, their digests, and onto the disk with them."""

import hashlib
import os
import shutil
import stat
from pathlib import Path

from sumajax.checkpoint.format import DamagedError, Description


def sync(path: Path) -> None:
    """Onto the disk itself, so that a power cut cannot undo what a rename promised."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def verify_files(path: Path, description: Description) -> None:
    """Refuses a checkpoint in which any file that was written is missing or another.

    Files that are not in the description are somebody else's, and none of our business. A file may
    be a link to one elsewhere, as in caches that share files: it is read, and its digest decides.
    """
    for name, (size, digest) in sorted(description.files.items()):
        file = path / name
        try:
            status = os.stat(file)
        except (FileNotFoundError, NotADirectoryError) as error:
            raise DamagedError(f"{path} is damaged (its file {name} is missing)") from error
        if not stat.S_ISREG(status.st_mode):
            raise DamagedError(f"{path} is damaged ({name} is not a regular file)")
        if status.st_size != size:
            raise DamagedError(
                f"{path} is damaged (its file {name} has {status.st_size} bytes instead of {size})"
            )
        if file_digest(file) != digest:
            raise DamagedError(f"{path} is damaged (the content of its file {name} was altered)")


def files_below(path: Path) -> dict[str, Path]:
    """All files below `path` by their names relative to it; links to folders are not followed."""
    found = {}
    for folder, folders, names in os.walk(path):
        links = [name for name in folders if (Path(folder) / name).is_symlink()]
        for name in [*names, *links]:
            file = Path(folder) / name
            found[file.relative_to(path).as_posix()] = file
    return found


def remove(path: Path) -> None:
    """A folder with all that is in it; of a link only itself. What cannot be removed stays."""
    if path.is_symlink():
        path.unlink(missing_ok=True)
    else:
        shutil.rmtree(path, ignore_errors=True)


def file_digest(file: Path) -> str:
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
