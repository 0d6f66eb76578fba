"""Replays: one episode as a GIF or a strip of frames, with who sees what and who talks to whom."""

from sumajax.reporting.replay.marks import caption, frame_artists, messages, seen_cells, spots
from sumajax.reporting.replay.pictures import (
    draw_frame,
    strip_figure,
    strip_moments,
    write_gif,
    write_strip,
)
from sumajax.reporting.replay.recording import Episode, Recording, record, record_episode
from sumajax.reporting.replay.traffic_episode import TrafficEpisode
from sumajax.reporting.replay.traffic_marks import car_spots, traffic_caption

__all__ = [
    "Episode",
    "Recording",
    "TrafficEpisode",
    "caption",
    "car_spots",
    "draw_frame",
    "frame_artists",
    "messages",
    "record",
    "record_episode",
    "seen_cells",
    "spots",
    "strip_figure",
    "strip_moments",
    "traffic_caption",
    "write_gif",
    "write_strip",
]
