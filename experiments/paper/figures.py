"""The paper's Figure 2 from kept curves: means and ranges over seeds, a panel for each policy."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from experiments.paper.arms import SCRATCH, SOURCE, SOURCE_PLAIN, TRANSFER, Arm, Task
from experiments.paper.published import EXPERIMENTS
from experiments.paper.statistics import Curves, Row, curves_of
from sumajax.reporting.curves import FAINT, INK, dress, write_png


@dataclass(frozen=True)
class TimeAxis:
    """What a panel is drawn over."""

    name: str
    label: str


HOURS = TimeAxis("hours", "the paper's hours")
ENV_STEPS = TimeAxis("env-steps", "environment steps (millions)")
AXES = (HOURS, ENV_STEPS)
FAR = 1.3
"""Times the lines' end from which the paper's T is not drawn to scale: it would squeeze them."""


@dataclass(frozen=True)
class Line:
    """How an arm is drawn; lines differ in lightness, dashes and width, so grey will do."""

    arm: Arm
    label: str
    colour: str
    style: Any
    width: float
    shade: float


# Blue and orange of Okabe and Ito's palette; in grey the first is dark and the second light.
_OURS, _OTHER = "#0072B2", "#E69F00"
_DASHED: Any = (0, (3.5, 1.5))
UPSAMPLED = Line(SOURCE, "upsampled", _OURS, "-", 1.8, 0.25)
PLAIN = Line(SOURCE_PLAIN, "not upsampled", _OTHER, _DASHED, 1.8, 0.3)
TRANSFERRED = Line(TRANSFER, "transferred", _OURS, "-", 1.8, 0.25)
FROM_SCRATCH = Line(SCRATCH, "from scratch", _OTHER, _DASHED, 1.8, 0.3)


@dataclass(frozen=True)
class Panel:
    """One policy on one task."""

    title: str
    experiment: str
    task: Task

    @property
    def lines(self) -> tuple[Line, Line]:
        return (UPSAMPLED, PLAIN) if self.task == "source" else (TRANSFERRED, FROM_SCRATCH)


_PP = (("IC3Net", "pp-ic3net"), ("MAGIC", "pp-magic"), ("HetNet", "pp-hetnet"))
PANELS = (
    tuple(Panel(f"(a) PP 5x5, {words}", name, "source") for words, name in _PP),
    tuple(Panel(f"(b) PP 10x10, {words}", name, "target") for words, name in _PP),
    (
        Panel("(c) PCP 5x5, HetNet", "pcp-hetnet-2p1c", "source"),
        Panel("(d) PCP 10x10, HetNet 2P/1C", "pcp-hetnet-2p1c", "target"),
        Panel("(d) PCP 10x10, HetNet 3P/2C", "pcp-hetnet-3p2c", "target"),
    ),
)
"""Of the paper's figure, a row of it in a row."""

TARGETS = tuple(
    Panel(row.title.replace(", 10x10", ""), name, "target") for name, row in EXPERIMENTS.items()
)


def figure_2(
    rows: Iterable[Row],
    references: Iterable[Row],
    preset: str,
    axis: TimeAxis,
    output: Path | None = None,
) -> Figure:
    """The paper's Figure 2, a panel for each policy on each task.

    A transferred arm starts where its source ended. On the paper's axis its fixed hour T is marked,
    and its two points there.

    Args:
      rows: of curves.csv.
      references: of references.csv: levels of a random policy and of the shortest paths.
    """
    return _drawn(PANELS, rows, references, preset, axis, (12.0, 10.5), output)


def targets(
    rows: Iterable[Row], references: Iterable[Row], preset: str, output: Path | None = None
) -> Figure:
    """The five target tasks in one line, by environment steps, the source's in."""
    return _drawn((TARGETS,), rows, references, preset, ENV_STEPS, (15.0, 3.6), output)


def _drawn(
    panels: Sequence[Sequence[Panel]],
    rows: Iterable[Row],
    references: Iterable[Row],
    preset: str,
    axis: TimeAxis,
    size: tuple[float, float],
    output: Path | None,
) -> Figure:
    rows, references = list(rows), list(references)
    figure = Figure(figsize=size, dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(panels), len(panels[0]), squeeze=False, sharey="row")
    drawn: dict[str, Artist] = {}
    for line, line_of_axes in zip(panels, grid, strict=True):
        for panel, axes in zip(line, line_of_axes, strict=True):
            drawn |= _draw(axes, panel, rows, references, preset, axis)
        line_of_axes[0].set_ylabel("steps taken per episode", color=INK)
    figure.legend(
        list(drawn.values()),
        list(drawn),
        loc="outside lower center",
        ncols=len(drawn) or 1,
        frameon=False,
        labelcolor=INK,
    )
    if output is not None:
        write_png(figure, output)
    return figure


def _draw(
    axes: Axes, panel: Panel, rows: list[Row], references: list[Row], preset: str, axis: TimeAxis
) -> dict[str, Artist]:
    """Draws a panel; what its legend needs, by label."""
    axes.set_yscale("log")
    drawn: dict[str, Artist] = {}
    seeds, ends = [], [0.0]
    for line in panel.lines:
        arm = curves_of(rows, panel.experiment, line.arm, preset)
        if arm is not None:
            shift = _shift(rows, panel, line, preset, axis)
            drawn[line.label], end = _draw_line(axes, line, arm, shift, axis)
            ends.append(end)
            seeds.append(f"{len(arm.filled)} {line.label}")
    if axis is HOURS and panel.task == "target":
        drawn |= _draw_the_papers(axes, panel, max(ends))
    _draw_levels(axes, references, panel)
    dress(axes, axis.label)
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_title(
        f"{panel.title}\nseeds: {', '.join(seeds) or 'not run yet'}",
        loc="left",
        fontsize=9,
        color=INK,
    )
    return drawn


def _shift(rows: list[Row], panel: Panel, line: Line, preset: str, axis: TimeAxis) -> float:
    """What the arm's source cost."""
    if line.arm.start is None:
        return 0.0
    source = curves_of(rows, EXPERIMENTS[panel.experiment].source_of, line.arm.start, preset)
    return 0.0 if source is None else float(_x(source, axis)[-1])


def _x(arm: Curves, axis: TimeAxis) -> np.ndarray:
    """(E,) of an arm alone."""
    return arm.hours if axis is HOURS else np.asarray(arm.env_steps.mean(0)) / 1e6


def _draw_line(
    axes: Axes, line: Line, arm: Curves, shift: float, axis: TimeAxis
) -> tuple[Artist, float]:
    """Draws it; the line, and where it ends."""
    position = shift + _x(arm, axis)
    if len(arm.filled) > 1:
        least, most = arm.filled.min(0), arm.filled.max(0)
        axes.fill_between(position, least, most, color=line.colour, alpha=line.shade, linewidth=0)
    (drawn,) = axes.plot(
        position,
        arm.filled.mean(0),
        color=line.colour,
        linestyle=line.style,
        linewidth=line.width,
    )
    return drawn, float(position[-1])


def _draw_the_papers(axes: Axes, panel: Panel, end: float) -> dict[str, Artist]:
    """A mark at T with the paper's two points; at the right edge where T lies far behind the end.

    Args:
      end: of the lines.
    """
    row = EXPERIMENTS[panel.experiment]
    beyond = 0 < FAR * end < row.hours
    at = 1.06 * end if beyond else row.hours
    axes.axvline(at, color=FAINT, linewidth=0.9, linestyle=(0, (5, 3)), zorder=1)
    axes.annotate(
        f"T = {row.hours:g} h" + (" (not to scale)" if beyond else ""),
        (at, 0.5 if beyond else 0.14),  # clear of the lines
        xycoords=("data", "axes fraction"),
        xytext=(-3, 0),
        textcoords="offset points",
        rotation=90,
        ha="right",
        va="center",
        fontsize=8,
        color=INK,
    )
    drawn: dict[str, Artist] = {}
    for value, filled, words in ((row.scratch, False, "scratch"), (row.transfer, True, "transfer")):
        (drawn[f"the paper at T, {words}"],) = axes.plot(
            [at],
            [value],
            marker=">" if beyond else "o",
            markersize=7,
            linestyle="none",
            color=INK,
            markerfacecolor=INK if filled else "white",
            zorder=5,
        )
    return drawn


def _draw_levels(axes: Axes, references: list[Row], panel: Panel) -> None:
    """A random policy and the shortest paths, over the held-out starts."""
    for row in references:
        if (row["experiment"], row["task"]) != (panel.experiment, panel.task):
            continue
        for column, words in (("random_steps_taken", "random"), ("shortest_paths", "shortest")):
            value = row[column]
            if value != value:
                continue
            axes.axhline(value, color=FAINT, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=1)
            text = axes.annotate(
                f"{words} {value:.1f}",
                (0.01, value),
                xycoords=("axes fraction", "data"),
                xytext=(0, 2),
                textcoords="offset points",
                fontsize=7,
                color=INK,
            )
            text.set_in_layout(False)
