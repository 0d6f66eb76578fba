"""The scan over environment and policy against a loop over both, and where gradients flow."""

from dataclasses import dataclass, replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beginnings import begun, random_parameters
from trajectories import TINY_TASK, Clock, summing_policy, tiny_learner

from sumajax.environments import PredatorPrey
from sumajax.learning.rollout import act, draw, last_value, rollout, select, start
from sumajax.learning.windows import GAPS_IN_WINDOW

STEPS, ENVS = 12, 3  # more than two episodes of at most 5 steps


@cache
def scene():
    """A tiny IC3Net, three fresh environments and all the random numbers of a rollout."""
    learner = tiny_learner(policy="ic3net")
    env, policy = learner.env, learner.policy
    return env, policy, random_parameters(policy), *beginning(env, policy, KEYS, STEPS)


KEYS = jax.random.split(jax.random.key(1), ENVS)


@partial(jax.jit, static_argnums=(0, 1, 3))
def beginning(env, policy, keys, steps):
    """Fresh environments and all the random numbers of so many steps."""
    return start(env, policy, keys), draw(env, policy, keys, steps)


@cache
def rolled():
    env, policy, params, actors, draws = scene()
    return jax.jit(partial(rollout, env, policy))(params, actors, draws)


def test_every_step_equals_one_made_by_hand():
    """Step the task, record, and only then follow what ended by a fresh start without memory."""
    env, policy, params, actors, draws = scene()
    following, trajectory = rolled()

    @jax.jit
    def one_step(state, carry, noise):
        carry, output = policy.apply_with(params, carry, env.observe(state), noise)
        return env.active(state), carry, output, *env.step(state, output.action)

    following, trajectory, draws = jax.tree.map(np.asarray, (following, trajectory, draws))
    for e in range(ENVS):
        state = jax.tree.map(lambda x, e=e: x[e], actors.env_state)
        carry, earned = policy.initial_carry(), np.zeros(env.num_agents)
        for t in range(STEPS):
            noise, fresh = jax.tree.map(lambda x, t=t, e=e: x[t, e], (draws.noise, draws.fresh))
            seen = jax.tree.map(lambda x, t=t, e=e: x[t, e], trajectory)
            active, carry, output, state, transition = one_step(state, carry, noise)
            np.testing.assert_array_equal(seen.active, active)
            earned = earned + transition.reward
            np.testing.assert_array_equal(seen.decisions["action"].choice, output.action)
            for name in ("reward", "terminated", "truncated", "success", "steps_taken"):
                np.testing.assert_array_equal(getattr(seen, name), getattr(transition, name), name)
            np.testing.assert_allclose(seen.value, output.value, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(seen.episode_return, earned, rtol=1e-5, atol=1e-6)
            if transition.terminated or transition.truncated:
                state, carry, earned = fresh, policy.initial_carry(), np.zeros(env.num_agents)
        left = jax.tree.map(lambda x, e=e: x[e], following)
        jax.tree.map(np.testing.assert_array_equal, left.env_state, state)
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-5), left.carry, carry)
        np.testing.assert_allclose(left.episode_return, earned, atol=1e-5)


def test_memory_and_episodes_go_on_across_segments():
    """Two rollouts, the second from where the first ended, are one rollout."""
    env, policy, params, actors, draws = scene()
    following, trajectory = rolled()
    halves = [jax.tree.map(lambda x, s=s: x[s], draws) for s in np.split(np.arange(STEPS), 2)]
    half = jax.jit(partial(rollout, env, policy))
    middle, first = half(params, actors, halves[0])
    end, second = half(params, middle, halves[1])
    joined = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)
    close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)
    jax.tree.map(close, (end, joined), (following, trajectory))


def test_random_numbers_of_an_environment_come_from_its_own_key():
    """So they do not change with the number of environments or with how they are spread."""
    env, policy, _, *together = scene()
    alone = beginning(env, policy, KEYS[1:2], STEPS)
    (start, draws), (starts, all_draws) = jax.tree.map(np.asarray, (alone, tuple(together)))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[:, 1:2]), draws, all_draws)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[1:2]), start, starts)


def test_the_bootstrap_is_the_value_of_the_likeliest_next_step():
    env, policy, params, _, _ = scene()
    following, _ = rolled()

    @jax.jit
    def both(params, following):
        greedy = policy.greedy_noise((ENVS,))
        obs = jax.vmap(env.observe)(following.env_state)
        _, output = policy.apply_with(params, following.carry, obs, greedy)
        return last_value(env, policy, params, following), output.value

    np.testing.assert_allclose(*both(params, following), rtol=1e-5, atol=1e-6)


def test_no_gradient_goes_through_the_bootstrap():
    env, policy, params, _, _ = scene()
    following, _ = rolled()
    gradient = jax.jit(jax.grad(lambda p: last_value(env, policy, p, following).sum()))(params)
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("gap", [None, 1, 2, 3, 5, 7, 100])
def test_gradients_are_cut_where_detach_gap_says(gap):
    """After a step whose number in its episode, from 1, the gap divides; and between episodes.

    The summing policy's value after step t is the sum of its inputs x_0..x_t, so its derivative
    with respect to x_s is 1 if step s is reached from step t and 0 if not.
    """
    env = Clock(max_steps=7)
    policy, length = summing_policy(env), 7 + 3
    actors, draws = beginning(env, policy, KEYS[:1], length)

    def values(x):
        _, trajectory = rollout(env, policy, {"params": {"x": x}}, actors, draws, gap)
        return trajectory.value[:, 0, 0]

    slope = jax.jit(jax.jacobian(values))(np.zeros(env.max_steps, np.float32))
    expected = np.zeros((length, env.max_steps))
    for t in range(length):
        in_episode = t % env.max_steps
        block = 0 if gap is None else in_episode // gap * gap
        expected[t, block : in_episode + 1] = 1
    np.testing.assert_array_equal(slope, expected)


def test_the_gap_changes_no_value():
    env, policy, params, actors, draws = scene()
    cut = jax.jit(partial(rollout, env, policy, detach_gap=2))(params, actors, draws)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), cut, rolled())


def one_long_scan(env, policy, params, actors, draws, gap):
    """Logits and values (T, E, N, ...) of a scan that cuts memory where the gap says."""
    beginning = policy.initial_carry((ENVS,))

    def body(actors, now):
        carry, output = act(env, policy, params, None, actors, now.noise)
        env_state, transition = jax.vmap(env.step)(actors.env_state, output.action)
        cut = transition.steps_taken % gap == 0
        done = transition.terminated | transition.truncated
        carry = select(cut, jax.lax.stop_gradient(carry), carry)
        env_state, carry = select(done, (now.fresh, beginning), (env_state, carry))
        decisions = {name: decision.logits for name, decision in output.decisions.items()}
        return replace(actors, env_state=env_state, carry=carry), (decisions, output.value)

    return jax.lax.scan(body, actors, draws)[1]


@pytest.mark.parametrize(
    "policy",
    # MAGIC remembers what IC3Net does, an LSTM's state for each agent; HetNet two for some.
    ["ic3net", pytest.param("magic", marks=pytest.mark.slow), "hetnet"],
)
def test_gradients_are_those_of_one_long_scan_that_cuts_memory(policy):
    """The pieces that it is gone through in are a matter of speed only."""
    gap, steps = 2, 40
    assert steps > 2 * GAPS_IN_WINDOW * gap
    learner = tiny_learner(policy=policy)
    env, policy = learner.env, learner.policy
    params, (actors, draws) = random_parameters(policy), beginning(env, policy, KEYS, steps)
    names = ("value", "action", "gate")
    weight = dict(
        zip(names, np.random.default_rng(0).normal(size=(3, steps, ENVS, 1)), strict=True)
    )

    def weighed(logits, value):
        chosen = sum((weight[name][..., None] * x**2).sum() for name, x in logits.items())
        return chosen + (weight["value"] * value).sum()

    def in_pieces(params):
        _, seen = rollout(env, policy, params, actors, draws, gap)
        return weighed({name: d.logits for name, d in seen.decisions.items()}, seen.value)

    def reference(params):
        return weighed(*one_long_scan(env, policy, params, actors, draws, gap))

    @jax.jit
    def both(params):
        return [jax.value_and_grad(objective)(params) for objective in (in_pieces, reference)]

    (a, ours), (b, expected) = jax.tree.map(np.asarray, both(params))
    np.testing.assert_allclose(a, b, rtol=1e-4)
    largest = max(np.abs(leaf).max() for leaf in jax.tree.leaves(expected))
    jax.tree.map(
        partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5 * largest), ours, expected
    )
    assert largest > 1e-2


@dataclass(frozen=True)
class Unlisted(PredatorPrey):
    """Predator-Prey that does not say which state tensors there are."""

    def state_table(self):
        return None

    def state_index(self, state):
        raise AssertionError("there is no table to index")


def test_states_encoded_once_or_at_every_step_give_the_same_gradients():
    """The table is a matter of speed only."""
    shape = {"num_envs": 4, "rollout_length": 10}
    by_table = tiny_learner(TINY_TASK, **shape)
    direct = tiny_learner(Unlisted(size=3, num_predators=2, max_steps=5), **shape)

    @jax.jit
    def both(state):
        inputs = by_table._weights(state), *by_table._inputs(state), state.updates
        return [learner._gradient(*inputs) for learner in (by_table, direct)]

    results = both(begun(by_table))
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6)
    jax.tree.map(close, *results)
    assert any(np.abs(leaf).max() > 1e-3 for leaf in jax.tree.leaves(results[0][0]))
