"""What is drawn of an episode, and the files that it is written to."""

import sys

import matplotlib
import numpy as np
import pytest
from drawn_episodes import episode
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from PIL import Image

from sumajax.reporting import replay as module
from sumajax.reporting import write_gif, write_strip


def gids(shown, moment):
    artists = module.frame_artists(shown, moment, cell_points=40)
    return sorted(artist.get_gid() for artist in artists if artist.get_gid())


def test_arrows_leave_talkers_only_and_gates_are_rings():
    shown = episode()
    assert gids(shown, 0) == ["gate 0", "gate 1", "message 0 1"]  # both ways in one
    one_way = shown.attention.copy()
    one_way[:, 0, 1] = 0
    assert gids(episode(attention=one_way), 1) == ["gate 0", "gate 1", "message 0 1"]
    unequal = shown.attention.copy()
    unequal[:, 0, 1] = 0.2
    assert "message 1 0" in gids(episode(attention=unequal), 1)
    alone = np.broadcast_to(np.eye(3), (3, 3, 3))
    assert not any("message" in gid for gid in gids(episode(attention=alone), 0))
    silent = episode(attention=0 * alone, communication=np.zeros((3, 3)))
    assert gids(silent, 0) == []
    assert gids(shown, 3) == []  # the outcome: nobody talks any more


def test_stronger_attention_is_a_stronger_arrow():
    attention = np.zeros((3, 3, 3))
    attention[:, 1, 0], attention[:, 2, 0] = 0.9, 0.1
    artists = module.frame_artists(episode(attention=attention), 0, 40)
    alpha = {artist.get_gid(): artist.get_alpha() for artist in artists}
    assert alpha["message 0 1"] > 2 * alpha["message 0 2"] > 0


def test_captures_are_marked_on_capture_agents_alone():
    captured = np.ones((4, 3), bool)
    captured[:2, 2] = False
    shown = episode(captured=captured)
    assert "captured 2" not in gids(shown, 1)
    assert "captured 2" in gids(shown, 2)
    assert "captured 0" not in gids(shown, 2)


@pytest.mark.parametrize("together", [2, 3, 5, 10])
def test_agents_in_one_cell_stand_apart_inside_it(together):
    cells = np.array([[2, 3]] * together + [[0, 0]])
    centres, radii = module.spots(cells)
    np.testing.assert_array_equal(centres[-1], [0, 0])
    here, radius = centres[:-1], radii[:-1]
    assert (np.abs(here - [3, 2]) + radius[:, None] < 0.5).all()
    distance = np.hypot(*(here[:, None] - here[None]).transpose(2, 0, 1))
    distance[np.eye(together, dtype=bool)] = np.inf
    assert (distance > radius[:, None] + radius[None]).all()
    assert radius.min() > 0.08


def test_windows_end_at_the_border_and_blind_agents_have_none():
    shown = episode()
    assert sorted(map(tuple, module.seen_cells(shown, 0, 0))) == sorted(
        [(0, 0), (0, 1), (1, 0), (1, 1)] + [(r, c) for r in range(3) for c in range(3)]
    )
    assert len(module.seen_cells(shown, 0, 1)) == 0
    assert len(module.seen_cells(episode(capture_vision=0), 0, 1)) == 1


def test_a_prey_that_moves_is_drawn_where_it_is():
    shown = episode(prey=np.array([[4, 1], [4, 2], [3, 2], [3, 3]]))

    def star(moment):
        artists = module.frame_artists(shown, moment, cell_points=40)
        (found,) = [a.get_xy() for a in artists if isinstance(a, Polygon) and len(a.get_xy()) == 11]
        return found[:-1].mean(0)

    np.testing.assert_allclose([star(t) for t in range(4)], shown.prey[:, ::-1], atol=1e-6)
    cells = np.array(shown.agents)
    cells[2, 0] = [3, 2]
    shown = episode(prey=shown.prey, agents=cells)
    assert [module.caption(shown, t)[-12:] for t in (1, 2)] == [" 0/3 on prey", " 1/3 on prey"]


def test_captions_say_the_step_and_how_the_team_stands():
    cells = np.array(episode().agents)
    cells[2:, 0] = [4, 1]
    shown = episode(agents=cells, success=True)
    captions = [module.caption(shown, t) for t in range(4)]
    assert captions == ["step 0/3: 0/3 on prey", "step 1/3: 0/3 on prey", "step 2/3: 1/3 on prey",
                        "step 3/3: done"]  # fmt: skip
    assert module.caption(episode(), 3) == "step 3/3: not done"


def test_a_gif_has_a_frame_for_every_state_and_holds_the_last(tmp_path):
    write_gif(episode(steps=4), tmp_path / "replay.gif", seconds_per_step=0.3)
    with Image.open(tmp_path / "replay.gif") as gif:
        assert gif.n_frames == 5
        assert gif.info["loop"] == 0
        frames, durations = [], []
        for frame in range(5):
            gif.seek(frame)
            frames.append(np.asarray(gif.convert("RGB")))
            durations.append(gif.info["duration"])
    assert durations == [300, 300, 300, 300, 2000]
    assert (frames[0] == 255).mean() > 0.2  # the background is white
    assert all((frame != frames[0]).any() for frame in frames[1:])


@pytest.mark.parametrize(("size", "frames", "across"), [((5, 6), 6, 5), ((10, 10), 6, 3)])
def test_a_strip_spreads_its_frames_over_the_episode(tmp_path, size, frames, across):
    shown = episode(steps=11, size=size)
    moments = module.strip_moments(11, frames)
    assert (moments[0], moments[-1], len(moments)) == (0, 11, frames)
    figure = module.strip_figure(shown, moments)
    boxes = [axes.get_position().bounds for axes in figure.axes]
    assert len(boxes) == frames
    assert len({round(box[0], 6) for box in boxes}) == across
    write_strip(shown, tmp_path / "strip.png", frames)
    with Image.open(tmp_path / "strip.png") as image:
        assert image.width == 1800
    assert module.strip_moments(2, 6) == [0, 1, 2]
    assert module.strip_moments(9, 1) == [9]
    with pytest.raises(ValueError, match="at least one frame"):
        write_strip(shown, tmp_path / "none.png", 0)


def test_drawing_leaves_global_state_alone(tmp_path):
    settings = dict(matplotlib.rcParams)
    module.draw_frame(Figure().add_subplot(), episode(), 0)
    write_gif(episode(steps=1), tmp_path / "replay.gif")
    pyplot = sys.modules.get("matplotlib.pyplot")  # somebody else's, if at all
    assert pyplot is None or not pyplot.get_fignums()
    assert dict(matplotlib.rcParams) == settings
