"""Figures: cost against the grid's side, learning curves, trained there and played here."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

from experiments.scaling.costs import Arm
from experiments.scaling.plans import SCRATCH
from experiments.studies import Row
from sumajax.reporting.curves import FAINT, INK, dress, write_png

LEVEL = 2.0
"""Times the shortest paths, of the figure of costs."""
COST_PARTS = ("pp10", "pp20", "pp40", "dilution")
"""Whose chains grow from 5x5 on Predator-Prey, each policy in its own way."""
AXES = {"env_steps": (1e-6, "environment steps (millions)"), "cpu_seconds": (1.0, "CPU seconds")}

# Okabe and Ito's palette, as in the package's own curves.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
MATRICES_ABREAST = 3

DASHED: Any = (0, (4, 1.5))
DOTTED: Any = (0, (1, 1.5))
DASH_DOTTED: Any = (0, (5, 1.2, 1, 1.2))


def cost_figure(found: Sequence[Arm], output: Path) -> None:
    """Cost of the first team at `LEVEL` times the shortest paths against the grid's side: chains
    with full lines, scratch dashed, a colour for each policy.
    """
    lines = cost_lines(found)
    if not lines:
        return
    figure = Figure(figsize=(8.2, 3.6), layout="constrained")
    colours = _colours(policy for policy, _ in lines)
    for place, (unit, (scale, label)) in enumerate(AXES.items()):
        axes = figure.add_subplot(1, len(AXES), place + 1)
        for (policy, kind), by_side in lines.items():
            _cost_line(axes, by_side, unit, scale, colours[policy], kind)
            axes.plot(
                [], [], color=colours[policy], linestyle=_style(kind), label=f"{policy}, {kind}"
            )
        dress(axes, "cells along a side of the grid")
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        sides = sorted({side for by_side in lines.values() for side in by_side})
        axes.xaxis.set_major_locator(FixedLocator(sides))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_minor_locator(NullLocator())
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_xlim(min(sides) / 1.2, max(sides) * 1.2)
        axes.set_ylabel(f"{label}\nto {LEVEL:g} x shortest paths", color=INK)
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper left", ncols=4, frameon=False, fontsize=9)
    note = (
        "mean and all seeds, sources counted; squares: scratch; open triangle: a seed that never "
        "arrived, at its cost"
    )
    figure.supxlabel(note, x=0.995, ha="right", fontsize=8, color=FAINT)
    write_png(figure, output)


def cost_lines(found: Sequence[Arm]) -> dict[tuple[str, str], dict[int, Arm]]:
    """(policy, chain or scratch) -> arms by the grid's side; the first stage is both.

    A grid that has a part of its own is of that part; what larger chains pass on their way stands
    for the others.
    """
    lines: dict[tuple[str, str], dict[int, Arm]] = {}
    for part in COST_PARTS:
        own = [arm for arm in found if arm.about["part"] == part]
        for policy in dict.fromkeys(arm.about["policy"] for arm in own):
            of_policy = [arm for arm in own if arm.about["policy"] == policy]
            scratch = [arm for arm in of_policy if arm.about["stage"] == SCRATCH]
            staged = [arm for arm in of_policy if arm.about["stage"] != SCRATCH]
            first = [arm for arm in staged if not arm.about["after"]]
            chain = sorted(staged, key=lambda arm: len(arm.about["after"].split()), reverse=True)
            ends = {"chain": chain} | ({SCRATCH: first + scratch} if scratch else {})
            for kind, of_kind in ends.items():
                by_side = lines.setdefault((policy, kind), {})
                for arm in of_kind:
                    by_side.setdefault(arm.about["side"], arm)
    return lines


def _style(kind: str) -> Any:
    return DASHED if kind == SCRATCH else "-"


def _cost_line(
    axes: Axes, by_side: Mapping[int, Arm], unit: str, scale: float, colour: str, kind: str
) -> None:
    sides = sorted(by_side)
    means = []
    for side in sides:
        arm = by_side[side]
        cost = arm.cost_to(LEVEL, unit)
        arrived = np.isfinite(cost)
        least = np.where(arrived, cost, arm.total(unit)) * scale
        means.append(least.mean())
        dot = "s" if kind == SCRATCH else "o"
        marks = {dot: (least[arrived], colour), "^": (least[~arrived], "none")}
        for marker, (values, face) in marks.items():
            axes.scatter(
                [side] * len(values),
                values,
                marker=marker,
                s=22,
                facecolors=face,
                edgecolors=colour,
                linewidths=0.9,
                alpha=0.8,
            )
    axes.plot(sides, means, color=colour, linestyle=_style(kind), linewidth=1.6)


def _colours(names: Any) -> dict[str, str]:
    return {name: COLOURS[place % len(COLOURS)] for place, name in enumerate(dict.fromkeys(names))}


def curves_figure(own: Sequence[Arm], output: Path) -> None:
    """Steps taken over all that was spent, of the arms that end on a part's target: chains begin
    where their sources have ended.
    """
    target = max(own, key=lambda arm: len(arm.about["after"].split())).about["task"]
    arms = [arm for arm in own if arm.about["task"] == target]
    figure = Figure(figsize=(8.2, 3.6), layout="constrained")
    for place, (scale, label) in enumerate(AXES.values()):
        axes = figure.add_subplot(1, len(AXES), place + 1)
        colours = _colours(_line_name(arm) for arm in arms)
        for line, arm in enumerate(arms):
            name = _line_name(arm)
            x, low, middle, high = band(arm, place)
            # Lines beyond the palette have its colours once more.
            style = _style(arm.about["stage"]) if line < len(COLOURS) else DASH_DOTTED
            axes.plot(
                x * scale, middle, color=colours[name], linestyle=style, linewidth=1.5, label=name
            )
            if len(arm.seeds) > 1:
                axes.fill_between(
                    x * scale, low, high, color=colours[name], alpha=0.18, linewidth=0
                )
        axes.axhline(arms[0].about["bound"], color=FAINT, linewidth=0.8, linestyle=DOTTED)
        dress(axes, label)
        axes.set_ylim(bottom=0)
    figure.axes[0].set_ylabel(f"steps taken, {target}", color=INK)
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper left", ncols=2, frameon=False, fontsize=8)
    note = "held-out, sampled; mean and range over seeds; dotted: shortest paths"
    figure.supxlabel(note, x=0.995, ha="right", fontsize=8, color=FAINT)
    write_png(figure, output)


def _line_name(arm: Arm) -> str:
    about = arm.about
    words = SCRATCH if about["stage"] == SCRATCH else about["words"]
    return f"{about['policy']}, {words}"


def band(arm: Arm, column: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(P,) cost, and least, mean and greatest steps taken, on the points that all seeds have."""
    points = min(len(path) for path in arm.paths.values())
    paths = np.stack([path[:points] for path in arm.paths.values()])
    steps = paths[..., 2]
    return paths[..., column].mean(0), steps.min(0), steps.mean(0), steps.max(0)


def matrix_figure(
    matrices: Mapping[str, Mapping[tuple[str, str], Sequence[Row]]], output: Path
) -> None:
    """Steps taken by a team trained on one task (rows) and played on another (columns)."""
    if not matrices:
        return
    columns = min(len(matrices), MATRICES_ABREAST)
    lines = -(-len(matrices) // columns)
    figure = Figure(figsize=(4.4 * columns, 3.4 * lines), layout="constrained")
    for place, (name, cells) in enumerate(matrices.items()):
        axes = figure.add_subplot(lines, columns, place + 1)
        trained = list(dict.fromkeys(there for there, _ in cells))
        played = sorted({here for _, here in cells}, key=trained.index)
        success = np.full((len(trained), len(played)), np.nan)
        for (there, here), rows in cells.items():
            success[trained.index(there), played.index(here)] = np.mean(
                [r["success"] for r in rows]
            )
        axes.imshow(success, vmin=0, vmax=1, cmap="Blues", aspect="auto")
        for (there, here), rows in cells.items():
            row, column = trained.index(there), played.index(here)
            light = success[row, column] > 0.6
            axes.text(
                column,
                row,
                f"{np.mean([r['steps_taken'] for r in rows]):.1f}\n{success[row, column]:.1%}",
                ha="center",
                va="center",
                fontsize=8,
                color="white" if light else INK,
            )
        axes.set_xticks(range(len(played)), played, fontsize=8)
        axes.set_yticks(range(len(trained)), trained, fontsize=8)
        axes.set_title(name, fontsize=9, color=INK)
        axes.set_xlabel("played on", color=INK)
        axes.set_ylabel("trained on", color=INK)
    note = "steps taken and success, held-out, sampled, at the limit of the task"
    figure.supxlabel(note, x=0.995, ha="right", fontsize=8, color=FAINT)
    write_png(figure, output)
