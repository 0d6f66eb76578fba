"""Predator-Capture-Prey as its rules say: what capture agents add to Predator-Prey."""

import re
from dataclasses import replace

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
    step,
    symmetries,
    take,
    view,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from sumajax.environments import Environment, PredatorCapturePrey, PredatorPrey
from sumajax.environments.grid import CAPTURE, DOWN, LEFT, RIGHT, STAY, UP

seeds = st.integers(0, 2**31 - 1)


def pair(**changes) -> PredatorCapturePrey:
    """One predator and one capture agent."""
    settings = {"size": 5, "num_predators": 1, "num_capturers": 1, "max_steps": 10}
    return PredatorCapturePrey(**settings | changes)


def start(env, agents=((0, 1), (0, 3)), prey=(0, 2)):
    return env.state_at(jnp.array(agents), jnp.array(prey))


ARRIVE, BOTH_CAPTURE, BOTH_STAY = [RIGHT, LEFT], [CAPTURE, CAPTURE], [STAY, STAY]


class TestTeam:
    def test_predators_come_first(self):
        env = PredatorCapturePrey(num_predators=2, num_capturers=3)
        assert env.num_agents == 5
        assert env.agent_class.tolist() == [0, 0, 1, 1, 1]

    def test_only_capture_agents_may_capture(self):
        env = PredatorCapturePrey(num_predators=2, num_capturers=1)
        assert env.num_actions == 6
        assert env.action_mask.sum(-1).tolist() == [5, 5, 6]
        assert env.action_mask[:, CAPTURE].tolist() == [False, False, True]

    def test_capture_agents_are_blind_unless_told_otherwise(self):
        assert pair().sighted_classes == (True, False)
        assert pair(capture_vision=0).sighted_classes == (True, True)
        assert isinstance(pair(), Environment)

    def test_a_team_may_be_of_one_class_alone(self):
        hunters = PredatorCapturePrey(size=5, num_predators=0, num_capturers=2)
        state = start(hunters)
        _, transitions = play(hunters, state, [ARRIVE, BOTH_CAPTURE])
        assert [t.terminated.item() for t in transitions] == [False, True]


class TestCapture:
    def test_it_takes_one_step_more_than_the_way(self):
        """The capture counts only from the prey's cell as it was before the step."""
        env = pair()
        states, transitions = play(env, start(env), [ARRIVE, BOTH_CAPTURE])
        assert [state.captured.tolist() for state in states] == [[True, False]] * 2 + [[True] * 2]
        assert [t.terminated.item() for t in transitions] == [False, True]
        assert env.shortest_steps(states[0]) == 2
        assert [env.shortest_steps(state).item() for state in states[1:]] == [1, 0]

    @pytest.mark.parametrize("mode", ["mixed", "cooperative", "competitive"])
    def test_elsewhere_it_is_a_stay_without_a_penalty(self, mode):
        env = pair(reward_mode=mode)
        capture, stay = (play(env, start(env), [plan]) for plan in (BOTH_CAPTURE, BOTH_STAY))
        assert_same(capture, stay)

    def test_for_a_predator_it_is_a_stay_even_on_the_prey(self):
        env = pair()
        plan = [[RIGHT, STAY], [CAPTURE, STAY], [CAPTURE, STAY]]
        capture = play(env, start(env), plan)
        stay = play(env, start(env), [[RIGHT, STAY], BOTH_STAY, BOTH_STAY])
        assert_same(capture, stay)

    def test_on_the_prey_nothing_but_capturing_is_left_to_do(self):
        env = pair()
        plan = [ARRIVE, [STAY, UP], [STAY, DOWN], [STAY, RIGHT], [STAY, STAY]]
        states, transitions = play(env, start(env), plan)
        assert all(state.agents[1].tolist() == [0, 2] for state in states[1:])
        assert not any(t.success for t in transitions)

    def test_the_prey_stays_where_everybody_can_see_it(self):
        env = pair()
        plan = [[STAY, LEFT], [STAY, CAPTURE], [RIGHT, STAY]]
        states, _ = play(env, start(env), plan)
        prey_channel = [view(env, state)[0, 2].tolist() for state in states]
        ahead = [[-1, -1, -1], [0, 0, 1], [0, 0, 0]]
        assert prey_channel == [ahead] * 3 + [[[-1, -1, -1], [0, 1, 0], [0, 0, 0]]]

    def test_active_agents_have_something_left_to_do(self):
        env = pair()
        states, _ = play(env, start(env), [ARRIVE, BOTH_CAPTURE])
        active = [env.active(state).tolist() for state in states]
        assert active == [[True, True], [False, True], [False, False]]
        assert all(env.alive(state).all() for state in states)  # they are still there


class TestEnd:
    def test_every_capture_agent_must_capture(self):
        env = PredatorCapturePrey(size=5, num_predators=0, num_capturers=2)
        plan = [ARRIVE, [CAPTURE, STAY], BOTH_STAY, [STAY, CAPTURE]]
        _, transitions = play(env, start(env), plan)
        assert [t.terminated.item() for t in transitions] == [False, False, False, True]
        assert [t.success.item() for t in transitions] == [False, False, False, True]

    def test_every_predator_must_arrive(self):
        env = pair()
        plan = [[STAY, LEFT], [STAY, CAPTURE], [RIGHT, STAY]]
        _, transitions = play(env, start(env), plan)
        assert [t.terminated.item() for t in transitions] == [False, False, True]

    @pytest.mark.parametrize("mode", ["cooperative", "competitive"])
    def test_the_other_modes_run_on_with_success(self, mode):
        """HetNet's program calls no cooperative team successful; ours is when its work is done."""
        env = pair(reward_mode=mode, max_steps=3)
        _, transitions = play(env, start(env), [ARRIVE, BOTH_CAPTURE, BOTH_STAY])
        assert [t.success.item() for t in transitions] == [False, True, True]
        assert [t.truncated.item() for t in transitions] == [False, False, True]
        assert not any(t.terminated for t in transitions)

    def test_success_with_the_last_allowed_step_is_an_end_not_a_cut(self):
        env = pair(max_steps=2)
        last = play(env, start(env), [ARRIVE, BOTH_CAPTURE])[1][-1]
        assert last.terminated
        assert not last.truncated
        assert last.steps_taken == 2


class TestReward:
    @pytest.mark.parametrize(
        ("mode", "scheme", "rewards"),
        [
            # On the way, on the prey, captured; the predator, then the capture agent.
            ("mixed", "default", [[-0.05, -0.05], [0, -0.05], [0, 0]]),
            ("mixed", "second", [[-0.05, -0.05], [0, -0.025], [0, 0]]),
            ("cooperative", "default", [[-0.05, -0.05], [0.10, -0.05], [0.10, 0.10]]),
            ("cooperative", "second", [[-0.05, -0.05], [0.10, -0.025], [0.10, 0.10]]),
            ("competitive", "default", [[-0.05, -0.05], [0.025, -0.05], [0.025, 0.025]]),
            ("competitive", "second", [[-0.05, -0.05], [0.025, -0.025], [0.025, 0.025]]),
        ],
    )
    def test_a_capture_agent_is_paid_from_the_capturing_step_on(self, mode, scheme, rewards):
        env = pair(reward_mode=mode, capture_reward=scheme)
        _, transitions = play(env, start(env), [BOTH_STAY, ARRIVE, BOTH_CAPTURE])
        np.testing.assert_allclose([t.reward for t in transitions], rewards)

    def test_the_second_scheme_pays_as_usual_off_the_prey(self):
        env = pair(capture_reward="second")
        _, transitions = play(env, start(env), [[RIGHT, CAPTURE]])
        np.testing.assert_allclose(transitions[0].reward, [0, -0.05])

    @settings(deadline=None, max_examples=30)
    @given(seed=seeds)
    def test_the_mixed_return_counts_the_steps_before_an_agent_is_done(self, seed):
        """Done with step k returns -0.05 (k - 1): arrival, for a capture agent the capture."""
        env = PredatorCapturePrey(size=3, num_predators=2, num_capturers=2, max_steps=40)
        key, action_key = jax.random.split(jax.random.key(seed))
        actions = random_actions(env, action_key, (40,))
        states, transition = play_recorded(env, reset(env, key), actions)
        done = np.asarray(states.reached) & np.asarray(states.captured)
        returns = np.asarray(transition.reward).sum(0)
        np.testing.assert_allclose(returns, -0.05 * (~done).sum(0), atol=1e-5)


def by_definition(env, before, actions, after):
    """Rewards (N,), terminated, truncated and success of a step, agent by agent."""
    before, after, rewards = take_all(before), take_all(after), []
    there = [(agent == after.prey).all() for agent in after.agents]
    done = []
    for i, agent_class in enumerate(env.agent_class):
        stood_there = (before.agents[i] == before.prey).all()
        captures = agent_class == 0 or before.captured[i] or (stood_there and actions[i] == CAPTURE)
        done.append(there[i] and captures)
        team = {"mixed": 0, "cooperative": 0.05 * sum(there)}
        team["competitive"] = 0.05 / max(sum(there), 1)
        waits = -0.025 if env.capture_reward == "second" and there[i] else -0.05
        rewards.append(team[env.reward_mode] if done[i] else waits)
    terminated = env.reward_mode == "mixed" and all(done)
    truncated = before.time + 1 >= env.max_steps and not terminated
    return rewards, terminated, truncated, all(done)


def take_all(tree):
    return jax.tree.map(np.asarray, tree)


class TestDefinition:
    @settings(deadline=None, max_examples=40)
    @given(
        seed=seeds,
        mode=st.sampled_from(["mixed", "cooperative", "competitive"]),
        scheme=st.sampled_from(["default", "second"]),
    )
    def test_rewards_and_ends(self, seed, mode, scheme):
        """Of a step in the middle of an episode, on a grid so small that most have arrived."""
        env = PredatorCapturePrey((2, 2), 2, 1, reward_mode=mode, capture_reward=scheme)
        env = replace(env, max_steps=13)
        state, actions = random_moment(env, seed)
        after, transition = step(env, state, actions)
        rewards, terminated, truncated, success = by_definition(env, state, actions, after)
        np.testing.assert_allclose(transition.reward, rewards, atol=1e-6)
        assert transition.terminated == terminated
        assert transition.truncated == truncated
        assert transition.success == success


class TestObservation:
    def test_channels_are_predators_capture_agents_and_prey(self):
        env = PredatorCapturePrey(size=5, num_predators=2, num_capturers=2)
        state = start(env, agents=[[2, 2], [2, 3], [1, 2], [1, 2]], prey=(3, 3))
        seen = view(env, state)
        assert seen.shape == (4, *env.view_shape) == (4, 3, 3, 3)
        assert seen[0, 0].tolist() == [[0, 0, 0], [0, 1, 1], [0, 0, 0]]
        assert seen[0, 1].tolist() == [[0, 2, 0], [0, 0, 0], [0, 0, 0]]
        assert seen[0, 2].tolist() == [[0, 0, 0], [0, 0, 0], [0, 0, 1]]

    def test_a_blind_agent_reads_zeros_also_outside(self):
        env = pair()
        seen = view(env, start(env, agents=[[0, 0], [4, 4]]))
        assert not seen[1].any()
        assert (seen[0] == -1).sum() == 3 * 5

    def test_a_blind_agent_hides_nothing_from_the_others(self):
        """In HetNet's program the cells around a blind agent vanish for everybody near it."""
        env = pair()
        seen = view(env, start(env, agents=[[2, 2], [2, 3]], prey=(2, 1)))
        assert seen[0, 1, 1, 2] == 1
        assert seen[0, 2, 1, 0] == 1

    @pytest.mark.parametrize("capture_vision", [0, 1, 2])
    def test_a_capture_agent_with_some_vision_sees_the_middle_of_its_window(self, capture_vision):
        env = pair(vision=2, capture_vision=capture_vision)
        everything = pair(vision=2, capture_vision=2)
        state = start(env, agents=[[1, 2], [2, 2]], prey=(2, 3))
        middle = slice(2 - capture_vision, 3 + capture_vision)
        mine, full = view(env, state), np.asarray(view(everything, state))
        expected = np.full((3, 5, 5), -1.0)
        expected[:, middle, middle] = full[1, :, middle, middle]
        np.testing.assert_array_equal(mine[1], expected)
        np.testing.assert_array_equal(mine[0], full[0])
        assert full[1, :, 2, 2].tolist() == [0, 1, 0]

    def test_the_state_tensor_is_the_own_cell_also_of_the_blind(self):
        env = pair(size=(2, 4))
        seen = env.observe(start(env, agents=[[0, 0], [1, 3]]))
        assert jnp.argwhere(seen.state[:, 0]).tolist() == [[0, 0, 0], [1, 1, 3]]


class TestSymmetry:
    ENV = PredatorCapturePrey(size=4, num_predators=2, num_capturers=2, capture_reward="second")

    @settings(deadline=None, max_examples=25)
    @given(seed=seeds, symmetry=symmetries)
    def test_a_turned_or_mirrored_grid_is_the_same_task(self, seed, symmetry):
        state, actions = random_moment(self.ENV, seed)
        after, transition = step(self.ENV, state, actions)
        turned_after, turned_transition = step(
            self.ENV, symmetry.state(state, side=4), symmetry.actions(actions)
        )
        assert_same(turned_after, symmetry.state(after, side=4))
        assert_same(turned_transition, transition)
        turned_view = symmetry.windows(view(self.ENV, after))
        np.testing.assert_array_equal(view(self.ENV, turned_after), turned_view)

    @settings(deadline=None, max_examples=25)
    @given(seed=seeds, predators=st.permutations([0, 1]), capturers=st.permutations([2, 3]))
    def test_agents_of_a_class_are_interchangeable(self, seed, predators, capturers):
        order = np.array(predators + capturers)
        state, actions = random_moment(self.ENV, seed)
        after, transition = step(self.ENV, state, actions)
        other_after, other_transition = step(
            self.ENV, reorder(state, order), np.asarray(actions)[order]
        )
        assert_same(other_after, reorder(after, order))
        reward = np.asarray(transition.reward)[order]
        assert_same(other_transition, transition.replace(reward=reward))
        seen = np.asarray(view(self.ENV, after))[order]
        np.testing.assert_array_equal(view(self.ENV, other_after), seen)


@pytest.mark.parametrize("mode", ["mixed", "cooperative", "competitive"])
def test_without_capture_agents_it_is_predator_prey(mode):
    common = {"size": 4, "num_predators": 3, "vision": 1, "max_steps": 25, "reward_mode": mode}
    pcp, pp = PredatorCapturePrey(num_capturers=0, **common), PredatorPrey(**common)
    key = jax.random.key(0)
    state, actions = reset(pp, key), random_actions(pp, key, (25,))
    assert_same(reset(pcp, key), state)
    (states, transitions), theirs = (
        play_recorded(pp, state, actions),
        play_recorded(pcp, state, actions),
    )
    assert_same(theirs, (states, transitions))
    for t in (0, 12, 24):
        three, two = view(pcp, take(states, t)), view(pp, take(states, t))
        np.testing.assert_array_equal(three[:, [0, 2]], two)
        np.testing.assert_array_equal(three[:, 1], np.minimum(two[:, 1], 0))


class TestMistakes:
    @pytest.mark.parametrize(
        ("changes", "sentence"),
        [
            ({"num_capturers": -1}, "num_capturers must be at least 0, got -1."),
            (
                {"num_predators": 0, "num_capturers": 0},
                "the team is empty; give at least one predator or capture agent.",
            ),
            (
                {"capture_reward": "half"},
                "capture_reward 'half' is unknown; choose one of default, second.",
            ),
            ({"capture_vision": 0.5}, "capture_vision must be a whole number, got 0.5."),
            (
                {"capture_vision": 2},
                "capture_vision 2 must lie between 0 and vision 1, "
                "or be None for blind capture agents.",
            ),
            (
                {"capture_vision": -1},
                "capture_vision -1 must lie between 0 and vision 1, "
                "or be None for blind capture agents.",
            ),
        ],
    )
    def test_a_bad_configuration_is_named_in_one_sentence(self, changes, sentence):
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
            PredatorCapturePrey(**changes)

    def test_there_is_no_seventh_action(self):
        env = pair()
        sentence = "action 6 of agent 1 is not one of the 6 actions 0..5."
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
            env.step(start(env), jnp.array([0, 6]))


class TestReferenceLevels:
    """As for Predator-Prey; capture agents choose among six actions and need one step more."""

    @pytest.mark.parametrize(
        ("team", "limit", "steps", "error", "success"),
        [
            ((5, 2, 1), 80, 70.78, 0.22, 0.325),
            ((5, 2, 1), 200, 119.8, 0.8, 0.793),
            ((10, 2, 1), 80, 79.72, 0.05, 0.013),
            ((10, 2, 1), 200, 193.77, 0.30, 0.101),
            ((10, 3, 2), 80, 79.99, 0.01, 0.001),
            ((10, 3, 2), 200, 198.87, 0.11, 0.027),
        ],
    )
    def test_uniform_random(self, team, limit, steps, error, success):
        length = random_lengths(PredatorCapturePrey(*team, max_steps=200))
        assert_level(length, limit, steps, error, success)

    @pytest.mark.parametrize(
        ("team", "steps"), [((5, 2, 1), 5.06), ((10, 2, 1), 9.75), ((10, 3, 2), 10.83)]
    )
    def test_shortest_paths(self, team, steps):
        assert_shortest_paths(PredatorCapturePrey(*team), steps)

    def test_the_bound_is_what_shortest_paths_take(self):
        assert_bound_is_reached(PredatorCapturePrey((4, 7), 2, 2, max_steps=40))
