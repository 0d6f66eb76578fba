"""Pictures of an episode: an animated GIF, or a strip of moments as a PNG."""

import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from sumajax.reporting.metrics import write_bytes
from sumajax.reporting.replay.marks import FAINT, INK, frame_artists, legend_marks
from sumajax.reporting.replay.recording import Episode
from sumajax.reporting.replay.traffic_episode import TrafficEpisode

AnyEpisode = Episode | TrafficEpisode

STRIP_INCHES = 9.0
DPI = 100


def write_gif(
    episode: AnyEpisode, path: str | Path, *, seconds_per_step: float | None = None
) -> None:
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


def write_strip(episode: AnyEpisode, path: str | Path, frames: int = 6) -> None:
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


def strip_figure(episode: AnyEpisode, moments: Sequence[int]) -> Figure:
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


def draw_frame(axes: Axes, episode: AnyEpisode, moment: int) -> None:
    """Draws frame `moment` in 0..T into `axes`; lengths are in cells, so it scales with them."""
    _draw_grid(axes, episode.size)
    for artist in frame_artists(episode, moment, _cell_points(axes)):
        axes.add_artist(artist)


def _frame_inches(episode: AnyEpisode) -> tuple[float, float]:
    rows, columns = episode.size
    cell = float(np.clip(5.2 / max(rows, columns), 0.32, 0.72))
    return max(columns * cell + 0.2, 4.2), rows * cell + 1.0


def _frames(episode: AnyEpisode, figure: Figure) -> Iterator[np.ndarray]:
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


def _cell_points(axes: Axes) -> float:
    """The side of a cell in points, once the grid's proportions are set."""
    axes.apply_aspect()
    origin, one = axes.transData.transform([(0.0, 0.0), (1.0, 0.0)])
    figure = axes.get_figure(root=True)
    return abs(float(one[0] - origin[0])) * 72 / (figure.dpi if figure is not None else DPI)


def _add_legend(figure: Figure, episode: AnyEpisode, across: int) -> None:
    figure.legend(
        handles=legend_marks(episode),
        loc="lower center",
        ncols=across,
        frameon=False,
        fontsize=8,
        labelcolor=INK,
        handletextpad=0.4,
        columnspacing=1.2,
    )
