"""Learning curves of an experiment, drawn without a display and without global state."""

import io
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from sumajax.reporting.metrics import read_metrics, seed_curves, write_bytes

# Okabe and Ito's palette (2008) keeps its colours apart under every common colour blindness; line
# styles say the same once more in grey.
TARGET_COLOUR = "#0072B2"
ON_THE_WAY_COLOURS = ("#E69F00", "#009E73", "#CC79A7", "#56B4E9")
RIVAL_COLOURS = ("#D55E00", "#000000", "#999999")
DASHED: Any = (0, (4, 1.5))
Y_LABELS = {
    "steps_taken": "steps taken per episode",
    "success": "success rate",
    "return": "return per agent",
    "communication": "share of talking agents",
}
AXES = ("env_steps", "seconds")
INK, FAINT = "#333333", "#777777"


@dataclass(frozen=True)
class Curve:
    """One arm, ready to draw: E epochs, seeds summed up."""

    x: np.ndarray  # (E,) environment steps or seconds, shifted by the source's cost
    middle: np.ndarray  # (E,) median over seeds, mean for one or two
    low: np.ndarray  # (E,) lower quartile, least for one or two
    high: np.ndarray  # (E,) upper quartile, greatest for one or two
    num_seeds: int
    shift: float = 0.0  # how much of x is the source's


def learning_curves(
    metrics: str | Path | Iterable[Mapping[str, Any]],
    output: str | Path | None = None,
    *,
    x: str | Sequence[str] = AXES,
    y: str = "steps_taken",
    bounds: Mapping[str, float] | None = None,
    labels: Mapping[str, str] | None = None,
    title: str | None = None,
    after: Mapping[str, Sequence[str]] | None = None,
    log_y: bool | None = None,
) -> Figure:
    """Learning curves of the arms in `metrics`, one panel for each quantity in `x`.

    An arm starts where those ended that it comes after, so that at any x all arms have cost the
    same in all (the form of the paper's Figure 2). Over three seeds and more a line is the median
    and its band the quartiles; below that the mean, least and greatest.

    Args:
      metrics: path of a metrics.csv, or its rows.
      output: where to write a PNG, 1800 pixels wide for two panels, meant to be read at half that.
      x: `env_steps`, `seconds` or both.
      y: any numeric column of metrics.csv.
      bounds: reference levels, drawn as thin lines: name to value.
      labels: other names for the arms.
      after: for each arm the arms it comes after, the first one first; the arm that comes after
        most is the target, drawn in blue, and those before it are dashed.
      log_y: None draws steps taken on a logarithmic axis where they spread over a factor of four.

    Raises:
      ValueError: for an unknown x, or when there is nothing to draw.
    """
    rows = _rows(metrics)
    panels = (x,) if isinstance(x, str) else tuple(x)
    for name in panels:
        if name not in AXES:
            raise ValueError(f"x must be one of {', '.join(AXES)}, got {name!r}.")
    after = after or {}
    columns = [arm_curves(rows, name, y, after) for name in panels]
    if not columns[0]:
        raise ValueError(f"there is no {y} of any arm to draw.")
    styles = _styles(list(columns[0]), after, labels or {})
    figure = _draw(panels, columns, y, bounds or {}, styles, log_y)
    _draw_legend(figure, columns[0], title)
    if output is not None:
        write_png(figure, output)
    return figure


def arm_curves(
    rows: Sequence[Mapping[str, Any]], x: str, y: str, after: Mapping[str, Sequence[str]]
) -> dict[str, Curve]:
    """The curve of every arm that has one, shifted by the cost of the arms it comes `after`."""
    curves = {}
    for arm in dict.fromkeys(row["arm"] for row in rows):
        _, values = seed_curves(rows, arm, x, y)
        seen = np.isfinite(values[y]).any(axis=0)  # epochs in which no episode ended are left out
        if not seen.any():
            continue
        middle, low, high = spread(values[y][:, seen])
        shift = sum(_cost(rows, x, before) for before in after.get(arm, ()))
        position = shift + _over_seeds(np.nanmean, values[x][:, seen])
        curves[arm] = Curve(position, middle, low, high, len(values[y]), shift)
    return curves


@dataclass(frozen=True)
class _Style:
    """How an arm is drawn."""

    label: str
    colour: str
    style: Any


def _styles(
    arms: Sequence[str], after: Mapping[str, Sequence[str]], labels: Mapping[str, str]
) -> dict[str, _Style]:
    target = max(arms, key=lambda arm: len(after.get(arm, ())))
    before = [arm for arm in arms if arm in after.get(target, ())]
    rivals = [arm for arm in arms if arm not in (target, *before)]
    colours = {target: TARGET_COLOUR}
    for group, palette in ((before, ON_THE_WAY_COLOURS), (rivals, RIVAL_COLOURS)):
        colours |= {arm: palette[place % len(palette)] for place, arm in enumerate(group)}
    return {
        arm: _Style(labels.get(arm, arm), colours[arm], DASHED if arm in before else "-")
        for arm in arms
    }


def spread(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(S, E) values, each epoch with at least one number -> middle, low and high, (E,) each."""
    if len(values) < 3:
        return (
            _over_seeds(np.nanmean, values),
            _over_seeds(np.nanmin, values),
            _over_seeds(np.nanmax, values),
        )
    low, middle, high = np.nanpercentile(values, [25, 50, 75], axis=0)
    return middle, low, high


def write_png(figure: Figure, path: str | Path) -> None:
    """Writes a figure as PNG at its own resolution, in one rename."""
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=figure.dpi, facecolor="white")
    write_bytes(path, image.getvalue())


def _rows(metrics: str | Path | Iterable[Mapping[str, Any]]) -> list[Any]:
    return read_metrics(metrics) if isinstance(metrics, (str, Path)) else list(metrics)


def _over_seeds(function: Any, values: np.ndarray) -> np.ndarray:
    return np.asarray(function(values, axis=0))


def _cost(rows: Sequence[Mapping[str, Any]], x: str, arm: str) -> float:
    """What an arm cost by its end, mean over seeds; 0 where its rows are elsewhere."""
    _, values = seed_curves(rows, arm, x)
    return float(np.nanmax(values[x], axis=1).mean()) if values[x].size else 0.0


def _draw(
    panels: Sequence[str],
    columns: Sequence[Mapping[str, Curve]],
    y: str,
    bounds: Mapping[str, float],
    styles: Mapping[str, _Style],
    log_y: bool | None,
) -> Figure:
    figure = Figure(figsize=(9.0 if len(panels) > 1 else 6.0, 3.9), dpi=200, layout="constrained")
    FigureCanvasAgg(figure)
    all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, name, curves in zip(all_axes, panels, columns, strict=True):
        _draw_panel(axes, curves, name, styles)
    all_axes[0].set_ylabel(Y_LABELS.get(y, y.replace("_", " ")), color=INK)
    _scale_y(all_axes[0], columns[0], y, bounds, log_y)
    for axes in all_axes:
        _draw_bounds(axes, bounds, named=axes is all_axes[-1])
    return figure


def _draw_panel(
    axes: Axes, curves: Mapping[str, Curve], x: str, styles: Mapping[str, _Style]
) -> None:
    unit, label = _unit(x, max(curve.x.max() for curve in curves.values()))
    for arm, curve in curves.items():
        if curve.num_seeds > 1:
            axes.fill_between(
                curve.x / unit,
                curve.low,
                curve.high,
                color=styles[arm].colour,
                alpha=0.2,
                linewidth=0,
            )
        axes.plot(
            curve.x / unit,
            curve.middle,
            color=styles[arm].colour,
            linestyle=styles[arm].style,
            linewidth=1.6,
            marker="o" if len(curve.x) == 1 else None,
            markersize=4,
            label=styles[arm].label,
        )
    dress(axes, label)


def dress(axes: Axes, label: str) -> None:
    """The look of every panel with curves: `label` under an axis from 0, a faint grid, no box."""
    axes.set_xlabel(label, color=INK)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    axes.grid(True, color="#E6E6E6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(colors=INK, labelsize=9)


def _unit(x: str, largest: float) -> tuple[float, str]:
    """What to divide by, and the axis label, so that ticks are short numbers."""
    if x == "env_steps":
        for unit, word in ((1e6, "millions"), (1e3, "thousands")):
            if largest >= unit:
                return unit, f"environment steps ({word})"
        return 1.0, "environment steps"
    for unit, word in ((7200.0, "hours"), (120.0, "minutes")):
        if largest >= unit:
            return (3600.0 if word == "hours" else 60.0), f"training time ({word})"
    return 1.0, "training time (seconds)"


def _scale_y(
    axes: Axes,
    curves: Mapping[str, Curve],
    y: str,
    bounds: Mapping[str, float],
    log_y: bool | None,
) -> None:
    levels = np.concatenate([*(curve.middle for curve in curves.values()), [*bounds.values()]])
    if log_y is None:
        log_y = y == "steps_taken" and levels.min() > 0 and levels.max() >= 4 * levels.min()
    if log_y:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_minor_formatter(NullFormatter())
    elif y == "success":
        axes.set_ylim(-0.02, 1.02)


def _draw_bounds(axes: Axes, bounds: Mapping[str, float], named: bool) -> None:
    for value in bounds.values():
        axes.axhline(value, color=FAINT, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=1)
    if not (named and bounds):
        return
    # Names stand to the right of the panel, where no curve can run through them.
    low, high = axes.get_ylim()
    scale = axes.transAxes.inverted()
    wanted = {
        name: float(scale.transform(axes.transData.transform((0, value)))[1])
        for name, value in bounds.items()
    }
    texts = {
        name: "\n".join(textwrap.wrap(f"{name} {value:.4g}", 18)) for name, value in bounds.items()
    }
    for name, height in apart(wanted, {k: 0.055 * (t.count("\n") + 1) for k, t in texts.items()}):
        axes.annotate(
            texts[name],
            (1.0, wanted[name]),
            xytext=(1.03, height),
            xycoords="axes fraction",
            fontsize=8,
            color=INK,
            va="center",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": FAINT, "linewidth": 0.6, "shrinkA": 1},
        )
    axes.set_ylim(low, high)


def apart(wanted: Mapping[str, float], size: Mapping[str, float]) -> list[tuple[str, float]]:
    """Heights near the `wanted` ones at which labels of the given sizes do not overlap."""
    placed: list[tuple[str, float]] = []
    for name in sorted(wanted, key=lambda name: wanted[name]):
        height = wanted[name]
        if placed:
            below, under = placed[-1]
            height = max(height, under + (size[below] + size[name]) / 2)
        placed.append((name, height))
    return placed


def _draw_legend(figure: Figure, curves: Mapping[str, Curve], title: str | None) -> None:
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(
        handles,
        names,
        loc="outside upper left",
        ncols=len(names),
        frameon=False,
        fontsize=9,
        labelcolor=INK,
        title=title,
        title_fontproperties={"size": 11, "weight": "bold"},
        alignment="left",
    )
    figure.supxlabel(_note(curves), x=0.995, ha="right", fontsize=8, color=FAINT)


def _note(curves: Mapping[str, Curve]) -> str:
    """What line and band stand for."""
    seeds = max(curve.num_seeds for curve in curves.values())
    few = {1: "one seed", 2: "mean of two seeds, band: both"}
    note = few.get(seeds, f"median of {seeds} seeds, band: quartiles")
    if any(curve.shift > 0 for curve in curves.values()):
        return f"{note}; a stage starts at the cost of those before it"
    return note
