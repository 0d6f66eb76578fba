"""Tables, figures and the report of the paper's reproduction, all from the kept CSV files."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from experiments.paper.arms import ABLATIONS, SCRATCH, SOURCE, SOURCE_PLAIN, TABLE_2, TRANSFER, Arm
from experiments.paper.claims import NOT_RUN, RULES, Claim, claims, number, said
from experiments.paper.figures import figure_2
from experiments.paper.parts import ABLATED, Budget, Part, PresetName, unchanged_arms
from experiments.paper.published import EXPERIMENTS, SOURCES
from experiments.paper.results import Results, write_csv
from experiments.paper.statistics import (
    STATISTICS_COLUMNS,
    Comparison,
    Estimate,
    Row,
    aggregate,
    comparison_of,
    curves_of,
    estimate,
    iqm,
    middle,
    ratio_of,
    statistics,
)
from sumajax.reporting import write_text

PRESETS: tuple[PresetName, ...] = get_args(PresetName)
PROVENANCE = "provenance"


def write_report(results: Results) -> None:
    """Writes every table and figure and the report beside the kept files."""
    directory = results.directory
    write_table(directory / "table1", table_1(results.rows["curves"]))
    write_table(directory / "table2", table_2(results.rows["seconds_per_epoch"]))
    write_table(directory / "ablations", ablations(results))
    all_statistics = statistics_rows(results)
    write_csv(directory / "statistics.csv", STATISTICS_COLUMNS, all_statistics)
    write_text(directory / "statistics.md", markdown(list(map(_shown, all_statistics))))
    for preset in presets(results):
        figure = directory / f"figure2-{preset}.png"
        figure_2(results.rows["curves"], results.rows["references"], preset, figure)
    write_text(directory / "README.md", report(results))


def presets(results: Results) -> list[str]:
    """Those of which something is kept."""
    kept = {row["preset"] for row in results.rows["curves"]}
    return [preset for preset in PRESETS if preset in kept]


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Cells as shown, as CSV and as Markdown."""
    write_csv(path.with_suffix(".csv"), rows[0] if rows else (), rows)
    write_text(path.with_suffix(".md"), markdown(rows))


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table; every row has the keys of the first."""
    if not rows:
        return f"{NOT_RUN.capitalize()}.\n"
    lines = [tuple(rows[0]), ("---",) * len(rows[0]), *(tuple(row.values()) for row in rows)]
    return "".join(
        f"| {' | '.join('' if c is None else str(c) for c in line)} |\n" for line in lines
    )


def table_1(curves: Iterable[Row]) -> list[dict[str, str]]:
    """Table I: steps taken at the hour, the paper's single run beside ours."""
    curves = list(curves)
    return [
        {
            "experiment": row.title,
            "T (h)": f"{row.hours:g}",
            "paper: scratch": f"{row.scratch:.2f}",
            "paper: transfer": f"{row.transfer:.2f}",
            "paper: ratio": f"{row.ratio:.2f}x",
            "preset": preset,
            **_ours_of_table_1(comparison_of(curves, name, preset)),
        }
        for name, row in EXPERIMENTS.items()
        for preset in PRESETS
    ]


def _ours_of_table_1(compared: Comparison | None) -> dict[str, str]:
    names = ("seeds", "at (h)", "scratch", "transfer", "ratio")
    if compared is None:
        return dict.fromkeys(names, NOT_RUN)
    scratch, transfer = (estimate(iqm, sample) for sample in compared.final)
    ratio = estimate(ratio_of(iqm), *compared.final)
    cells = (f"{ratio.seeds}", f"{compared.hour:.3g}", *map(said, (scratch, transfer)))
    return dict(zip(names, (*cells, f"{said(ratio)}x"), strict=True))


MARKS = (0.1, 0.3, 0.6, 1.0, 1.2, 2.0, 2.5, 5.0, 10.0, 20.0)
"""Millions of environment steps at which both arms are shown side by side."""


def on_the_way(curves: Iterable[Row]) -> list[dict[str, str]]:
    """Both arms at the same number of environment steps, by experiment, preset and what counts."""
    curves = list(curves)
    rows = []
    for name, row in EXPERIMENTS.items():
        for preset in PRESETS:
            compared = comparison_of(curves, name, preset)
            for counted in (False, True) if compared else ():
                assert compared is not None
                x, *arms = compared.on_the_way(counted)
                reached = [mark for mark in MARKS if x.size and x[0] <= 1e6 * mark <= 1.001 * x[-1]]
                cells = {mark: [np.interp(1e6 * mark, x, arm) for arm in arms] for mark in reached}
                rows.append(
                    {
                        "experiment": row.title,
                        "preset": preset,
                        "source": "counted" if counted else "not counted",
                        **{
                            f"{mark:g} M": "{:.1f} -> {:.1f}".format(*cells[mark])
                            if mark in cells
                            else "-"
                            for mark in MARKS
                        },
                    }
                )
    return rows


def table_2(measured: Iterable[Row]) -> list[dict[str, str]]:
    """Table II: seconds per epoch, the paper's beside ours."""
    ours = {(row["experiment"], row["arm"], row["preset"]): row for row in measured}
    rows = []
    for name, row in EXPERIMENTS.items():
        for arm in TABLE_2:
            if arm.task == "source" and name not in SOURCES:
                continue
            paper = row.seconds[arm.like]
            cells = {
                preset: _seconds(ours.get((name, arm.name, preset)), paper.mean)
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


def _seconds(row: Row | None, paper: float) -> str:
    if row is None:
        return NOT_RUN
    ours = f"{row['seconds']:.3f} ± {row['standard_error']:.3f}"
    return f"{ours} ({paper / row['seconds']:.0f}x as fast)"


def statistics_rows(results: Results) -> list[Row]:
    """Every statistic of every experiment and preset that was run, long form."""
    rows: list[Row] = []
    curves, levels = results.rows["curves"], _levels(results.rows["references"])
    for preset in presets(results):
        found = [c for name in EXPERIMENTS if (c := comparison_of(curves, name, preset))]
        for comparison in found:
            rows += statistics(comparison)
        rows += _source_statistics(curves, preset)
        rows += aggregate(found, levels)
    return rows


def _source_statistics(curves: list[Row], preset: str) -> list[Row]:
    """Question Q1: the source task with and without upsampling."""
    rows: list[Row] = []
    for name in SOURCES:
        arms = {arm: curves_of(curves, name, arm, preset) for arm in (SOURCE, SOURCE_PLAIN)}
        lasts = {arm.name: found.last for arm, found in arms.items() if found is not None}
        estimates = {arm: estimate(iqm, last) for arm, last in lasts.items()}
        if len(lasts) == 2:
            estimates["source/source-plain"] = estimate(ratio_of(iqm), *lasts.values())
        blank: Row = dict.fromkeys(STATISTICS_COLUMNS)
        rows += [
            {
                **blank,
                "preset": preset,
                "experiment": name,
                "quantity": "steps taken on the source, last tenth of the epochs",
                "of": of,
                "seeds": found.seeds,
                "value": found.value,
                "low": found.low,
                "high": found.high,
            }
            for of, found in estimates.items()
        ]
    return rows


def _levels(references: Iterable[Row]) -> dict[str, tuple[float, float]]:
    return {
        row["experiment"]: (row["random_steps_taken"], row["shortest_paths"])
        for row in references
        if row["task"] == "target"
    }


def _shown(row: Row) -> dict[str, Any]:
    """A statistic as a row of Markdown."""
    found = Estimate(row["value"], row["low"], row["high"], row["seeds"], bool(row["at_least"]))
    reached = row["reached"]
    return {
        "preset": row["preset"],
        "experiment": row["experiment"],
        "quantity": row["quantity"],
        "of": row["of"],
        "seeds": row["seeds"],
        "value [95%]": said(found) + (f" ({reached} reached)" if reached is not None else ""),
        "at": None if row["at"] is None or math.isnan(row["at"]) else number(row["at"], 3),
    }


def ablations(results: Results) -> list[dict[str, str]]:
    """What the claim rests on: the transferred arm changed in one thing at a time."""
    curves = results.rows["curves"]
    kept = {(row["experiment"], row["arm"], row["preset"]) for row in curves}
    rows = []
    for preset in PRESETS:
        for name in ABLATED:
            transfer, scratch = unchanged_arms(name, preset)
            variants = {"as the paper (transfer)": transfer, "from scratch": scratch}
            for ablation in ABLATIONS.values():
                variants |= ablation.variants
            for text, arm in variants.items():
                there = (name, arm.name, preset) in kept
                if not there and preset not in presets(results):
                    continue
                about = {"preset": preset, "experiment": EXPERIMENTS[name].title, "variant": text}
                rows.append(about | _ablated(results, name, arm, preset))
    return rows


def _ablated(results: Results, name: str, arm: Arm, preset: str) -> dict[str, str]:
    columns = ("seeds", "zero shot", "mean on the way", "at the end", "env steps to 20")
    found = curves_of(results.rows["curves"], name, arm, preset)
    if found is None:
        return dict.fromkeys(columns, NOT_RUN)
    looks = [
        row["steps_taken"]
        for row in results.rows["evaluations"]
        if (row["experiment"], row["preset"], row["mode"]) == (name, preset, "sampled")
        and row["arm"] == arm.zero_shot
    ]
    times = found.env_steps_to(20.0)
    reached = f"{int(np.isfinite(times).sum())} of {len(times)}"
    cells = (
        f"{len(times)}",
        said(estimate(iqm, np.array(looks))) if looks else "-",
        said(estimate(iqm, found.filled.mean(-1))),
        said(estimate(iqm, found.last)),
        f"{said(estimate(middle, times))} ({reached})",
    )
    return dict(zip(columns, cells, strict=True))


def report(results: Results) -> str:
    """README.md: claim by claim, then tables, budgets and commands."""
    known = presets(results) or list(PRESETS)
    found = [claim for preset in PRESETS for claim in claims(results.rows["curves"], preset)]
    by_name: dict[str, list[Claim]] = {}
    for claim in found:
        by_name.setdefault(claim.name, []).append(claim)
    lines = [
        "# The paper's evidence, reproduced",
        "Made by `python -m experiments.paper --rebuild` from the CSV files beside it; "
        "nothing in it is written by hand. What was not run says so.",
        "## Claim by claim",
        markdown([_line(claim) for group in by_name.values() for claim in group]),
        "### How a verdict is found",
        RULES,
        "## Table I: steps taken at the paper's fixed hour",
        markdown(table_1(results.rows["curves"])),
        "The paper ran each once. Ours: interquartile mean over seeds, 95% interval.",
        "## Table II: seconds per epoch of 20,000 environment steps",
        markdown(table_2(results.rows["seconds_per_epoch"])),
        _speed_note(results.rows["seconds_per_epoch"]),
        "## Figure 2",
        *(f"![Figure 2, preset {name}](figure2-{name}.png)" for name in presets(results)),
        "## On the way: steps taken from scratch -> after transfer, at equal environment steps",
        "Counted or not: whether the source's steps count for the transferred policy. Learning "
        "rates anneal to the end of each budget under preset `fast`.",
        markdown(on_the_way(results.rows["curves"])),
        "## Ablations",
        markdown(ablations(results)),
        "Further statistics: [statistics.md](statistics.md), [statistics.csv](statistics.csv).",
        "## Budgets",
        _budgets(results, known),
        "## Commands",
        "As they were given at their commits; the program was `experiments/reproduce_paper.py` "
        "before it became `python -m experiments.paper`.",
        _commands(results.directory),
    ]
    return "\n\n".join(line.rstrip("\n") for line in lines) + "\n"


def _line(claim: Claim) -> dict[str, str]:
    return {
        "claim": claim.name,
        "preset": claim.preset,
        "paper": claim.paper,
        "ours": claim.ours,
        "verdict": f"**{claim.verdict}**" if claim.verdict != NOT_RUN else claim.verdict,
        "reason": claim.reason,
    }


def _speed_note(measured: Iterable[Row]) -> str:
    rows = list(measured)
    if not rows:
        return "Ours has not been measured yet (`--measure-speed`)."
    machines = sorted({row["machine"] for row in rows})
    load = max(row["load_before"] for row in rows)
    least = min(row["epochs"] for row in rows)
    return (
        f"Ours: one seed, mean and standard error over {least} epochs or more on "
        f"{'; '.join(machines)}; the highest load before a row was {load:.2f}."
    )


def _budgets(results: Results, known: Iterable[str]) -> str:
    """Epochs per arm: the paper's, those of `fast`, and those that the kept curves have."""
    rows = []
    for name, row in EXPERIMENTS.items():
        for arm in (SOURCE, SOURCE_PLAIN, TRANSFER, SCRATCH):
            if arm.task == "source" and name not in SOURCES:
                continue
            kept = {preset: results.last_epochs(Part(name, arm), preset) for preset in known}
            rows.append(
                {
                    "experiment": row.title,
                    "arm": arm.name,
                    "preset paper": Budget("paper").epochs(Part(name, arm)),
                    "preset fast": Budget("fast").epochs(Part(name, arm)),
                    "kept": "; ".join(_kept(*item) for item in kept.items() if item[1]) or NOT_RUN,
                }
            )
    return markdown(rows)


def _kept(preset: str, last: Mapping[int, int]) -> str:
    epochs = sorted(set(last.values()))
    return f"{preset}: {len(last)} seeds, {' or '.join(map(str, epochs))} epochs"


def _commands(directory: Path) -> str:
    """Every part with the command, commit and machine that made it."""
    rows = []
    for file in sorted((directory / PROVENANCE).glob("*.json")):
        said_of = json.loads(file.read_text())
        last = said_of["sessions"][-1]
        rows.append(
            {
                "part": ", ".join(said_of["parts"]),
                "preset": said_of["preset"],
                "seeds": " ".join(map(str, said_of["seeds"])),
                "command": f"`{last.get('command', '')}`",
                "commit": last.get("stopped") or last["commit"],
                "file": f"[{file.name}]({PROVENANCE}/{file.name})",
            }
        )
    return markdown(rows)
