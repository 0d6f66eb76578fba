"""Tables, figures and the report of the paper's reproduction, all from the kept CSV files."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper.arms import ABLATIONS, SCRATCH, SOURCE, SOURCE_PLAIN, TRANSFER, Arm
from experiments.paper.claims import NOT_RUN, RULES, Claim, claims, number, said, spread
from experiments.paper.figures import AXES, figure_2, targets
from experiments.paper.parts import ABLATED, PRESETS, Budget, Part, unchanged_arms
from experiments.paper.published import EXPERIMENTS, SOURCES
from experiments.paper.results import Results, write_csv
from experiments.paper.statistics import (
    LEAST_SEEDS,
    STATISTICS_COLUMNS,
    THRESHOLDS,
    Accounting,
    Comparison,
    Ratio,
    Row,
    Spread,
    accountings,
    comparison_of,
    curves_of,
    mean_of,
    median_of,
    pair_rows,
    ratio_of_means,
    ratio_of_medians,
    statistics,
)
from experiments.paper.table2 import seconds_here, speed_note, table_2
from sumajax.reporting import write_text

PROVENANCE = "provenance"

KEPT = """\
[curves.csv](curves.csv) has an epoch of a seed in a row, [evaluations.csv](evaluations.csv) the
held-out episodes, [references.csv](references.csv) a random team and the shortest paths on the same
starts, [seconds_per_epoch.csv](seconds_per_epoch.csv) the speed. A test
(`tests/experiments/paper/test_recomputed.py`) works the figures of the README and of the pages in
`docs/` out of them once more, without this program. Larger grids have rows of their own:
[scale](scale/README.md)."""

COSTS = """\
Three accountings, the source's cost in each: the paper's hours (epochs times its Table II),
environment steps, and minutes here (epochs times our Table II: one seed alone). Steps taken are the
mean over the hour before for the first, over ten epochs before for the others; times are medians
until an epoch's mean is that low. The ratio is of those; its interval is of the ratio of geometric
means, Student's on logarithms, given with three seeds or more in both arms while an arm's seeds all
came to 30 steps or none did. Minutes are for arms of one preset: each preset's Table II is of one
machine, not the same for both, and of a later commit than the curves (see Commands)."""

BUDGETS = """\
Preset `paper`: the paper's pre-training, then until its fixed hour T. Preset `fast`: 1.0 M steps on
the source; on the target 2.5 M for IC3Net, 1.2 M for MAGIC, and for HetNet 3.0 M, set after not
every seed from scratch had learnt within 1.2 M (arms `-brief`, kept for Predator-Prey). A budget is
stated before the run by `experiments/paper/parts.py`."""


def write_report(results: Results) -> None:
    """Writes every table and figure and the report beside the kept files."""
    directory = results.directory
    write_table(directory / "table1", table_1(results.rows["curves"]))
    write_table(directory / "table2", table_2(results.rows["seconds_per_epoch"]))
    write_table(directory / "ablations", ablations(results))
    all_statistics = statistics_rows(results)
    write_csv(directory / "statistics.csv", STATISTICS_COLUMNS, all_statistics)
    write_text(directory / "statistics.md", markdown(list(map(_shown, all_statistics))))
    curves, references = results.rows["curves"], results.rows["references"]
    for preset in presets(results):
        for axis in AXES:
            figure_2(curves, references, preset, axis, directory / figure_file(preset, axis.name))
    targets(curves, references, "fast", directory / "transfer-fast.png")
    write_text(directory / "README.md", report(results))


def figure_file(preset: str, axis: str) -> str:
    """The file of Figure 2 under a preset, on one time axis."""
    return f"figure2-{preset}-{axis}.png"


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
    names = ("seeds", "at (h)", "target epochs", "scratch", "transfer", "ratio", "never at 30")
    if compared is None:
        return dict.fromkeys(names, NOT_RUN)
    found = compared.equal(compared.papers_hours)
    if found.transfer is None:
        return dict.fromkeys(names, "the source costs more")
    ratio = ratio_of_means(found.scratch, found.transfer, compared.of_one_kind)
    cells = (
        _seeds(compared),
        f"{compared.hour:.3g}",
        f"{found.scratch_epochs}, {found.transfer_epochs} after {len(compared.source.epochs)}",
        spread(mean_of(found.scratch)),
        spread(mean_of(found.transfer)),
        f"{said(ratio)}x",
        _failures(compared, 30.0),
    )
    return dict(zip(names, cells, strict=True))


def _seeds(compared: Comparison) -> str:
    """Of both arms, where they differ."""
    many = dict.fromkeys(len(arm.filled) for arm in (compared.scratch, compared.transfer))
    return ", ".join(map(str, many))


def _failures(compared: Comparison, threshold: float) -> str:
    """Seeds that never came to a threshold within their budget, scratch and transferred."""
    arms = (compared.scratch, compared.transfer)
    return ", ".join(f"{len(a.filled) - a.came_to(threshold)} of {len(a.filled)}" for a in arms)


def costs(results: Results) -> list[dict[str, str]]:
    """Both arms at equal cost, under every accounting, the source's cost in."""
    here = seconds_here(results.rows["seconds_per_epoch"])
    rows = []
    for name, row in EXPERIMENTS.items():
        for preset in PRESETS:
            compared = comparison_of(results.rows["curves"], name, preset)
            for by in accountings(compared, here[name, preset]) if compared else ():
                assert compared is not None
                about = {"experiment": row.title, "preset": preset, "equal": by.name}
                rows.append(about | _at_equal_cost(compared, by))
    return rows


def _at_equal_cost(compared: Comparison, by: Accounting) -> dict[str, str]:
    found = compared.equal(by)
    cells = {
        "at": number(found.at, 3),
        "seeds": _seeds(compared),
        "target epochs: scratch": f"{found.scratch_epochs}",
        "transfer": f"{found.transfer_epochs}",
        "steps taken: scratch": spread(mean_of(found.scratch)),
    }
    if found.transfer is None:
        text = "the source alone costs more"
        return cells | {"transferred": text, "ratio [95%]": "-"}
    ratio = ratio_of_means(found.scratch, found.transfer, compared.of_one_kind)
    return cells | {
        "transferred": spread(mean_of(found.transfer)),
        "ratio [95%]": f"{said(ratio)}x",
    }


def times(results: Results) -> list[dict[str, str]]:
    """Cost until a number of steps taken, under every accounting, and who never came."""
    here = seconds_here(results.rows["seconds_per_epoch"])
    rows = []
    for name, row in EXPERIMENTS.items():
        for preset in PRESETS:
            compared = comparison_of(results.rows["curves"], name, preset)
            for threshold in THRESHOLDS if compared else ():
                assert compared is not None
                arms = (compared.scratch, compared.transfer)
                alone = [spread(median_of(arm.env_steps_to(threshold)), 3) for arm in arms]
                cells = {
                    by.name: _time_cell(compared, threshold, by)
                    for by in accountings(compared, here[name, preset])
                }
                rows.append(
                    {
                        "experiment": row.title,
                        "preset": preset,
                        "to": f"{threshold:g} steps",
                        "never: scratch, transfer": _failures(compared, threshold),
                        "target alone, M environment steps": " -> ".join(alone),
                        **{
                            f"source in, {by}": cells.get(by, "not measured")
                            for by in ("M environment steps", "the paper's hours", "minutes here")
                        },
                    }
                )
    return rows


def _time_cell(compared: Comparison, threshold: float, by: Accounting) -> str:
    scratch, transfer = compared.times_to(threshold, by)
    ratio = ratio_of_medians(scratch, transfer, float(by.scratch.mean(0)[-1]))
    shown = " -> ".join(spread(median_of(sample), 3) for sample in (scratch, transfer))
    return f"{shown}: {said(ratio, 3)}x" if ratio.value == ratio.value else shown


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


def statistics_rows(results: Results) -> list[Row]:
    """Every statistic of every experiment and preset that was run, long form."""
    rows: list[Row] = []
    curves = results.rows["curves"]
    here = seconds_here(results.rows["seconds_per_epoch"])
    for preset in presets(results):
        for name in EXPERIMENTS:
            if comparison := comparison_of(curves, name, preset):
                rows += statistics(comparison, here[name, preset])
        rows += _source_statistics(curves, preset)
    return rows


def _source_statistics(curves: list[Row], preset: str) -> list[Row]:
    """Question Q1: the source task with and without upsampling."""
    rows: list[Row] = []
    quantity = "steps taken on the source, last tenth of the epochs"
    for name in SOURCES:
        upsampled, plain = (curves_of(curves, name, arm, preset) for arm in (SOURCE, SOURCE_PLAIN))
        if upsampled is None or plain is None:
            continue
        names = (SOURCE.name, SOURCE_PLAIN.name)
        samples = (upsampled.last, plain.last)
        about = {"preset": preset, "experiment": name}
        rows += [{**about, **row} for row in pair_rows(quantity, samples, True, names=names)]
    return rows


def _shown(row: Row) -> dict[str, Any]:
    """A statistic as a row of Markdown."""
    if row["least"] is None:
        ratio = Ratio(row["value"], row["low"], row["high"], bool(row["at_least"]))
        value = said(ratio)
    else:
        value = spread(Spread(row["value"], row["least"], row["most"], row["seeds"]))
    came = f" ({row['came']} came)" if row["came"] is not None else ""
    return {
        "preset": row["preset"],
        "experiment": row["experiment"],
        "quantity": row["quantity"],
        "of": row["of"],
        "seeds": row["seeds"],
        "value (range) or ratio [95%]": value + came,
        "at": None if row["at"] is None else number(row["at"], 3),
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
                if (name, arm.name, preset) not in kept:
                    continue
                about = {"preset": preset, "experiment": EXPERIMENTS[name].title, "variant": text}
                rows.append(about | _ablated(results, name, arm, preset))
    return rows


def _ablated(results: Results, name: str, arm: Arm, preset: str) -> dict[str, str]:
    columns = (
        "seeds",
        "zero shot",
        "mean on the way",
        "at the end",
        "M target steps to 20",
        "never at 20",
    )
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
    cells = (
        f"{len(times)}",
        spread(mean_of(np.array(looks))) if looks else "-",
        spread(mean_of(found.filled.mean(-1))),
        spread(mean_of(found.last)),
        spread(median_of(times), 3),
        f"{int(np.isinf(times).sum())} of {len(times)}",
    )
    return dict(zip(columns, cells, strict=True))


def report(results: Results) -> str:
    """README.md: claim by claim, then tables, budgets and commands."""
    known = presets(results) or list(PRESETS)
    lines = [
        "# The paper's evidence, reproduced",
        "Made by `python -m experiments.paper --rebuild` from the rows that are kept beside it; "
        "nothing in it is written by hand. What was not run says so, and is listed under "
        "[Budgets](#budgets).",
        KEPT,
        "## Claim by claim",
        _claims(results),
        "What they were under the rules before these: [docs/verdicts.md](../../docs/verdicts.md).",
        "### How a verdict is found",
        RULES,
        "## Table I: steps taken at the paper's fixed hour",
        markdown(table_1(results.rows["curves"])),
        "The paper ran each once. Ours: mean over seeds (range). Target epochs: scratch's, and the "
        "transferred arm's after those of its source, which the hours count; `at` is T or the end "
        "of the shorter budget. Never at 30: seeds from scratch, transferred.",
        "## Costs",
        COSTS,
        "### Steps taken at equal cost",
        markdown(costs(results)),
        "### Cost to a number of steps taken",
        markdown(times(results)),
        "## Table II: seconds per epoch",
        "An epoch is 20,000 environment steps, under preset `paper` in whole episodes 20 to 24 "
        "thousand.",
        markdown(table_2(results.rows["seconds_per_epoch"])),
        speed_note(results.rows["seconds_per_epoch"]),
        "## Figure 2",
        "On the paper's axis, its hours, and by environment steps. Lines are means over the seeds, "
        "bands from the least to the greatest; a transferred policy starts at the cost of its "
        "source.",
        *(
            f"![Figure 2, preset {name}, by {axis.label}]({figure_file(name, axis.name)})"
            for name in presets(results)
            for axis in AXES
        ),
        "## On the way: steps taken from scratch -> after transfer, at equal environment steps",
        "Means over the seeds. Counted or not: whether the source's steps count for the "
        "transferred policy. Learning rates anneal to the end of each budget under preset `fast`.",
        markdown(on_the_way(results.rows["curves"])),
        "## Ablations",
        "Means over seeds (range); times are medians. What they say: "
        "[docs/ablations.md](../../docs/ablations.md).",
        markdown(ablations(results)),
        "Further statistics: [statistics.md](statistics.md), [statistics.csv](statistics.csv).",
        "## Budgets",
        BUDGETS,
        _budgets(results, known),
        _not_run(results),
        "## Commands",
        "As they were given at their commits; the program was `experiments/reproduce_paper.py` "
        "before it became `python -m experiments.paper`.",
        _configurations(results.directory),
        _commands(results.directory),
    ]
    return "\n\n".join(line.rstrip("\n") for line in lines) + "\n"


def _claims(results: Results) -> str:
    """Every claim, both presets of one below each other."""
    by_name: dict[str, list[Claim]] = {}
    for preset in PRESETS:
        for claim in claims(results.rows["curves"], preset):
            by_name.setdefault(claim.name, []).append(claim)
    return markdown([_line(claim) for group in by_name.values() for claim in group])


def _line(claim: Claim) -> dict[str, str]:
    return {
        "claim": claim.name,
        "preset": claim.preset,
        "paper": claim.paper,
        "ours": claim.ours,
        "verdict": f"**{claim.verdict}**" if claim.verdict != NOT_RUN else claim.verdict,
        "reason": claim.reason,
    }


def _budgets(results: Results, known: Iterable[str]) -> str:
    """Epochs per arm: the paper's, those of `fast`, and those that the kept curves have."""
    rows = []
    for part in _parts_with_verdicts():
        kept = {preset: results.last_epochs(part, preset) for preset in known}
        rows.append(
            {
                "experiment": EXPERIMENTS[part.experiment].title,
                "arm": part.arm.name,
                "preset paper": Budget("paper").epochs(part),
                "preset fast": Budget("fast").epochs(part),
                "kept": "; ".join(_kept(*item) for item in kept.items() if item[1]) or NOT_RUN,
            }
        )
    return markdown(rows)


def _parts_with_verdicts() -> list[Part]:
    """The arms of Table I and of question Q1."""
    return [
        Part(name, arm)
        for name in EXPERIMENTS
        for arm in (SOURCE, SOURCE_PLAIN, TRANSFER, SCRATCH)
        if arm.task == "target" or name in SOURCES
    ]


def _kept(preset: str, last: Mapping[int, int]) -> str:
    epochs = sorted(set(last.values()))
    seeds = "1 seed" if len(last) == 1 else f"{len(last)} seeds"
    return f"{preset}: {seeds}, {' or '.join(map(str, epochs))} epochs"


def _not_run(results: Results) -> str:
    """Arms of Table I and Q1 with too few seeds for a verdict, and ablations without rows."""
    lines = []
    for preset in PRESETS:
        few = [
            f"{part} ({len(seeds)} of {LEAST_SEEDS} seeds)"
            for part in _parts_with_verdicts()
            if len(seeds := results.last_epochs(part, preset)) < LEAST_SEEDS
        ]
        missing = [
            str(part)
            for name in ABLATED
            for ablation in ABLATIONS.values()
            for part in (Part(name, arm) for arm in ablation.variants.values())
            if not results.last_epochs(part, preset)
        ]
        lines += [
            f"* Preset `{preset}`, {words}: {', '.join(those) or 'none'}."
            for words, those in (
                ("with too few seeds for a verdict", few),
                ("ablations that were not run", missing),
            )
        ]
    return "\n".join(lines)


def _configurations(directory: Path) -> str:
    """How many of the files say with which settings their runs were trained."""
    files = list((directory / PROVENANCE).glob("*.json"))
    kept = sum("experiment" in json.loads(file.read_text()) for file in files)
    return (
        f"The resolved configuration (tasks, starts, every setting of the learner) is in {kept} of "
        f"{len(files)} files, those of runs since the program keeps it; of the others it is what "
        "their commit makes of their command."
    )


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
