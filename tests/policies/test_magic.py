"""MAGIC: a learned graph decides who hears whom in this step, and nothing of it is remembered."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax.environments import PredatorPrey
from sumajax.policies import make_policy
from sumajax.policies.magic import Scheduler, edge_density

from .teams import PREY_THREE, greedy, listener, observe, parameters, shapes, size, small, stepper

DRAWN = 1e4
"""Noise that decides an edge whatever its logits."""


def with_graph(policy, graph):
    """Greedy noise, but every round's graph is `graph` (N, N): rows hear, columns speak."""
    noise = greedy(policy)
    forced = DRAWN * (2 * np.asarray(graph, np.float32) - 1)
    return noise | {"graph": np.broadcast_to(forced, noise["graph"].shape)}


def heard(graph, setting="medium"):
    """(N, N) bool: whose view moves whose logits in the same step."""
    policy = small("magic", setting=setting)
    return listener(policy)(observe(PREY_THREE, 0), with_graph(policy, graph))


@pytest.mark.parametrize("setting", ["medium", "hard"])
def test_everybody_hears_everybody_on_a_complete_graph(setting):
    assert heard(np.ones((3, 3)), setting).all()


@pytest.mark.parametrize("setting", ["medium", "hard"])
def test_nobody_hears_anybody_on_an_empty_graph(setting):
    np.testing.assert_array_equal(heard(np.zeros((3, 3)), setting), np.eye(3, dtype=bool))


def test_rows_hear_columns():
    graph = np.eye(3)
    graph[0, 2] = 1
    np.testing.assert_array_equal(heard(graph), graph.astype(bool))


def test_two_rounds_carry_a_message_over_a_relay():
    """0 hears 1 and 1 hears 2: after the second round 0 has heard 2."""
    graph = np.eye(3)
    graph[0, 1] = graph[1, 2] = 1
    assert heard(graph)[0, 2]


def test_what_was_heard_is_not_remembered():
    policy = small("magic")
    params, obs = parameters(policy), observe(PREY_THREE, 0)
    carries = [
        stepper(policy)(params, policy.initial_carry(), obs, with_graph(policy, graph))[0]
        for graph in (np.zeros((3, 3)), np.ones((3, 3)))
    ]
    chex.assert_trees_all_equal(*carries)


@pytest.mark.parametrize("setting", ["medium", "hard"])
def test_the_scheduler_learns_through_the_drawn_graph(setting):
    policy = small("magic", setting=setting)
    params, obs = parameters(policy), observe(PREY_THREE, 0)
    noise = policy.sample_noise(jax.random.key(1), ())

    def loss(params):
        output = policy.apply_with(params, policy.initial_carry(), obs, noise)[1]
        return (output.value**2).sum() + (jax.nn.softmax(output.logits) ** 2).sum()

    gradient = jax.jit(jax.grad(loss))(params)["params"]["core"]
    chex.assert_tree_all_finite(gradient)
    for layer in ("scheduler", "gat_enc"):
        for name, leaf in gradient[layer].items():
            assert jnp.abs(leaf).max() > 0, f"{layer} {name}"


def test_greedy_edges_are_those_the_logits_prefer():
    policy = small("magic")
    params, obs = parameters(policy), observe(PREY_THREE, 0)
    inputs = (params, policy.initial_carry(), obs, greedy(policy))
    method = policy.module.encode_and_step
    (_, output), seen = jax.jit(
        lambda *x: policy.module.apply(*x, method=method, capture_intermediates=True)
    )(*inputs)
    (logits,) = seen["intermediates"]["core"]["scheduler"]["__call__"]
    preferred = (logits[..., 1] > logits[..., 0]).astype(jnp.float32)
    np.testing.assert_array_equal(output.communication, edge_density(preferred))


def test_communication_is_the_share_of_others_a_sender_reaches():
    graphs = np.zeros((2, 3, 3))
    graphs[0, 0, 1] = graphs[0, 2, 1] = 1  # in the first round 1 reaches both others
    graphs[1, 0, 1] = graphs[1, 0, 2] = 1  # in the second 1 and 2 reach agent 0
    graphs[:, 0, 0] = 1  # reaching oneself does not count
    np.testing.assert_allclose(edge_density(jnp.asarray(graphs)), [0, 3 / 4, 1 / 4])
    assert edge_density(jnp.ones((1, 1, 1))) == 0


def test_attention_is_that_of_the_first_round():
    policy = small("magic")
    graph = np.array([[1, 1, 0], [0, 0, 0], [1, 1, 1]])
    _, output = stepper(policy)(
        parameters(policy),
        policy.initial_carry(),
        observe(PREY_THREE, 0),
        with_graph(policy, graph),
    )
    np.testing.assert_array_equal(output.attention > 0, graph > 0)
    np.testing.assert_allclose(output.attention.sum(-1), [1, 0, 1], atol=1e-6)


def test_scheduler_is_an_mlp_on_each_ordered_pair():
    """Its first layer is done per agent and its graphs together; here pair by pair, one by one."""
    scheduler, e = Scheduler(in_features=8, graphs=2), jax.random.normal(jax.random.key(1), (3, 8))
    params = scheduler.init(jax.random.key(0), e)
    logits, weights = scheduler.apply(params, e), params["params"]
    assert logits.shape == (2, 3, 3, 2)
    for q, i, j in np.ndindex(2, 3, 3):
        x = jnp.concatenate([e[i], e[j]])
        for layer in range(3):
            x = x @ weights[f"kernel_{layer}"][q] + weights[f"bias_{layer}"][q]
            x = jax.nn.relu(x) if layer < 2 else x
        np.testing.assert_allclose(logits[q, i, j], x, atol=1e-5)


@pytest.mark.parametrize(
    ("setting", "graphs", "heads", "decodes"), [("medium", 2, 8, False), ("hard", 1, 4, True)]
)
def test_published_settings(setting, graphs, heads, decodes):
    policy = make_policy("magic", PREY_THREE, setting=setting)
    core = shapes(policy)["params"]["core"]
    assert core["scheduler"]["kernel_0"] == (graphs, 64, 16)
    assert core["gat_enc"]["a_i"] == (heads, 32)
    assert ("decoder" in core) == decodes
    assert greedy(policy)["graph"].shape == (graphs, 3, 3)


def test_published_for_agents_that_come_and_go():
    """Everybody hears everybody: nothing is drawn, and there is no scheduler."""
    policy = make_policy("magic", PREY_THREE, setting="complete")
    core = shapes(policy)["params"]["core"]
    assert not {"scheduler", "gat_enc"} & set(core)
    assert core["decoder"]["kernel"] == (128, 128)
    assert "graph" not in greedy(policy)
    _, output = stepper(policy)(
        parameters(policy), policy.initial_carry(), observe(PREY_THREE, 0), greedy(policy)
    )
    np.testing.assert_array_equal(output.communication, [1, 1, 1])
    assert (output.attention > 0).all()


def test_size_is_the_specified_one():
    policy = make_policy("magic", PredatorPrey(size=10, num_predators=5))
    assert size(policy) == 278_026
