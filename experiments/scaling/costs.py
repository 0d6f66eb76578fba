"""What an arm had cost when its team was first that good, the sources counted."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from experiments.scaling.results import Results
from experiments.scaling.runs import END, ZERO_SHOT
from experiments.studies import Row

LEVELS = (3.0, 2.0, 1.5)
"""Times the shortest paths."""
UNITS = ("env_steps", "cpu_seconds")


@dataclass(frozen=True)
class Arm:
    """A stage with all its seeds, from the kept rows.

    Attributes:
      rows: of `stages`, a row a seed.
      paths: of each seed, (total env steps, total CPU seconds, steps taken) of held-out episodes in
        order, the sources in; a stage that was not evaluated on the way has training's own figures.
    """

    rows: tuple[Row, ...]
    totals: dict[int, dict[str, float]]  # by seed: what arm and sources cost in all
    paths: dict[int, np.ndarray] = field(repr=False)  # by seed: (points, 3)

    @property
    def about(self) -> Row:
        return self.rows[0]

    @property
    def seeds(self) -> list[int]:
        return [row["seed"] for row in self.rows]

    def cost_to(self, level: float, unit: str) -> np.ndarray:
        """(S,) cost when the steps taken first came to `level` times the bound; never: infinite."""
        return np.array([self._cost_to(row, level, unit) for row in self.rows])

    def _cost_to(self, row: Row, level: float, unit: str) -> float:
        path = self.paths[row["seed"]]
        there = path[:, 2] <= level * row["bound"]
        return float(path[there.argmax(), UNITS.index(unit)]) if there.any() else math.inf

    def total(self, unit: str) -> np.ndarray:
        """(S,) cost of the arm and its sources when it ended."""
        return np.array([self.totals[seed][unit] for seed in self.seeds])


def arms(results: Results) -> list[Arm]:
    """Every stage of every experiment, in the order in which they are kept."""
    by_arm: dict[tuple[str, str], list[Row]] = {}
    for row in results.rows["stages"]:
        by_arm.setdefault((row["experiment"], row["stage"]), []).append(row)
    cost = {_place(row): {unit: row[unit] for unit in UNITS} for row in results.rows["stages"]}
    found: dict[str, dict[tuple[str, str, int], list[Row]]] = {}
    for name in ("evaluations", "curves", "held_out"):
        found[name] = {}
        for row in results.rows[name]:
            found[name].setdefault(_place(row), []).append(row)
    return [_arm(rows, cost, found) for rows in by_arm.values()]


def _arm(rows: Sequence[Row], cost: Any, found: Any) -> Arm:
    totals, paths = {}, {}
    for row in rows:
        seed, place = row["seed"], _place(row)
        before = [cost[row["experiment"], stage, seed] for stage in row["after"].split()]
        source = {unit: sum(stage[unit] for stage in before) for unit in UNITS}
        totals[seed] = {unit: source[unit] + row[unit] for unit in UNITS}
        way = found["evaluations"].get(place) or found["curves"][place]
        points = [[point[unit] for unit in UNITS] + [point["steps_taken"]] for point in way]
        played = found["held_out"].get(place, [])
        if zero_shot := figure(played, row, ZERO_SHOT):
            points.insert(0, [0.0, 0.0, zero_shot])
        if end := figure(played, row, END):
            points.append([row[unit] for unit in UNITS] + [end])
        shift = np.array([*source.values(), 0.0])
        paths[seed] = np.array(points, float) + shift
    return Arm(tuple(rows), totals, paths)


def _place(row: Row) -> tuple[str, str, int]:
    return row["experiment"], row["stage"], row["seed"]


def figure(played: Sequence[Row], row: Row, when: str) -> float | None:
    """Steps taken by sampled actions on the stage's own task, at the limit it is trained with."""
    wanted = (when, row["task"], "sampled", row["max_steps"])
    for one in played:
        if (one["when"], one["task"], one["mode"], one["limit"]) == wanted:
            return float(one["steps_taken"])
    return None
