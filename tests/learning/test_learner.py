"""Updates, epochs and their figures."""

from dataclasses import dataclass, replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beginnings import begin, begun, random_parameters
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from probes import ConstantReward, MatchView
from trajectories import TINY_TASK, random_trajectory, tiny_learner

from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.learning import Learner, make_learner, preset
from sumajax.learning.learner import mean_of, summarise, tally_of, until_episode_end
from sumajax.learning.losses import LossParts, estimate_advantages, policy_gradient
from sumajax.learning.rollout import last_value, rollout
from sumajax.policies import make_policy
from sumajax.policies.ic3net import IC3Net

SHORT_EPOCH = {"num_envs": 200, "rollout_length": 20}  # 5 updates


@cache
def learner() -> Learner:
    return tiny_learner(TINY_TASK, **SHORT_EPOCH)


@cache
def fresh(seed):
    return jax.jit(learner().init)(jax.random.key(seed))


def assert_same(a, b):
    jax.tree.map(np.testing.assert_array_equal, *jax.tree.map(raw, (a, b)))


def raw(leaf):
    """Keys as numbers."""
    key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if key else leaf)


class TestReproducibility:
    def test_one_seed_gives_one_result_bit_for_bit(self):
        first, again = (learner().train(fresh(0), 2) for _ in range(2))
        assert_same(first, again)

    def test_two_seeds_differ(self):
        first, other = (learner().train(fresh(seed), 2)[0] for seed in (0, 1))
        for a, b in zip(jax.tree.leaves(first.params), jax.tree.leaves(other.params), strict=True):
            assert (a != b).any()

    def test_two_chunks_are_one(self):
        """An epoch does not depend on how many a compiled call makes: so a run can be resumed."""
        whole, _ = learner().train(fresh(0), 2)
        resumed, _ = learner().train(learner().train(fresh(0), 1)[0], 1)
        close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)
        jax.tree.map(close, *jax.tree.map(raw, (whole, resumed)))

    def test_training_goes_on_with_other_numbers(self):
        """The key stays, the number of the update makes the difference."""
        state, _ = learner().train(fresh(0), 1)
        assert int(state.updates) == learner().config.updates_per_epoch
        assert_same(state.key, fresh(0).key)
        now, later = (learner()._inputs(s)[1].noise["action"] for s in (fresh(0), state))
        assert (now != later).mean() > 0.99


class TestCompilation:
    def test_training_is_traced_once(self):
        """Also where the second call takes what the first returned, and by an equal learner."""
        state, before = fresh(0), Learner.train._cache_size()
        equal = tiny_learner(replace(TINY_TASK), **SHORT_EPOCH)
        for trainer in (learner(), learner(), equal):
            state, _ = trainer.train(state, 2)
        assert Learner.train._cache_size() - before <= 1

    def test_functions_of_the_task_are_traced_a_fixed_number_of_times(self):
        """However many steps, environments, updates and epochs there are."""
        counted = tiny_learner(Counting(max_steps=2), **SHORT_EPOCH)
        state = begun(counted)
        Counting.views = 0
        state, _ = counted.train(state, 2)
        traced = Counting.views
        assert 1 <= traced <= 8
        counted.train(state, 2)
        assert Counting.views == traced


@dataclass(frozen=True)
class Counting(MatchView):
    """Counts how often Python looks at its view."""

    views = 0

    def view(self, state):
        Counting.views += 1
        return super().view(state)


class TestGradient:
    def test_is_that_of_the_loss_through_the_rollout(self):
        """Finite differences in float64, the choices held fixed by the noise.

        The whole program is differentiated: memory, messages, gates and auto-reset; what the loss
        takes as constants stays what it is at the first parameters.
        """
        env = PredatorPrey(size=3, num_predators=2, max_steps=4)
        with jax.enable_x64(True):
            tiny = tiny_learner(env, "ic3net", num_envs=5, rollout_length=8)
            config = tiny.config
            assert config.mask_inactive
            assert config.team_reward > 0
            assert config.advantages == "centred"
            params, actors, draws = gradient_inputs(tiny)

            @jax.jit
            def gradient_and_constants(params):
                """Also what the loss takes as constants: targets, advantages and who acts."""
                weights = {"policy": params, "critic": None}
                ours, (_, tally) = tiny._gradient(weights, actors, draws, jnp.int32(0))
                following, now = rollout(env, tiny.policy, params, actors, draws)
                beyond = last_value(env, tiny.policy, params, following)
                individual = now.value + estimate_advantages(now, beyond, config)
                share = config.team_reward
                target = (1 - share) * individual + share * individual.mean(-1, keepdims=True)
                better = target - now.value
                acting = now.active.astype(float)
                better = better - (acting * better).sum() / acting.sum()
                return ours["policy"], tally, now, (target, better, acting)

            @jax.jit
            def loss(params, target, better, acting):
                _, seen = rollout(env, tiny.policy, params, actors, draws)
                everyone = jnp.ones_like(acting)
                policy, entropy = policy_gradient(seen.decisions, better, everyone, acting)
                critic = ((seen.value - target) ** 2).sum()
                weights = config.value_weight, config.entropy_weight
                return policy + weights[0] * critic - weights[1] * entropy

            found = jax.tree.map(np.asarray, gradient_and_constants(params))
            ours, tally, now, constants = found
            assert now.terminated.any()
            assert now.truncated.any()
            assert int(tally.env_steps) == 40
            rng, step = np.random.default_rng(0), 1e-6
            for _ in range(4):
                direction = jax.tree.map(lambda p: rng.normal(size=p.shape), params)
                ahead, behind = (
                    loss(jax.tree.map(lambda p, d, s=s: p + s * d, params, direction), *constants)
                    for s in (step, -step)
                )
                products = jax.tree.map(lambda g, d: (g * d).sum(), ours, direction)
                along = sum(jax.tree.leaves(products))
                np.testing.assert_allclose(
                    along, (float(ahead) - float(behind)) / (2 * step), rtol=1e-5
                )

    def test_the_step_is_the_gradient_over_environment_steps(self):
        """Not over agents: the originals' learning rates are made for a sum over agents."""
        tiny = tiny_learner(
            optimiser="rmsprop", max_grad_norm=None, learning_rate=0.1, **SHORT_EPOCH
        )
        state = begun(tiny)

        @jax.jit
        def gradient_and_step(state):
            weights = {"policy": state.params, "critic": None}
            inputs = weights, *tiny._inputs(state), state.updates
            return tiny._gradient(*inputs), tiny.update(state)

        (sums, (_, tally)), (stepped, _) = gradient_and_step(state)
        sums = jax.tree.map(np.asarray, sums)
        assert int(tally.env_steps) == 4000

        def expected(p, g):
            g = g / 4000
            return p - 0.1 * g / (np.sqrt(0.03 * g**2) + 1e-6)

        close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
        jax.tree.map(close, stepped.params, jax.tree.map(expected, state.params, sums["policy"]))


def gradient_inputs(tiny):
    """Parameters, environments at staggered ages and random numbers, as NumPy's in float64."""
    params = random_parameters(tiny.policy, 1)

    @jax.jit
    def drawn(params):
        return tiny._inputs(tiny.init_from(params, jax.random.key(2)))

    return in_float64((params, *drawn(params)))


def in_float64(tree):
    def widened(x):
        return np.asarray(x, np.float64 if x.dtype == jnp.float32 else None)

    return jax.tree.map(widened, tree)


class TestWholeEpisodes:
    @settings(max_examples=100, deadline=None)
    @given(arrays.arrays(np.bool_, (9, 3)), st.integers(1, 6))
    def test_an_environment_stops_at_the_first_end_that_is_late_enough(self, last, least):
        trajectory, _ = random_trajectory(np.random.default_rng(0), [[]] * 3, beyond=9)
        trajectory = trajectory.replace(
            terminated=jnp.asarray(last), truncated=jnp.zeros(last.shape, bool)
        )
        expected = np.zeros(last.shape, bool)
        for env in range(last.shape[1]):
            for t in range(len(last)):
                expected[t, env] = True
                if last[t, env] and t + 1 >= least:
                    break
        np.testing.assert_array_equal(until_episode_end(trajectory, least), expected)

    def test_every_update_starts_afresh_and_ends_with_an_episode(self):
        tiny = tiny_learner(settings="paper", num_envs=4, rollout_length=5)
        state = begun(tiny)
        run = jax.jit(lambda s: (tiny._inputs(s), tiny.update(s)))
        for _ in range(3):
            (actors, draws), (state, tally) = run(state)
            actors = jax.tree.map(np.asarray, actors)
            assert (actors.env_state.time == 0).all()
            assert not any(leaf.any() for leaf in jax.tree.leaves(actors.carry))
            assert jax.tree.leaves(draws)[0].shape[0] == 5 + TINY_TASK.max_steps - 1
            assert 4 * 5 <= int(tally.env_steps) <= 4 * (5 + TINY_TASK.max_steps - 1)
            assert int(tally.steps_taken) == int(tally.env_steps), (
                "every step is of a whole episode"
            )


class TestPresetPaper:
    @pytest.mark.parametrize("policy", ["ic3net", "magic"])
    def test_an_update(self, policy):
        """HetNet's is in test_hetnet_loss.py."""
        env = PredatorCapturePrey(size=3, num_predators=2, num_capturers=1, max_steps=4)
        tiny = tiny_learner(env, policy, "paper", num_envs=2, rollout_length=4)
        run = jax.jit(lambda params, key: tiny.update(begin(tiny, params, key)))
        state, tally = run(random_parameters(tiny.policy), jax.random.key(0))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.params))
        assert float(tally.gradient_norm) > 0
        assert int(tally.episodes) >= 2


class TestFigures:
    def test_what_is_counted(self):
        """Figures of episodes are of those that ended (docs/reference/learning.md, An epoch)."""
        lengths, rng = [[3, 7], [7, 2]], np.random.default_rng(0)
        trajectory, valid = random_trajectory(rng, lengths)
        parts = LossParts(*map(jnp.float32, (6.0, 8.0, 12.0, 4.0)))
        tally = tally_of(trajectory, jnp.asarray(valid), parts)
        figures = summarise(tally.replace(gradient_norm=jnp.float32(3.0)))
        ends = np.asarray(trajectory.last)
        assert int(figures.env_steps) == 19
        assert int(figures.episodes) == 4
        np.testing.assert_allclose(figures.steps_taken, 19 / 4)
        np.testing.assert_allclose(figures.success, 2 / 4)
        returns = np.asarray(trajectory.episode_return)[ends].mean()
        np.testing.assert_allclose(figures.episode_return, returns, rtol=1e-5)
        talk = np.asarray(trajectory.communication)[valid].mean()
        np.testing.assert_allclose(figures.communication, talk, rtol=1e-5)
        np.testing.assert_allclose(figures.policy_loss, 6 / 4)
        np.testing.assert_allclose(figures.value_loss, 8 / (19 * 2), rtol=1e-6)
        np.testing.assert_allclose(figures.entropy, 12 / 4)
        np.testing.assert_allclose(figures.gradient_norm, 3.0)

    def test_no_episode_ended(self):
        """NaN, not a zero that looks like a figure."""
        tiny = tiny_learner(ConstantReward(max_steps=3), num_envs=20_000, rollout_length=1)
        _, metrics = tiny.train(begun(tiny), 3)
        np.testing.assert_array_equal(metrics.episodes, [0, 0, 20_000])
        for name in ("steps_taken", "success", "episode_return"):
            np.testing.assert_array_equal(np.isnan(getattr(metrics, name)), [True, True, False])
        assert np.isfinite(metrics.value_loss).all()
        np.testing.assert_array_equal(metrics.steps_taken[2], 3)
        np.testing.assert_array_equal(metrics.episode_return[2], 3)
        sums = jax.tree.leaves(metrics)
        assert all(np.isfinite(leaf).all() for leaf in sums), "a program hands out no NaN"

    @pytest.mark.parametrize("count", [0, 4])
    def test_a_mean_traced_and_not(self, count):
        total, count = jnp.int32(3), jnp.int32(count)
        expected = 0.75 if count else np.nan
        np.testing.assert_array_equal(mean_of(total, count), np.float32(expected))
        np.testing.assert_array_equal(jax.jit(mean_of)(total, count), np.float32(expected))

    def test_an_epoch(self):
        _, metrics = learner().train(fresh(0), 2)
        np.testing.assert_array_equal(metrics.env_steps, [20_000, 20_000])
        assert ((metrics.steps_taken >= 1) & (metrics.steps_taken <= TINY_TASK.max_steps)).all()
        assert ((metrics.success > 0) & (metrics.success < 1)).all()
        assert (metrics.gradient_norm > 0).all()


CRITIC_ALONE = {**SHORT_EPOCH, "critic_epochs": 1, "critic_rate": 0.01, "value_weight": 1.0}


@cache
def held():
    """A learner, its start, and state and metrics after an epoch of its critic alone."""
    tiny = tiny_learner(TINY_TASK, "ic3net", **CRITIC_ALONE)
    return tiny, begun(tiny), *tiny.train(begun(tiny), 1)


class TestCriticAlone:
    """The first `critic_epochs`."""

    def test_nothing_that_the_policy_depends_on_changes(self):
        tiny, state, after, metrics = held()
        for is_critic, a, b in zip(
            jax.tree.leaves(tiny.policy.only_critic(state.params)),
            jax.tree.leaves(state.params),
            jax.tree.leaves(after.params),
            strict=True,
        ):
            assert (a != b).any() == is_critic
        assert not any(leaf.any() for leaf in jax.tree.leaves(metrics.fault))

    def test_the_critic_learns(self):
        tiny = tiny_learner(ConstantReward(), **{**CRITIC_ALONE, "critic_epochs": 20})
        _, metrics = tiny.train(begun(tiny), 20)
        assert metrics.value_loss[-1] < 0.01 * metrics.value_loss[0]

    def test_then_all_learns_with_fresh_optimiser_memory(self):
        tiny, state, before, _ = held()
        after, _ = jax.jit(tiny.update)(before)
        plain = replace(tiny, config=replace(tiny.config, critic_epochs=0))
        # The memory that a start has is fresh.
        expected, _ = jax.jit(plain.update)(before.replace(opt_state=state.opt_state))
        close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-7)
        jax.tree.map(close, after.params, expected.params)
        for a, b in zip(*map(jax.tree.leaves, (before.params, after.params)), strict=True):
            assert (a != b).any()

    def test_a_policy_that_names_no_critic_learns_as_a_whole(self):
        policy = make_policy("iric", TINY_TASK)
        nameless = replace(policy, module=Nameless(team=policy.team, communicates=False))
        config = preset("fast", critic_epochs=1)
        assert make_learner(TINY_TASK, nameless, config).config == preset("fast")


class Nameless(IC3Net):
    critic_parameters = frozenset()


class TestStart:
    def test_environments_are_at_staggered_ages(self):
        """Every age alike, where all episodes last as long."""
        tiny = tiny_learner(ConstantReward(max_steps=4, terminates=False), **SHORT_EPOCH)
        start = jax.jit(tiny.init_from)(random_parameters(tiny.policy), jax.random.key(0))
        actors = jax.tree.map(np.asarray, start.actors)
        ages = np.bincount(actors.env_state.time, minlength=4)
        assert ages.size == 4
        assert ages.min() > 200 / 4 / 2
        np.testing.assert_array_equal(actors.episode_return[:, 0], actors.env_state.time)

    def test_the_first_episodes_are_no_quicker_than_the_later_ones(self):
        """A policy that stays as it is: its first epoch counts what its tenth does."""
        tiny = tiny_learner(
            PredatorPrey(size=4, num_predators=2, max_steps=100),
            **{**SHORT_EPOCH, "learning_rate": 1e-9},
        )
        start = jax.jit(tiny.init_from)(random_parameters(tiny.policy), jax.random.key(0))
        _, metrics = tiny.train(start, 10)
        later = metrics.steps_taken[1:]
        assert abs(metrics.steps_taken[0] - later.mean()) < 4 * later.std()

    def test_with_whole_episodes_every_update_starts_afresh_anyway(self):
        tiny = tiny_learner(settings="paper", num_envs=4, rollout_length=5)
        start = jax.jit(tiny.init_from)(random_parameters(tiny.policy), jax.random.key(0))
        assert not np.asarray(start.actors.env_state.time).any()

    def test_given_parameters_and_memory_are_kept(self):
        ones = partial(jax.tree.map, lambda x: np.ones(x.shape, x.dtype))
        params, memory = ones(fresh(0).params), ones(fresh(0).opt_state)
        state = jax.jit(learner().init_from)(params, jax.random.key(3), memory)
        assert_same(state.params, params)
        assert_same(state.opt_state, memory)
        assert int(state.updates) == 0

    def test_memory_is_fresh_unless_given(self):
        state = jax.jit(learner().init_from)(fresh(0).params, jax.random.key(3))
        assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(state.opt_state))

    def test_a_policy_of_another_task_is_refused(self):
        other = make_policy("iric", PredatorPrey(size=4, num_predators=2))
        with pytest.raises(ValueError, match=r"the policy was made for another task: state_shape"):
            make_learner(TINY_TASK, other)

    def test_the_default_is_preset_fast(self):
        assert make_learner(TINY_TASK, make_policy("iric", TINY_TASK)).config == preset("fast")
