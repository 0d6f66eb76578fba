"""Draws the figures of docs/: `python docs/figures.py` writes them beside this file.

Each is drawn twice, for light and for dark pages, from what the package computes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle

from sumajax import PredatorPrey, StateUpsampled

SMALL, LARGE = 5, 10
VISION = 1
FOLLOWED = 0
"""The agent whose state is shown."""
SOURCE = {"agents": [(3, 1), (0, 3), (4, 4)], "prey": (1, 1)}
TARGET = {"agents": [(6, 3), (1, 8), (8, 8), (3, 5), (9, 1)], "prey": (2, 2)}
WIDTH, HEIGHT, DPI = 6.2, 4.05, 170
"""Inches: small, so that the words are still read on a telephone."""
BOX = (0.79, 0.2, 0.2, 0.58)
"""Of the policy: left, bottom, width, height, as shares of the figure."""
ROWS = {"source": 0.545, "target": 0.02}
"""Bottoms of the two rows of grids."""
COLUMNS = (0.005, 0.27, 0.53)
SIDE = 0.235
"""Width of a grid."""


@dataclass(frozen=True)
class Colours:
    """Of a kind of page."""

    name: str
    ink: str
    line: str
    agent: str
    prey: str
    lit: str
    sight: str


LIGHT = Colours("light", "#222222", "#c4c4c4", "#00695c", "#d84315", "#00897b", "#b2dfdb")
DARK = Colours("dark", "#e6e6e6", "#5a5d66", "#4db6ac", "#ff8a65", "#4db6ac", "#24504c")


def upsampling(colours: Colours) -> Figure:
    """What upsampling does, after the paper's Figure 1: one policy reads states of one size from a
    small task and from a large one."""
    small = PredatorPrey(size=SMALL, num_predators=len(SOURCE["agents"]), vision=VISION)
    large = PredatorPrey(size=LARGE, num_predators=len(TARGET["agents"]), vision=VISION)
    here, there = small.state_at(**SOURCE), large.state_at(**TARGET)
    seen_large = StateUpsampled(small, size=LARGE)
    figure = plt.figure(figsize=(WIDTH, HEIGHT), dpi=DPI)
    grids = {
        ("source", 0): _own_state(small.observe(here)),
        ("source", 1): _own_state(small.observe(here)),
        ("source", 2): _own_state(seen_large.observe(here)),
        ("target", 0): _own_state(large.observe(there)),
        ("target", 2): _own_state(large.observe(there)),
    }
    axes = {place: _axes(figure, *place) for place in grids}
    for (row, column), grid in grids.items():
        title = {
            ("source", 0): f"source, {SMALL}x{SMALL}",
            ("source", 1): "own state $s$",
            ("source", 2): r"upsampled $\phi(s)$",
            ("target", 0): f"target, {LARGE}x{LARGE}",
            ("target", 2): "own state $s$",
        }[row, column]
        axes[row, column].set_title(title, color=colours.ink, fontsize=12.5, pad=5)
        if column:
            _state(axes[row, column], grid, colours)
    _task(axes["source", 0], SOURCE["agents"], SOURCE["prey"], SMALL, colours)
    _task(axes["target", 0], TARGET["agents"], TARGET["prey"], LARGE, colours)
    _box(figure, colours)
    left, right = (lambda c: COLUMNS[c] - 0.004), (lambda c: COLUMNS[c] + SIDE + 0.004)
    for row, ways in {"source": [(0, 1), (1, 2)], "target": [(0, 2)]}.items():
        middle = ROWS[row] + _tall(SIDE) / 2
        for start, end in ways:
            _arrow(figure, (right(start), middle), (left(end), middle), colours)
        _arrow(figure, (right(2), middle), (BOX[0], middle), colours)
    return figure


def _own_state(observation: Any) -> np.ndarray:
    """(rows, columns): the state tensor of the agent that is followed."""
    return np.asarray(observation.state[FOLLOWED, 0])


def _tall(width: float) -> float:
    """The height of a square of so much of the figure's width."""
    return width * WIDTH / HEIGHT


def _axes(figure: Figure, row: str, column: int) -> Axes:
    return figure.add_axes((COLUMNS[column], ROWS[row], SIDE, _tall(SIDE)))


def _frame(axes: Axes, size: int, colours: Colours) -> None:
    """A grid of cells, row 0 at the top."""
    axes.set(xlim=(0, size), ylim=(size, 0), aspect="equal", xticks=[], yticks=[])
    axes.patch.set_alpha(0.0)
    for line in range(size + 1):
        axes.axhline(line, color=colours.line, linewidth=0.7, zorder=2.5)
        axes.axvline(line, color=colours.line, linewidth=0.7, zorder=2.5)
    for spine in axes.spines.values():
        spine.set_color(colours.line)


def _state(axes: Axes, grid: np.ndarray, colours: Colours) -> None:
    size = grid.shape[0]
    _frame(axes, size, colours)
    lit = np.ma.masked_equal(grid, 0)
    axes.imshow(lit, cmap=ListedColormap([colours.lit]), extent=(0, size, size, 0), zorder=2)


def _task(
    axes: Axes,
    agents: Sequence[tuple[int, int]],
    prey: tuple[int, int],
    size: int,
    colours: Colours,
) -> None:
    _frame(axes, size, colours)
    side = 2 * VISION + 1
    for row, column in agents:
        corner = (column - VISION, row - VISION)
        axes.add_patch(Rectangle(corner, side, side, color=colours.sight, alpha=0.7, zorder=0))
    area = (95 / size) ** 2
    for place, (row, column) in enumerate(agents):
        edge = colours.ink if place == FOLLOWED else "none"
        axes.scatter(column + 0.5, row + 0.5, area * 0.42, colours.agent, edgecolors=edge, zorder=3)
    axes.scatter(prey[1] + 0.5, prey[0] + 0.5, area * 0.5, colours.prey, marker="*", zorder=3)


def _box(figure: Figure, colours: Colours) -> None:
    left, bottom, width, height = BOX
    figure.add_artist(
        FancyBboxPatch(
            (left, bottom),
            width,
            height,
            boxstyle="round,pad=0,rounding_size=0.015",
            facecolor="none",
            edgecolor=colours.ink,
            linewidth=1.2,
        )
    )
    words = {
        0.80: ("pre-train", 12, "normal"),
        0.56: (f"one policy,\nreads {LARGE}x{LARGE}", 11.5, "bold"),
        0.17: ("train on", 12, "normal"),
    }
    middle = left + width / 2
    for height_share, (text, size, weight) in words.items():
        y = bottom + height * height_share
        figure.text(middle, y, text, size=size, weight=weight, color=colours.ink, ha="center")
    start, end = bottom + height * 0.49, bottom + height * 0.28
    _arrow(figure, (middle, start), (middle, end), colours)


def _arrow(
    figure: Figure, start: tuple[float, float], end: tuple[float, float], colours: Colours
) -> None:
    figure.add_artist(
        FancyArrowPatch(
            start,
            end,
            transform=figure.transFigure,
            arrowstyle="-|>",
            mutation_scale=11,
            shrinkA=0,
            shrinkB=0,
            color=colours.ink,
            linewidth=1.2,
        )
    )


def main(directory: Path = Path(__file__).parent) -> list[Path]:
    """Writes every figure; returns their files."""
    files = []
    for colours in (LIGHT, DARK):
        figure = upsampling(colours)
        files.append(directory / f"upsampling-{colours.name}.png")
        figure.savefig(files[-1], transparent=True)
        plt.close(figure)
    return files


if __name__ == "__main__":
    main()
