"""evaluations.csv: held-out episodes on the way, a row per seed each time."""

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np

from sumajax import reporting
from sumajax.transfer import Stage

COLUMNS = ("arm", "seed", "epoch", "env_steps", "steps_taken", "success", "return")
"""Of evaluations.csv: sampled actions on the held-out starts while a target arm trains."""


def append(
    file: Path, stage: Stage, epoch: int, env_steps: np.ndarray, held_out: dict[str, Any]
) -> None:
    rows = _read(file)
    for index, seed in enumerate(stage.seeds):
        figures = [held_out[name][index] for name in COLUMNS[4:]]
        rows.append([stage.arm, seed, epoch, int(env_steps[index]), *figures])
    _write(file, rows)


def truncate_after(file: Path, arm: str, epoch: int) -> None:
    rows = _read(file)
    kept = [row for row in rows if row[0] != arm or int(row[2]) <= epoch]
    if len(kept) < len(rows):
        _write(file, kept)


def _read(file: Path) -> list[list[Any]]:
    return list(csv.reader(file.read_text().splitlines()))[1:] if file.exists() else []


def _write(file: Path, rows: list[list[Any]]) -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([COLUMNS, *rows])
    reporting.write_text(file, text.getvalue())
