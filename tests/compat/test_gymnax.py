"""The form of gymnax 1.0: six values, automatic reset, the final observation in info."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax.compat import spaces as own_spaces
from sumajax.compat.gymnax import AutoReset
from sumajax.environments import PredatorPrey, TrafficJunction
from sumajax.upsampling import StateUpsampled

TASK = PredatorPrey(size=3, num_predators=2, max_steps=3)
ENV = AutoReset(TASK)
STAY, DOWN = jnp.array([4, 4]), jnp.array([2, 2])


def same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_a_step_has_six_values_and_keeps_the_trees():
    obs, state = ENV.reset(jax.random.key(0))
    result = ENV.step(jax.random.key(1), state, STAY, ENV.default_params)
    assert len(result) == 6
    next_obs, next_state, reward, terminated, truncated, info = result
    for before, after in ((obs, next_obs), (state, next_state)):
        assert jax.tree.map(lambda x: (x.shape, x.dtype), before) == jax.tree.map(
            lambda x: (x.shape, x.dtype), after
        )
    assert reward.shape == (2,)
    assert terminated.shape == truncated.shape == ()
    same(info["final_observation"], next_obs)  # no end, so no reset
    same(next_obs, ENV.observe(None, next_state))


def test_the_time_limit_truncates_and_starts_afresh():
    _, state = ENV.reset(jax.random.key(0))
    for time in range(3):
        last, start = state, jax.random.key(time)
        obs, state, _, terminated, truncated, info = ENV.step(start, state, STAY)
    assert truncated
    assert not terminated
    assert int(state.time) == 0
    same((obs, state), ENV.reset(jax.random.split(start)[1]))
    same(info["final_observation"], TASK.observe(TASK.step(last, STAY)[0]))
    assert int(info["steps_taken"]) == 3


def test_a_team_that_is_done_terminates():
    state = TASK.state_at([[0, 0], [0, 0]], [1, 0])
    obs, _, reward, terminated, truncated, info = ENV.step(jax.random.key(0), state, DOWN)
    assert terminated
    assert not truncated
    assert info["success"]
    np.testing.assert_array_equal(reward, [0, 0])
    with pytest.raises(AssertionError):
        same(info["final_observation"], obs)


def test_done_with_the_last_step_is_an_end_not_a_cut():
    state = TASK.state_at([[0, 0], [0, 0]], [1, 0]).replace(time=jnp.int32(2))
    *_, terminated, truncated, _ = ENV.step(jax.random.key(0), state, DOWN)
    assert terminated
    assert not truncated


def test_the_reset_leaves_a_part_of_the_key():
    """A wrapper or program may draw from the step's half; no episode may start from the whole."""
    state = TASK.state_at([[0, 0], [2, 2]], [1, 0]).replace(time=jnp.int32(2))
    key = jax.random.key(3)
    _, fresh, *_ = ENV.step(key, state, STAY)
    for used in (key, jax.random.split(key)[0]):
        with pytest.raises(AssertionError):
            same(fresh, ENV.reset(used)[1])


def test_one_reward_for_the_team():
    team = AutoReset(TASK, team_reward=True)
    state = TASK.state_at([[0, 0], [2, 2]], [1, 0])
    _, after, reward, *_ = team.step(jax.random.key(0), state, DOWN)
    _, same_after, rewards, *_ = ENV.step(jax.random.key(0), state, DOWN)
    assert reward.shape == ()
    np.testing.assert_allclose(reward, rewards.mean())
    assert rewards[0] != rewards[1]
    same(after, same_after)


def test_its_name_is_that_of_the_innermost_task():
    assert AutoReset(StateUpsampled(StateUpsampled(TASK, 6), 12)).name == "PredatorPrey"


def test_batched():
    keys = jax.random.split(jax.random.key(0), 4)
    _, states = jax.vmap(ENV.reset)(keys)
    result = jax.vmap(ENV.step)(keys, states, jnp.tile(STAY, (4, 1)))
    assert result[2].shape == (4, 2)
    assert result[5]["final_observation"].state.shape == (4, 2, 1, 3, 3)


def test_spaces():
    obs, state = ENV.reset(jax.random.key(0))
    assert ENV.observation_space().contains(obs)
    actions = ENV.action_space().sample(jax.random.key(0))
    assert len(actions) == ENV.num_agents == 2
    assert ENV.action_space().contains(actions)
    ENV.step(jax.random.key(0), state, actions)
    assert ENV.default_params.max_steps_in_episode == 3
    assert (ENV.name, ENV.num_actions) == ("PredatorPrey", 5)


def test_a_task_whose_agents_come_and_go():
    """Who is there is part of what is seen, and the key in the state goes on to draw who comes."""
    junction = AutoReset(TrafficJunction(num_cars=3, max_steps=4, arrival_rate=0.5))
    obs, state = junction.reset(jax.random.key(0))
    there = []
    for time in range(5):
        assert junction.observation_space().contains(obs)
        result = junction.step(jax.random.key(time), state, jnp.zeros(3, jnp.int32))
        obs, state, _, terminated, truncated, info = result
        assert not terminated
        assert bool(truncated) == (time == 3)
        there.append(np.asarray(info["final_observation"].alive))
        np.testing.assert_array_equal(obs.alive, state.alive)
    assert np.any(there)
    assert int(state.time) == 1  # of the next episode


def test_our_own_spaces():
    """They stand in where neither library is installed."""
    key = jax.random.key(0)
    box, number = own_spaces.Box(-1.0, 1.0, (2, 3)), own_spaces.Discrete(4)
    pair = own_spaces.Tuple([number, box])
    for space in (box, number, pair):
        assert space.contains(space.sample(key))
    assert not box.contains(jnp.full((2, 3), 1.5))
    assert not number.contains(4)
    assert not pair.contains((jnp.int32(-1), jnp.zeros((2, 3))))
    sample = own_spaces.Dict({"state": box, "view": box}).sample(key)
    assert {name: x.shape for name, x in sample.items()} == {"state": (2, 3), "view": (2, 3)}


def test_gymnaxs_legacy_wrapper_takes_it():
    wrappers = pytest.importorskip(
        "gymnax.wrappers", reason="gymnax is not installed (no dependency)"
    )
    legacy = wrappers.LegacyStepAPIWrapper(ENV)
    _, state = legacy.reset(jax.random.key(0))
    _, _, reward, done, info = legacy.step(jax.random.key(1), state, STAY)
    assert not done
    assert reward.shape == (2,)
    assert "final_observation" in info


def test_gymnaxs_log_wrapper_takes_it_with_one_reward_for_the_team():
    wrappers = pytest.importorskip(
        "gymnax.wrappers", reason="gymnax is not installed (no dependency)"
    )
    logged = wrappers.LogWrapper(AutoReset(TASK, team_reward=True))
    _, state = logged.reset(jax.random.key(0))

    def step(state, key):
        _, state, *_, info = logged.step(key, state, STAY)
        return state, info

    _, info = jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 3))
    assert info["returned_episode"].tolist() == [False, False, True]
    np.testing.assert_allclose(info["returned_episode_returns"][-1], -0.15, rtol=1e-5)
