"""The kept files of the study: what its finished runs came to, and where the rows come from.

Tables and figures are made of these files alone. A row belongs to one experiment, stage and seed,
and a run replaces all rows of its experiment and seeds.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper.results import write_csv
from experiments.scaling.plans import Study
from experiments.studies import KEY, Row, StudyRun, curves_of, read_csv, replaced
from sumajax.environments.wrapper import unwrapped
from sumajax.evaluation import shortest_path_steps
from sumajax.experiment import Experiment, Stage
from sumajax.experiment.records import StageRecords
from sumajax.experiment.summary import grid_label

COLUMNS = {
    "stages": (
        *KEY,
        "part",
        "policy",
        "words",
        "after",
        "task",
        "side",
        "max_steps",
        "epochs",
        "env_steps",
        "cpu_seconds",
        "bound",
        "random",
    ),
    "curves": (*KEY, "epoch", "env_steps", "cpu_seconds", "steps_taken", "success"),
    "evaluations": (*KEY, "env_steps", "cpu_seconds", "steps_taken", "success"),
    "held_out": (*KEY, "when", "task", "mode", "limit", "episodes", "steps_taken", "success"),
}
"""The kept files. `after`: the stages that a stage comes from, first to last. `env_steps` and
`cpu_seconds` are of the stage alone and of one seed; `curves` are training's own figures,
`evaluations` held-out ones on the way, `held_out` those of what a stage begins and ends with, on
its own task and on the others of its chain. `bound`: the shortest paths."""

PLAYED = "held_out.csv"
"""In a run's directory: the rows of `held_out` that are known."""


@dataclass
class Results:
    """The rows of the kept files, by file."""

    directory: Path
    rows: dict[str, list[Row]] = field(default_factory=dict)

    @classmethod
    def read(cls, directory: Path) -> "Results":
        """What is kept in `directory`; nothing where there is no file yet."""
        return cls(directory, {name: read_csv(directory / f"{name}.csv") for name in COLUMNS})

    def write(self) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        for name, columns in COLUMNS.items():
            write_csv(self.directory / f"{name}.csv", columns, self.rows[name])

    def add(self, experiment: str, seeds: Sequence[int], rows: dict[str, list[Row]]) -> None:
        """Puts the rows of a run in the place of all of its experiment and seeds."""
        for name in COLUMNS:
            self.rows[name] = replaced(self.rows[name], experiment, seeds, rows[name])


# --- From a run's directory --------------------------------------------------------------------


def rows_of_run(found: StudyRun[Study]) -> dict[str, list[Row]]:
    """The rows of a finished run, by kept file."""
    study, experiment, directory = found.study, found.experiment, found.directory
    summary = json.loads((directory / "summary.json").read_text())
    records = StageRecords(directory / "stages.json")
    curves = curves_of(found, ("steps_taken", "success"))
    by_place = {(r["stage"], r["seed"], r["env_steps"]): r["cpu_seconds"] for r in curves}
    on_the_way = read_csv(directory / "evaluations.csv")
    bounds: dict[Any, Any] = {
        env: shortest_path_steps(env) for env in {stage.env for stage in experiment.stages}
    }
    stages = [
        {
            **_stage_row(study, experiment, stage, seed, records, curves),
            # Of all held-out starts; the run's own are of those that it played on the way.
            "bound": float(np.mean(bounds[stage.env])),
            "random": summary["references"][stage.name]["random_steps_taken"],
        }
        for seed in experiment.seeds
        for stage in experiment.stages
    ]
    return {
        "stages": stages,
        "curves": curves,
        "evaluations": [
            {
                "experiment": study.name,
                "stage": row["arm"],
                "seed": int(row["seed"]),
                "env_steps": int(row["env_steps"]),
                "cpu_seconds": by_place[row["arm"], int(row["seed"]), int(row["env_steps"])],
                "steps_taken": float(row["steps_taken"]),
                "success": float(row["success"]),
            }
            for row in on_the_way
        ],
        "held_out": read_csv(directory / PLAYED),
    }


def _stage_row(
    study: Study,
    experiment: Experiment,
    stage: Stage,
    seed: int,
    records: StageRecords,
    curves: Iterable[Row],
) -> Row:
    last = [row for row in curves if (row["stage"], row["seed"]) == (stage.name, seed)][-1]
    return {
        "experiment": study.name,
        "stage": stage.name,
        "seed": seed,
        "part": study.part,
        "policy": study.variant,
        "words": study.words,
        "after": " ".join(before.name for before in experiment.ancestors(stage)),
        "task": task_label(stage.env),
        "side": max(unwrapped(stage.env).state_shape[-2:]),
        "max_steps": stage.env.max_steps,
        "epochs": records[stage.name]["result"]["epochs"],
        "env_steps": last["env_steps"],
        "cpu_seconds": last["cpu_seconds"],
    }


def task_label(env: Any) -> str:
    """Grid and team, as 20x20 10P or 20x20 6P/4C."""
    task = unwrapped(env)
    team = f"{task.num_predators}P"
    if task.num_capturers:
        team += f"/{task.num_capturers}C"
    return f"{grid_label(task)} {team}"
