"""HetNet: two classes, a relation for every pair of them, a critic for each."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import drawn

from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.policies import TeamSpec, make_policy
from sumajax.policies.hetnet import HetGraph, present_relations, team_descriptor
from sumajax.policies.types import MASKED_LOGIT

from .teams import (
    CAPTURE_FIVE,
    CAPTURE_THREE,
    PREY_FIVE,
    PREY_THREE,
    greedy,
    listener,
    observe,
    parameters,
    size,
    small,
    stepper,
)

WIDTHS = (10, 6)
both_kinds = pytest.mark.parametrize("name", ["hetnet", "hetnet-binary"])


def step(policy, obs, noise=None, params=None):
    params = params or parameters(policy)
    return stepper(policy)(params, policy.initial_carry(), obs, noise or greedy(policy))[1]


def graph_of(num_p, num_a, bits=None):
    """A small graph part, its parameters and features of such a team."""
    graph = HetGraph(WIDTHS, heads=2, features=4, bits=bits)
    random = np.random.default_rng(0)
    shapes = (num_p, WIDTHS[0]), (num_a, WIDTHS[1]), (2, num_p + num_a, bits or 0)
    f_p, f_a, noise = (random.normal(size=shape).astype(np.float32) for shape in shapes)
    return graph, (f_p, f_a, np.ones((2, 4), np.float32), noise if bits else None)


@pytest.mark.parametrize("bits", [None, 5])
def test_parameters_do_not_depend_on_which_relations_have_edges(bits):
    trees = []
    for team in [(3, 2), (2, 1), (1, 0), (3, 0), (0, 2), (1, 1)]:
        graph, inputs = graph_of(*team, bits=bits)
        params = jax.eval_shape(graph.init, jax.random.key(0), *inputs)
        trees.append(jax.tree.map(lambda leaf: leaf.shape, params))
    assert all(tree == trees[0] for tree in trees)


@pytest.mark.parametrize(
    ("team", "relations"),
    [
        ((3, 2), {"p2p", "a2p", "p2a", "a2a", "p2s", "a2s"}),
        ((2, 1), {"p2p", "a2p", "p2a", "p2s", "a2s"}),
        ((1, 1), {"a2p", "p2a", "p2s", "a2s"}),
        ((3, 0), {"p2p", "p2s"}),
        ((1, 0), {"p2s"}),
        ((0, 2), {"a2a", "a2s"}),
    ],
)
def test_relations_without_an_edge_are_left_out(team, relations):
    assert set(present_relations(*team)) == relations


@both_kinds
def test_every_agent_hears_every_predator_in_the_same_step(name):
    """Of capture agents nothing can be seen here: their features are their cells, not views."""
    policy = small(name, CAPTURE_THREE)
    noise = policy.sample_noise(jax.random.key(1), ())
    heard = listener(policy)(observe(CAPTURE_THREE, 0), noise)
    np.testing.assert_array_equal(heard, [[True, True, False]] * 3)


@both_kinds
def test_capture_agents_are_heard_too(name):
    """By derivative: a hard bit need not flip when a capture agent moves."""
    policy, obs = small(name, CAPTURE_THREE), observe(CAPTURE_THREE, 0)
    noise = policy.sample_noise(jax.random.key(1), ())

    def of_predators(state):
        return step(policy, obs.replace(state=state), noise).logits[:2].sum()

    by_capturer = jax.jit(jax.grad(of_predators))(obs.state)[2]
    assert (by_capturer != 0).any()


def test_one_agent_alone_acts():
    env = PredatorPrey(size=4, num_predators=1)
    policy = small("hetnet", env)
    output = step(policy, observe(env, 0), params=parameters(small("hetnet")))
    chex.assert_tree_all_finite(output)
    np.testing.assert_array_equal(output.attention, [[0]])


@pytest.mark.parametrize("team", [(0, 2), (2, 0)], ids=["capture agents only", "predators only"])
@both_kinds
def test_a_class_may_be_empty(name, team):
    env = PredatorCapturePrey(size=4, num_predators=team[0], num_capturers=team[1])
    output = step(small(name, env), observe(env, 0), params=parameters(small(name, CAPTURE_THREE)))
    chex.assert_tree_all_finite(output)
    assert output.logits.shape == (2, 6)


def test_a_class_has_one_value():
    value = step(small("hetnet", CAPTURE_FIVE), observe(CAPTURE_FIVE, 0)).value
    assert value[0] == value[1] == value[2] != value[3]
    assert value[3] == value[4]


def test_agents_critics_give_every_agent_a_value():
    policy = small("hetnet", CAPTURE_FIVE, critic="agent")
    value = step(policy, observe(CAPTURE_FIVE, 0), params=parameters(policy)).value
    assert value.shape == (5,)
    assert len(set(value.tolist())) == 5


def test_agents_critics_change_no_decision():
    """And add two layers of 64 inputs, one for each class, to the published parameters."""
    of_class, of_agent = (small("hetnet", CAPTURE_FIVE, critic=kind) for kind in ("class", "agent"))
    assert size(of_agent) == size(of_class) + 2 * (64 + 1)
    obs, params = observe(CAPTURE_FIVE, 0), parameters(of_agent)
    published, ours = (step(policy, obs, params=params) for policy in (of_class, of_agent))
    np.testing.assert_allclose(ours.logits, published.logits, rtol=1e-6)


def test_predators_have_five_actions():
    logits = step(small("hetnet", CAPTURE_THREE), observe(CAPTURE_THREE, 0)).logits
    np.testing.assert_array_equal(logits[:2, 5], [MASKED_LOGIT] * 2)
    assert (jnp.abs(logits[:, :5]) < 100).all()
    assert abs(logits[2, 5]) < 100


def test_both_classes_share_what_they_make_of_their_cell():
    """A predator and a capture agent on one cell have the same position memory."""
    policy, obs = small("hetnet", CAPTURE_THREE), observe(CAPTURE_THREE, 0)
    together = obs.replace(state=np.broadcast_to(obs.state[:1], obs.state.shape))
    carry, _ = stepper(policy)(parameters(policy), policy.initial_carry(), together, greedy(policy))
    np.testing.assert_array_equal(carry.h_state[0], carry.h_state[2])
    assert carry.h_obs.shape == (2, 32)


def test_attention_rows_sum_to_one_for_each_class_that_is_heard():
    output = step(small("hetnet", CAPTURE_FIVE), observe(CAPTURE_FIVE, 0))
    np.testing.assert_array_equal(jnp.diag(output.attention), 0)
    np.testing.assert_allclose(output.attention[:, :3].sum(-1), 1, rtol=1e-5)
    np.testing.assert_allclose(output.attention[:, 3:].sum(-1), 1, rtol=1e-5)


def test_real_messages_use_all_of_the_means_to_talk():
    output = step(small("hetnet"), observe(PREY_THREE, 0))
    np.testing.assert_array_equal(output.communication, 1)


def test_binary_communication_is_the_share_of_bits_set():
    policy = small("hetnet-binary", CAPTURE_THREE)
    noise = greedy(policy)
    # Agent 0 sets every bit of both layers, agent 1 of the first only, agent 2 none.
    forced = np.array([[1e4, 1e4, -1e4], [1e4, -1e4, -1e4]], np.float32)
    noise["bits"] = np.broadcast_to(forced[..., None], noise["bits"].shape)
    output = step(policy, observe(CAPTURE_THREE, 0), noise)
    np.testing.assert_array_equal(output.communication, [1, 0.5, 0])


def test_binary_messages_are_all_that_agents_hear():
    """With every bit decided by the noise, a predator's view moves nobody else."""
    policy = small("hetnet-binary", CAPTURE_THREE)
    noise = greedy(policy)
    noise["bits"] = np.full_like(noise["bits"], 1e4)
    heard = listener(policy)(observe(CAPTURE_THREE, 0), noise)
    np.testing.assert_array_equal(heard, np.diag([True, True, False]))


@pytest.mark.parametrize("bits", [None, 5])
def test_gradients_reach_every_parameter(bits):
    graph, inputs = graph_of(3, 2, bits=bits)
    params = drawn(graph.init, *inputs)

    def loss(params):
        logits, value, _ = graph.apply(params, *inputs)
        return sum((y**2).sum() for y in (*logits.values(), value))

    def zero(path, slope):
        return jax.tree_util.keystr(path) if np.abs(slope).max() == 0 else None

    gradient = jax.jit(jax.grad(loss))(params)
    chex.assert_tree_all_finite(gradient)
    dead = jax.tree.leaves(jax.tree_util.tree_map_with_path(zero, gradient))
    # Two agents of a class have one sender each within it: nothing to weigh.
    assert {path.split("'")[-2] for path in dead} <= {"a2a_dst", "a2a_src"}


@pytest.mark.parametrize(
    ("env", "descriptor"),
    [
        (PREY_FIVE, [0.5, 0.0, 0.2, 1.0]),
        (CAPTURE_FIVE, [0.3, 0.2, 0.2, 1.0]),
    ],
)
def test_state_nodes_know_the_team(env, descriptor):
    team = TeamSpec.of(env)
    np.testing.assert_allclose(team_descriptor(team, "normalised"), [descriptor] * 2)
    raw = [*np.array(descriptor[:2]) * 10, 4, 500]
    np.testing.assert_allclose(team_descriptor(team, "repo"), [raw] * 2)


def test_the_published_descriptor_starts_the_critic_far_off():
    """Over initialisations: the raw numbers, up to 500, make first values of tens."""
    obs, init = observe(PREY_THREE, 0), jax.jit(small("hetnet").init)  # that of either descriptor
    initial = [init(jax.random.key(seed)) for seed in range(8)]

    def spread(meta):
        policy = small("hetnet", meta=meta)
        return np.std([step(policy, obs, params=params).value for params in initial])

    assert spread("repo") > 10 * spread("normalised")


@pytest.mark.parametrize(
    ("env", "parameter_count"),
    [
        (PredatorPrey(size=10, num_predators=5), 285_254),
        (PredatorCapturePrey(size=10), 285_542),
        (PredatorCapturePrey(size=10, num_predators=3, num_capturers=2), 285_542),
    ],
    ids=["predator-prey", "2P1C", "3P2C"],
)
def test_size_is_the_specified_one(env, parameter_count):
    assert size(make_policy("hetnet", env)) == parameter_count


def test_capture_agents_that_see_are_refused():
    with pytest.raises(ValueError, match="capture_vision=None"):
        make_policy("hetnet", PredatorCapturePrey(size=4, capture_vision=1))


@pytest.mark.parametrize(
    "change",
    [
        {"agent_class": (1, 0, 0)},
        {"agent_class": (0, 1, 2)},
        {"action_mask": ((True,) * 6,) * 3},
        {"num_actions": 4, "action_mask": ((True,) * 4,) * 3},
    ],
    ids=["capture agents first", "three classes", "predators that capture", "too few actions"],
)
def test_teams_it_is_not_made_for_are_refused(change):
    policy = small("hetnet", CAPTURE_THREE)
    with pytest.raises(ValueError, match="hetnet"):
        type(policy.module)(team=replace(policy.team, **change))
