"""A critic of its own: shown the true state, sharing nothing with the policy."""

from dataclasses import dataclass
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beginnings import begun
from probes import LastStepReward, Probe, ProbeState
from trajectories import TINY_TASK, tiny_learner

from sumajax.environments import PredatorCapturePrey, PredatorPrey, TrafficJunction
from sumajax.environments.traffic_junction import CRITIC_AHEAD, CRITIC_BEHIND
from sumajax.learning import make_learner, preset
from sumajax.learning.critic import init_critic, shown, values
from sumajax.learning.rollout import start
from sumajax.policies import make_policy
from sumajax.policies.ic3net import IC3Net
from sumajax.policies.types import PolicyModule
from sumajax.upsampling import StateUpsampled

SHORT = {"num_envs": 20, "rollout_length": 10, "critic": "state"}  # 100 updates an epoch


@dataclass(frozen=True)
class HiddenCue(LastStepReward):
    """Pays the cue, which only a critic is shown, at the second of two steps."""

    def reward(self, state, actions):
        return super().reward(state, actions) * state.cue

    def critic_features(self, state):
        return jnp.stack([state.cue, state.time]).astype(jnp.float32)[None]


@cache
def updated(policy="ic3net", **changes):
    """A tiny learner's start, the state after an update, and the compiled update."""
    learner = tiny_learner(TINY_TASK, policy, **SHORT, **changes)
    start, update = begun(learner), jax.jit(learner.update)
    return start, update(start)[0], update


def moved(before, after):
    return any(
        (np.asarray(a) != b).any()
        for a, b in zip(*map(jax.tree.leaves, (before, after)), strict=True)
    )


class TestWhatItLearns:
    @pytest.mark.parametrize("policy", ["ic3net", "hetnet"])
    def test_its_error_never_reaches_the_policy(self, policy):
        start, end, _ = updated(policy, policy_weight=0.0, entropy_weight=0.0)
        assert not moved(start.params, end.params)
        assert moved(start.critic.params, end.critic.params)

    def test_the_policy_does_not_learn_from_its_own_value_any_more(self):
        start, end, _ = updated()
        core = [tree["params"]["core"] for tree in (start.params, end.params)]
        assert moved(*(tree["action"] for tree in core))
        assert not moved(*(tree["value"] for tree in core))

    def test_alone_at_first(self):
        start, middle, update = updated(critic_epochs=1)
        assert not moved(start.params, middle.params)
        assert moved(start.critic.params, middle.critic.params)
        end, _ = update(middle.replace(updates=jnp.int32(100)))
        assert moved(start.params, end.params)

    def test_it_knows_what_no_agent_sees(self):
        env = HiddenCue()
        config = preset("fast", "iric", critic="state", num_envs=50)
        learner = make_learner(env, make_policy("iric", env, hidden=4, encoder="linear"), config)
        state, _ = learner.train(begun(learner), 5)
        cue, time = jnp.array([0, 0, 1, 1]), jnp.array([0, 1, 0, 1])
        actors = state.actors.replace(
            env_state=ProbeState(cue, time), carry=learner.policy.initial_carry((4,))
        )
        found = jax.jit(partial(values, env, learner.policy))(state.critic.params, actors)
        expected = [[0.0], [0.0], [config.gamma], [1.0]]
        np.testing.assert_allclose(found, expected, atol=0.05)

    def test_what_the_learner_did_without_it_stays(self):
        """The policy and its environments start as they do with the policy's own critic."""
        judged = tiny_learner(TINY_TASK, **SHORT)
        own = tiny_learner(TINY_TASK, **{**SHORT, "critic": "policy"})
        start, theirs = jax.jit(lambda key: (judged.init(key), own.init(key)))(jax.random.key(0))
        assert theirs.critic is None
        jax.tree.map(np.testing.assert_array_equal, start.params, theirs.params)
        jax.tree.map(np.testing.assert_array_equal, start.actors, theirs.actors)


class TestValues:
    @pytest.mark.parametrize("policy", ["ic3net", "magic", "hetnet", "tarmac"])
    @pytest.mark.parametrize("classes", [(3, 0), (2, 1)])
    def test_of_all_agents_from_the_true_state_and_what_they_remember(self, policy, classes):
        env = PredatorCapturePrey(4, *classes) if classes[1] else PredatorPrey(4, classes[0])
        made = make_policy(policy, env)

        @jax.jit
        def judged(keys):
            """Six teams, the third of them alone, and the six if all they remember is ones."""
            actors = start(env, made, keys)
            params = init_critic(env, made, actors, jax.random.key(1)).params
            one = jax.tree.map(lambda x: x[2:3], actors)
            remembering = actors.replace(carry=jax.tree.map(jnp.ones_like, actors.carry))
            return [values(env, made, params, x) for x in (actors, one, remembering)]

        found, alone, remembering = map(np.asarray, judged(jax.random.split(jax.random.key(0), 6)))
        assert found.shape == (6, 3)
        np.testing.assert_allclose(alone[0], found[2], rtol=1e-6)
        assert (remembering != found).all()

    def test_a_policy_that_does_not_say_what_it_remembers_is_judged_by_the_state(self):
        env = PredatorPrey(size=4, num_predators=3)
        made = make_policy("ic3net", env)
        actors = start(env, made, jax.random.split(jax.random.key(0), 6))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(IC3Net, "memory", PolicyModule.memory)
            seen = shown(env, made, actors)
        np.testing.assert_array_equal(seen, jax.vmap(env.critic_features)(actors.env_state))

    def test_the_same_parameters_judge_any_team_and_grid(self):
        learners = [
            tiny_learner(env, **SHORT) for env in (TINY_TASK, PredatorPrey(size=6, num_predators=5))
        ]
        shapes = [
            jax.tree.map(jnp.shape, jax.eval_shape(learner.init, jax.random.key(0)).critic)
            for learner in learners
        ]
        assert shapes[0] == shapes[1]

    def test_an_upsampled_task_shows_what_the_task_shows(self):
        env = PredatorPrey(size=4, num_predators=3)
        state = env.reset(jax.random.key(0))
        seen = StateUpsampled(env, 8).critic_features(state)
        np.testing.assert_array_equal(seen, env.critic_features(state))


class TestFeaturesOfPredatorCapturePrey:
    ENV = PredatorCapturePrey(size=10, num_predators=2, num_capturers=1)

    def test_worked_example(self):
        """Prey at (4, 4): a predator on it, one three cells off, a capture agent beside it."""
        env = self.ENV
        state = env.state_at([(4, 5), (4, 7), (5, 4)], (4, 4))
        state, _ = env.step(state, jnp.array([3, 4, 4]))
        near = [[1, 1, 1], [0.9**3, 0.97**3, 0.99**3], [0.9, 0.97, 0.99]]
        team = [(1 + 0.9**3 + 0.9) / 3, (1 + 0.97**3 + 0.97) / 3, 1, 1, 1 / 3, 1]
        expected = [
            [0.0, 0.0, *near[0], 1, 1, 1, 0, *team],
            [0.0, -0.3, *near[1], 0, 1, 0, 0, *team],
            [-0.1, 0.0, *near[2], 0, 0, 0, 1, *team],
        ]
        np.testing.assert_allclose(env.critic_features(state), expected, rtol=1e-5, atol=1e-6)

    def test_capture_agents_that_see(self):
        env = PredatorCapturePrey(num_predators=1, num_capturers=1, capture_vision=1)
        state = env.state_at([(0, 0), (3, 4)], (4, 4))
        sees, anybody = 7, 14
        features = env.critic_features(state)
        assert features[:, sees].tolist() == [0, 1]
        assert features[:, anybody].tolist() == [1, 1]


class TestFeaturesOfTrafficJunction:
    """Two cars on easy: one two cells before the crossing, one three; and an empty slot."""

    ENV = TrafficJunction("easy", num_cars=3, max_steps=8)
    CELLS = CRITIC_BEHIND + 1 + CRITIC_AHEAD
    CROSSING = 3

    def features(self):
        """(N, 5, cells): on its way; others there now, before it, with it, after it; (N, 6)."""
        env = self.ENV
        down, right = env.roads.first_places[:, 0]
        state = env.reset(jax.random.key(0)).replace(
            place=jnp.array([down + 1, right, env.roads.nowhere]),
            alive=jnp.array([True, True, False]),
            wait=jnp.array([2, 0, 0]),
            last_action=jnp.array([1, 0, 1]),
            time=jnp.int32(5),
        )
        features = np.asarray(env.critic_features(state))
        split = 5 * self.CELLS
        return features[:, :split].reshape(3, 5, self.CELLS), features[:, split:]

    def test_cells_of_the_own_way(self):
        way, length = self.features()[0][:, 0], 7
        for car, position in enumerate([1, 0]):
            on_it = position + np.arange(-CRITIC_BEHIND, CRITIC_AHEAD + 1)
            np.testing.assert_array_equal(way[car], (on_it >= 0) & (on_it < length))

    def test_who_gets_to_the_crossing_before_and_after(self):
        cells, _ = self.features()
        _, now, before, together, after = np.moveaxis(cells, 0, 1)
        assert not now.any()
        assert not together.any()
        expected = np.zeros((3, self.CELLS))
        expected[1, CRITIC_BEHIND + self.CROSSING] = 1
        np.testing.assert_array_equal(before, expected)
        expected = np.zeros((3, self.CELLS))
        expected[0, CRITIC_BEHIND + self.CROSSING - 1] = 1
        np.testing.assert_array_equal(after, expected)

    def test_of_itself_and_of_the_junction(self):
        _, rest = self.features()
        shared = [1 / 3, 0.3, 0.3]
        expected = [[0, 1, 0.2, *shared], [1, 0, 0, *shared], [0] * 6]
        np.testing.assert_allclose(rest, expected, rtol=1e-6)

    def test_who_is_behind(self):
        env = self.ENV
        down = env.roads.first_places[0, 0]
        state = env.reset(jax.random.key(0)).replace(
            place=jnp.array([down + 2, down + 1, env.roads.nowhere]),
            alive=jnp.array([True, True, False]),
        )
        cells = np.asarray(env.critic_features(state))[:, : 5 * self.CELLS].reshape(3, 5, -1)
        now = cells[:, 1]
        assert now[0].nonzero()[0].tolist() == [CRITIC_BEHIND - 1]
        assert now[1].nonzero()[0].tolist() == [CRITIC_BEHIND + 1]

    def test_as_many_on_every_junction(self):
        sizes = {
            jax.eval_shape(env.critic_features, jax.eval_shape(env.reset, jax.random.key(0))).shape
            for env in (TrafficJunction("medium", num_cars=3), TrafficJunction("hard", num_cars=3))
        }
        assert sizes == {(3, 5 * self.CELLS + 6)}


class TestErrors:
    def test_a_task_that_shows_nothing_is_refused(self):
        env = Probe()
        with pytest.raises(ValueError, match="Probe has no critic_features; use critic 'policy'"):
            make_learner(env, make_policy("iric", env), preset("fast", critic="state"))

    def test_the_loss_of_hetnet_has_critics_of_its_own(self):
        with pytest.raises(ValueError, match="loss 'hetnet' needs critic=policy"):
            preset("paper", "hetnet", critic="state")

    def test_unknown(self):
        with pytest.raises(ValueError, match="critic 'central' is unknown; choose one of policy, "):
            preset("fast", critic="central")
