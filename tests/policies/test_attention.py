"""Graph attention: which senders count, by how much, and what the graph learns from it."""

from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import drawn

from sumajax.policies.attention import GraphAttention, relation_attention

AGENTS, INPUTS, HEADS, FEATURES = 4, 6, 2, 3

GRAPH = np.array(
    [
        [1.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 0.0],  # hears nobody
        [1.0, 1.0, 1.0, 1.0],  # hears everybody
        [0.0, 1.0, 0.0, 0.0],
    ],
    np.float32,
)
ISOLATED, FULL = 1, 2


@lru_cache
def attention(**settings):
    """The compiled layer, a function of messages and graph."""
    layer = GraphAttention(INPUTS, HEADS, FEATURES, **settings)
    params = drawn(layer.init, np.zeros((AGENTS, INPUTS), np.float32))
    params["params"]["bias"] *= 0  # as it starts
    return jax.jit(lambda m, graph: layer.apply(params, m, graph))


def attend(graph, **settings):
    """Output, weights and the function of messages and graph that gave them."""
    m = np.random.default_rng(0).normal(size=(AGENTS, INPUTS)).astype(np.float32)
    output = attention(**settings)
    return *output(m, graph), output, m


def masked_softmax(output, m):
    """The weights over present edges only, from the complete graph's unnormalised ones."""
    _, complete = output(m, np.ones_like(GRAPH))
    present = complete * GRAPH[..., None]
    return present / np.maximum(present.sum(1, keepdims=True), 1e-9)


@pytest.mark.parametrize("average", [False, True])
def test_normalised_weights_are_a_softmax_over_the_present_edges(average):
    _, weights, output, m = attend(GRAPH, normalize=True, average=average)
    np.testing.assert_allclose(weights, masked_softmax(output, m), atol=1e-6)


def test_an_isolated_receiver_hears_its_bias_only():
    y, weights, *_ = attend(GRAPH, normalize=True)
    np.testing.assert_array_equal(weights[ISOLATED], 0)
    np.testing.assert_array_equal(y[ISOLATED], 0)  # the bias starts at zero


def test_an_isolated_receiver_can_learn_to_open_its_edges():
    """Replacing the factors by a mask would leave it without a gradient."""
    *_, output, m = attend(GRAPH, normalize=True)
    slope = jax.jit(jax.grad(lambda graph: output(m, graph)[0][ISOLATED].sum()))(GRAPH)
    slope = np.asarray(slope)
    assert np.isfinite(slope).all()
    assert (slope[ISOLATED] != 0).all()
    np.testing.assert_array_equal(np.delete(slope, ISOLATED, axis=0), 0)


def test_without_normalising_absent_edges_take_their_share():
    _, weights, *_ = attend(GRAPH, normalize=False)
    total = np.asarray(weights).sum(1)
    np.testing.assert_allclose(total[FULL], 1, rtol=1e-6)
    assert (total[np.array([0, 3])] < 1).all()


@pytest.mark.parametrize(("self_loop", "diagonal"), [("removed", 0), ("forced", 1)])
def test_the_diagonal_is_as_set(self_loop, diagonal):
    _, weights, *_ = attend(GRAPH, self_loop=self_loop)
    present = np.array(GRAPH)
    np.fill_diagonal(present, diagonal)
    np.testing.assert_array_equal(weights > 0, np.repeat(present[..., None] > 0, HEADS, axis=-1))


def test_no_graph_is_the_complete_graph():
    y, weights, output, m = attend(None, average=True, self_loop="forced")
    expected, expected_weights = output(m, np.ones_like(GRAPH))
    np.testing.assert_array_equal(y, expected)
    np.testing.assert_array_equal(weights, expected_weights)


def test_heads_are_averaged_or_concatenated():
    side_by_side, *_ = attend(GRAPH, average=False)
    mean, *_ = attend(GRAPH, average=True)
    assert side_by_side.shape == (AGENTS, HEADS * FEATURES)
    np.testing.assert_allclose(
        mean, side_by_side.reshape(AGENTS, HEADS, FEATURES).mean(1), atol=1e-6
    )


def test_messages_flow_along_the_edges_only():
    *_, output, m = attend(GRAPH, normalize=True)
    slope = jax.jit(jax.jacrev(lambda m: output(m, GRAPH)[0]))(m)  # (N, K O, N, D)
    hears = np.asarray(np.abs(slope).sum((1, 3)) > 0)
    hears_itself_too = np.asarray(GRAPH > 0)  # a receiver's own score matters where it hears two
    np.testing.assert_array_equal(
        hears & ~np.eye(AGENTS, dtype=bool), hears_itself_too & ~np.eye(AGENTS, dtype=bool)
    )


def test_initial_weights_have_the_published_spread():
    layer = GraphAttention(128, 8, 32)
    weights = jax.jit(layer.init)(jax.random.key(0), jnp.zeros((2, 128)))["params"]
    weights = jax.tree.map(np.asarray, weights)
    np.testing.assert_allclose(weights["W"].std(), 0.102, rtol=0.03)
    for vector in ("a_i", "a_j"):
        np.testing.assert_allclose(weights[vector].std(), 0.316, rtol=0.15)
    np.testing.assert_array_equal(weights["bias"], 0)


@pytest.fixture(scope="module")
def relation():
    """Receivers' and senders' shares of the scores (3, K) and messages (3, K, O)."""
    random = np.random.default_rng(0)
    shapes = [(3, HEADS), (3, HEADS), (3, HEADS, FEATURES)]
    return [random.normal(size=shape).astype(np.float32) for shape in shapes]


def test_a_relation_weighs_its_senders_by_a_softmax(relation):
    receiver, sender, messages = relation
    heard, weights = jax.jit(relation_attention)(*relation)
    scores = receiver[:, None] + sender[None]
    scores = np.where(scores > 0, scores, 0.2 * scores)
    expected = np.exp(scores) / np.exp(scores).sum(1, keepdims=True)
    np.testing.assert_allclose(weights, expected, rtol=1e-5)
    np.testing.assert_allclose(heard, np.einsum("jik,iko->jko", expected, messages), rtol=1e-4)


def test_a_relation_within_a_class_has_no_self_edge(relation):
    _, weights = jax.jit(partial(relation_attention, exclude_self=True))(*relation)
    weights = np.asarray(weights)
    np.testing.assert_array_equal(weights[np.arange(3), np.arange(3)], 0)
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-6)


def test_a_single_sender_is_heard_in_full(relation):
    receiver, sender, messages = relation
    heard, _ = jax.jit(relation_attention)(receiver, sender[:1], messages[:1])
    np.testing.assert_allclose(heard, np.broadcast_to(messages[:1], heard.shape), rtol=1e-6)
