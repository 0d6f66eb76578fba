"""Table II: seconds per epoch, the paper's and ours, of the kept passes."""

import math
from collections.abc import Iterable, Sequence
from statistics import mean

from experiments.paper.arms import SOURCE, TABLE_2
from experiments.paper.claims import NOT_RUN
from experiments.paper.parts import PRESETS
from experiments.paper.published import EXPERIMENTS, SOURCES
from experiments.paper.results import Row


def by_pass(measured: Iterable[Row]) -> dict[tuple[str, str, str], list[Row]]:
    """The passes of each row of Table II: by experiment, arm and preset."""
    found: dict[tuple[str, str, str], list[Row]] = {}
    for row in measured:
        found.setdefault((row["experiment"], row["arm"], row["preset"]), []).append(row)
    return found


def seconds_here(measured: Iterable[Row]) -> dict[tuple[str, str], dict[str, float]]:
    """This machine's seconds per epoch, by the arm's name, of each experiment and preset.

    Means over the passes. Where two experiments have one source, it was measured once.
    """
    seconds = {key: mean(r["seconds"] for r in rows) for key, rows in by_pass(measured).items()}
    return {
        (name, preset): {
            arm: value
            for (experiment, arm, its_preset), value in seconds.items()
            if its_preset == preset
            and experiment == (row.source_of if arm == SOURCE.name else name)
        }
        for name, row in EXPERIMENTS.items()
        for preset in PRESETS
    }


def table_2(measured: Iterable[Row]) -> list[dict[str, str]]:
    """Table II: seconds per epoch, the paper's beside ours."""
    ours = by_pass(measured)
    rows = []
    for name, row in EXPERIMENTS.items():
        for arm in TABLE_2:
            if arm.task == "source" and name not in SOURCES:
                continue
            paper = row.seconds[arm.like]
            cells = {
                preset: _seconds(ours.get((name, arm.name, preset), []), paper.mean)
                for preset in PRESETS
            }
            rows.append(
                {
                    "experiment": row.title if arm.task == "target" else row.source_title,
                    "arm": arm.name,
                    "paper (s)": f"{paper.mean:.2f} ± {paper.error:.2f}",
                    **{f"ours, {preset} (s)": cell for preset, cell in cells.items()},
                }
            )
    return rows


def _seconds(passes: Sequence[Row], paper: float) -> str:
    if not passes:
        return NOT_RUN
    seconds = [row["seconds"] for row in passes]
    ours = f"{mean(seconds):.3f} ± {_error(passes):.3f}"
    return f"{ours} ({paper / mean(seconds):.0f}x as fast)"


def _error(passes: Sequence[Row]) -> float:
    """The standard error within a pass, or half the difference of the passes where it is larger."""
    seconds = [row["seconds"] for row in passes]
    return max(*(row["standard_error"] for row in passes), (max(seconds) - min(seconds)) / 2)


def _agree(passes: Sequence[Row]) -> bool:
    """Whether the passes differ by no more than two standard errors of their difference."""
    seconds = [row["seconds"] for row in passes]
    return max(seconds) - min(seconds) <= 2 * math.hypot(*(r["standard_error"] for r in passes))


def speed_note(measured: Iterable[Row]) -> str:
    """How ours was measured, and whether its passes agree."""
    rows = list(measured)
    if not rows:
        return "Ours has not been measured yet (`--measure-speed`)."
    return (
        "Ours: one seed alone; the standard error within a pass over the rows, or half the "
        "difference between passes where it is larger. "
        + " ".join(
            _sitting(preset, [r for r in rows if r["preset"] == preset]) for preset in PRESETS
        )
    )


def _sitting(preset: str, rows: Sequence[Row]) -> str:
    """Where and how the rows of a preset were measured, and whether their passes agree."""
    if not rows:
        return f"Preset `{preset}` has not been measured yet."
    load = max(row["load_before"] for row in rows)
    least = min(row["epochs"] for row in rows)
    machines = "; ".join(sorted({row["machine"] for row in rows}))
    about = (
        f"Preset `{preset}`, on {machines}: {least} epochs or more, the highest load before a row "
        f"{load:.3f}"
    )
    measured = by_pass(rows).values()
    twice = [passes for passes in measured if len(passes) > 1]
    if not twice:
        return f"{about}, one pass."
    once = len(measured) - len(twice)
    rest = f"; {once} of {len(measured)} have one pass alone" if once else ""
    worst = max(
        max(r["seconds"] for r in passes) / min(r["seconds"] for r in passes) for passes in twice
    )
    return (
        f"{about}; the passes of {sum(map(_agree, twice))} of {len(twice)} rows agree within two "
        f"standard errors, the furthest differ by {100 * (worst - 1):.0f}%{rest}."
    )
