"""Replays: one episode as a GIF or a strip of frames, with who sees what and who talks to whom."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
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
from PIL import Image

from sumajax.environments.grid import DOWN, LEFT, RIGHT, UP, window_offsets
from sumajax.environments.types import Environment
from sumajax.policies.types import Policy
from sumajax.reporting.metrics import write_bytes

PREDATOR, CAPTURER = 0, 1

# Okabe and Ito's palette; classes differ by shape as well.
AGENT_COLOURS = ("#0072B2", "#D55E00")
PREY_COLOUR, TALK_COLOUR, DONE_COLOUR = "#F0E442", "#B0468A", "#009E73"
INK, FAINT = "#333333", "#BBBBBB"

STRIP_INCHES = 9.0
DPI = 100
RING = 1.18
"""Radius of the ring around an agent that talks, in radii of the agent."""
MIN_WEIGHT = 1e-3
"""Attention below this is not drawn: nothing worth seeing was said."""
STEPS = {UP: (-1, 0), RIGHT: (0, 1), DOWN: (1, 0), LEFT: (0, -1)}


@dataclass(frozen=True)
class Episode:
    """Everything a replay shows of T steps of N agents, as numpy arrays.

    Frame t of T + 1 is the team before step t with what it says and does in that step; the last
    frame is the outcome.
    """

    agents: np.ndarray  # (T+1, N, 2) int cells (row, column)
    prey: np.ndarray  # (2,) int cell
    reached: np.ndarray  # (T+1, N) bool: has stood on the prey
    captured: np.ndarray  # (T+1, N) bool: nothing left to capture; true for predators throughout
    actions: np.ndarray  # (T, N) int: 0 up, 1 right, 2 down, 3 left, 4 stay, 5 capture
    attention: np.ndarray  # (T, N, N) weight of sender j (column) at receiver i (row)
    communication: np.ndarray  # (T, N) in [0, 1]: share of its means an agent used to talk
    reward: np.ndarray  # (T, N) of each step
    agent_class: np.ndarray  # (N,) 0 predator, 1 capture agent
    size: tuple[int, int]  # (rows, columns) of the task's grid
    vision: int  # of the predators, in cells
    capture_vision: int | None = None  # of the capture agents; None: blind
    success: bool = False  # the team was done at the end

    def __post_init__(self) -> None:
        steps, agents = self.actions.shape
        expected = {
            "agents": (steps + 1, agents, 2),
            "prey": (2,),
            "reached": (steps + 1, agents),
            "captured": (steps + 1, agents),
            "attention": (steps, agents, agents),
            "communication": (steps, agents),
            "reward": (steps, agents),
            "agent_class": (agents,),
        }
        for name, shape in expected.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(
                    f"{name} of an episode of {steps} steps and {agents} agents must have shape "
                    f"{shape}, got {np.shape(getattr(self, name))}."
                )

    @property
    def num_steps(self) -> int:
        """T."""
        return len(self.actions)

    @property
    def num_agents(self) -> int:
        """N."""
        return len(self.agent_class)

    def sight(self, agent: int) -> int | None:
        """How far an agent sees, in cells; None for a blind one."""
        return self.vision if self.agent_class[agent] == PREDATOR else self.capture_vision


def record_episode(
    env: Environment, policy: Policy, params: Any, key: chex.PRNGKey, greedy: bool = False
) -> Episode:
    """Runs one episode to its end and keeps what a replay needs.

    Args:
      env: Predator-Prey, Predator-Capture-Prey, or one of them upsampled.
      greedy: take the likeliest choice everywhere instead of sampling.

    Raises:
      ValueError: for a task whose state has no agents and prey on a grid.
    """
    task = getattr(env, "env", env)  # StateUpsampled changes what is observed, not the grid
    state = jax.eval_shape(task.reset, key)
    if not all(hasattr(state, name) for name in ("agents", "prey", "reached", "captured")):
        raise ValueError(
            f"a replay needs agents and prey on a grid; {type(task).__name__} has not."
        )
    first, steps = _run(env, policy, params, key, greedy)
    steps = jax.device_get(steps)
    length = int(np.argmax(steps["ended"])) + 1 if steps["ended"].any() else len(steps["ended"])

    def whole(name: str) -> np.ndarray:
        return np.concatenate([np.asarray(getattr(first, name))[None], steps[name][:length]])

    return Episode(
        agents=whole("agents"),
        prey=np.asarray(first.prey),
        reached=whole("reached"),
        captured=whole("captured"),
        actions=steps["actions"][:length],
        attention=steps["attention"][:length],
        communication=steps["communication"][:length],
        reward=steps["reward"][:length],
        agent_class=np.asarray(env.agent_class),
        size=(task.state_shape[1], task.state_shape[2]),
        vision=(env.view_shape[-1] - 1) // 2,
        capture_vision=getattr(task, "capture_vision", None),
        success=bool(steps["success"][length - 1]),
    )


@partial(jax.jit, static_argnames=("env", "policy"))
def _run(
    env: Environment, policy: Policy, params: Any, key: chex.PRNGKey, greedy: chex.Array
) -> tuple[Any, dict[str, chex.Array]]:
    """The first state, and `max_steps` steps from it; what follows the end is cut off later."""
    reset_key, noise_key = jax.random.split(key)
    first = env.reset(reset_key)
    noise = policy.sample_noise(noise_key, (env.max_steps,))
    noise = jax.tree.map(lambda numbers: jnp.where(greedy, 0, numbers), noise)

    def step(loop: tuple[Any, Any], noise_t: Any) -> tuple[tuple[Any, Any], dict[str, chex.Array]]:
        state, carry = loop
        # IC3Net's gate of this step was chosen one step ahead, and its output holds the next one.
        gate = getattr(carry, "gate", None)
        team_step: Any = policy.module.apply(
            params, carry, env.observe(state), noise_t, method=policy.module.encode_and_step
        )
        carry, output = team_step
        state, transition = env.step(state, output.action)
        record = {
            "agents": state.agents,
            "reached": state.reached,
            "captured": state.captured,
            "actions": output.action,
            "attention": output.attention,
            "communication": output.communication if gate is None else gate,
            "reward": transition.reward,
            "ended": transition.terminated | transition.truncated,
            "success": transition.success,
        }
        return (state, carry), record

    _, steps = jax.lax.scan(step, (first, policy.initial_carry()), noise)
    return first, steps


def write_gif(episode: Episode, path: str | Path, *, seconds_per_step: float | None = None) -> None:
    """Writes an animated GIF of T + 1 frames, the last one held, repeating for ever.

    Args:
      seconds_per_step: None shows short episodes at 0.4 and takes about 20 seconds for long ones.
    """
    seconds = seconds_per_step or float(np.clip(20 / max(episode.num_steps, 1), 0.1, 0.4))
    figure = Figure(figsize=_frame_inches(episode), dpi=DPI)
    images = [Image.fromarray(pixels) for pixels in _frames(episode, figure)]
    palette = _palette([images[0], images[len(images) // 2], images[-1]])
    paletted = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    durations = [round(1000 * seconds)] * episode.num_steps + [2000]
    content = io.BytesIO()
    paletted[0].save(
        content,
        format="GIF",
        save_all=True,
        append_images=paletted[1:],
        duration=durations,
        loop=0,
        optimize=False,
    )
    write_bytes(path, content.getvalue())


def write_strip(episode: Episode, path: str | Path, frames: int = 6) -> None:
    """Writes a PNG of `frames` moments spread over the episode, first and last among them.

    The picture is 1800 pixels wide and meant to be read at half that; large grids stand in fewer
    columns.

    Raises:
      ValueError: for fewer than one frame.
    """
    if frames < 1:
        raise ValueError(f"a strip needs at least one frame, got {frames}.")
    figure = strip_figure(episode, strip_moments(episode.num_steps, frames))
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=2 * DPI, facecolor="white")
    write_bytes(path, content.getvalue())


def strip_moments(num_steps: int, frames: int) -> list[int]:
    """At most `frames` of the moments 0..num_steps, evenly spread, the last one included."""
    return sorted({round(moment) for moment in np.linspace(num_steps, 0, frames)})


def strip_figure(episode: Episode, moments: Sequence[int]) -> Figure:
    """A figure with a panel for each of `moments` and one legend."""
    rows, columns = episode.size
    across = min(len(moments), max(2, int(STRIP_INCHES * DPI / (26 * columns))))
    down = -(-len(moments) // across)
    gap, head, foot = 0.12, 0.28, 0.4  # inches
    side = min(STRIP_INCHES / across, STRIP_INCHES / 3) - gap
    panel = side * rows / columns
    height = down * (panel + head) + foot
    left = (STRIP_INCHES - across * (side + gap) + gap) / 2
    figure = Figure(figsize=(STRIP_INCHES, height), dpi=DPI)
    FigureCanvasAgg(figure)
    for place, moment in enumerate(moments):
        row, column = divmod(place, across)
        corner = left + column * (side + gap), height - (row + 1) * (panel + head)
        inches = np.array([*corner, side, panel])
        axes = figure.add_axes(tuple(inches / ([STRIP_INCHES, height] * 2)))
        draw_frame(axes, episode, moment)
    _add_legend(figure, episode, across=8)
    return figure


def draw_frame(axes: Axes, episode: Episode, moment: int) -> None:
    """Draws frame `moment` in 0..T into `axes`; lengths are in cells, so it scales with them."""
    _draw_grid(axes, episode.size)
    for artist in frame_artists(episode, moment, _cell_points(axes)):
        axes.add_artist(artist)


def frame_artists(episode: Episode, moment: int, cell_points: float) -> list[Artist]:
    """What a frame shows beside the grid, in the order it is drawn.

    Args:
      cell_points: side of a cell in points, for the size of the numbers.
    """
    places, radius = spots(episode.agents[moment])
    # Whoever stands on the prey stands in front of it: its tips still show.
    occupied = (episode.agents[moment] == episode.prey).all(-1).any()
    artists = [
        *_sight(episode, moment),
        *_prey(episode.prey, 0.5 if occupied else 0.32),
        _title(episode, moment),
    ]
    if moment < episode.num_steps:
        artists += [
            *_messages(episode, moment, places, radius),
            *_moves(episode, moment, places, radius),
        ]
        artists += _gates(episode.communication[moment], places, radius)
    for agent in range(episode.num_agents):
        artists += _agent(episode, moment, agent, places[agent], float(radius[agent]), cell_points)
    return sorted(artists, key=Artist.get_zorder)


def caption(episode: Episode, moment: int) -> str:
    """The step of a frame and how the team stands."""
    step = f"step {moment}/{episode.num_steps}"
    if moment == episode.num_steps:
        return f"{step}: {'done' if episode.success else 'not done'}"
    there = int((episode.agents[moment] == episode.prey).all(-1).sum())
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


def messages(episode: Episode, moment: int) -> list[tuple[int, int, float]]:
    """(sender, receiver, weight) of every message of a step; nobody sends to itself."""
    weights = np.asarray(episode.attention[moment])
    return [
        (int(sender), int(receiver), float(weights[receiver, sender]))
        for receiver, sender in np.argwhere(weights > MIN_WEIGHT)
        if sender != receiver
    ]


def _frame_inches(episode: Episode) -> tuple[float, float]:
    rows, columns = episode.size
    cell = float(np.clip(5.2 / max(rows, columns), 0.32, 0.72))
    return max(columns * cell + 0.2, 4.2), rows * cell + 1.0


def _frames(episode: Episode, figure: Figure) -> Iterator[np.ndarray]:
    """(height, width, 3) uint8 of every frame, drawn on one figure after another."""
    canvas = FigureCanvasAgg(figure)
    width, height = figure.get_size_inches()
    axes = figure.add_axes((0.1 / width, 0.62 / height, 1 - 0.2 / width, 1 - 0.92 / height))
    _add_legend(figure, episode, across=4)
    _draw_grid(axes, episode.size)
    canvas.draw()
    # What never changes is drawn once; on a slow core this saves two thirds of the time.
    background = canvas.copy_from_bbox(figure.bbox)
    for moment in range(episode.num_steps + 1):
        canvas.restore_region(background)
        for artist in frame_artists(episode, moment, _cell_points(axes)):
            axes.add_artist(artist)
            axes.draw_artist(artist)
            artist.remove()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _palette(images: Sequence[Image.Image]) -> Image.Image:
    """One palette for all frames, from a few of them, so that colours do not flicker."""
    sheet = Image.new("RGB", (images[0].width, images[0].height * len(images)))
    for index, image in enumerate(images):
        sheet.paste(image, (0, index * image.height))
    palette = sheet.quantize(255, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    colours = np.array(palette.getpalette(), np.uint8).reshape(-1, 3)
    colours[(colours >= 248).all(-1)] = 255  # the cut drops low bits, and white would turn grey
    palette.putpalette(colours.ravel().tolist())
    return palette


def _draw_grid(axes: Axes, size: tuple[int, int]) -> None:
    rows, columns = size
    axes.set_xlim(-0.5, columns - 0.5)
    axes.set_ylim(rows - 0.5, -0.5)  # row 0 at the top
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    across = [[(-0.5, row - 0.5), (columns - 0.5, row - 0.5)] for row in range(1, rows)]
    along = [[(column - 0.5, -0.5), (column - 0.5, rows - 0.5)] for column in range(1, columns)]
    axes.add_artist(LineCollection(across + along, colors="#E0E0E0", linewidths=0.7, zorder=0.4))
    for spine in axes.spines.values():
        spine.set_color(FAINT)


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


def _messages(
    episode: Episode, moment: int, places: np.ndarray, radius: np.ndarray
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


def _gates(shares: np.ndarray, places: np.ndarray, radius: np.ndarray) -> Iterator[Artist]:
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


def _cell_points(axes: Axes) -> float:
    """The side of a cell in points, once the grid's proportions are set."""
    axes.apply_aspect()
    origin, one = axes.transData.transform([(0.0, 0.0), (1.0, 0.0)])
    figure = axes.get_figure(root=True)
    return abs(float(one[0] - origin[0])) * 72 / (figure.dpi if figure is not None else DPI)


def _legend(episode: Episode) -> list[Artist]:
    """What the marks mean, as far as they occur."""

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


def _add_legend(figure: Figure, episode: Episode, across: int) -> None:
    figure.legend(
        handles=_legend(episode),
        loc="lower center",
        ncols=across,
        frameon=False,
        fontsize=8,
        labelcolor=INK,
        handletextpad=0.4,
        columnspacing=1.2,
    )
