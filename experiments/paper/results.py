"""The kept files of the paper's reproduction: curves and evaluations, taken from run directories.

Everything that is shown is made from these files alone (`report.py`): a row belongs to one
experiment, arm, preset and seed, and a run replaces all rows of those it trained.
"""

import csv
import io
import json
import platform
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from experiments.paper.arms import SCRATCH, SOURCE, TRANSFER
from experiments.paper.parts import Part
from experiments.paper.published import EXPERIMENTS
from sumajax.description import describe, rebuild_task
from sumajax.experiment.directory import plain
from sumajax.experiment.records import StageRecords
from sumajax.learning import LearnerConfig, preset
from sumajax.learning.scaling import for_stage
from sumajax.policies import make_policy
from sumajax.reporting import metrics as metrics_file

KEY = ("experiment", "arm", "preset", "seed")
COLUMNS = {
    "curves": (
        *KEY,
        "epoch",
        "env_steps",
        "seconds",
        "seeds_at_once",
        "steps_taken",
        "success",
    ),
    "evaluations": (*KEY, "env_steps", "mode", "episodes", "steps_taken", "success", "return"),
    "references": ("experiment", "task", "random_steps_taken", "random_success", "shortest_paths"),
    "seconds_per_epoch": (
        "experiment",
        "arm",
        "preset",
        "pass",
        "epochs",
        "seconds",
        "standard_error",
        "load_before",
        "machine",
        "commit",
    ),
}
"""The kept files, each with its columns. `seconds` of a curve is the wall time of its arm with
`seeds_at_once` seeds training side by side; `env_steps` and `seconds` count the arm alone."""

WHOLE = {
    *("seed", "epoch", "env_steps", "seeds_at_once", "episodes", "epochs", "pass"),
    *("max_steps", "side", "limit"),
}
WORDS = {
    *("experiment", "arm", "preset", "mode", "task", "machine", "commit"),
    *("stage", "part", "policy", "words", "after", "when"),
}
"""Columns of kept files, of the other studies' too, that are no numbers with a fraction."""

Row = dict[str, Any]


@dataclass
class Results:
    """The rows of the kept files, by file; changed only by `replace`."""

    directory: Path
    rows: dict[str, list[Row]] = field(default_factory=dict)

    @classmethod
    def read(cls, directory: Path) -> "Results":
        """What is kept in `directory`; nothing where there is no file yet.

        Raises:
          ValueError: for a file that is none of these.
        """
        return cls(directory, {name: _read(directory / f"{name}.csv", name) for name in COLUMNS})

    def write(self) -> None:
        """Every file in one rename each."""
        self.directory.mkdir(parents=True, exist_ok=True)
        for name, columns in COLUMNS.items():
            write_csv(self.directory / f"{name}.csv", columns, self.rows[name])

    def replace(self, name: str, rows: Iterable[Row], key: tuple[str, ...]) -> None:
        """Puts `rows` in the place of all with the same `key`."""
        rows = list(rows)
        new = {tuple(row[column] for column in key) for row in rows}
        kept = [r for r in self.rows[name] if tuple(r[column] for column in key) not in new]
        self.rows[name] = sorted(kept + rows, key=_order)

    def last_epochs(self, part: Part, preset_name: str) -> dict[int, int]:
        """The last epoch of every seed of a part that is kept."""
        wanted = (part.experiment, part.arm.name, preset_name)
        last: dict[int, int] = {}
        for row in self.rows["curves"]:
            if (row["experiment"], row["arm"], row["preset"]) == wanted:
                last[row["seed"]] = max(row["epoch"], last.get(row["seed"], 0))
        return last

    def add(self, run: "FinishedRun") -> None:
        """The curves, evaluations and reference levels of a run."""
        self.replace("curves", run.curves(), KEY)
        self.replace("evaluations", run.evaluations(), (*KEY, "mode"))
        self.replace("references", run.references(), ("experiment", "task"))


@dataclass(frozen=True)
class FinishedRun:
    """A run directory, and what its stages are called here.

    Attributes:
      parts: by the name of the stage.
    """

    directory: Path
    parts: Mapping[str, Part]

    @cached_property
    def config(self) -> dict[str, Any]:
        return json.loads((self.directory / "config.json").read_text())

    @property
    def plan(self) -> dict[str, Any]:
        """The whole plan, resolved: every stage with its task, start and learner."""
        return self.config["experiment"]

    @property
    def has_ended(self) -> bool:
        return (self.directory / "summary.json").exists()

    def curves(self) -> list[Row]:
        """Rows of the stages, epoch by epoch."""
        rows = metrics_file.read_metrics(self.directory / "metrics.csv")
        return [
            {
                **self._key(self.parts[row["arm"]], row["seed"]),
                **{name: row[name] for name in ("epoch", "env_steps", "seconds")},
                "seeds_at_once": len(self.plan["seeds"]),
                **{name: row[name] for name in ("steps_taken", "success")},
            }
            for row in rows
            if row["arm"] in self.parts
        ]

    def evaluations(self) -> list[Row]:
        """Held-out episodes of the final policies, and of those that a stage started from."""
        records = StageRecords(self.directory / "stages.json")
        rows = []
        for stage, part in self.parts.items():
            record = records[stage]
            if result := record.get("result"):
                rows += self._evaluated(part, result["env_steps"], result["evaluation"])
            if part.arm.zero_shot and record.get("zero_shot"):
                zero_shot = {"arm": part.arm.zero_shot}
                rows += [row | zero_shot for row in self._evaluated(part, 0, record["zero_shot"])]
        return rows

    def _evaluated(
        self, part: Part, env_steps: int, modes: Mapping[str, Mapping[str, Any]]
    ) -> list[Row]:
        """A row per seed and way of choosing actions."""
        return [
            {
                **self._key(part, seed),
                "env_steps": env_steps,
                "mode": mode,
                "episodes": held_out["episodes"],
                **{name: held_out[name][i] for name in ("steps_taken", "success", "return")},
            }
            for mode, held_out in modes.items()
            for i, seed in enumerate(self.plan["seeds"])
        ]

    def references(self) -> list[Row]:
        """A random policy and the shortest paths, on the tasks as this experiment has them."""
        if not self.has_ended:
            return []
        summary = json.loads((self.directory / "summary.json").read_text())
        levels = summary.get("references", {})
        where = {
            (part.experiment, part.arm.task): levels[stage]
            for stage, part in self.parts.items()
            if stage in levels
        }
        return [
            {
                "experiment": experiment,
                "task": task,
                "random_steps_taken": level["random_steps_taken"],
                "random_success": level["random_success"],
                "shortest_paths": level["shortest_path_steps"],
            }
            for (experiment, task), level in where.items()
        ]

    def _key(self, part: Part, seed: int) -> Row:
        return {
            "experiment": part.experiment,
            "arm": part.arm.name,
            "preset": self.plan["preset"],
            "seed": seed,
        }


def recognised(directory: Path) -> FinishedRun:
    """A run of `pp_transfer.py` or `pcp_transfer.py` as the experiment of Table I that it is.

    Only stages that came to their end count.

    Raises:
      ValueError: for a directory that is no such run.
    """
    try:
        plan = json.loads((directory / "config.json").read_text())["experiment"]
        stages = {stage["name"]: stage for stage in plan["stages"]}
        rows = metrics_file.read_metrics(directory / "metrics.csv")
        matches = [found for name in EXPERIMENTS if (found := _parts_of(plan, name)) is not None]
        ended = [
            name
            for name, stage in stages.items()
            if metrics_file.complete_epochs(rows, name) == stage["epochs"]
        ]
    except (OSError, ValueError, KeyError, TypeError):
        raise ValueError(
            f"{directory} is no run of pp_transfer.py or pcp_transfer.py; give its directory."
        ) from None
    if not matches:
        raise ValueError(
            f"{directory} is none of the paper's experiments (by tasks, policy, upsampling and "
            "what is carried over); leave it out."
        )
    if not ended:
        raise ValueError(f"{directory} has no stage that came to its end; let it run first.")
    return FinishedRun(directory, {name: matches[0][name] for name in ended})


def _parts_of(plan: Mapping[str, Any], name: str) -> dict[str, Part] | None:
    """What part of an experiment each stage of a plan is; None if one of them is none."""
    found: dict[str, Part] = {}
    for stage in plan["stages"]:
        start = stage["start"]
        before = found[start].arm if isinstance(start, str) else None
        part = next(
            (
                part
                for part in _candidates(name)
                if (start is None) == (part.arm.start is None)
                and before in (None, part.arm.start)
                and _is(part, plan, stage)
            ),
            None,
        )
        if part is None:
            return None
        found[stage["name"]] = part
    return found


def _candidates(name: str) -> list[Part]:
    """The parts of an experiment of Table I."""
    return [Part(EXPERIMENTS[name].source_of, SOURCE), Part(name, TRANSFER), Part(name, SCRATCH)]


def _is(part: Part, plan: Mapping[str, Any], stage: Mapping[str, Any]) -> bool:
    """Whether a stage of a config.json trains a part, however long."""
    policy = make_policy(part.row.policy, part.env)
    ours = describe(part.env, policy)
    return (
        _same(plan["policy"], ours["policy"])
        and _same(stage["task"], ours["task"])
        and stage["carry_optimiser"] == part.arm.carry_optimiser
        and tuple(stage["leave_out"]) == part.arm.leave_out
    )


def _same(given: Any, ours: Any) -> bool:
    """Whether a description is ours; settings that it does not know have their default."""
    if isinstance(given, Mapping) and isinstance(ours, Mapping):
        return all(_same(given[name], ours[name]) for name in ours if name in given)
    return bool(given == ours)


def changed_settings(plan: Mapping[str, Any]) -> list[str]:
    """Settings of a plan's learners that are not those of this version's preset."""
    own = preset(plan["preset"], plan["policy"]["name"])
    changed = {
        name: None
        for stage in plan["stages"]
        for name, value in _trained_with(own, stage).items()
        if stage["learner"].get(name, value) != value
    }
    return list(changed)


def _trained_with(learner: LearnerConfig, stage: Mapping[str, Any]) -> dict[str, Any]:
    env, transferred = rebuild_task(dict(stage)), stage["start"] is not None
    return plain(asdict(for_stage(learner, env, stage["epochs"], transferred=transferred)))


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": models[0] if models else platform.processor(),
        "cores": len(models) or None,
        "system": platform.platform(),
    }


def commit() -> str:
    """Of the package that runs; `-dirty` where files differ from it, `unknown` outside git."""
    answer = subprocess.run(
        ["git", "describe", "--always", "--abbrev=12", "--exclude=*", "--dirty"],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    return answer.stdout.strip() or "unknown"


def write_csv(path: Path, columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Rows as CSV, in one rename; numbers with six digits, no value as an empty cell."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = tuple(columns)
    writer.writerow(columns)
    writer.writerows([_cell(row[column]) for column in columns] for row in rows)
    metrics_file.write_text(path, text.getvalue())


def _cell(value: Any) -> str:
    if value is None or value != value:  # NaN
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _read(path: Path, name: str) -> list[Row]:
    if not path.exists():
        return []
    with open(path, newline="") as file:
        reader = csv.DictReader(file)
        if tuple(reader.fieldnames or ()) != COLUMNS[name]:
            raise ValueError(f"{path} does not have the columns {', '.join(COLUMNS[name])}.")
        try:
            return [{column: typed(column, row[column]) for column in row} for row in reader]
        except (ValueError, TypeError) as error:
            raise ValueError(
                f"{path}, line {reader.line_num}: not a row of it ({error})."
            ) from None


def typed(column: str, cell: str) -> Any:
    """What a cell of a kept file says; NaN where a number is missing."""
    if column in WORDS:
        return cell
    if column in WHOLE:
        return int(cell)
    return float(cell) if cell else float("nan")


def _order(row: Row) -> tuple[Any, ...]:
    """Experiments as in the paper, then by arm, seed and epoch."""
    names = list(EXPERIMENTS)
    return (
        row.get("preset", ""),
        names.index(row["experiment"]),
        row.get("arm", row.get("task")),
        row.get("seed", 0),
        row.get("epoch", 0),
        row.get("pass", 0),
        row.get("mode", ""),
    )
