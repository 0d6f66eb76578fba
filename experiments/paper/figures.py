"""The paper's Figure 2 from kept curves: median and quartiles over seeds, on three time axes."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from experiments.paper.arms import SCRATCH, SOURCE, SOURCE_PLAIN, TRANSFER, Arm, Task
from experiments.paper.published import EXPERIMENTS
from experiments.paper.statistics import Curves, Row, curves_of
from sumajax.reporting.curves import FAINT, INK, dress, spread, write_png

# Okabe and Ito's palette, as in the package's own curves; an experiment keeps its colour.
COLOURS = {
    "pp-ic3net": "#0072B2",
    "pp-magic": "#009E73",
    "pp-hetnet": "#D55E00",
    "pcp-hetnet-2p1c": "#D55E00",
    "pcp-hetnet-3p2c": "#56B4E9",
}
LABELS = {
    "pp-ic3net": "IC3Net",
    "pp-magic": "MAGIC",
    "pp-hetnet": "HetNet",
    "pcp-hetnet-2p1c": "HetNet 2P/1C",
    "pcp-hetnet-3p2c": "HetNet 3P/2C",
}
DASHED: Any = (0, (4, 1.5))


@dataclass(frozen=True)
class Panel:
    """A row of the figure: which arms, and which of them is the paper's own method.

    Attributes:
      ours: arm drawn with a full line; `other`, dashed, is what it is compared with.
    """

    title: str
    experiments: tuple[str, ...]
    task: Task
    ours: Arm
    other: Arm
    words: tuple[str, str]


_SOURCE = ("upsampled", "not upsampled")
_TARGET = ("transferred", "from scratch")
_PP = ("pp-ic3net", "pp-magic", "pp-hetnet")
_PCP = ("pcp-hetnet-2p1c", "pcp-hetnet-3p2c")
PANELS = (
    Panel("(a) PP 5x5 source", _PP, "source", SOURCE, SOURCE_PLAIN, _SOURCE),
    Panel("(b) PP 10x10 target", _PP, "target", TRANSFER, SCRATCH, _TARGET),
    Panel("(c) PCP 5x5 source", _PCP[:1], "source", SOURCE, SOURCE_PLAIN, _SOURCE),
    Panel("(d) PCP 10x10 target", _PCP, "target", TRANSFER, SCRATCH, _TARGET),
)

AXES = {
    "hours": "the paper's hours",
    "env_steps": "environment steps (millions)",
    "seconds": "our wall clock per seed (minutes)",
}
UNITS = {"hours": 1.0, "env_steps": 1e6, "seconds": 60.0}


def figure_2(
    rows: Iterable[Row], references: Iterable[Row], preset: str, output: Path | None = None
) -> Figure:
    """A row for each panel of the paper's figure, a column for each time axis.

    A transferred arm starts where its source ended.

    Args:
      rows: of curves.csv.
      references: of references.csv: levels of a random policy and of the shortest paths.
    """
    rows, references = list(rows), list(references)
    figure = Figure(figsize=(13.0, 14.5), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    seeds: set[int] = set()
    parts: Any = figure.subfigures(len(PANELS), 1)
    for panel, part in zip(PANELS, parts, strict=True):
        line = part.subplots(1, len(AXES), sharey=True)
        curves = _curves(rows, panel, preset)
        seeds |= {len(arm.steps_taken) for arm, _ in curves.values()}
        levels = _levels(references, panel)
        for axes, x in zip(line, AXES, strict=True):
            for (experiment, name), (arm, source) in curves.items():
                _draw(axes, x, arm, source, experiment, full=name == panel.ours)
            _draw_levels(axes, levels, named=axes is line[-1])
            _dress(axes, AXES[x], empty=not curves)
        line[0].set_ylabel("steps taken per episode", color=INK)
        part.suptitle(
            _title(panel, curves), x=0.005, ha="left", fontsize=11, weight="bold", color=INK
        )
        _legend(part, panel, curves)
    figure.suptitle(_note(preset, seeds), x=0.005, ha="left", fontsize=10, color=FAINT)
    if output is not None:
        write_png(figure, output)
    return figure


Drawn = Mapping[tuple[str, Arm], tuple[Curves, Curves | None]]


def _curves(rows: list[Row], panel: Panel, preset: str) -> Drawn:
    """(experiment, arm) -> its curves, and the source they start behind."""
    found = {}
    for name in panel.experiments:
        for arm in (panel.other, panel.ours):
            curve = curves_of(rows, name, arm, preset)
            source = None
            if arm.start is not None:
                source = curves_of(rows, EXPERIMENTS[name].source_of, arm.start, preset)
            if curve is not None:
                found[name, arm] = (curve, source)
    return found


def _x(arm: Curves, x: str) -> np.ndarray:
    values = arm.hours if x == "hours" else getattr(arm, x).mean(0)
    return np.asarray(values) / UNITS[x]


def _draw(
    axes: Axes, x: str, arm: Curves, source: Curves | None, experiment: str, full: bool
) -> None:
    shift = _x(source, x)[-1] if source is not None else 0.0
    position = shift + _x(arm, x)
    middle, low, high = spread(arm.filled)
    colour, style = COLOURS[experiment], "-" if full else DASHED
    if len(arm.filled) > 1:
        axes.fill_between(position, low, high, color=colour, alpha=0.18, linewidth=0)
    axes.plot(position, middle, color=colour, linestyle=style, linewidth=1.5)


def _levels(references: list[Row], panel: Panel) -> dict[str, list[float]]:
    chosen = [
        row
        for row in references
        if row["experiment"] in panel.experiments and row["task"] == panel.task
    ]
    # Experiments on one task have one level.
    return {
        name: sorted({round(row[column], 1) for row in chosen if row[column] == row[column]})
        for name, column in (("random", "random_steps_taken"), ("oracle", "shortest_paths"))
    }


def _draw_levels(axes: Axes, levels: Mapping[str, list[float]], named: bool) -> None:
    for name, values in levels.items():
        for value in values:
            axes.axhline(value, color=FAINT, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=1)
        if named and values:
            text = f"{name} {', '.join(f'{value:g}' for value in values)}"
            axes.annotate(
                text,
                (1.02, float(np.mean(values))),
                xycoords=("axes fraction", "data"),
                fontsize=8,
                color=INK,
                va="center",
                annotation_clip=False,
            )


def _dress(axes: Axes, label: str, empty: bool) -> None:
    dress(axes, label)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_formatter(NullFormatter())
    if empty:
        axes.text(0.5, 0.5, "not run yet", transform=axes.transAxes, ha="center", color=FAINT)


def _title(panel: Panel, curves: Drawn) -> str:
    """What the panel is, what its lines are, and which of them are missing."""
    drawn = {arm for _, arm in curves}
    ours, other = (
        words if arm in drawn else f"{words} (not run yet)"
        for words, arm in zip(panel.words, (panel.ours, panel.other), strict=True)
    )
    return f"{panel.title}: full line {ours}, dashed {other}"


def _legend(part: SubFigure, panel: Panel, curves: Drawn) -> None:
    names = [name for name in panel.experiments if any(key[0] == name for key in curves)]
    handles = [Line2D([], [], color=COLOURS[name]) for name in names]
    if handles:
        labels = [LABELS[name] for name in names]
        part.legend(handles, labels, loc="upper right", ncols=3, frameon=False, labelcolor=INK)


def _note(preset: str, seeds: set[int]) -> str:
    many = f"{min(seeds)} to {max(seeds)}" if len(seeds) > 1 else f"{max(seeds, default=0)}"
    return (
        f"Figure 2, preset {preset}, {many} seeds: median, band between the quartiles (two seeds: "
        "mean and both); a transferred policy starts at the cost of its source."
    )
