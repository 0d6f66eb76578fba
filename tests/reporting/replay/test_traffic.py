"""Replays of Traffic Junction: what is recorded of an episode, and what is drawn of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import drawn_parameters
from PIL import Image

from sumajax.environments import TrafficJunction
from sumajax.environments.traffic_junction import Arrivals
from sumajax.policies import make_policy
from sumajax.reporting.replay import (
    TrafficEpisode,
    frame_artists,
    record_episode,
    traffic_caption,
    write_gif,
    write_strip,
)
from sumajax.upsampling import StateUpsampled

ENV = TrafficJunction(num_cars=3, max_steps=4)
ARRIVALS = {0: (0, 0), 1: (0, 2), 2: (1, 1)}  # in a step: entry and slot
ACTIONS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1], [0, 0, 0]])


def episode() -> TrafficEpisode:
    """Two cars collide at the first entry, a third comes; 0 talks and the others hear it."""
    states, successes = [jax.jit(ENV.reset)(jax.random.key(0))], []
    step = jax.jit(ENV.step_with)
    for t, actions in enumerate(ACTIONS):
        entry, slot = ARRIVALS.get(t, (None, 0))
        happens = np.array([entry == 0, entry == 1])
        new = Arrivals(happens, np.full(2, slot, np.int32), np.zeros(2, np.int32))
        state, transition = step(states[-1], actions.astype(np.int32), new)
        states.append(state)
        successes.append(bool(transition.success))
    attention = np.zeros((4, 3, 3))
    attention[:, 1:, 0] = 0.5
    communication = np.zeros((4, 3))
    communication[:, 0] = 1
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    return TrafficEpisode.of(ENV, together, ACTIONS, attention, communication, successes[-1])


@pytest.fixture(scope="module")
def shown():
    return episode()


def gids(shown, moment):
    return sorted(a.get_gid() for a in frame_artists(shown, moment, 40) if a.get_gid())


def test_cars_with_their_way_ahead(shown):
    assert [shown.cars(moment) for moment in range(5)] == [[], [0], [0, 2], [0, 1, 2], [0, 1, 2]]
    np.testing.assert_array_equal(shown.way(3, 0), [(row, 3) for row in range(1, 7)])
    np.testing.assert_array_equal(shown.heading(3, 0), [1, 0])
    np.testing.assert_array_equal(shown.heading(3, 1), [0, 1])


def test_on_the_last_cell_a_car_heads_on(shown):
    last = np.full_like(shown.place, 6)
    at_the_end = TrafficEpisode(**{**vars(shown), "place": last})
    np.testing.assert_array_equal(at_the_end.heading(0, 0), [1, 0])


def test_empty_slots_neither_talk_nor_hear(shown):
    np.testing.assert_array_equal(shown.communication[:, 0], [0, 1, 1, 1])
    heard = [set(zip(*np.nonzero(attention), strict=True)) for attention in shown.attention]
    assert heard == [set(), set(), {(2, 0)}, {(1, 0), (2, 0)}]


def test_a_frame_shows_cars_brakes_collisions_and_talk(shown):
    assert gids(shown, 0) == ["road"]
    assert gids(shown, 1) == ["brakes 0", "car 0", "gate 0", "road", "way 0"]
    together = ["crash 0", "crash 2", "brakes 2", "car 0", "car 2", "gate 0", "message 0 2"]
    assert gids(shown, 2) == sorted([*together, "road", "way 0", "way 2"])
    last = gids(shown, 4)
    assert not [name for name in last if name.startswith(("brakes", "gate", "message"))]
    assert [name for name in last if name.startswith("car")] == ["car 0", "car 1", "car 2"]


def test_captions(shown):
    captions = [traffic_caption(shown, moment) for moment in range(5)]
    assert captions[:3] == ["step 0/4: 0 cars", "step 1/4: 1 car", "step 2/4: 2 cars, 2 collide"]
    assert captions[4] == "step 4/4: collisions"


def test_files(shown, tmp_path):
    write_gif(shown, tmp_path / "episode.gif")
    write_strip(shown, tmp_path / "episode.png", frames=3)
    assert Image.open(tmp_path / "episode.gif").n_frames == 5
    assert Image.open(tmp_path / "episode.png").width == 1800


def test_a_recorded_episode_is_one_of_the_task():
    task = TrafficJunction(num_cars=2, max_steps=6, arrival_rate=0.7)
    env = StateUpsampled(task, 14)
    policy = make_policy("commnet", env, hidden=4, encoder="linear")
    params = drawn_parameters(policy)
    recorded = record_episode(env, policy, params, jax.random.key(1))
    assert isinstance(recorded, TrafficEpisode)
    assert (recorded.size, recorded.num_steps, recorded.num_agents) == ((7, 7), 6, 2)
    stays = recorded.alive[:-1] & recorded.alive[1:]
    moved = np.diff(recorded.place, axis=0)
    same_car = stays & (moved >= 0) & (moved <= 1)
    np.testing.assert_array_equal(moved[same_car], 1 - recorded.actions[same_car])
    assert recorded.success == (not recorded.collided.any())
