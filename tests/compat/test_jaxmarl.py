"""JaxMARL's conventions, with and without JaxMARL."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax.compat import jaxmarl as compat
from sumajax.environments import PredatorCapturePrey, PredatorPrey, TrafficJunction
from sumajax.upsampling import StateUpsampled

PP = PredatorPrey(size=3, num_predators=2, max_steps=4)
PCP = PredatorCapturePrey(size=3, num_predators=1, num_capturers=1, max_steps=4)
TASKS = {"PP": PP, "PCP": PCP, "upsampled": StateUpsampled(PP, 6)}


@pytest.fixture(scope="module", params=TASKS)
def env(request):
    return compat.JaxMARLEnv(TASKS[request.param])


def stays(env):
    return {agent: jnp.int32(4) for agent in env.agents}


class TestSpaces:
    def test_are_alike_for_all_agents(self, env):
        assert env.agents == ["agent_0", "agent_1"] == list(env.observation_spaces)
        assert env.num_agents == 2
        for agent in env.agents:
            observation, action = env.observation_space(agent), env.action_space(agent)
            assert observation.shape == env.observation_space("agent_0").shape
            assert (action.n, action.shape) == (env.task.num_actions, ())
            assert 0 <= int(action.sample(jax.random.key(0))) < action.n
            assert action.contains(0)
            assert not action.contains(action.n)

    def test_hold_what_is_observed(self, env):
        obs, _ = env.reset(jax.random.key(0))
        for agent in env.agents:
            space = env.observation_space(agent)
            assert obs[agent].shape == space.shape
            assert obs[agent].dtype == space.dtype
            assert space.contains(obs[agent])
            assert not space.contains(obs[agent] - 9)

    def test_classes_are_told_apart_where_there_are_two(self):
        lengths = {}
        for name in ("PP", "PCP"):
            env = compat.JaxMARLEnv(TASKS[name])
            lengths[name] = env.observation_space("agent_0").shape[0]
            obs, _ = env.reset(jax.random.key(0))
            if name == "PCP":
                np.testing.assert_array_equal(obs["agent_0"][-2:], [1, 0])
                np.testing.assert_array_equal(obs["agent_1"][-2:], [0, 1])
                assert env.agent_classes == {"predators": ["agent_0"], "capturers": ["agent_1"]}
        assert lengths == {"PP": 9 + 2 * 9, "PCP": 9 + 3 * 9 + 2}


class TestStep:
    def test_dictionaries_and_shapes(self, env):
        _, state = env.reset(jax.random.key(0))
        result = env.step(jax.random.key(1), state, stays(env))
        assert len(result) == 5
        next_obs, next_state, rewards, dones, info = result
        assert list(next_obs) == list(rewards) == env.agents
        assert set(dones) == {*env.agents, "__all__"}
        assert all(leaf.shape == () for leaf in jax.tree.leaves((rewards, dones)))
        assert all(leaf.shape == (env.num_agents,) for leaf in jax.tree.leaves(info))
        assert int(next_state.step) == 1
        assert jax.tree.structure(state) == jax.tree.structure(next_state)
        for agent in env.agents:
            np.testing.assert_array_equal(env.get_obs(next_state)[agent], next_obs[agent])

    def test_is_the_tasks_own(self, env):
        _, state = env.reset(jax.random.key(0))
        actions = {"agent_0": jnp.int32(0), "agent_1": jnp.int32(1)}
        _, stepped, rewards, *_ = env.step(jax.random.key(1), state, actions)
        expected, transition = env.task.step(state.env_state, jnp.array([0, 1]))
        jax.tree.map(np.testing.assert_array_equal, stepped.env_state, expected)
        np.testing.assert_array_equal(list(rewards.values()), transition.reward)

    def test_takes_actions_with_and_without_an_axis(self, env):
        _, state = env.reset(jax.random.key(0))
        key = jax.random.key(1)
        plain = env.step(key, state, stays(env))
        with_axis = env.step(key, state, {a: x[None] for a, x in stays(env).items()})
        jax.tree.map(np.testing.assert_array_equal, plain, with_axis)

    def test_batched(self, env):
        keys = jax.random.split(jax.random.key(0), 5)
        _, states = jax.vmap(env.reset)(keys)
        actions = {agent: jnp.full((5, 1), 4) for agent in env.agents}
        obs, _, rewards, dones, info = jax.vmap(env.step)(keys, states, actions)
        assert obs["agent_0"].shape == (5, *env.observation_space("agent_0").shape)
        assert rewards["agent_1"].shape == dones["__all__"].shape == (5,)
        assert info["success"].shape == (5, 2)


class TestAutomaticReset:
    def test_after_the_last_step(self, env):
        _, state = env.reset(jax.random.key(0))
        start = state
        for time in range(4):
            obs, state, _, dones, info = env.step(jax.random.key(time), state, stays(env))
            assert bool(dones["__all__"]) == bool(dones["agent_0"]) == (time == 3)
            assert int(info["steps_taken"][0]) == time + 1
        assert info["truncated"].all()
        assert not info["terminated"].any()
        assert int(state.step) == 0
        assert not state.done
        assert (state.env_state.prey != start.env_state.prey).any() or (
            state.env_state.agents != start.env_state.agents
        ).any()
        for agent in env.agents:
            np.testing.assert_array_equal(env.get_obs(state)[agent], obs[agent])

    def test_to_a_chosen_state(self, env):
        _, state = env.reset(jax.random.key(0))
        _, chosen = env.reset(jax.random.key(5))
        for _ in range(3):
            _, state, *_ = env.step(jax.random.key(1), state, stays(env), chosen)
        _, state, _, dones, _ = env.step(jax.random.key(1), state, stays(env), chosen)
        assert dones["__all__"]
        jax.tree.map(np.testing.assert_array_equal, state, chosen)

    def test_not_inside_step_env(self, env):
        _, state = env.reset(jax.random.key(0))
        for _ in range(4):
            _, state, _, dones, _ = env.step_env(jax.random.key(1), state, stays(env))
        assert dones["__all__"]
        assert state.done
        assert int(state.step) == 4

    def test_leaves_a_part_of_the_key(self, env):
        _, state = env.reset(jax.random.key(0))
        for _ in range(3):
            _, state, *_ = env.step(jax.random.key(1), state, stays(env))
        key = jax.random.key(2)
        _, fresh, *_ = env.step(key, state, stays(env))
        jax.tree.map(np.testing.assert_array_equal, fresh, env.reset(jax.random.split(key)[1])[1])


class TestEquality:
    def test_two_of_one_task_are_one(self):
        one, same = compat.JaxMARLEnv(PP), compat.JaxMARLEnv(PredatorPrey(3, 2, max_steps=4))
        assert one == same
        assert hash(one) == hash(same)
        assert one != compat.JaxMARLEnv(StateUpsampled(PP, 6))
        assert one != PP

    def test_they_are_compiled_once(self):
        traces = []

        def start(env, key):
            traces.append(env)
            return env.reset(key)

        compiled = jax.jit(start, static_argnums=0)
        for _ in range(2):
            compiled(compat.JaxMARLEnv(PredatorPrey(3, 2, max_steps=4)), jax.random.key(0))
        assert len(traces) == 1


class TestAvailableActions:
    def test_are_the_mask(self, env):
        available = env.get_avail_actions(env.reset(jax.random.key(0))[1])
        np.testing.assert_array_equal(list(available.values()), env.task.action_mask)

    def test_another_action_is_a_stay(self):
        env = compat.JaxMARLEnv(PCP)
        _, state = env.reset(jax.random.key(0))
        capture = {"agent_0": jnp.int32(5), "agent_1": jnp.int32(4)}
        assert not env.get_avail_actions(state)["agent_0"][5]
        results = [env.step(jax.random.key(1), state, a) for a in (capture, stays(env))]
        jax.tree.map(np.testing.assert_array_equal, *results)


class TestTrafficJunction:
    """Agents that come and go: who is not there sees zeros and is paid nothing."""

    def test_an_episode(self):
        env = compat.make("sumajax_traffic_junction", num_cars=3, max_steps=4, arrival_rate=0.5)
        assert env.task == TrafficJunction(num_cars=3, max_steps=4, arrival_rate=0.5)
        assert env.agent_classes == {"cars": env.agents}
        obs, state = env.reset(jax.random.key(0))
        came = []
        for time in range(4):
            gas = dict.fromkeys(env.agents, jnp.int32(0))
            obs, state, rewards, dones, _ = env.step(jax.random.key(time), state, gas)
            alive = np.asarray(env.task.alive(state.env_state))
            for agent, there in zip(env.agents, alive, strict=True):
                assert env.observation_space(agent).contains(obs[agent])
                assert bool(obs[agent].any()) == there
                assert there or dones["__all__"] or float(rewards[agent]) == 0
            came.append(alive)
            assert bool(dones["__all__"]) == (time == 3)
        assert np.any(came)

    def test_upsampled(self):
        env = compat.make("sumajax_traffic_junction", upsample_to=14)
        assert env.name == "TrafficJunction"
        assert env.observation_space("agent_0").shape == (2 * 14 * 14 + 4 * 9,)


class TestMake:
    def test_by_name(self):
        assert compat.make("sumajax_predator_prey").task == PredatorPrey()
        env = compat.make("sumajax_predator_capture_prey", size=4, upsample_to=8)
        assert env.task == StateUpsampled(PredatorCapturePrey(size=4), 8)
        assert env.name == "PredatorCapturePrey"

    @pytest.mark.parametrize(
        ("name", "settings", "sentence"),
        [
            ("chess", {}, "task 'chess' is unknown; choose one of sumajax_predator_prey"),
            ("sumajax_predator_prey", {"colour": 1}, "its settings are size, num_predators"),
            ("sumajax_predator_prey", {"size": 0}, "size must be a positive int"),
        ],
    )
    def test_mistakes(self, name, settings, sentence):
        with pytest.raises(ValueError, match=sentence):
            compat.make(name, **settings)

    def test_the_command_needs_a_script(self):
        with pytest.raises(SystemExit, match="usage"):
            compat.main([])


def test_the_package_does_not_import_jaxmarl():
    """Nor does anything of it load the compatibility modules unasked."""
    program = "import sys, sumajax; print([m for m in sys.modules if 'jaxmarl' in m])"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert said.stdout.strip() == "[]", said.stderr


class TestWithJaxMARL:
    """What JaxMARL's base tests (test_envs_implement_base_api.py) ask beside the above."""

    @pytest.fixture(autouse=True)
    def theirs(self):
        return pytest.importorskip("jaxmarl", reason="JaxMARL is not installed (no dependency)")

    def test_is_one_of_theirs(self, env):
        from jaxmarl.environments import MultiAgentEnv
        from jaxmarl.environments.spaces import Space

        assert isinstance(env, MultiAgentEnv)
        for agent in env.agents:
            assert isinstance(env.observation_space(agent), Space)
            assert isinstance(env.action_space(agent), Space)

    def test_is_found_by_name(self, theirs, monkeypatch):
        monkeypatch.setattr(theirs, "make", theirs.make)
        monkeypatch.setattr(theirs.registration, "make", theirs.registration.make)
        compat.register(mine=PP)
        assert theirs.make("mine").task == PP
        assert theirs.make("sumajax_predator_prey", size=7).task == PredatorPrey(size=7)
        assert theirs.make("switch_riddle").name
        assert {"mine", "sumajax_predator_prey"} <= set(theirs.registered_envs)

    def test_their_log_wrapper(self, env):
        from jaxmarl.wrappers.baselines import LogWrapper

        logged = LogWrapper(env)
        _, state = logged.reset(jax.random.key(0))
        for time in range(4):
            _, state, _, _, info = logged.step(jax.random.key(time), state, stays(env))
        assert info["returned_episode"].all()
        np.testing.assert_array_equal(info["returned_episode_lengths"], [4, 4])
        np.testing.assert_allclose(info["returned_episode_returns"], [-0.2, -0.2], rtol=1e-5)
