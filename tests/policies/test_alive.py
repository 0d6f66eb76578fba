"""Agents that are not there: they say nothing, hear nothing, and are no part of the team's mean."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax.policies import Policy, PolicyModule, TeamSpec, make_policy

from .teams import PREY_FIVE, PREY_THREE, ComeAndGo, greedy, observe, parameters, small, stepper

FIVE = ComeAndGo(size=4, num_predators=5)
THREE = ComeAndGo(size=4, num_predators=3)
ALIVE = np.array([1, 0, 1, 1, 0], bool)

POLICIES: dict[str, tuple[str, dict[str, Any]]] = {
    "ic3net": ("ic3net", {}),
    "ic3net, two rounds": ("ic3net", {"comm_passes": 2}),
    "commnet": ("commnet", {}),
    "iric": ("iric", {}),
    "magic": ("magic", {}),
    "magic, complete graphs": ("magic", {"setting": "complete"}),
    "tarmac": ("tarmac", {}),
    "tarmac-ic3net, two rounds": ("tarmac-ic3net", {"comm_passes": 2}),
}
each_policy = pytest.mark.parametrize(("name", "settings"), POLICIES.values(), ids=POLICIES)


def second_step(policy, env, alive, disturb=None, order=None):
    """What the team does in its second step, everybody there in the first and willing to talk.

    `disturb` changes what the agents (N,) it names see and remember; `order` reorders the team.
    """
    params, step, n = parameters(policy), stepper(policy), env.num_agents
    noise = greedy(policy)
    if "graph" in noise:
        noise["graph"] = np.full_like(noise["graph"], 9.0)
    if "gate" in noise:
        noise["gate"] = np.broadcast_to(np.array([0.0, 99.0], np.float32), (n, 2))
    everybody = None if alive is None else np.ones(n, bool)
    first = observe(env, 0, alive=everybody)
    second = observe(env, 1, alive=alive)
    if order is not None:
        first, second = jax.tree.map(lambda y: y[order], (first, second))
    carry, _ = step(params, policy.initial_carry(), first, noise)
    if disturb is not None:
        second = second.replace(view=np.where(disturb[:, None, None, None], 7.0, second.view))
        carry = carry.replace(h=np.where(disturb[:, None], np.float32(0.9), carry.h))
    return step(params, carry, second, noise)


@each_policy
def test_what_an_absent_agent_remembers_and_sees_changes_nobody(name, settings):
    policy = small(name, FIVE, **settings)
    carry, output = second_step(policy, FIVE, ALIVE)
    other_carry, other = second_step(policy, FIVE, ALIVE, disturb=~ALIVE)
    assert np.abs(carry.h - other_carry.h)[~ALIVE].max() > 0.01
    np.testing.assert_array_equal(carry.h[ALIVE], other_carry.h[ALIVE])
    np.testing.assert_array_equal(output.logits[ALIVE], other.logits[ALIVE])
    np.testing.assert_array_equal(output.value[ALIVE], other.value[ALIVE])


@each_policy
def test_an_absent_agent_hears_nothing(name, settings):
    policy = small(name, FIVE, **settings)
    carry, output = second_step(policy, FIVE, ALIVE)
    other_carry, other = second_step(policy, FIVE, ALIVE, disturb=ALIVE)
    np.testing.assert_array_equal(carry.h[~ALIVE], other_carry.h[~ALIVE])
    np.testing.assert_array_equal(output.logits[~ALIVE], other.logits[~ALIVE])


@each_policy
def test_an_absent_agent_is_shown_as_silent(name, settings):
    _, output = second_step(small(name, FIVE, **settings), FIVE, ALIVE)
    talks = name != "iric"
    np.testing.assert_array_equal(output.communication, talks * ALIVE)
    pairs = np.array(output.attention)
    np.fill_diagonal(pairs, 0)
    np.testing.assert_array_equal(
        pairs > 0, talks * ALIVE[:, None] * ALIVE * ~np.eye(5, dtype=bool)
    )


@each_policy
def test_with_everybody_there_nothing_is_different(name, settings):
    masked = second_step(small(name, FIVE, **settings), FIVE, np.ones(5, bool))
    plain = second_step(small(name, PREY_FIVE, **settings), PREY_FIVE, None)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), masked, plain)


@pytest.mark.parametrize("alive", [ALIVE, [1, 0, 0, 0, 0], [0, 0, 0, 0, 0]], ids=str)
@each_policy
def test_order_of_the_agents_means_nothing(name, settings, alive):
    policy, order = small(name, FIVE, **settings), np.array([3, 0, 4, 1, 2])
    alive = np.asarray(alive, bool)
    _, output = second_step(policy, FIVE, alive)
    _, swapped = second_step(policy, FIVE, alive, order=order)
    assert np.isfinite(output.logits).all()
    np.testing.assert_allclose(swapped.logits, output.logits[order], atol=1e-5)
    np.testing.assert_allclose(swapped.value, output.value[order], atol=1e-5)
    np.testing.assert_allclose(swapped.attention, output.attention[order][:, order], atol=1e-5)


@pytest.mark.parametrize("name", ["ic3net", "commnet", "tarmac", "tarmac-ic3net"])
def test_a_team_with_absent_agents_is_the_smaller_team(name):
    """Not MAGIC: its softmax counts absent edges, as published."""
    params, here = parameters(small(name, THREE)), np.flatnonzero(ALIVE)
    large, few = small(name, FIVE), small(name, PREY_THREE)
    obs = observe(FIVE, 3, alive=ALIVE)
    memory = np.random.default_rng(5).normal(size=(5, 16)).astype(np.float32)
    carry = large.initial_carry().replace(h=memory, s=memory, gate=np.ones(5, np.float32))
    _, output = stepper(large)(params, carry, obs, greedy(large))
    alone = obs.replace(state=obs.state[here], view=obs.view[here], alive=None)
    carry = jax.tree.map(lambda y: y[here], carry)
    _, expected = stepper(few)(params, carry, alone, greedy(few))
    np.testing.assert_allclose(output.logits[here], expected.logits, atol=1e-6)
    np.testing.assert_allclose(output.attention[np.ix_(here, here)], expected.attention, atol=1e-6)


class Unaware(PolicyModule):
    """A policy made without a thought of agents that leave."""

    def encode_states(self, states):
        return states

    def __call__(self, carry, state_features, view, noise):
        return carry, None

    def initial_carry(self, batch_shape):
        return ()

    def sample_noise(self, key, batch_shape):
        return ()


def test_a_policy_that_does_not_ask_who_is_there_serves_where_nobody_leaves():
    policy = Policy("unaware", Unaware(TeamSpec.of(PREY_THREE)))
    policy.step({}, (), jnp.zeros(3), jnp.zeros(3), ())


def test_a_policy_that_does_not_ask_who_is_there_is_refused_where_agents_leave():
    policy = Policy("unaware", Unaware(TeamSpec.of(THREE)))
    with pytest.raises(
        ValueError, match=r"Unaware has no argument `alive`; give Unaware\.__call__"
    ):
        policy.step({}, (), jnp.zeros(3), jnp.zeros(3), (), np.ones(3, bool))


def test_an_observation_must_say_who_is_there_where_agents_leave():
    policy = small("commnet", THREE)
    carry, obs = policy.initial_carry(), observe(THREE, 0)
    with pytest.raises(ValueError, match="nothing says who is there: set `alive` of the observ"):
        jax.jit(policy.apply)(parameters(policy), carry, obs, jax.random.key(0))


@pytest.mark.parametrize("name", ["hetnet", "hetnet-binary"])
def test_hetnet_has_no_absent_agents(name):
    with pytest.raises(ValueError, match="agents of this task come and go; use another policy"):
        make_policy(name, THREE)
