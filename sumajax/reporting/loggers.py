"""TensorBoard and Weights & Biases: the rows of metrics.csv, sent on as they are written.

Neither library is imported, or needed, before a logger is asked for. metrics.csv is written always
and stays the run's own record; a logger only shows it elsewhere.
"""

import importlib.util
import math
import os
import sys
import uuid
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from sumajax.reporting.metrics import COLUMNS, write_text

LoggerName = Literal["tensorboard", "wandb"]
FIGURES = COLUMNS[4:]
"""What is logged, over `env_steps`: the columns of metrics.csv behind it."""


class Logger(Protocol):
    """Somewhere else to look at a run."""

    def resume(self, arm: str, env_steps: int) -> None:
        """Training of `arm` goes on from there; what was logged beyond is out of date."""

    def log(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Adds rows of metrics.csv."""

    def close(self) -> None:
        """Writes what is still held back."""


class Loggers:
    """Any number of loggers as one, and as a context manager; none is none.

    Raises:
      ValueError: for an unknown name, or a library that is not installed; says how to get it.
    """

    def __init__(
        self, names: Sequence[str], directory: str | Path, config: Mapping[str, Any] | None = None
    ) -> None:
        check_installed(names)
        self._loggers: list[Logger] = [
            _LOGGERS[name][0](Path(directory), config or {}) for name in dict.fromkeys(names)
        ]

    def resume(self, arm: str, env_steps: int) -> None:
        """See `Logger`."""
        for logger in self._loggers:
            logger.resume(arm, env_steps)

    def log(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """See `Logger`."""
        rows = list(rows)
        for logger in self._loggers:
            logger.log(rows)

    def close(self) -> None:
        """See `Logger`."""
        for logger in self._loggers:
            logger.close()

    def __enter__(self) -> "Loggers":
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()


class TensorBoard:
    """Event files in <directory>/tensorboard/<arm>/seed_<n>, so that arms and seeds overlay.

    Seen with `tensorboard --logdir <directory>`.
    """

    def __init__(self, directory: Path, config: Mapping[str, Any]) -> None:
        import tensorboardX

        self._library = tensorboardX
        self._directory = directory / "tensorboard"
        self._writers: dict[tuple[str, int], Any] = {}
        self._begin: dict[str, int] = {}

    def resume(self, arm: str, env_steps: int) -> None:
        self._begin[arm] = env_steps

    def log(self, rows: Iterable[Mapping[str, Any]]) -> None:
        for row in rows:
            writer = self._writer(row["arm"], row["seed"])
            for name, value in _numbers(row).items():
                writer.add_scalar(name, value, row["env_steps"])
        for writer in self._writers.values():
            writer.flush()

    def close(self) -> None:
        for writer in self._writers.values():
            writer.close()
        self._writers.clear()

    def _writer(self, arm: str, seed: int) -> Any:
        if (arm, seed) not in self._writers:
            folder = self._directory / arm / f"seed_{seed}"
            done = self._begin.get(arm, 0)
            # Makes TensorBoard forget what a killed run logged beyond its last checkpoint.
            purge = done + 1 if done or folder.exists() else None
            self._writers[arm, seed] = self._library.SummaryWriter(str(folder), purge_step=purge)
        return self._writers[arm, seed]


class WeightsAndBiases:
    """One W&B run for the whole experiment, gone on with when the experiment is.

    Figures are called <arm>/seed_<n>/<column>, over <arm>/env_steps, and their means over the
    seeds, what a sweep goes by, <arm>/mean/<column>. The project is `sumajax`; the library's own
    variables (WANDB_PROJECT, WANDB_MODE=offline and so on) come first.

    Raises:
      ValueError: where W&B starts no run, as without a key; before anything is trained.
    """

    def __init__(self, directory: Path, config: Mapping[str, Any]) -> None:
        import wandb

        self._known: set[tuple[str, str]] = set()
        # A sweep says itself which project and which run its trials are.
        in_sweep, is_named = (f"WANDB_{name}_ID" in os.environ for name in ("SWEEP", "RUN"))
        try:
            self._run = wandb.init(
                project=None if in_sweep else os.environ.get("WANDB_PROJECT", "sumajax"),
                name=directory.name,
                dir=str(directory),
                config=dict(config),
                id=None if is_named else _identity(directory / "wandb-id.txt"),
                resume="allow",
            )
        except Exception as error:  # its own, the network's, the login's: there is no common kind
            why = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(
                f"Weights & Biases starts no run ({why.rstrip('.')}); run `wandb login` or set "
                "WANDB_API_KEY, set WANDB_MODE=offline to keep the run here, or leave wandb out of "
                "--log."
            ) from None

    def resume(self, arm: str, env_steps: int) -> None:
        """Nothing to do: W&B takes no figure back, a later one at the same place follows it."""

    def log(self, rows: Iterable[Mapping[str, Any]]) -> None:
        rows = list(rows)
        for row in rows:
            self._log(row["arm"], f"seed_{row['seed']}", row["env_steps"], _numbers(row))
        for (arm, _), of_epoch in _by_epoch(rows).items():
            env_steps = int(np.mean([row["env_steps"] for row in of_epoch]))
            self._log(arm, "mean", env_steps, _means(map(_numbers, of_epoch)))

    def _log(self, arm: str, what: str, env_steps: int, numbers: Mapping[str, float]) -> None:
        if (arm, what) not in self._known:
            self._known.add((arm, what))
            self._run.define_metric(f"{arm}/{what}/*", step_metric=f"{arm}/env_steps")
        figures = {f"{arm}/{what}/{name}": value for name, value in numbers.items()}
        self._run.log({f"{arm}/env_steps": env_steps, **figures})

    def close(self) -> None:
        self._run.finish()


_LOGGERS: dict[str, tuple[type[Any], str]] = {
    "tensorboard": (TensorBoard, "tensorboardX"),
    "wandb": (WeightsAndBiases, "wandb"),
}
"""By name: the logger, and the library it needs."""


def check_installed(names: Sequence[str]) -> None:
    """Refuses loggers that are unknown or whose library is missing, before anything is written.

    Raises:
      ValueError: says which and how to get it.
    """
    for name in names:
        if name not in _LOGGERS:
            raise ValueError(f"logger {name!r} is unknown; choose of {', '.join(_LOGGERS)}.")
        library = _LOGGERS[name][1]
        if library not in sys.modules and importlib.util.find_spec(library) is None:
            raise ValueError(
                f"logger {name!r} needs {library}, which is not installed; "
                "pip install -e '.[logging]' brings it."
            )


def _numbers(row: Mapping[str, Any]) -> dict[str, float]:
    """The figures of a row that have a value."""
    values = {name: float(row[name]) for name in FIGURES}
    return {name: value for name, value in values.items() if math.isfinite(value)}


def _by_epoch(rows: Iterable[Mapping[str, Any]]) -> dict[tuple[str, int], list[Mapping[str, Any]]]:
    """The rows of all seeds, by arm and epoch."""
    found: dict[tuple[str, int], list[Mapping[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["arm"], row["epoch"]), []).append(row)
    return found


def _means(of_seeds: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Of each figure over the seeds that have it."""
    values: dict[str, list[float]] = {}
    for numbers in of_seeds:
        for name, value in numbers.items():
            values.setdefault(name, []).append(value)
    return {name: float(np.mean(value)) for name, value in values.items()}


def _identity(file: Path) -> str:
    """The run's name at W&B, kept in a file, so that a stopped run goes on under it."""
    if not file.exists():
        write_text(file, uuid.uuid4().hex[:16] + "\n")
    return file.read_text().strip()
