"""The kept files of the paper's reproduction: curves and evaluations, taken from run directories.

Everything that is shown is made from these files alone (`paper_report.py`): a row belongs to one
experiment, arm, preset and seed, and a run replaces all rows of those it trained.
"""

import csv
import io
import json
import platform
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sumajax.cli.transfer_config import SCRATCH, SOURCE, TRANSFER

from experiments.paper.published import EXPERIMENTS
from sumajax.learning import preset
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

WHOLE = {"seed", "epoch", "env_steps", "seeds_at_once", "episodes", "epochs"}
WORDS = {"experiment", "arm", "preset", "mode", "task", "machine", "commit"}

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

    def last_epochs(self, experiment: str, arm: str, preset_name: str) -> dict[int, int]:
        """The last epoch of every seed that is kept."""
        wanted = (experiment, arm, preset_name)
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
    """A run directory, and what its arms are called here.

    Attributes:
      names: (experiment, arm) by the run's own name of an arm.
    """

    directory: Path
    names: dict[str, tuple[str, str]]

    @property
    def config(self) -> dict[str, Any]:
        return json.loads((self.directory / "config.json").read_text())

    @property
    def options(self) -> dict[str, Any]:
        return self.config["options"]

    @property
    def summary(self) -> dict[str, Any]:
        """Empty while the run goes on."""
        file = self.directory / "summary.json"
        return json.loads(file.read_text()) if file.exists() else {}

    def curves(self) -> list[Row]:
        """Rows of the arms that came to their end."""
        rows = metrics_file.read_metrics(self.directory / "metrics.csv")
        at_once = len(self.options["seeds"])
        return [
            {
                **self._key(row["arm"], row["seed"]),
                **{name: row[name] for name in ("epoch", "env_steps", "seconds")},
                "seeds_at_once": at_once,
                **{name: row[name] for name in ("steps_taken", "success")},
            }
            for row in rows
            if row["arm"] in self.names
        ]

    def evaluations(self) -> list[Row]:
        """Held-out episodes of the final policies, and of the source's on the target."""
        summary = self.summary
        found = {
            name: (name, summary[name]["env_steps"], summary[name]["evaluation"])
            for name in self.names
            if summary.get(name)
        }
        if TRANSFER in found and summary.get("zero_shot"):
            looks = {"sampled": summary["zero_shot"], "greedy": summary["zero_shot_greedy"]}
            found["zero-shot"] = (TRANSFER, 0, looks)
        return [
            {
                **self._key(arm, seed),
                "env_steps": env_steps,
                "mode": mode,
                "episodes": held_out["episodes"],
                **{name: held_out[name][i] for name in ("steps_taken", "success", "return")},
                **({"arm": self._zero_shot} if name == "zero-shot" else {}),
            }
            for name, (arm, env_steps, modes) in found.items()
            for mode, held_out in modes.items()
            if held_out
            for i, seed in enumerate(summary["seeds"])
        ]

    @property
    def _zero_shot(self) -> str:
        return self.names[TRANSFER][1].replace(TRANSFER, "zero-shot", 1)

    def references(self) -> list[Row]:
        """A random policy and the shortest paths, on the tasks as this experiment has them."""
        levels = self.summary.get("references", {})
        task = {SOURCE: "source", TRANSFER: "target", SCRATCH: "target"}
        # An arm from scratch is the source stage of a run with one task.
        where = {
            (experiment, "target" if name.startswith(SCRATCH) else "source"): levels["source"]
            for arm, (experiment, name) in self.names.items()
            if levels and task[arm] == "source"
        }
        where |= {
            (experiment, "target"): levels["target"]
            for arm, (experiment, _) in self.names.items()
            if levels and task[arm] == "target"
        }
        return [
            {
                "experiment": experiment,
                "task": on,
                "random_steps_taken": level["random_steps_taken"],
                "random_success": level["random_success"],
                "shortest_paths": level["shortest_path_steps"],
            }
            for (experiment, on), level in where.items()
        ]

    def _key(self, arm: str, seed: int) -> Row:
        experiment, name = self.names[arm]
        named = self.options["preset"]
        return {"experiment": experiment, "arm": name, "preset": named, "seed": seed}


DEFAULTS = {
    "scale": "none",
    "upsampling": "blocks",
    "encoder": "flat",
    "carry_optimiser": False,
    "leave_out": [],
}
"""What an experiment of Table I has; a run with anything else is none of them."""


def recognised(directory: Path) -> FinishedRun:
    """A run of `pp_transfer.py` or `pcp_transfer.py` as the experiment of Table I that it is.

    Only arms that came to their end count.

    Raises:
      ValueError: for a directory that is no such run.
    """
    try:
        options = json.loads((directory / "config.json").read_text())["options"]
        tasks = {name: options[name] for name in ("source", "target")}
        budgets = {SOURCE: options["source_epochs"]} | dict.fromkeys(
            (TRANSFER, SCRATCH), options["target_epochs"]
        )
        rows = metrics_file.read_metrics(directory / "metrics.csv")
    except (OSError, ValueError, KeyError, TypeError):
        raise ValueError(
            f"{directory} is no run of pp_transfer.py or pcp_transfer.py; give its directory."
        ) from None
    matches = [
        row
        for row in EXPERIMENTS.values()
        if row.policy == options["policy"]
        and all(_same(tasks[name], asdict(getattr(row, name))) for name in tasks)
    ]
    changed = [name for name, value in DEFAULTS.items() if options.get(name, value) != value]
    if not matches or changed:
        why = f"its {changed[0]} is {options[changed[0]]}" if changed else "by tasks and policy"
        raise ValueError(f"{directory} is none of the paper's experiments ({why}); leave it out.")
    (row,) = matches
    names = {
        arm: (row.source_of if arm == SOURCE else row.name, arm)
        for arm, epochs in budgets.items()
        if epochs and metrics_file.complete_epochs(rows, arm) == epochs
    }
    if not names:
        raise ValueError(f"{directory} has no arm that came to its end; let it run first.")
    return FinishedRun(directory, names)


def changed_settings(options: Mapping[str, Any]) -> list[str]:
    """Settings of a run's learner that are not those of this version's preset."""
    given = options["learner"]
    ours = asdict(preset(options["preset"], options["policy"]))
    return [name for name, value in ours.items() if given.get(name, value) != value]


def _same(given: Mapping[str, Any], ours: Mapping[str, Any]) -> bool:
    """Whether a task of a config.json is ours; settings it does not know have their default."""
    return all(given.get(name, value) == value for name, value in ours.items())


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
            return [{column: _value(column, row[column]) for column in row} for row in reader]
        except (ValueError, TypeError) as error:
            raise ValueError(
                f"{path}, line {reader.line_num}: not a row of it ({error})."
            ) from None


def _value(column: str, cell: str) -> Any:
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
        row.get("mode", ""),
    )
