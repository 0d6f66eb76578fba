"""What is kept of an episode: by the rules of the task, step by step, and whose messages."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_episodes import episode

from sumajax.environments import PredatorCapturePrey, PredatorPrey, Wrapper
from sumajax.environments.grid import move
from sumajax.policies import Policy, PolicyModule, PolicyOutput, TeamSpec, make_policy
from sumajax.policies.types import decide
from sumajax.reporting import record_episode
from sumajax.reporting import replay as module
from sumajax.upsampling import StateUpsampled

moved_on_3x3 = jax.jit(lambda agents, actions: move(agents, actions, (3, 3)))


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
        assert (shown.prey == shown.prey[0]).all()
        prey = shown.prey[:, None]
        assert shown.success == bool((shown.agents[-1] == prey[-1]).all())
        assert shown.success or shown.num_steps == 30
        assert not (shown.agents == prey)[:-1].all((1, 2)).any()
        for t in range(shown.num_steps):
            moved = np.asarray(moved_on_3x3(shown.agents[t], shown.actions[t]))
            still = np.where(shown.reached[t][:, None], shown.agents[t], moved)
            np.testing.assert_array_equal(shown.agents[t + 1], still)
        on_prey = (shown.agents == prey).all(-1)
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


def test_a_prey_that_moves_is_recorded_where_it_is():
    """And a grid seen at another size, however often, is recorded at its own."""

    @dataclass(frozen=True)
    class Fleeing(PredatorPrey):
        def step(self, state, actions):
            state, transition = super().step(state, actions)
            return state.replace(prey=(state.prey + jnp.array([0, 1])) % 5), transition

    env = StateUpsampled(StateUpsampled(Fleeing(size=5, num_predators=1, max_steps=4), 10), 20)
    policy = make_policy("iric", env, hidden=4, encoder="linear")
    shown = record_episode(env, policy, jax.jit(policy.init)(jax.random.key(0)), jax.random.key(1))
    assert shown.size == (5, 5)
    assert shown.prey.shape == (shown.num_steps + 1, 2)
    moved = (shown.prey[1:] - shown.prey[:-1]) % 5
    np.testing.assert_array_equal(moved, [[0, 1]] * shown.num_steps)


def test_any_task_can_be_recorded():
    """Its own states, for a drawing of its own."""

    @dataclass(frozen=True)
    class Bare(Wrapper):
        def reset(self, key):
            return {"inside": self.env.reset(key), "key": key}

        def step(self, state, actions):
            inside, transition = self.env.step(state["inside"], actions)
            return {"inside": inside, "key": state["key"]}, transition

        def observe(self, state):
            return self.env.observe(state["inside"])

    env = Bare(PredatorPrey(size=3, num_predators=2, max_steps=5))
    policy = make_policy("iric", env, hidden=4, encoder="linear")
    params = jax.jit(policy.init)(jax.random.key(0))
    recording = module.record(env, policy, params, jax.random.key(1))
    steps = len(recording.actions)
    np.testing.assert_array_equal(recording.states["inside"].time, np.arange(steps + 1))
    assert recording.states["key"].shape == (steps + 1,)
    assert recording.reward.shape == (steps, 2)
    assert recording.success == (steps < 5)


def test_a_policy_of_another_team_is_refused_in_words():
    policy = make_policy("iric", PredatorPrey(size=3, num_predators=2), hidden=4)
    with pytest.raises(ValueError, match="made for another task: agent_class"):
        record_episode(PredatorPrey(size=3), policy, {}, jax.random.key(0))


def test_a_prey_given_once_stands_still():
    np.testing.assert_array_equal(episode(steps=3).prey, [[4, 1]] * 4)


def test_an_episode_checks_its_shapes():
    with pytest.raises(ValueError, match=r"attention of an episode of 3 steps and 3 agents"):
        episode(attention=np.zeros((3, 2, 2)))


def test_recorded_arrows_leave_talkers_only(recorded):
    _, episodes, _ = recorded
    for shown in episodes:
        for t in range(shown.num_steps):
            for sender, receiver, weight in module.messages(shown, t):
                assert shown.communication[t, sender] == 1
                assert weight == shown.attention[t, receiver, sender]
