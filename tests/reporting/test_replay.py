import sys

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.environments.grid import move
from sumajax.policies import Policy, PolicyModule, PolicyOutput, TeamSpec, make_policy
from sumajax.policies.types import decide
from sumajax.reporting import Episode, record_episode, write_gif, write_strip
from sumajax.reporting import replay as module
from sumajax.upsampling import StateUpsampled


def episode(steps=3, size=(5, 6), **changes):
    """A capture agent (the last) and predators that stand still; 0 and 1 talk to each other."""
    agents = 3
    attention = np.zeros((steps, agents, agents))
    attention[:, 0, 1] = attention[:, 1, 0] = 0.5
    communication = np.zeros((steps, agents))
    communication[:, :2] = 1
    cells = np.stack([np.arange(agents), np.arange(agents)], axis=-1)
    agent_class = np.zeros(agents, int)
    agent_class[-1] = 1
    fields = {
        "agents": np.broadcast_to(cells, (steps + 1, agents, 2)),
        "prey": np.array([4, 1]),
        "reached": np.zeros((steps + 1, agents), bool),
        "captured": np.broadcast_to(agent_class == 0, (steps + 1, agents)),
        "actions": np.full((steps, agents), 4),
        "attention": attention,
        "communication": communication,
        "reward": np.zeros((steps, agents)),
        "agent_class": agent_class,
        "size": size,
        "vision": 1,
    }
    return Episode(**{**fields, **changes})


def gids(shown, moment):
    artists = module.frame_artists(shown, moment, cell_points=40)
    return sorted(artist.get_gid() for artist in artists if artist.get_gid())


@pytest.fixture(scope="module")
def recorded():
    env = StateUpsampled(PredatorPrey(size=3, num_predators=2, max_steps=30), 6)
    policy = make_policy("ic3net", env, hidden=8)
    params = jax.jit(policy.init)(jax.random.key(0))
    return env.env, [
        record_episode(env, policy, params, jax.random.key(seed)) for seed in range(6)
    ], record_episode(env, policy, params, jax.random.key(0), greedy=True)  # fmt: skip


def test_a_recorded_episode_obeys_the_rules_of_the_task(recorded):
    _, episodes, greedy = recorded
    assert len({shown.num_steps for shown in episodes}) > 1  # some end before the limit
    for shown in [*episodes, greedy]:
        assert shown.size == (3, 3)
        assert shown.num_steps <= 30
        assert shown.success == bool((shown.agents[-1] == shown.prey).all())
        assert shown.success or shown.num_steps == 30
        assert not (shown.agents[:-1] == shown.prey).all((1, 2)).any()
        for t in range(shown.num_steps):
            moved = np.asarray(move(shown.agents[t], shown.actions[t], (3, 3)))
            still = np.where(shown.reached[t][:, None], shown.agents[t], moved)
            np.testing.assert_array_equal(shown.agents[t + 1], still)
        on_prey = (shown.agents == shown.prey).all(-1)
        np.testing.assert_array_equal(shown.reached[1:], np.logical_or.accumulate(on_prey)[1:])
        np.testing.assert_allclose(shown.reward, np.where(on_prey[1:], 0, -0.05))


def test_the_gates_of_a_step_are_those_its_messages_went_through(recorded):
    _, episodes, _ = recorded
    assert not episodes[0].communication[0].any()  # IC3Net starts silent
    talked = np.concatenate([shown.communication for shown in episodes])
    assert set(np.unique(talked)) == {0.0, 1.0}
    attention = np.concatenate([shown.attention for shown in episodes])
    both = talked[:, :, None] * talked[:, None, :] * (1 - np.eye(2))
    np.testing.assert_array_equal(attention > 0, both > 0)


class AnyAction(PolicyModule):
    """Likes every action alike, stay (the first class) or capture (the second) a little more."""

    def encode_states(self, states):
        return jnp.zeros((states.shape[0], 1))

    def __call__(self, carry, state_features, view, noise):
        favourite = jnp.where(jnp.asarray(self.team.agent_class) == 0, 4, 5)
        decision = decide(jax.nn.one_hot(favourite, self.team.num_actions), noise)
        share = jnp.full(self.team.num_agents, 0.25)
        return carry, PolicyOutput({"action": decision}, share, share, jnp.eye(2))

    def initial_carry(self, batch_shape):
        return ()

    def sample_noise(self, key, batch_shape):
        shape = (*batch_shape, self.team.num_agents, self.team.num_actions)
        return jax.random.gumbel(key, shape)


def test_greedy_takes_the_likeliest_choice_and_a_key_gives_one_episode():
    env = PredatorCapturePrey(
        size=3, num_predators=1, num_capturers=1, max_steps=6, capture_vision=0
    )
    policy = Policy("any", AnyAction(TeamSpec.of(env)))
    first, again, greedy = (
        record_episode(env, policy, {}, jax.random.key(1), greedy)
        for greedy in (False, False, True)
    )
    np.testing.assert_array_equal(first.actions, again.actions)
    assert greedy.actions.tolist() == [[4, 5]] * 6
    assert first.actions.tolist() != greedy.actions.tolist()
    assert greedy.agent_class.tolist() == [0, 1]
    assert greedy.captured.tolist() == [[True, False]] * 7
    assert (first.communication == 0.25).all()
    assert (first.vision, first.capture_vision, first.success) == (1, 0, False)


def test_a_task_without_agents_on_a_grid_is_refused():
    class Elsewhere:
        def reset(self, key):
            return key

    with pytest.raises(ValueError, match="Elsewhere has not"):
        record_episode(Elsewhere(), None, None, jax.random.key(0))  # type: ignore[arg-type]


def test_an_episode_checks_its_shapes():
    with pytest.raises(ValueError, match=r"attention of an episode of 3 steps and 3 agents"):
        episode(attention=np.zeros((3, 2, 2)))


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


def test_recorded_arrows_leave_talkers_only(recorded):
    _, episodes, _ = recorded
    for shown in episodes:
        for t in range(shown.num_steps):
            for sender, receiver, weight in module.messages(shown, t):
                assert shown.communication[t, sender] == 1
                assert weight == shown.attention[t, receiver, sender]


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
