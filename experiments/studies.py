"""What the programs share that train experiments seed by seed and keep rows of them: a directory
for an experiment and its seeds, kept files that a run replaces its own rows of, and where the rows
come from. `scale.py` and `traffic_junction.py` are such programs.
"""

import csv
import json
import os
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from filelock import FileLock

from experiments.paper.results import Row, commit, machine, typed
from sumajax.description import versions
from sumajax.experiment import Experiment, run_experiment
from sumajax.experiment.run import Run, Where
from sumajax.reporting import metrics, write_json

PROVENANCE = "provenance"


class Study(Protocol):
    """An experiment without its seeds."""

    @property
    def name(self) -> str:
        """Of its directory and rows."""

    def experiment(self, seeds: Sequence[int]) -> Experiment: ...


S = TypeVar("S", bound=Study)

# --- Runs ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StudyRun(Generic[S]):
    """A study with seeds that are trained side by side, and its directory."""

    study: S
    seeds: tuple[int, ...]
    directory: Path
    devices: int = 1

    @cached_property
    def experiment(self) -> Experiment:
        return self.study.experiment(self.seeds)

    @property
    def run(self) -> Run:
        return Run(self.experiment, self.directory, Where(devices=self.devices))

    @property
    def has_ended(self) -> bool:
        return (self.directory / "summary.json").exists()

    def train(self) -> None:
        """What is still missing of it."""
        if not self.has_ended:
            run_experiment(self.experiment, self.directory, Where(devices=self.devices))


def begun(study: Study, runs: Path) -> list[tuple[int, ...]]:
    """Seeds of the study's runs, finished or not."""
    found = sorted((runs / study.name).glob("seeds-*/config.json"))
    return [tuple(map(int, path.parent.name.split("-")[1:])) for path in found]


def study_runs(study: S, seeds: Sequence[int], runs: Path, devices: int) -> list[StudyRun[S]]:
    """The runs in which all `seeds` are: those that were begun as they were begun, and one with
    the seeds that are in none.
    """
    groups = [group for group in begun(study, runs) if set(group) & set(seeds)]
    left = set(seeds).difference(*groups)
    if left:
        groups.append(tuple(sorted(left)))
    return [
        StudyRun(study, group, runs / study.name / f"seeds-{'-'.join(map(str, group))}", devices)
        for group in groups
    ]


# --- Rows ---------------------------------------------------------------------------------------

KEY = ("experiment", "stage", "seed")
"""What every row is of."""


def read_csv(path: Path) -> list[Row]:
    """Rows with their types; none where there is no file."""
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return [
            {name: typed(name, cell) for name, cell in row.items()} for row in csv.DictReader(file)
        ]


def replaced(
    rows: Sequence[Row], experiment: str, seeds: Sequence[int], new: Sequence[Row]
) -> list[Row]:
    """`rows` with those of a run in the place of all of its experiment and seeds."""
    kept = [row for row in rows if row["experiment"] != experiment or row["seed"] not in seeds]
    # By experiment and seed; within them in the order in which they were trained.
    return sorted([*kept, *new], key=lambda row: (row["experiment"], row["seed"]))


def curves_of(found: StudyRun[Any], figures: Sequence[str]) -> list[Row]:
    """Training's own figures, an epoch of a seed in a row."""
    return [
        {
            "experiment": found.study.name,
            "stage": row["arm"],
            "seed": row["seed"],
            **{name: row[name] for name in ("epoch", "env_steps", *figures)},
            # The process trains all seeds; each has its share of the time.
            "cpu_seconds": row["cpu_seconds"] / len(found.seeds),
        }
        for row in metrics.read_metrics(found.directory / "metrics.csv")
    ]


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """The kept files, for one program at a time: several may train, each in runs of its own."""
    directory.mkdir(parents=True, exist_ok=True)
    with FileLock(directory / ".lock"):
        yield


# --- Where the rows come from ------------------------------------------------------------------


def _provenance(found: StudyRun[Any], output: Path) -> Path:
    return output / PROVENANCE / f"{found.study.name}-{found.directory.name}.json"


def note_session(found: StudyRun[Any], output: Path) -> None:
    """Adds a session to the run's file, unless the run has ended: command, commit, machine."""
    file = _provenance(found, output)
    if found.has_ended and file.exists():
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    before = json.loads(file.read_text()) if file.exists() else {}
    now = {
        "command": shlex.join(["python", *sys.argv]),
        "commit": commit(),
        "versions": versions(),
        "machine": machine(),
        "load_before": os.getloadavg()[0],
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    about = {"experiment": found.study.name, "seeds": found.seeds}
    write_json(file, {**before, **about, "sessions": [*before.get("sessions", []), now]})


def keep_plan(found: StudyRun[Any], output: Path) -> None:
    """Adds what was trained, resolved: tasks, starts and every setting of the learner."""
    file = _provenance(found, output)
    plan: Any = json.loads((found.directory / "config.json").read_text())["experiment"]
    write_json(file, {**json.loads(file.read_text()), "plan": plan})
