"""Held-out episodes, the random policy, the bound; and acting with a policy."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax import checkpoint, evaluation
from sumajax.checkpoint import CheckpointError
from sumajax.environments import PredatorCapturePrey, PredatorPrey, Wrapper
from sumajax.evaluation import (
    EPISODES,
    Agent,
    evaluate,
    evaluate_random,
    held_out_keys,
    load_agent,
    shortest_path_steps,
)
from sumajax.policies import Policy, PolicyModule, PolicyOutput, TeamSpec, make_policy
from sumajax.policies.types import decide
from sumajax.upsampling import StateUpsampled

PP = PredatorPrey(size=5, num_predators=3, vision=1, max_steps=80)
PCP = PredatorCapturePrey(size=5, num_predators=2, num_capturers=1, vision=1, max_steps=80)
TINY = PredatorPrey(size=3, num_predators=2, max_steps=12)
TINY_PCP = PredatorCapturePrey(size=3, num_predators=1, num_capturers=1, max_steps=12)
FEW = 16


@cache
def tiny_policy():
    policy = make_policy("ic3net", TINY, hidden=4, encoder="linear")
    return policy, jax.jit(policy.init)(jax.random.key(0))


def played(seed=0, *, greedy):
    policy, params = tiny_policy()
    return evaluate(TINY, policy, params, jax.random.key(seed), episodes=FEW, greedy=greedy)


class TestHeldOutStarts:
    def test_there_are_1024(self):
        assert EPISODES == 1024
        assert held_out_keys().shape == (1024,)

    def test_they_are_the_same_for_ever(self):
        """Figures of one version can be compared with those of another."""
        keys = jax.random.key_data(held_out_keys())
        expected = [[944756501, 178618546], [36542745, 2238904669]]
        np.testing.assert_array_equal(keys[:2], expected)

    def test_all_of_them_differ(self):
        assert len(np.unique(jax.random.key_data(held_out_keys()), axis=0)) == EPISODES

    def test_training_does_not_start_from_them(self):
        """Nor from the keys its episodes are folded from."""
        held_out = {tuple(k) for k in jax.random.key_data(held_out_keys()).tolist()}
        seeds = jax.vmap(jax.random.key)(jnp.arange(100))
        assert not held_out & {tuple(k) for k in jax.random.key_data(seeds).tolist()}


class TestRandomPolicy:
    @pytest.mark.parametrize(
        ("env", "steps", "success"), [(PP, 68.93, 0.369), (PCP, 70.78, 0.325)], ids=["PP", "PCP"]
    )
    def test_level(self, env, steps, success):
        """docs/reference/predator_prey.md, Reference levels: of 6,000; four standard errors."""
        result = evaluate_random(env, make_policy("iric", env), jax.random.key(0))
        assert abs(np.mean(result.steps_taken) - steps) < 4 * 18.4 / np.sqrt(EPISODES)
        assert abs(np.mean(result.success) - success) < 4 * 0.5 / np.sqrt(EPISODES)

    @pytest.mark.parametrize("env", [TINY, TINY_PCP], ids=["PP", "PCP"])
    def test_every_episode_is_played_to_its_own_end(self, env):
        """Step by step: what has ended keeps its figures while others go on; each agent draws from
        the actions that its class has."""
        key, mask = jax.random.key(7), jnp.asarray(env.action_mask)
        result = evaluate_random(env, make_policy("iric", env), key, episodes=FEW)

        @jax.jit
        def by_hand(states):
            def step(states, time):
                logits = jnp.broadcast_to(jnp.where(mask, 0.0, -jnp.inf), (FEW, *mask.shape))
                actions = jax.random.categorical(jax.random.fold_in(key, time), logits)
                states, transition = jax.vmap(env.step)(states, actions.astype(jnp.int32))
                return states, (actions, transition)

            return jax.lax.scan(step, states, jnp.arange(env.max_steps))[1]

        actions, steps = jax.device_get(by_hand(jax.vmap(env.reset)(held_out_keys(FEW))))
        ends = (steps.terminated | steps.truncated).argmax(0)
        assert np.array(mask)[np.arange(env.num_agents), actions].all()
        assert len(set(ends.tolist())) > 2
        np.testing.assert_array_equal(result.steps_taken, ends + 1)
        for episode, end in enumerate(ends):
            assert bool(result.success[episode]) == steps.success[end, episode]
            earned = steps.reward[: end + 1, episode].mean(-1).sum()
            np.testing.assert_allclose(result.episode_return[episode], earned, rtol=1e-5)


class TestGreedy:
    def test_ignores_the_key(self):
        first, other = (played(seed, greedy=True) for seed in (0, 1))
        jax.tree.map(np.testing.assert_array_equal, first, other)

    def test_sampling_does_not(self):
        first, again, other = (played(seed, greedy=False) for seed in (0, 0, 1))
        jax.tree.map(np.testing.assert_array_equal, first, again)
        assert (first.episode_return != other.episode_return).any()

    def test_however_few_are_played_at_a_time(self, monkeypatch):
        """Greedy play draws nothing, so the lanes an episode waits for cannot matter."""
        policy, params = tiny_policy()
        monkeypatch.setattr(evaluation, "LANES", 3)
        queued = jax.jit(evaluate.__wrapped__, static_argnums=(0, 1), static_argnames="episodes")(
            TINY, policy, params, jax.random.key(0), episodes=FEW, greedy=True
        )
        jax.tree.map(np.testing.assert_array_equal, queued, played(greedy=True))

    def test_takes_the_likeliest_choice_at_every_step(self):
        policy, params = tiny_policy()
        agent = Agent(TINY, policy, params)
        state, carry = jax.jit(TINY.reset)(held_out_keys(FEW)[0]), agent.initial_carry()

        @jax.jit
        def step(state, carry):
            carry, actions = agent.act(carry, TINY.observe(state), jax.random.key(0), greedy=True)
            return TINY.step(state, actions), carry

        for _ in range(TINY.max_steps):
            (state, transition), carry = step(state, carry)
            if transition.terminated or transition.truncated:
                break
        assert int(played(greedy=True).steps_taken[0]) == int(transition.steps_taken)

    def test_greedy_may_be_traced_or_known(self):
        policy, params = tiny_policy()
        agent, carry = Agent(TINY, policy, params), policy.initial_carry()
        obs = jax.jit(lambda key: TINY.observe(TINY.reset(key)))(held_out_keys(FEW)[0])
        key = jax.random.key(0)
        traced = jax.jit(agent.act)
        known = jax.jit(agent.act, static_argnames="greedy")
        for greedy in (False, True):
            expected = agent.act(carry, obs, key, greedy=greedy)[1]
            for compiled in (traced, known):
                np.testing.assert_array_equal(compiled(carry, obs, key, greedy=greedy)[1], expected)

    def test_both_kinds_share_one_program(self):
        policy, params = tiny_policy()
        played(greedy=False)
        before = evaluate._cache_size()
        played(greedy=True)
        other = jax.tree.map(lambda p: p + 1, params)
        evaluate(TINY, policy, other, jax.random.key(3), episodes=FEW, greedy=True)
        assert evaluate._cache_size() == before


class TestAgent:
    def test_is_an_argument_like_any_other(self):
        """Its parameters are leaves, task and policy the structure: one program for all of them."""
        policy, params = tiny_policy()
        obs = TINY.observe(TINY.reset(held_out_keys(FEW)[0]))

        @jax.jit
        def value(agent):
            return agent.policy.apply(agent.params, agent.initial_carry(), obs, jax.random.key(0))

        agent = Agent(TINY, policy, params)
        doubled = jax.tree.map(lambda x: 2 * x, agent)
        assert isinstance(doubled, Agent)
        assert jax.tree.structure(doubled) == jax.tree.structure(agent)
        first, second = value(agent)[1].value, value(doubled)[1].value
        assert value._cache_size() == 1
        assert not np.allclose(first, second)

    def test_is_compared_by_what_it_does(self):
        policy, params = tiny_policy()
        agent, same = (Agent(TINY, policy, jax.tree.map(jnp.array, params)) for _ in range(2))
        other = agent.replace(params=jax.tree.map(lambda x: x + 1, params))
        assert agent == same
        assert hash(agent) == hash(same)
        assert agent not in (other, agent.replace(env=PP), "agent")
        assert len({agent, same, other}) == 2


class TestBound:
    @pytest.mark.parametrize(
        ("env", "steps", "deviation"), [(PP, 4.67, 1.33), (PCP, 5.08, 1.36)], ids=["PP", "PCP"]
    )
    def test_mean(self, env, steps, deviation):
        """docs/reference/predator_prey.md, Reference levels: of 20,000 starts; here of 1,024."""
        bound = np.asarray(shortest_path_steps(env))
        assert abs(bound.mean() - steps) < 4 * deviation / np.sqrt(EPISODES)
        assert abs(bound.std() - deviation) < 0.2

    def test_no_policy_is_faster(self):
        result = evaluate_random(TINY, make_policy("iric", TINY), jax.random.key(0), episodes=FEW)
        assert (result.steps_taken >= shortest_path_steps(TINY, FEW)).all()

    def test_seen_at_another_size_it_is_the_same(self):
        """Upsampling the state changes neither starts nor moves."""
        seen = StateUpsampled(TINY, 6)
        np.testing.assert_array_equal(
            shortest_path_steps(seen, FEW), shortest_path_steps(TINY, FEW)
        )

    def test_a_task_that_offers_none(self):
        assert shortest_path_steps(object()) is None


class TestLoadAgent:
    @pytest.fixture
    def directory(self, tmp_path):
        """Seeds 7 and 8."""
        policy, params = tiny_policy()
        stacked = jax.tree.map(lambda x: jnp.stack([x, x + 1]), params)
        meta = checkpoint.describe(TINY, policy, seeds=[7, 8])
        checkpoint.save(tmp_path / "saved", {"params": stacked}, meta)
        return tmp_path / "saved"

    def test_a_seed_is_called_by_its_number(self, directory):
        policy, params = tiny_policy()
        first, second = (load_agent(directory, seed=seed) for seed in (7, 8))
        assert first == Agent(TINY, policy, params)
        assert second == Agent(TINY, policy, jax.tree.map(lambda x: x + 1, params))
        assert load_agent(directory) == first

    def test_one_that_there_is_not(self, directory):
        """A place in the list is no seed."""
        with pytest.raises(CheckpointError, match=r"has no seed 1; its seeds are 7, 8\."):
            load_agent(directory, seed=1)

    def test_a_task_that_offers_none_offers_none_at_another_size(self):
        class Plain(Wrapper):
            """Predator-Prey's contract, and nothing beside it."""

            def __getattr__(self, name):
                raise AttributeError(name)

        assert shortest_path_steps(StateUpsampled(Plain(TINY), 6), FEW) is None


class WholeNumbers(PolicyModule):
    """Draws its actions as whole numbers: 0 is stay, the likeliest."""

    def encode_states(self, states):
        return jnp.zeros((states.shape[0], 1))

    def __call__(self, carry, state_features, view, noise):
        likes = jax.nn.one_hot((4 + noise["turn"]) % self.team.num_actions, self.team.num_actions)
        decisions = {"action": decide(likes, noise["gumbel"])}
        silent = jnp.zeros(likes.shape[:-1])
        pairs = jnp.zeros((*silent.shape, self.team.num_agents))
        return carry, PolicyOutput(decisions, silent, silent, pairs)

    def initial_carry(self, batch_shape):
        return ()

    def sample_noise(self, key, batch_shape):
        shape = (*batch_shape, self.team.num_agents)
        turn = jax.random.randint(key, shape, 0, self.team.num_actions)
        return {"turn": turn, "gumbel": jnp.zeros((*shape, self.team.num_actions))}


class TestNoiseOfAnyType:
    policy = Policy("whole", WholeNumbers(TeamSpec.of(TINY)))

    def test_evaluation(self):
        """Greedy, everybody stays for ever; drawn, somebody arrives."""
        for greedy in (True, False):
            result = evaluate(TINY, self.policy, {}, jax.random.key(0), episodes=FEW, greedy=greedy)
            assert (result.steps_taken == TINY.max_steps).all() == greedy

    def test_acting(self):
        agent = Agent(TINY, self.policy, {})
        obs = TINY.observe(TINY.reset(jax.random.key(0)))
        act = jax.jit(lambda key, greedy: agent.act((), obs, key, greedy=greedy)[1])
        for greedy in (True, jnp.array(True)):
            assert act(jax.random.key(0), greedy).tolist() == [4, 4]
        drawn = [act(jax.random.key(seed), False).tolist() for seed in range(4)]
        assert any(actions != [4, 4] for actions in drawn)


class TestAnotherTask:
    """A policy on a task it was not shaped for is refused in words, not by a failing product."""

    @pytest.mark.parametrize(
        ("env", "differs"),
        [
            (PredatorPrey(size=3, num_predators=3), r"agent_class \(0, 0\) against \(0, 0, 0\)"),
            (PredatorPrey(size=4, num_predators=2), r"state_shape \(1, 3, 3\) against \(1, 4, 4\)"),
            (StateUpsampled(TINY, 6), r"state_shape \(1, 3, 3\) against \(1, 6, 6\)"),
            (TINY_PCP, r"num_actions 5 against 6"),
        ],
    )
    def test_evaluation(self, env, differs):
        policy, params = tiny_policy()
        with pytest.raises(ValueError, match=f"made for another task: .*{differs}.*make_policy"):
            evaluate(env, policy, params, jax.random.key(0), episodes=FEW)

    @pytest.mark.parametrize("env", [PredatorPrey(size=3), PredatorPrey(size=4, num_predators=2)])
    def test_acting(self, env):
        agent = Agent(TINY, *tiny_policy())
        obs = env.observe(env.reset(jax.random.key(0)))
        with pytest.raises(ValueError, match=r"observation's state has shape .* made for .*; call"):
            agent.act(agent.initial_carry(), obs, jax.random.key(0))

    def test_acting_with_the_memory_of_another_team_or_batch(self):
        agent = Agent(TINY, *tiny_policy())
        obs = TINY.observe(TINY.reset(jax.random.key(0)))
        other = make_policy("ic3net", PredatorPrey(size=3), hidden=4, encoder="linear")
        for carry in (other.initial_carry(), agent.initial_carry((7,)), ()):
            with pytest.raises(ValueError, match=r"the carry has shapes .*initial_carry\(\(\)\)"):
                agent.act(carry, obs, jax.random.key(0))
