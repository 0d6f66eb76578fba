"""What is drawn of a moment of Traffic Junction, as matplotlib artists; lengths are in cells."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch, Polygon
from matplotlib.path import Path
from matplotlib.text import Text
from matplotlib.transforms import Affine2D

from sumajax.reporting.replay.marks import (
    DONE_COLOUR,
    INK,
    TALK_COLOUR,
    frame_artists,
    gates,
    legend_marks,
    message_arrows,
    spots,
)
from sumajax.reporting.replay.traffic_episode import TrafficEpisode

# Okabe and Ito's palette without yellow and the colours that mean something here.
CAR_COLOURS = ("#0072B2", "#009E73", "#56B4E9", "#8C6D31", "#5C5C8A")
ROAD, CRASH, BRAKE_LIGHT = "#D2D6DB", "#D7261E", "#D55E00"
LEGIBLE = 3.0
"""Points from the middle of a car to its edge below which its number is left out."""


@frame_artists.register
def traffic_artists(episode: TrafficEpisode, moment: int, cell_points: float) -> list[Artist]:
    """Roads, cars with the way they have ahead, who brakes, who talks, and collisions."""
    places, radius = car_spots(episode, moment)
    artists: list[Artist] = [_road(episode), _title(episode, moment)]
    for slot in episode.cars(moment):
        place, size = places[slot], float(radius[slot])
        artists += _way_ahead(episode, moment, slot, place)
        artists += _car(episode, moment, slot, place, size, cell_points)
        if episode.collided[moment, slot]:
            artists.append(_crash(episode.cell(moment, slot), slot))
    if moment < episode.num_steps:
        artists += message_arrows(episode, moment, places, radius)
        artists += gates(episode.communication[moment], places, radius)
    return sorted(artists, key=Artist.get_zorder)


@legend_marks.register
def traffic_legend(episode: TrafficEpisode) -> list[Artist]:
    """What the marks mean."""
    colour = CAR_COLOURS[0]

    def mark(marker: str, label: str, **style: Any) -> Line2D:
        return Line2D([], [], linestyle="", marker=marker, markersize=8, label=label, **style)

    return [
        Patch(facecolor=ROAD, label="road"),
        mark("s", "car", color=colour),
        Line2D([], [], color=colour, alpha=0.6, label="its way ahead"),
        mark("|", "brakes", color=BRAKE_LIGHT, markeredgewidth=2.5),
        mark("*", "collision", color=CRASH),
        mark(
            "o", "talks", markerfacecolor="none", markeredgecolor=TALK_COLOUR, markeredgewidth=1.4
        ),
        Line2D([], [], color=TALK_COLOUR, label="message heard"),
    ]


def traffic_caption(episode: TrafficEpisode, moment: int) -> str:
    """The step of a frame, how many cars there are, and what has gone wrong."""
    step = f"step {moment}/{episode.num_steps}"
    if moment == episode.num_steps:
        return f"{step}: {'no collision' if episode.success else 'collisions'}"
    cars, collided = len(episode.cars(moment)), int(episode.collided[moment].sum())
    said = f"{step}: {cars} car{'s' * (cars != 1)}"
    return f"{said}, {collided} collide" if collided else said


def car_spots(episode: TrafficEpisode, moment: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) centres as (x, y) in cells and (N,) sizes of cars; those in one cell stand apart."""
    centres, sizes = np.zeros((episode.num_agents, 2)), np.zeros(episode.num_agents)
    cars = episode.cars(moment)
    if cars:
        cells = np.stack([episode.cell(moment, slot) for slot in cars])
        centres[cars], sizes[cars] = spots(cells)
    return centres, sizes


def _road(episode: TrafficEpisode) -> Artist:
    centre = np.argwhere(episode.roads.road)[:, None, ::-1]
    corners = centre + np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
    return PolyCollection(
        corners, facecolors=ROAD, linewidths=0, antialiased=False, zorder=0.3, gid="road"
    )


def _title(episode: TrafficEpisode, moment: int) -> Artist:
    rows, columns = episode.size
    over = moment == episode.num_steps
    return Text(
        (columns - 1) / 2,
        -0.5 - 0.012 * rows,
        traffic_caption(episode, moment),
        color=INK if not over else DONE_COLOUR if episode.success else CRASH,
        fontweight="bold" if over else "normal",
        fontsize=9,
        ha="center",
        va="bottom",
        clip_on=False,
        zorder=9,
    )


def _colour(slot: int) -> str:
    return CAR_COLOURS[slot % len(CAR_COLOURS)]


def _way_ahead(
    episode: TrafficEpisode, moment: int, slot: int, place: np.ndarray
) -> Iterator[Artist]:
    """A line along the cells to come, each car's a little beside the others', with a tip."""
    ahead = episode.way(moment, slot)[1:, ::-1].astype(float)
    if not len(ahead):
        return
    beside = 0.36 * ((slot * 0.618) % 1 - 0.5)
    line = np.concatenate([[place], ahead + beside])
    style: dict[str, Any] = {"color": _colour(slot), "alpha": 0.6}
    yield PathPatch(Path(line), fill=False, linewidth=1.1, zorder=2, gid=f"way {slot}", **style)
    forward = ahead[-1] - (ahead[-2] if len(ahead) > 1 else episode.cell(moment, slot)[::-1])
    across = 0.16 * forward[::-1]
    tip = [line[-1] + 0.35 * forward, line[-1] + across, line[-1] - across]
    yield Polygon(np.stack(tip), linewidth=0, zorder=2, **style)


def _car(
    episode: TrafficEpisode,
    moment: int,
    slot: int,
    place: np.ndarray,
    radius: float,
    cell_points: float,
) -> Iterator[Artist]:
    """A car, pointing where it goes, with its slot's number and its brake lights."""
    (x, y), (down, right) = place, episode.heading(moment, slot)
    turned = Affine2D().rotate(float(np.arctan2(down, right))).translate(x, y)
    half, side = 1.35 * radius, 0.9 * radius
    corners = Path(
        [
            *[(-half, -side), (half - 0.6 * side, -side), (half, 0)],
            *[(half - 0.6 * side, side), (-half, side), (-half, -side)],
        ]
    )
    yield PathPatch(
        turned.transform_path(corners),
        facecolor=_colour(slot),
        edgecolor="white",
        linewidth=0.6,
        zorder=6,
        gid=f"car {slot}",
    )
    if moment < episode.num_steps and episode.actions[moment, slot]:
        back = Path([(-1.1 * half, -side), (-1.1 * half, side)])
        lights = turned.transform_path(back)
        yield PathPatch(
            lights, edgecolor=BRAKE_LIGHT, linewidth=2, zorder=6.5, gid=f"brakes {slot}"
        )
    points = radius * cell_points
    if points >= LEGIBLE:
        yield Text(
            x,
            y,
            str(slot),
            color="white",
            fontsize=min((1.2 if slot < 10 else 0.95) * points, 12),
            fontweight="bold",
            ha="center",
            va="center_baseline",
            zorder=7,
        )


def _crash(cell: np.ndarray, slot: int) -> Artist:
    """A burst behind the cars of a cell."""
    row, column = cell
    tips = np.arange(24) * np.pi / 12
    reach = np.where(np.arange(24) % 2 == 0, 0.8, 0.52)
    corners = np.stack([column + reach * np.cos(tips), row + reach * np.sin(tips)], axis=-1)
    return Polygon(
        corners, facecolor="#F7C6C3", edgecolor=CRASH, linewidth=0.9, zorder=3, gid=f"crash {slot}"
    )
