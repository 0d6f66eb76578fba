"""What is drawn of a moment of an episode, as matplotlib artists; lengths are in cells."""

from collections.abc import Iterator
from functools import singledispatch
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import (
    Circle,
    FancyArrowPatch,
    FancyBboxPatch,
    Patch,
    Polygon,
    Rectangle,
)
from matplotlib.text import Text

from sumajax.environments.grid import DOWN, LEFT, RIGHT, UP, window_offsets
from sumajax.reporting.replay.recording import CAPTURER, PREDATOR, Episode
from sumajax.reporting.replay.traffic_episode import TrafficEpisode

# Okabe and Ito's palette; classes differ by shape as well.
AGENT_COLOURS = ("#0072B2", "#D55E00")
PREY_COLOUR, TALK_COLOUR, DONE_COLOUR = "#F0E442", "#B0468A", "#009E73"
INK, FAINT = "#333333", "#BBBBBB"

RING = 1.18
"""Radius of the ring around an agent that talks, in radii of the agent."""
MIN_WEIGHT = 1e-3
"""Attention below this is not drawn: nothing worth seeing was said."""
STEPS = {UP: (-1, 0), RIGHT: (0, 1), DOWN: (1, 0), LEFT: (0, -1)}


@singledispatch
def frame_artists(episode: Any, moment: int, cell_points: float) -> list[Artist]:
    """What a frame shows beside the grid, in the order it is drawn.

    Args:
      episode: of a kind that is registered here: another domain's marks are their own file.
      cell_points: side of a cell in points, for the size of the numbers.
    """
    raise TypeError(f"no marks for an episode of type {type(episode).__name__}.")


@frame_artists.register
def _(episode: Episode, moment: int, cell_points: float) -> list[Artist]:
    places, radius = spots(episode.agents[moment])
    # Whoever stands on the prey stands in front of it: its tips still show.
    occupied = (episode.agents[moment] == episode.prey[moment]).all(-1).any()
    artists = [
        *_sight(episode, moment),
        *_prey(episode.prey[moment], 0.5 if occupied else 0.32),
        _title(episode, moment),
    ]
    if moment < episode.num_steps:
        artists += [
            *message_arrows(episode, moment, places, radius),
            *_moves(episode, moment, places, radius),
        ]
        artists += gates(episode.communication[moment], places, radius)
    for agent in range(episode.num_agents):
        artists += _agent(episode, moment, agent, places[agent], float(radius[agent]), cell_points)
    return sorted(artists, key=Artist.get_zorder)


def caption(episode: Episode, moment: int) -> str:
    """The step of a frame and how the team stands."""
    step = f"step {moment}/{episode.num_steps}"
    if moment == episode.num_steps:
        return f"{step}: {'done' if episode.success else 'not done'}"
    there = int((episode.agents[moment] == episode.prey[moment]).all(-1).sum())
    return f"{step}: {there}/{episode.num_agents} on prey"


def spots(agents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where to draw agents so that those in one cell stand apart.

    Args:
      agents: (N, 2) cells.

    Returns:
      (N, 2) centres as (x, y) in cells, and (N,) radii.
    """
    centres = agents[:, ::-1].astype(float)
    radii = np.full(len(agents), 0.3)
    _, of_cell = np.unique(agents, axis=0, return_inverse=True)
    for index in np.unique(of_cell):
        here = np.flatnonzero(of_cell.ravel() == index)
        if len(here) == 1:
            continue
        # A ring of circles that touch neither each other nor the border of the cell.
        sine = np.sin(np.pi / len(here))
        radius = 0.46 * sine / (1 + sine)
        angle = -3 * np.pi / 4 + 2 * np.pi * np.arange(len(here)) / len(here)
        centres[here] += (0.46 - radius) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        radii[here] = 0.85 * radius  # room for the rings of those who talk
    return centres, radii


def messages(episode: Episode | TrafficEpisode, moment: int) -> list[tuple[int, int, float]]:
    """(sender, receiver, weight) of every message of a step; nobody sends to itself."""
    weights = np.asarray(episode.attention[moment])
    return [
        (int(sender), int(receiver), float(weights[receiver, sender]))
        for receiver, sender in np.argwhere(weights > MIN_WEIGHT)
        if sender != receiver
    ]


def _title(episode: Episode, moment: int) -> Artist:
    rows, columns = episode.size
    done = moment == episode.num_steps and episode.success
    return Text(
        (columns - 1) / 2,
        -0.5 - 0.012 * rows,
        caption(episode, moment),
        color=DONE_COLOUR if done else INK,
        fontweight="bold" if done else "normal",
        fontsize=9,
        ha="center",
        va="bottom",
        clip_on=False,
        zorder=9,
    )


def _sight(episode: Episode, moment: int) -> Iterator[Artist]:
    """A shade over all cells that somebody of a class sees, darker where several do."""
    for kind, colour in enumerate(AGENT_COLOURS):
        cells, seers = np.unique(seen_cells(episode, moment, kind), axis=0, return_counts=True)
        if len(cells):
            centre = cells[:, None, ::-1]
            corners = centre + np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
            alphas = np.where(seers > 1, 0.2, 0.11)
            colours = [to_rgba(colour, alpha) for alpha in alphas]
            yield PolyCollection(
                corners, facecolors=colours, linewidths=0, antialiased=False, zorder=0.5
            )


def seen_cells(episode: Episode, moment: int, kind: int) -> np.ndarray:
    """(M, 2) cells inside the grid that agents of a class see, one for each agent that does."""
    cells = [
        grid_cell + window_offsets(sight).reshape(-1, 2)
        for agent, grid_cell in enumerate(episode.agents[moment])
        if episode.agent_class[agent] == kind and (sight := episode.sight(agent)) is not None
    ]
    seen = np.concatenate([np.zeros((0, 2), int), *cells])
    return seen[((seen >= 0) & (seen < episode.size)).all(-1)]


def _prey(prey: np.ndarray, radius: float) -> Iterator[Artist]:
    row, column = prey
    yield Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor="#F8F3B0", linewidth=0, zorder=1)
    tips = np.arange(10) * np.pi / 5 - np.pi / 2
    reach = np.where(np.arange(10) % 2 == 0, radius, 0.45 * radius)
    corners = np.stack([column + reach * np.cos(tips), row + reach * np.sin(tips)], axis=-1)
    yield Polygon(corners, facecolor=PREY_COLOUR, edgecolor=INK, linewidth=0.8, zorder=3)


def message_arrows(
    episode: Episode | TrafficEpisode, moment: int, places: np.ndarray, radius: np.ndarray
) -> Iterator[Artist]:
    """Arrows from senders to receivers, as strong as the attention."""
    strongest = max(float(np.max(episode.attention, initial=0)), MIN_WEIGHT)
    weights = {(sender, receiver): w for sender, receiver, w in messages(episode, moment)}
    faint = min(1.0, (12 / max(len(weights), 1)) ** 0.5)  # a crowd of arrows must not hide the team
    for (sender, receiver), weight in weights.items():
        same = weights.get((receiver, sender)) == weight
        if same and sender > receiver:
            continue  # the arrow of the other way round has two heads
        start, end = _between(places, radius, sender, receiver)
        share = faint * min(weight / strongest, 1)
        arrow = FancyArrowPatch(
            tuple(start),
            tuple(end),
            # Unequal answers get a bent line each, equal ones share a straight line.
            connectionstyle="arc3,rad=0" if same else "arc3,rad=0.15",
            arrowstyle="<|-|>" if same else "-|>",
            mutation_scale=5 + 3 * faint,
            shrinkA=0,
            shrinkB=0,
            color=TALK_COLOUR,
            alpha=0.15 + 0.65 * share,
            linewidth=0.5 + 0.9 * share,
            zorder=4,
        )
        arrow.set_gid(f"message {sender} {receiver}")
        yield arrow


def gates(shares: np.ndarray, places: np.ndarray, radius: np.ndarray) -> Iterator[Artist]:
    """A ring around every agent that talks; the fainter, the less of its means it uses."""
    for agent, share in enumerate(shares):
        if share > MIN_WEIGHT:
            ring = Circle(
                (places[agent, 0], places[agent, 1]),
                RING * float(radius[agent]),
                fill=False,
                edgecolor=TALK_COLOUR,
                alpha=0.3 + 0.7 * min(float(share), 1.0),
                linewidth=1.4,
                zorder=5,
            )
            ring.set_gid(f"gate {agent}")
            yield ring


def _moves(
    episode: Episode, moment: int, places: np.ndarray, radius: np.ndarray
) -> Iterator[Artist]:
    """A small nose on the side every agent is about to move to."""
    for agent, action in enumerate(episode.actions[moment]):
        if int(action) not in STEPS or episode.reached[moment, agent]:
            continue
        down, right = STEPS[int(action)]
        ahead = radius[agent] * np.array([right, down])
        across = 0.4 * radius[agent] * np.array([down, right])
        foot = places[agent] + 1.25 * ahead
        corners = np.stack([places[agent] + 1.65 * ahead, foot + across, foot - across])
        colour = AGENT_COLOURS[episode.agent_class[agent]]
        yield Polygon(corners, facecolor=colour, linewidth=0, zorder=6)


def _between(
    places: np.ndarray, radius: np.ndarray, sender: int, receiver: int
) -> tuple[np.ndarray, np.ndarray]:
    """Ends of an arrow, outside both agents' rings."""
    way = places[receiver] - places[sender]
    length = max(float(np.hypot(*way)), 1e-6)
    gaps = np.minimum(1.25 * np.array([radius[sender], radius[receiver]]), 0.45 * length)
    return places[sender] + way * gaps[0] / length, places[receiver] - way * gaps[1] / length


def _agent(
    episode: Episode, moment: int, agent: int, place: np.ndarray, radius: float, cell_points: float
) -> Iterator[Artist]:
    """An agent with its number, as far as that is legible, and what it has captured."""
    x, y = float(place[0]), float(place[1])
    kind = int(episode.agent_class[agent])
    style: dict[str, Any] = {"facecolor": AGENT_COLOURS[kind], "edgecolor": "white"}
    if kind == PREDATOR:
        yield Circle((x, y), radius, linewidth=0.8, zorder=6, **style)
    else:
        half = 0.8 * radius
        box = f"round,pad=0,rounding_size={0.3 * half}"
        corner = (x - half, y - half)
        yield FancyBboxPatch(corner, 2 * half, 2 * half, box, linewidth=0.8, zorder=6, **style)
    points = radius * cell_points
    if points >= 3.5:
        yield Text(
            x,
            y,
            str(agent),
            color="white",
            fontsize=min((1.3 if agent < 10 else 1.0) * points, 12),
            fontweight="bold",
            ha="center",
            va="center_baseline",
            zorder=7,
        )
    if kind == CAPTURER and episode.captured[moment, agent]:
        yield from _badge(agent, x + 0.8 * radius, y - 0.8 * radius, 0.55 * radius)


def _badge(agent: int, x: float, y: float, size: float) -> Iterator[Artist]:
    """A tick for an agent that has captured the prey."""
    disc = Circle((x, y), size, facecolor=DONE_COLOUR, edgecolor="white", linewidth=0.6, zorder=8)
    disc.set_gid(f"captured {agent}")
    yield disc
    tick = np.array([(-0.5, 0.0), (-0.12, 0.4), (0.5, -0.4)]) * size
    yield Line2D(x + tick[:, 0], y + tick[:, 1], color="white", linewidth=1.0, zorder=9)


@singledispatch
def legend_marks(episode: Any) -> list[Artist]:
    """What the marks mean, as far as they occur."""
    raise TypeError(f"no marks for an episode of type {type(episode).__name__}.")


@legend_marks.register
def _(episode: Episode) -> list[Artist]:

    def mark(marker: str, label: str, **style: Any) -> Line2D:
        return Line2D([], [], linestyle="", marker=marker, markersize=8, label=label, **style)

    handles: list[Artist] = [mark("o", "predator", color=AGENT_COLOURS[PREDATOR])]
    if (episode.agent_class == CAPTURER).any():
        handles.append(mark("s", "capture agent", color=AGENT_COLOURS[CAPTURER]))
        handles.append(mark("$✓$", "captured", color=DONE_COLOUR))
    handles.append(
        mark("*", "prey", markerfacecolor=PREY_COLOUR, markeredgecolor=INK, markeredgewidth=0.8)
    )
    handles.append(Patch(facecolor=AGENT_COLOURS[PREDATOR], alpha=0.15, label="in sight"))
    handles.append(
        mark("o", "talks", markerfacecolor="none", markeredgecolor=TALK_COLOUR, markeredgewidth=1.4)
    )
    handles.append(Line2D([], [], color=TALK_COLOUR, label="message heard"))
    handles.append(mark(">", "next move", color=AGENT_COLOURS[PREDATOR]))
    return handles
