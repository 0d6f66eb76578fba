"""Predator-Prey as its rules say: IC3Net's program, with the decisions of the package noted."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from episodes import (
    assert_bound_is_reached,
    assert_level,
    assert_same,
    assert_shortest_paths,
    play,
    play_recorded,
    random_actions,
    random_lengths,
    random_moment,
    reorder,
    reset,
    reset_many,
    step,
    symmetries,
    take,
    view,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare

from sumajax.environments import Environment, PredatorPrey, predator_prey
from sumajax.environments.grid import CAPTURE, DOWN, LEFT, RIGHT, STAY, UP

MODES = ("mixed", "cooperative", "competitive")
seeds = st.integers(0, 2**31 - 1)


def duo(**changes) -> PredatorPrey:
    return PredatorPrey(**{"size": 5, "num_predators": 2, "max_steps": 10, **changes})


def start(env, agents=((0, 0), (4, 4)), prey=(0, 2)):
    return env.state_at(jnp.array(agents), jnp.array(prey))


class TestReset:
    def test_nobody_starts_on_the_prey_or_on_another_agent(self):
        env = PredatorPrey(size=(2, 3), num_predators=5)
        states = reset_many(env, jax.random.key(0), 200)
        cells = np.concatenate([states.agents, states.prey[:, None]], axis=1)
        assert all(len(np.unique(c, axis=0)) == 6 for c in cells)

    def test_everybody_starts_anywhere_with_equal_chances(self):
        """The agents and the prey, over a million episodes."""
        env = PredatorPrey(size=(3, 4), num_predators=2)
        states = reset_many(env, jax.random.key(0), 1_000_000)
        for cells in (*np.moveaxis(np.asarray(states.agents), 1, 0), np.asarray(states.prey)):
            counts = np.bincount(cells @ [4, 1], minlength=12)
            assert counts.shape == (12,)
            assert chisquare(counts).pvalue > 1e-3

    def test_an_episode_starts_from_nothing(self):
        state = duo().reset(jax.random.key(0))
        assert state.time == 0
        assert not state.reached.any()
        assert state.captured.all()  # nothing to capture in this domain


class TestMoving:
    def test_all_agents_move_at_once(self):
        env = PredatorPrey(size=5, num_predators=5)
        state = start(env, agents=[[2, 2]] * 5, prey=(0, 0))
        states, _ = play(env, state, [[UP, RIGHT, DOWN, LEFT, STAY]])
        assert states[1].agents.tolist() == [[1, 2], [2, 3], [3, 2], [2, 1], [2, 2]]

    def test_borders_hold_on_a_rectangular_grid(self):
        env = duo(size=(2, 4))
        state = start(env, agents=[[0, 3], [1, 0]], prey=(0, 0))
        for actions in ([UP, DOWN], [RIGHT, LEFT]):
            states, _ = play(env, state, [actions])
            assert states[1].agents.tolist() == [[0, 3], [1, 0]]

    def test_the_prey_never_moves(self):
        env = duo()
        states, _ = play(env, start(env), [[RIGHT, UP]] * 4)
        assert all(state.prey.tolist() == [0, 2] for state in states)

    def test_agents_may_share_a_cell_and_swap_cells(self):
        env = duo()
        state = start(env, agents=[[2, 2], [2, 3]])
        states, _ = play(env, state, [[RIGHT, STAY], [STAY, STAY]])
        assert states[1].agents.tolist() == [[2, 3], [2, 3]]
        states, _ = play(env, state, [[RIGHT, LEFT]])
        assert states[1].agents.tolist() == [[2, 3], [2, 2]]

    def test_who_reaches_the_prey_never_moves_again(self):
        env = duo()
        plan = [[RIGHT, STAY], [RIGHT, STAY], [DOWN, STAY], [LEFT, STAY], [UP, STAY]]
        states, _ = play(env, start(env), plan)
        assert [state.reached[0].item() for state in states] == [False, False] + [True] * 4
        assert all(state.agents[0].tolist() == [0, 2] for state in states[2:])

    @settings(deadline=None, max_examples=20)
    @given(seed=seeds)
    def test_frozen_agents_stay_frozen_whatever_they_choose(self, seed):
        env = PredatorPrey(size=3, num_predators=3, max_steps=30)
        key, action_key = jax.random.split(jax.random.key(seed))
        states, _ = play_recorded(env, reset(env, key), random_actions(env, action_key, (30,)))
        reached = np.asarray(states.reached)
        assert (reached[1:] >= reached[:-1]).all()
        moved = (states.agents[1:] != states.agents[:-1]).any(-1)
        assert not (np.asarray(moved) & reached[:-1]).any()


class TestReward:
    def test_mixed_pays_a_penalty_until_the_step_of_arrival(self):
        env = duo()
        _, transitions = play(env, start(env), [[RIGHT, UP], [RIGHT, UP], [DOWN, UP]])
        rewards = [transition.reward.tolist() for transition in transitions]
        np.testing.assert_allclose(rewards, [[-0.05, -0.05], [0, -0.05], [0, -0.05]])

    @pytest.mark.parametrize(
        ("mode", "alone", "together"), [("cooperative", 0.05, 0.10), ("competitive", 0.05, 0.025)]
    )
    def test_the_other_modes_pay_by_how_many_stand_on_the_prey(self, mode, alone, together):
        env = duo(reward_mode=mode)
        state = start(env, agents=[[0, 1], [0, 4]])
        _, transitions = play(env, state, [[RIGHT, LEFT], [STAY, LEFT], [STAY, STAY]])
        rewards = [transition.reward.tolist() for transition in transitions]
        np.testing.assert_allclose(rewards, [[alone, -0.05], [together] * 2, [together] * 2])

    @settings(deadline=None, max_examples=30)
    @given(seed=seeds)
    def test_the_mixed_return_counts_the_steps_before_arrival(self, seed):
        """Arriving with step k returns -0.05 (k - 1); never arriving, -0.05 for every step."""
        env = PredatorPrey(size=4, num_predators=3, max_steps=40)
        key, action_key = jax.random.split(jax.random.key(seed))
        states, transition = play_recorded(
            env, reset(env, key), random_actions(env, action_key, (40,))
        )
        steps_before_arrival = (~states.reached).sum(0)
        np.testing.assert_allclose(
            transition.reward.sum(0), -0.05 * steps_before_arrival, atol=1e-5
        )


class TestEnd:
    def test_mixed_terminates_when_the_last_agent_arrives(self):
        env = duo()
        state = start(env, agents=[[0, 1], [0, 4]])
        _, transitions = play(env, state, [[RIGHT, LEFT], [STAY, LEFT]])
        assert [t.terminated.item() for t in transitions] == [False, True]
        assert [t.success.item() for t in transitions] == [False, True]
        assert not any(t.truncated for t in transitions)

    @pytest.mark.parametrize("mode", ["cooperative", "competitive"])
    def test_the_other_modes_run_to_the_step_limit(self, mode):
        env = duo(reward_mode=mode, max_steps=4)
        state = start(env, agents=[[0, 1], [0, 3]])
        _, transitions = play(env, state, [[RIGHT, LEFT]] + [[STAY, STAY]] * 3)
        assert not any(t.terminated for t in transitions)
        assert [t.truncated.item() for t in transitions] == [False, False, False, True]
        assert all(t.success for t in transitions)

    def test_the_step_limit_truncates_a_team_that_is_not_done(self):
        env = duo(max_steps=3)
        _, transitions = play(env, start(env), [[STAY, STAY]] * 3)
        assert [t.truncated.item() for t in transitions] == [False, False, True]
        assert not any(t.terminated | t.success for t in transitions)

    def test_past_the_step_limit_every_step_is_cut_off_until_the_team_is_done(self):
        """Whoever steps on, or comes with a state of a longer limit, is told."""
        env = duo(max_steps=2)
        late = start(env, agents=[[0, 1], [0, 3]]).replace(time=jnp.int32(7))
        _, transitions = play(env, late, [[STAY, STAY], [RIGHT, STAY], [STAY, LEFT]])
        assert [t.steps_taken.item() for t in transitions] == [8, 9, 10]
        assert [t.truncated.item() for t in transitions] == [True, True, False]
        assert [t.terminated.item() for t in transitions] == [False, False, True]

    def test_success_with_the_last_allowed_step_is_an_end_not_a_cut(self):
        env = duo(max_steps=2)
        state = start(env, agents=[[0, 1], [0, 4]])
        _, transitions = play(env, state, [[RIGHT, LEFT], [STAY, LEFT]])
        last = transitions[-1]
        assert last.terminated
        assert last.success
        assert not last.truncated
        assert last.steps_taken == env.max_steps

    def test_steps_taken_counts_this_step(self):
        env = duo()
        states, transitions = play(env, start(env), [[STAY, STAY]] * 3)
        assert [t.steps_taken.item() for t in transitions] == [1, 2, 3]
        assert [state.time.item() for state in states] == [0, 1, 2, 3]


class TestObservation:
    def test_the_state_tensor_is_the_own_cell(self):
        env = duo(size=(3, 4))
        state = start(env, agents=[[0, 1], [2, 3]], prey=(1, 1))
        seen = env.observe(state)
        assert seen.state.shape == (2, *env.state_shape) == (2, 1, 3, 4)
        assert seen.state.dtype == jnp.float32
        assert jnp.argwhere(seen.state[:, 0]).tolist() == [[0, 0, 1], [1, 2, 3]]

    def test_the_view_counts_predators_and_prey_around_the_agent(self):
        env = PredatorPrey(size=5, num_predators=3, vision=1)
        state = start(env, agents=[[2, 2], [2, 2], [1, 3]], prey=(3, 2))
        seen = view(env, state)
        assert seen.shape == (3, *env.view_shape) == (3, 2, 3, 3)
        assert seen[0, 0].tolist() == [
            [0, 0, 1],
            [0, 2, 0],
            [0, 0, 0],
        ]  # itself included, unclipped
        assert seen[0, 1].tolist() == [[0, 0, 0], [0, 0, 0], [0, 1, 0]]
        assert seen[2, 0].tolist() == [[0, 0, 0], [0, 1, 0], [2, 0, 0]]

    def test_cells_outside_are_minus_one_in_every_channel(self):
        env = duo(size=(2, 5))
        seen = view(env, start(env, agents=[[0, 0], [1, 4]], prey=(0, 2)))
        outside = np.array([[-1, -1, -1], [-1, 0, 0], [-1, 0, 0]])
        np.testing.assert_array_equal(seen[0, 1], outside)
        np.testing.assert_array_equal(seen[1, 1], outside[::-1, ::-1])
        np.testing.assert_array_equal(seen[:, 0], seen[:, 1] + np.pad([[1.0]], 1))

    def test_the_prey_stays_visible_after_it_was_reached(self):
        env = duo()
        states, _ = play(env, start(env, agents=[[0, 1], [4, 4]]), [[RIGHT, STAY], [STAY, STAY]])
        assert all(view(env, state)[0, 1, 1, 1] == 1 for state in states[1:])

    def test_without_vision_an_agent_sees_its_own_cell(self):
        env = duo(vision=0)
        states, _ = play(env, start(env, agents=[[0, 1], [4, 4]]), [[RIGHT, STAY]])
        assert view(env, states[0]).tolist() == [[[[1]], [[0]]], [[[1]], [[0]]]]
        assert view(env, states[1]).tolist() == [[[[1]], [[1]]], [[[1]], [[0]]]]

    def test_observe_is_the_table_by_index_and_the_view(self):
        env = PredatorPrey(size=(3, 4), num_predators=4)
        state = reset(env, jax.random.key(3))
        seen = env.observe(state)
        np.testing.assert_array_equal(env.state_table()[env.state_index(state)], seen.state)
        np.testing.assert_array_equal(env.view(state), seen.view)


class TestSymmetry:
    @settings(deadline=None, max_examples=25)
    @given(seed=seeds, mode=st.sampled_from(MODES), symmetry=symmetries)
    def test_a_turned_or_mirrored_grid_is_the_same_task(self, seed, mode, symmetry):
        env = PredatorPrey(size=4, num_predators=3, reward_mode=mode)
        state, actions = random_moment(env, seed)
        after, transition = step(env, state, actions)
        turned = symmetry.state(state, side=4)
        turned_after, turned_transition = step(env, turned, symmetry.actions(actions))
        assert_same(turned_after, symmetry.state(after, side=4))
        assert_same(turned_transition, transition)
        np.testing.assert_array_equal(view(env, turned_after), symmetry.windows(view(env, after)))

    @settings(deadline=None, max_examples=25)
    @given(seed=seeds, mode=st.sampled_from(MODES), order=st.permutations(range(3)))
    def test_agents_are_interchangeable(self, seed, mode, order):
        env = PredatorPrey(size=4, num_predators=3, reward_mode=mode)
        order = np.array(order)
        state, actions = random_moment(env, seed)
        after, transition = step(env, state, actions)
        other_after, other_transition = step(env, reorder(state, order), np.asarray(actions)[order])
        assert_same(other_after, reorder(after, order))
        assert_same(
            other_transition, transition.replace(reward=np.asarray(transition.reward)[order])
        )
        np.testing.assert_array_equal(view(env, other_after), np.asarray(view(env, after))[order])


class TestFunctions:
    """Traced, batched, scanned or called eagerly, as a method or as a function: one result."""

    ENV = PredatorPrey(size=5, num_predators=3, max_steps=6)

    def recorded(self, seed: int = 0):
        key, action_key = jax.random.split(jax.random.key(seed))
        return reset(self.ENV, key), random_actions(self.ENV, action_key, (6,))

    def test_eager_compiled_and_scanned_agree(self):
        state, actions = self.recorded()
        states, transitions = play_recorded(self.ENV, state, actions)
        for t, action in enumerate(actions):
            state, transition = self.ENV.step(state, action)
            assert_same(state, take(states, t))
            assert_same(transition, take(transitions, t))
            np.testing.assert_array_equal(self.ENV.view(state), view(self.ENV, state))

    def test_batched_environments_do_not_mix(self):
        states = reset_many(self.ENV, jax.random.key(1), 8)
        actions = random_actions(self.ENV, jax.random.key(2), (8,))
        together = jax.jit(jax.vmap(self.ENV.step))(states, actions)
        views = jax.jit(jax.vmap(self.ENV.view))(states)
        for e in range(8):
            assert_same(step(self.ENV, take(states, e), actions[e]), take(together, e))
            np.testing.assert_array_equal(view(self.ENV, take(states, e)), views[e])

    def test_wide_numbers_change_nothing(self):
        """With 64-bit types on, not even the types of the results."""
        state, actions = self.recorded()
        narrow = reset(self.ENV, jax.random.key(7)), play_recorded(self.ENV, state, actions)
        with jax.enable_x64(True):
            wide = reset(self.ENV, jax.random.key(7)), play_recorded(self.ENV, state, actions)
            wide_view = view(self.ENV, wide[0])
        assert_same(wide, narrow)
        np.testing.assert_array_equal(wide_view, view(self.ENV, narrow[0]), strict=True)

    def test_methods_are_the_importable_functions(self):
        key = jax.random.key(5)
        state, actions = self.recorded()
        assert_same(predator_prey.reset(self.ENV, key), self.ENV.reset(key))
        assert_same(
            predator_prey.step(self.ENV, state, actions[0]), self.ENV.step(state, actions[0])
        )
        assert_same(predator_prey.observe(self.ENV, state), self.ENV.observe(state))

    def test_a_scan_keeps_shapes_and_types_and_traces_the_step_once(self):
        traced = []

        @jax.jit
        def run(state, actions):
            def one_step(state, action):
                traced.append(action)
                return self.ENV.step(state, action)

            return jax.lax.scan(one_step, state, actions)

        for seed in (0, 1):
            run(*self.recorded(seed))
        assert len(traced) == 1

    def test_configurations_are_values(self):
        assert PredatorPrey(size=5) == PredatorPrey(size=5)
        assert hash(PredatorPrey(size=5)) == hash(PredatorPrey(size=5))
        assert PredatorPrey(size=5) != PredatorPrey(size=6)
        assert PredatorPrey(size=[3, 4]) == PredatorPrey(size=(3, 4))
        assert str(PredatorPrey(size=np.int64(5))) == str(PredatorPrey(size=5))
        assert isinstance(PredatorPrey(), Environment)

    def test_agents_with_nothing_left_to_do_are_not_active(self):
        env = duo()
        states, _ = play(env, start(env, agents=[[0, 1], [4, 4]]), [[RIGHT, STAY]])
        assert [env.active(state).tolist() for state in states] == [[True, True], [False, True]]


class TestMistakes:
    @pytest.mark.parametrize(
        ("changes", "sentence"),
        [
            ({"size": 0}, "size must be a positive int or (rows, columns), got 0."),
            ({"size": (5,)}, "size must be a positive int or (rows, columns), got (5,)."),
            ({"num_predators": -1}, "num_predators must be at least 0, got -1."),
            (
                {"num_predators": 0},
                "the team is empty; give at least one predator or capture agent.",
            ),
            ({"num_predators": 2.0}, "num_predators must be a whole number, got 2.0."),
            ({"max_steps": 0}, "max_steps must be at least 1, got 0."),
            ({"max_steps": 2**31}, "max_steps must be at most 2147483647, got 2147483648."),
            (
                {"size": (3, 2**14)},
                "the 3x16384 grid is too large; its sides have at most 16383 cells.",
            ),
            ({"vision": -1}, "vision must be at least 0, got -1."),
            (
                {"vision": 5},
                "vision 5 must be smaller than the sides of the 5x5 grid; use at most 4.",
            ),
            (
                {"size": 2, "num_predators": 4},
                "4 agents and a prey need 5 distinct cells, but a 2x2 grid has 4; "
                "use fewer agents or a larger grid.",
            ),
            (
                {"reward_mode": "shared"},
                "reward_mode 'shared' is unknown; choose one of mixed, cooperative, competitive.",
            ),
        ],
    )
    def test_a_bad_configuration_is_named_in_one_sentence(self, changes, sentence):
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
            PredatorPrey(**changes)

    @pytest.mark.parametrize(
        ("agents", "prey", "sentence"),
        [
            ([[0, 0], [5, 1]], (2, 2), "agent cell (5, 1) lies outside the 5x5 grid; "),
            ([[0, 0], [1, 1]], (0, -1), "prey cell (0, -1) lies outside the 5x5 grid; "),
            ([[0, 0], [2, 2]], (2, 2), "an agent starts on the prey at (2, 2); "),
            (
                [[0, 0]],
                (2, 2),
                "state_at needs agents of shape (2, 2) and prey of shape (2,), got ",
            ),
            ([[0, 0], [1, 1]], 2, "state_at needs agents of shape (2, 2) and prey of shape (2,), "),
        ],
    )
    def test_an_impossible_start_is_refused(self, agents, prey, sentence):
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}"):
            duo().state_at(agents, prey)

    def test_a_traced_start_is_taken_as_it_is(self):
        env = duo()
        state = jax.jit(env.state_at)(jnp.array([[0, 0], [1, 1]]), jnp.array([2, 2]))
        assert_same(state, env.state_at([[0, 0], [1, 1]], [2, 2]))

    @pytest.mark.parametrize(
        ("actions", "sentence"),
        [
            ([0, CAPTURE], "action 5 of agent 1 is not one of the 5 actions 0..4."),
            ([-1, 0], "action -1 of agent 0 is not one of the 5 actions 0..4."),
            ([0], "step needs one action per agent, shape (2,), got (1,)."),
            ([0.5, 1.0], "actions are whole numbers, got an array of float32."),
        ],
    )
    def test_a_bad_action_is_named_in_one_sentence(self, actions, sentence):
        env = duo()
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
            env.step(start(env), jnp.array(actions))

    def test_a_traced_action_out_of_range_stays(self):
        env = duo()
        ((_, after), _), ((_, stayed), _) = (
            play(env, start(env), [actions]) for actions in ([CAPTURE, -1], [STAY, STAY])
        )
        assert_same(after, stayed)

    @pytest.mark.parametrize("field", ["num_capturers", "capture_reward", "capture_vision"])
    def test_it_has_no_settings_for_capture_agents(self, field):
        with pytest.raises(TypeError, match=field):
            PredatorPrey(**{field: 1})


class TestReferenceLevels:
    """Steps taken by policies that need no learning: section 4 of the rules the package follows.

    6000 episodes on either side; an earlier step limit is read off the same episodes.
    """

    @pytest.mark.parametrize(
        ("size", "num_predators", "limit", "steps", "error", "success"),
        [
            (5, 3, 20, 19.83, 0.02, 0.032),
            (5, 3, 80, 68.93, 0.24, 0.369),
            (5, 3, 200, 112.8, 0.8, 0.824),
            (10, 5, 40, 40.00, 0.0, 0.0),
            (10, 5, 80, 79.98, 0.01, 0.002),
            (10, 5, 200, 198.47, 0.14, 0.033),
        ],
    )
    def test_uniform_random(self, size, num_predators, limit, steps, error, success):
        length = random_lengths(PredatorPrey(size, num_predators, max_steps=200))
        assert_level(length, limit, steps, error, success)

    @pytest.mark.parametrize(("size", "num_predators", "steps"), [(5, 3, 4.65), (10, 5, 10.38)])
    def test_shortest_paths(self, size, num_predators, steps):
        assert_shortest_paths(PredatorPrey(size, num_predators, max_steps=40), steps)

    def test_the_bound_is_what_shortest_paths_take(self):
        assert_bound_is_reached(PredatorPrey(size=(4, 7), num_predators=3, max_steps=40))
