"""metrics.csv and summary.json: what a run leaves for other programs to read.

A row of metrics.csv belongs to one arm (a stage of the experiment), one seed and one epoch. Epochs
count from 1; `env_steps`, `seconds` and `cpu_seconds` count the arm's own training from 0, the last
of them user and system time of the process, which trains all seeds. Rows are only
ever appended, in whole chunks, and cut back on resume, so the file never holds half a row, a gap or
a double.
"""

import csv
import io
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

COLUMNS = (
    "arm",
    "seed",
    "epoch",
    "env_steps",
    "seconds",
    "steps_taken",
    "success",
    "return",
    "entropy",
    "policy_loss",
    "value_loss",
    "gradient_norm",
    "communication",
    "cpu_seconds",
)
"""The columns of metrics.csv, in order; other programs rely on them."""

YOUNGER = ("cpu_seconds",)
"""Columns that files of earlier versions lack; they are read as NaN."""

INTEGERS = ("seed", "epoch", "env_steps")
FIRST_EPOCH = 1

Row = dict[str, Any]
"""One row: arm is a str, seed, epoch and env_steps are int, the rest float; NaN is `no value`."""


def rows_of(
    arm: str, seeds: Sequence[int], first_epoch: int, values: Mapping[str, Any]
) -> list[Row]:
    """Rows of a chunk of epochs from arrays, epoch by epoch and within an epoch seed by seed.

    Args:
      seeds: S of them.
      first_epoch: epoch of the chunk's first row; an arm's first epoch is 1.
      values: arrays that broadcast to (S, E) for each numeric column but seed and epoch; the
        number of epochs E is that of the longest. A column left out is NaN, `env_steps` must be in.

    Raises:
      ValueError: for a name that is no column, or when `env_steps` is missing.
    """
    unknown = sorted(set(values) - set(COLUMNS[3:]))
    if unknown:
        raise ValueError(f"{unknown[0]!r} is no column of metrics.csv; it has {COLUMNS[3:]}.")
    if "env_steps" not in values:
        raise ValueError("a chunk of metrics needs env_steps.")
    epochs = max(np.shape(value)[-1] if np.ndim(value) else 1 for value in values.values())
    arrays = {
        name: np.broadcast_to(np.asarray(value), (len(seeds), epochs))
        for name, value in values.items()
    }
    missing = dict.fromkeys(COLUMNS[3:], math.nan)
    return [
        {
            "arm": arm,
            "seed": int(seed),
            "epoch": first_epoch + epoch,
            **missing,
            **{name: array[index, epoch] for name, array in arrays.items()},
        }
        for epoch in range(epochs)
        for index, seed in enumerate(seeds)
    ]


def append_rows(path: str | Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Appends whole rows to metrics.csv, with the header first where the file is new.

    All of them go out in one write; where an earlier writer was killed inside a row, that torn row
    is cut off first.

    Raises:
      ValueError: for a row without exactly the columns of the file, or a file of other columns.
    """
    text = "".join(_line(_cells(row)) for row in rows)
    _renew(Path(path))
    with open(path, "a+b") as file:
        whole = _whole_size(file)
        file.truncate(whole)
        if whole == 0:
            text = _line(COLUMNS) + text
        else:
            file.seek(0)
            _check_header(file.readline().decode(), path)
        file.seek(0, os.SEEK_END)
        file.write(text.encode())
        file.flush()
        os.fsync(file.fileno())


def _renew(path: Path) -> None:
    """A file of an earlier version, with the columns that it lacks."""
    if not path.exists():
        return
    with open(path, encoding="utf-8") as file:
        first = file.readline()
    if first.endswith("\n") and _check_header(first, path) != list(COLUMNS):
        rows = read_metrics(path)
        write_text(path, _line(COLUMNS) + "".join(_line(_cells(row)) for row in rows))


def read_metrics(path: str | Path) -> list[Row]:
    """The rows of metrics.csv in file order; empty cells are NaN, a torn last row is left out.

    Raises:
      FileNotFoundError: when there is none.
      ValueError: for a file of other columns or a cell that is no number.
    """
    text = Path(path).read_text(encoding="utf-8")
    lines = text[: text.rfind("\n") + 1].splitlines()
    if not lines:
        return []
    columns = _check_header(lines[0], path)
    return [
        _parse(cells, columns, path, number)
        for number, cells in enumerate(csv.reader(lines[1:]), start=2)
    ]


def truncate_after(path: str | Path, arm: str, epoch: int) -> int:
    """Cuts an arm back to `epoch` before training goes on from there; other arms stay as they are.

    Rows of the arm beyond `epoch` go, and of doubles (same seed and epoch) all but the last. The
    file is replaced in one rename, so a kill leaves the old one or the new one. Epoch 0 removes the
    arm; a file that does not exist is left so.

    Returns:
      The last epoch through which every seed of the arm has every row. Less than `epoch` means that
      rows are missing: go on from there, or accept a gap.
    """
    path = Path(path)
    if not path.exists():
        return 0
    kept: dict[tuple[Any, ...], Row] = {}
    for row in read_metrics(path):
        if row["arm"] == arm and row["epoch"] > epoch:
            continue
        kept[(row["arm"], row["seed"], row["epoch"])] = row
    rows = list(kept.values())
    write_text(path, _line(COLUMNS) + "".join(_line(_cells(row)) for row in rows))
    return complete_epochs(rows, arm)


def complete_epochs(rows: Iterable[Mapping[str, Any]], arm: str) -> int:
    """The last epoch up to which every seed of the arm has a row; 0 when there is none."""
    by_seed: dict[int, set[int]] = {}
    for row in rows:
        if row["arm"] == arm:
            by_seed.setdefault(row["seed"], set()).add(row["epoch"])
    epoch = FIRST_EPOCH - 1
    while by_seed and all(epoch + 1 in epochs for epochs in by_seed.values()):
        epoch += 1
    return epoch


def seed_curves(
    rows: Iterable[Mapping[str, Any]], arm: str, *names: str
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """An arm's columns as arrays.

    Returns:
      epochs (E,) int, and for each of `names` an (S, E) float array, seeds in rising order, NaN
      where a seed has no row or no value for an epoch.
    """
    chosen = [row for row in rows if row["arm"] == arm]
    seeds = sorted({row["seed"] for row in chosen})
    epochs = sorted({row["epoch"] for row in chosen})
    place = {seed: i for i, seed in enumerate(seeds)}, {epoch: i for i, epoch in enumerate(epochs)}
    values = {name: np.full((len(seeds), len(epochs)), np.nan) for name in names}
    for row in chosen:
        for name in names:
            values[name][place[0][row["seed"]], place[1][row["epoch"]]] = row[name]
    return np.array(epochs, int), values


REACHES: dict[str, Any] = {"steps_taken": np.less_equal, "success": np.greater_equal}
"""When a figure of merit has come to a threshold; NaN never has."""


def env_steps_to_threshold(
    rows: Iterable[Mapping[str, Any]], arm: str, threshold: float, merit: str = "steps_taken"
) -> list[int | None]:
    """Per seed, the arm's own environment steps when an epoch's mean steps taken first came to
    `threshold` or below, or with `merit` its success to that or above; None where it never did."""
    _, values = seed_curves(rows, arm, "env_steps", merit)
    reached = REACHES[merit](values[merit], threshold)
    return [
        int(env_steps[hit.argmax()]) if hit.any() else None
        for env_steps, hit in zip(values["env_steps"], reached, strict=True)
    ]


def steps_taken_ratio(rows: Iterable[Mapping[str, Any]], arm: str, other: str) -> float | None:
    """Steps taken in `arm` over those in `other`, at the last epoch that both have.

    Both are means over the seeds; above 1 the other is better. None when an arm is missing or has
    no value there.
    """
    rows = list(rows)
    epoch = min(complete_epochs(rows, arm), complete_epochs(rows, other))
    means = []
    for name in (arm, other):
        taken = [r["steps_taken"] for r in rows if r["arm"] == name and r["epoch"] == epoch]
        taken = [value for value in taken if not math.isnan(value)]
        if not taken:
            return None
        means.append(float(np.mean(taken)))
    return means[0] / means[1]


TRANSFERRED = {"transfer": "transfer", "scratch": "scratch"}
"""Roles of a comparison, and what the arms are called in an experiment of two stages."""


def comparison(
    rows: Iterable[Mapping[str, Any]],
    threshold: float,
    arms: Mapping[str, str] = TRANSFERRED,
    merit: str = "steps_taken",
) -> dict[str, Any]:
    """The `comparison` entry of summary.json, from the rows of metrics.csv.

    Args:
      arms: which arm is the `transfer` and which the `scratch`; either may be missing.
      merit: what the threshold is of; the entry names it where it is not steps taken.
    """
    rows = list(rows)
    named = [arms.get(role, "") for role in ("scratch", "transfer")]
    return {
        "steps_taken_ratio": steps_taken_ratio(rows, *named),
        "threshold": threshold,
        "env_steps_to_threshold": {
            role: env_steps_to_threshold(rows, arms.get(role, ""), threshold, merit)
            for role in ("transfer", "scratch")
        },
        **({} if merit == "steps_taken" else {"merit": merit}),
    }


def arm_summary(
    *,
    env_steps: int,
    epochs: int,
    compile_seconds: float,
    train_seconds: float,
    sampled: Mapping[str, Any] | None,
    greedy: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """One arm of summary.json; the speed leaves compile time out."""
    return {
        "env_steps": int(env_steps),
        "epochs": int(epochs),
        "compile_seconds": float(compile_seconds),
        "train_seconds": float(train_seconds),
        "env_steps_per_second": env_steps / train_seconds if train_seconds > 0 else None,
        "evaluation": {"sampled": sampled, "greedy": greedy},
    }


EVAL = ("episodes", "steps_taken", "success", "return")
"""What every evaluation of summary.json has; whatever else it has is of the domain's own."""


def evaluation_summary(
    episodes: int, steps_taken: Any, success: Any, returns: Any, **figures: Any
) -> dict[str, Any]:
    """One evaluation of summary.json: means over `episodes` starts, (S,) each, one per seed.

    Args:
      figures: the domain's own, by name, (S,) each.
    """
    return {
        "episodes": int(episodes),
        "steps_taken": np.atleast_1d(steps_taken).tolist(),
        "success": np.atleast_1d(success).tolist(),
        "return": np.atleast_1d(returns).tolist(),
        **{name: np.atleast_1d(values).tolist() for name, values in figures.items()},
    }


def write_json(path: str | Path, value: Any) -> None:
    """Writes JSON in one rename; numpy and JAX arrays become lists, NaN and infinity null."""
    write_text(path, json.dumps(_plain(value), indent=2, allow_nan=False) + "\n")


def write_text(path: str | Path, text: str) -> None:
    """Writes a UTF-8 text file in one rename: a reader sees the old file or all of the new one."""
    write_bytes(path, text.encode())


def write_bytes(path: str | Path, content: bytes) -> None:
    """Writes a file in one rename: a reader sees the old file or all of the new one."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _plain(value: Any) -> Any:
    """`value` in terms of what JSON has."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _cells(row: Mapping[str, Any]) -> list[str]:
    if set(row) != set(COLUMNS):
        wrong = sorted(set(row) ^ set(COLUMNS))
        raise ValueError(f"a row of metrics.csv has exactly the columns {COLUMNS}; see {wrong}.")
    return [_cell(name, row[name]) for name in COLUMNS]


def _cell(name: str, value: Any) -> str:
    """The shortest text that reads back as the same number, in the precision it came in."""
    if name == "arm":
        return str(value)
    if name in INTEGERS:
        return str(int(value))
    number = np.asarray(np.nan if value is None else value)[()]
    if np.isnan(number):
        return ""
    return str(number if isinstance(number, np.floating) else float(number))


def _line(cells: Iterable[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()


def _parse(cells: list[str], columns: Sequence[str], path: str | Path, number: int) -> Row:
    try:
        row = dict.fromkeys(COLUMNS, "") | dict(zip(columns, cells, strict=True))
        return {name: _number(name, cell) for name, cell in row.items()}
    except ValueError as error:
        raise ValueError(f"{path}, line {number}: not a row of metrics ({error}).") from None


def _number(name: str, cell: str) -> str | int | float:
    if name == "arm":
        return cell
    if name in INTEGERS:
        return int(cell)
    return float(cell) if cell else math.nan


def _check_header(line: str, path: str | Path) -> list[str]:
    """The columns of a file, all or all but the younger ones."""
    columns = line.rstrip("\r\n").split(",")
    if columns not in (list(COLUMNS), [name for name in COLUMNS if name not in YOUNGER]):
        raise ValueError(
            f"{path} is not a metrics file of this version: its first line should be "
            f"{','.join(COLUMNS)}."
        )
    return columns


def _whole_size(file: io.BufferedRandom) -> int:
    """Bytes of `file` up to and with its last line end."""
    file.seek(0)
    return file.read().rfind(b"\n") + 1
