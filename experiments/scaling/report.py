"""Tables of the study, from the kept CSV files: means over seeds, least to greatest, failures."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.scaling.costs import LEVELS, UNITS, Arm, arms, figure
from experiments.scaling.figures import cost_figure, curves_figure, matrix_figure
from experiments.scaling.plans import PARTS
from experiments.scaling.results import Results
from experiments.scaling.runs import ELSEWHERE, END, ZERO_SHOT
from experiments.studies import KEY, Row
from sumajax.reporting import write_text

MODES_SHOWN = ("sampled", "greedy")
TITLES = {
    "pp10": "Predator-Prey, 10x10 with 5",
    "pp20": "Predator-Prey, 20x20 with 10",
    "pp40": "Predator-Prey, 40x40 with 20",
    "pcp20": "Predator-Capture-Prey, 20x20 with 6 and 4",
    "rect": "Predator-Prey, 20x40 with 14",
    "rivals": "Rivals of state upsampling, 20x20 with 10",
    "dilution": "Policies on large teams, 20x20 with 10",
    "brief": "Brief sources (0.3 M steps each), 20x20 with 10",
    "short": "Short sources (0.5 M steps each), 20x20 with 10",
    "still": "Stages that end themselves, 20x20 with 10",
}
KEPT_AT = (100_000, 300_000, 1_000_000)
"""Environment steps of a stage after which it should still be as good as what it began with."""
HOW = """\
Written by `python experiments/scale.py --rebuild` from the CSV files beside it; where each run
comes from (command, commit, versions, machine, every setting) is in `provenance/`.

Steps taken are means over the held-out starts (1,024 at the beginning and the end of a stage, 128
on the way), then over seeds, with the least and the greatest seed and the success. Episodes that
fail count with their limit; shorter limits are read off the same episodes. Costs are of one seed
with the sources counted: environment steps, and CPU seconds of training alone (without compiling
and evaluating), which depend on the machine and on what else it was doing. A cost to reach a level
is that of the first held-out evaluation there. `> x`: a seed never was there and had cost x in the
end; no mean is taken then. "n of S" counts the seeds that arrived. The first stage of a chain is
not evaluated on the way; training's own figures stand for it.
"""


def write_report(results: Results) -> None:
    """Writes tables.md and every figure beside the kept files."""
    found, directory = arms(results), results.directory
    text = ["# Larger grids: tables\n", HOW]
    for part in PARTS:
        own = [arm for arm in found if arm.about["part"] == part]
        if not own:
            continue
        text.append(f"## {TITLES[part]}\n")
        text.append(markdown([_end_row(arm, results) for arm in own]))
        text.append("Cost to reach k times the shortest paths:\n")
        text.append(markdown([_cost_row(arm) for arm in own]))
        if matrix := _matrix_rows(own, results):
            text.append("Trained there (rows), played here (columns), sampled:\n")
            text.append(markdown(matrix))
    transfers, above = above_zero_shot(results)
    if above:
        text.append("## Above their zero shot\n")
        text.append(f"Of {transfers} transfers, over the starts on the way, at the task's limit:\n")
        text.append(markdown(above))
    missing = [part for part in PARTS if not any(arm.about["part"] == part for arm in found)]
    if missing:
        text.append(f"Not run: {', '.join(missing)}.\n")
    write_text(directory / "tables.md", "\n".join(text))
    cost_figure(found, directory / "cost.png")
    for part in PARTS:
        own = [arm for arm in found if arm.about["part"] == part]
        if own:
            curves_figure(own, directory / f"curves-{part}.png")
            matrix_figure(_matrices(own, results), directory / f"matrix-{part}.png")


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table; a row may lack columns that others have."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    lines = [columns, ["---"] * len(columns), *([row.get(c, "") for c in columns] for row in rows)]
    return "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)


# --- What a stage begins and ends with ---------------------------------------------------------


def _end_row(arm: Arm, results: Results) -> Row:
    about = arm.about
    played = [row for row in results.rows["held_out"] if _is_of(row, arm, about["task"])]
    cells: Row = {"policy": about["policy"], "arm": name_of(arm), "task": about["task"]}
    cells["bound"] = f"{about['bound']:.1f}"
    cells["seeds"] = len(arm.seeds)
    cells["M steps: own, all"] = _own_and_all(arm, "env_steps", 1e-6, ".2f")
    cells["CPU s: own, all"] = _own_and_all(arm, "cpu_seconds", 1.0, ".0f")
    limits = sorted({row["limit"] for row in played})
    for when in (ZERO_SHOT, END):
        for mode in MODES_SHOWN:
            for limit in limits:
                values = [
                    row
                    for row in played
                    if (row["when"], row["mode"], row["limit"]) == (when, mode, limit)
                ]
                kind = "limit" if limit == about["max_steps"] else "short limit"
                cells[f"{when}, {mode}, {kind}"] = f"{spread(values)} at {limit}" if values else "-"
    return cells


def _is_of(row: Row, arm: Arm, task: str) -> bool:
    about = arm.about
    wanted = (about["experiment"], about["stage"], task)
    return (row["experiment"], row["stage"], row["task"]) == wanted


def _own_and_all(arm: Arm, unit: str, scale: float, form: str) -> str:
    own = np.mean([row[unit] for row in arm.rows]) * scale
    return f"{own:{form}}, {arm.total(unit).mean() * scale:{form}}"


def spread(rows: Sequence[Row]) -> str:
    """Mean steps taken over seeds, the least and greatest seed, success."""
    steps = [row["steps_taken"] for row in rows]
    success = np.mean([row["success"] for row in rows])
    between = f"{min(steps):.1f}-{max(steps):.1f}; " if len(steps) > 1 else ""
    return f"{np.mean(steps):.1f} ({between}{success:.3f})"


def name_of(arm: Arm) -> str:
    """The stage, and what its chain is called where it is no plain one."""
    words, stage = arm.about["words"], arm.about["stage"]
    return stage if words == "chain" else f"{words}: {stage}"


# --- What a transfer keeps ---------------------------------------------------------------------


def above_zero_shot(results: Results) -> tuple[int, list[Row]]:
    """How many transfers there are, and a row for each that took more steps at one of `KEPT_AT`."""
    transfers, found = 0, []
    for stage in results.rows["stages"]:
        place = {name: stage[name] for name in KEY}
        own = [row for row in results.rows["held_out"] if place.items() <= row.items()]
        zero_shot = figure(own, stage, ZERO_SHOT)
        if zero_shot is None:
            continue
        transfers += 1
        way = {
            row["env_steps"]: row["steps_taken"]
            for row in results.rows["evaluations"]
            if place.items() <= row.items()
        }
        worse = [at for at in KEPT_AT if way.get(at, 0) > zero_shot]
        if worse:
            figures = {at: f"{way[at]:.1f}" if at in worse else "" for at in KEPT_AT}
            cells = {f"{at * 1e-6:.1f} M": taken for at, taken in figures.items()}
            found.append({**place, "zero shot": f"{zero_shot:.1f}", **cells})
    return transfers, found


# --- Costs -------------------------------------------------------------------------------------

_SHOWN: dict[str, tuple[str, Callable[[float], str]]] = {
    "env_steps": ("M steps", lambda cost: f"{cost * 1e-6:.2f}"),
    "cpu_seconds": ("CPU s", lambda cost: f"{cost:.0f}"),
}


def _cost_row(arm: Arm) -> Row:
    about = arm.about
    cells: Row = {"policy": about["policy"], "arm": name_of(arm), "task": about["task"]}
    for level in LEVELS:
        for unit in UNITS:
            name, said = _SHOWN[unit]
            cells[f"{level:g} x, {name}"] = cost_cell(
                arm.cost_to(level, unit), arm.total(unit), said
            )
    return cells


def cost_cell(cost: np.ndarray, total: np.ndarray, said: Callable[[float], str]) -> str:
    """Mean (least-greatest) of seeds that all arrived, else those that did beside `> total`."""
    arrived = np.isfinite(cost)
    count = f"{arrived.sum()} of {len(cost)}"
    if not arrived.any():
        return f"> {said(float(total.min()))} ({count})"
    between = f"{said(float(cost[arrived].min()))}-{said(float(cost[arrived].max()))}"
    if not arrived.all():
        return f"{between}, > {said(float(total[~arrived].min()))} ({count})"
    mean = said(float(cost.mean()))
    return f"{mean} ({between}; {count})" if len(cost) > 1 else f"{mean} ({count})"


# --- Trained there, played here ----------------------------------------------------------------


def _matrices(own: Sequence[Arm], results: Results) -> dict[str, dict[tuple[str, str], list[Row]]]:
    """Of each experiment with a chain: (task trained on, task played) -> rows of all seeds."""
    found: dict[str, dict[tuple[str, str], list[Row]]] = {}
    for arm in own:
        about = arm.about
        if about["stage"] not in _chain(own, about["experiment"]):
            continue
        cells = found.setdefault(about["experiment"], {})
        for row in results.rows["held_out"]:
            place = (row["experiment"], row["stage"])
            if place != (about["experiment"], about["stage"]) or row["mode"] != "sampled":
                continue
            if row["when"] in (END, ELSEWHERE):
                cells.setdefault((about["task"], row["task"]), []).append(row)
            elif about["after"]:
                before = _task(own, about["experiment"], about["after"].split()[-1])
                cells.setdefault((before, row["task"]), []).append(row)
    longest = {name: _longest(cells) for name, cells in found.items()}
    return {name: cells for name, cells in longest.items() if len(cells) > 1}


def _chain(own: Sequence[Arm], experiment: str) -> list[str]:
    """The stages of the longest line of stages that start from each other."""
    lines = [
        [*arm.about["after"].split(), arm.about["stage"]]
        for arm in own
        if arm.about["experiment"] == experiment
    ]
    return max(lines, key=len)


def _task(own: Sequence[Arm], experiment: str, stage: str) -> str:
    wanted = (experiment, stage)
    return next(
        arm.about["task"] for arm in own if (arm.about["experiment"], arm.about["stage"]) == wanted
    )


def _longest(cells: dict[tuple[str, str], list[Row]]) -> dict[tuple[str, str], list[Row]]:
    """At the longest limit of each task alone."""
    return {
        place: [row for row in rows if row["limit"] == max(r["limit"] for r in rows)]
        for place, rows in cells.items()
    }


def _matrix_rows(own: Sequence[Arm], results: Results) -> list[Row]:
    return [
        {
            "experiment": experiment,
            "trained on": trained,
            **{played: spread(rows) for (there, played), rows in cells.items() if there == trained},
        }
        for experiment, cells in _matrices(own, results).items()
        for trained in dict.fromkeys(there for there, _ in cells)
    ]
