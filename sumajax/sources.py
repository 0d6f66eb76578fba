"""What a trained policy can be had from: a run, checkpoints, or the package's own by its name.

Everything that takes a place of parameters asks here what it means, so the same words are
understood in a program, in a plan and on the command line.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from sumajax import checkpoint, store
from sumajax.checkpoint import CheckpointError


class Source(Protocol):
    """Parameters, and what they are of."""

    @property
    def name(self) -> str:
        """For sentences."""

    @property
    def meta(self) -> dict[str, Any]:
        """Task, policy, seeds and epoch, as a checkpoint has them."""

    def identity(self) -> str:
        """The same for copies of the same parameters, wherever they lie."""

    def load(self, like: Any, field: str = "params") -> Any:
        """The parameters, or another field of the training state, compared with `like`."""


@dataclass(frozen=True)
class Checkpoints:
    """A directory of them."""

    directory: Path
    meta: dict[str, Any]

    @property
    def name(self) -> str:
        return str(self.directory)

    def identity(self) -> str:
        return checkpoint.identity(self.directory)

    def load(self, like: Any, field: str = "params") -> Any:
        return checkpoint.load_params(self.directory, like, field=field)


def source_of(place: str | os.PathLike[str]) -> Source:
    """What `place` means: a directory where there is one, else a name of the package's store.

    Args:
      place: a run (its last stage is meant), one of its checkpoints/<stage>, one checkpoint, or the
        name of a trained policy of the package.

    Raises:
      CheckpointError: when it is none of them, or there is no good checkpoint.
    """
    if store.is_named(place):
        return store.entry(os.fspath(place))
    directory = Path(place)
    if len(directory.parts) == 1 and store.names() and not os.path.lexists(directory):
        raise CheckpointError(
            f"{directory} is no directory and no trained policy of the package; give a directory "
            f"that sumajax saved to, or one of {', '.join(store.names())}."
        )
    directory = checkpoints_of(directory)
    return Checkpoints(directory, checkpoint.read_meta(directory))


def stage_directories(run: Path) -> dict[str, Path]:
    """Where the checkpoints of each stage of a run lie, by its name; the stage that comes after
    most others, the run's target where it has been reached, stands first.

    Empty for what is no directory of a run.
    """
    folder = run / "checkpoints"
    names = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    found = {name: folder / name for name in names if checkpoint.latest(folder / name) is not None}
    follows = {name: _follows(checkpoint.read_meta(path)) for name, path in found.items()}
    return {name: found[name] for name in sorted(found, key=lambda name: -len(follows[name]))}


def _follows(meta: dict[str, Any]) -> list[str]:
    """The stages that a stage comes from; before they were recorded only `transfer` had one."""
    return meta.get("follows", ["source"] if meta.get("arm") == "transfer" else [])


def checkpoints_of(directory: Path) -> Path:
    """`directory`, or of a run the one of its last stage's checkpoints."""
    return next(iter(stage_directories(directory).values()), directory)
