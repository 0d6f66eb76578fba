"""TarMAC: who hears whom, how much, and when."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import drawn

from sumajax.environments import PredatorPrey
from sumajax.policies import make_policy
from sumajax.policies.ic3net import IC3NetCarry
from sumajax.policies.tarmac import TarMACCore, attend, hears

from .teams import PREY_THREE, greedy, listener, observe, parameters, size, small, stepper

OTHERS = ~np.eye(3, dtype=bool)


def heard_later(name, **talk):
    """(N, N) bool: whose view of the first step moves whose logits of the second."""
    return listener(small(name), steps=2)(observe(PREY_THREE, 0), **talk)


def test_everybody_hears_everybody_who_talks():
    assert heard_later("tarmac-ic3net", gate=[1, 1, 1]).all()


def test_a_silent_agent_is_not_heard_but_hears():
    heard = heard_later("tarmac-ic3net", gate=[1, 0, 1])
    np.testing.assert_array_equal(heard, [[1, 0, 1], [1, 1, 1], [1, 0, 1]])


def test_nobody_hears_a_silent_team():
    assert not heard_later("tarmac-ic3net", gate=[0, 0, 0])[OTHERS].any()


def test_without_a_gate_everybody_always_talks():
    assert heard_later("tarmac").all()


@pytest.mark.parametrize(("passes", "heard"), [(1, np.eye(3)), (2, np.ones((3, 3)))])
def test_messages_are_one_step_old_unless_there_is_a_second_round(passes, heard):
    policy = small("tarmac", comm_passes=passes)
    np.testing.assert_array_equal(listener(policy)(observe(PREY_THREE, 0)), heard)


class TestAttention:
    """Weights (receivers, senders), by hand."""

    query = np.log(np.array([[1.0], [2.0], [4.0]]))
    key = np.array([[0.0], [1.0], [2.0]])

    def test_is_a_softmax_over_all_senders_oneself_included(self):
        expected = np.array([[1, 1, 1], [1, 2, 4], [1, 4, 16]])
        expected = expected / expected.sum(-1, keepdims=True)
        np.testing.assert_allclose(attend(self.query, self.key), expected, rtol=1e-5)

    def test_is_over_those_who_talk(self):
        expected = np.array([[1, 0, 1], [1, 0, 4], [1, 0, 16]])
        expected = expected / expected.sum(-1, keepdims=True)
        ours = attend(self.query, self.key, np.array([1.0, 0.0, 1.0]))
        np.testing.assert_allclose(ours, expected, rtol=1e-5)

    def test_is_nothing_where_nobody_talks_and_has_a_derivative_there(self):
        def total(query):
            return attend(query, self.key, jnp.zeros(3)).sum()

        value, slope = jax.value_and_grad(total)(jnp.asarray(self.query))
        assert value == 0
        np.testing.assert_array_equal(slope, np.zeros((3, 1)))

    def test_who_is_not_there_hears_nothing(self):
        there = np.array([1.0, 0.0, 1.0])
        ours = attend(self.query, self.key, there, there)
        np.testing.assert_array_equal(ours[1], [0, 0, 0])
        np.testing.assert_allclose(ours.sum(-1), hears(there, there), rtol=1e-6)


def core_step(core, gate, seed=0, alive=None, change=None):
    """h of one step of a core whose memory, features and parameters follow from the seed."""
    n, hidden = len(gate), core.hidden
    rng = np.random.default_rng(seed)
    h, s, x = (rng.normal(size=(n, hidden)).astype(np.float32) for _ in range(3))

    def run(core, *inputs):
        folded = core.fold(jnp.zeros((0, hidden)))
        return core(*inputs[:2], inputs[1][..., :0], folded, alive)

    def both(params, carry, x):
        projected = core.apply(params, x, method=core.project_input)
        return core.apply(params, carry, projected, method=run)

    carry = IC3NetCarry(h, s, np.asarray(gate, np.float32))
    params = drawn(core.init, carry, jnp.zeros((n, 4 * hidden)), method=run)
    params = params if change is None else change(params)
    return jax.jit(both)(params, carry, x), params, (h, s, x)


def set_to(name, kind, value):
    def change(params):
        core = params["params"]
        layer = core[name] | {kind: np.full_like(core[name][kind], value)}
        return {"params": core | {name: layer}}

    return change


CORE = TarMACCore(hidden=8, num_actions=3)
TWICE = TarMACCore(hidden=8, num_actions=3, comm_passes=2)


@jax.jit
def lstm_of_core(params, memory, x):
    """h after a step of the LSTM of `CORE` alone."""
    return CORE.apply(params, memory, x, method=lambda core, *inputs: core.lstm(*inputs))[0]


def test_silence_is_the_layer_without_a_message():
    """The bias of C is always added, so that silence is not the absence of the layer."""
    (ours, *_), params, (h, s, x) = core_step(CORE, [0, 0])
    weights = params["params"]
    expected = lstm_of_core(params, (h, s), x + weights["C_0"]["bias"])
    np.testing.assert_allclose(ours, expected, atol=1e-6)


def test_what_is_heard_by_its_definition():
    """Message, C and the LSTM's input are one product in the program; here one after the other."""
    (ours, *_, attention), params, (h, s, x) = core_step(CORE, [1, 1, 0])
    weights = params["params"]

    def dense(name, y):
        return y @ weights[name]["kernel"] + weights[name]["bias"]

    scores = np.exp(dense("query", h) @ dense("key", h).T / np.sqrt(8)) * [1, 1, 0]
    scores = scores / scores.sum(-1, keepdims=True)
    np.testing.assert_allclose(attention[0], scores, atol=1e-6)
    heard = dense("C_0", scores @ dense("message", h))
    expected = lstm_of_core(params, (h, s), x + heard)
    np.testing.assert_allclose(ours, expected, atol=1e-6)


def test_the_second_round_is_a_step_of_the_lstm_even_if_nothing_is_said_in_it():
    def say_nothing(params):
        return set_to("C_1", "kernel", 0.0)(set_to("C_1", "bias", 0.0)(params))

    (once, *_), *_ = core_step(CORE, [1, 1])
    (twice, *_), *_ = core_step(TWICE, [1, 1], change=say_nothing)
    assert np.abs(once - twice).max() > 1e-2


def test_the_bias_of_signatures_changes_nothing():
    (ours, *_), *_ = core_step(CORE, [1, 1, 1])
    (biased, *_), *_ = core_step(CORE, [1, 1, 1], change=set_to("key", "bias", 5.0))
    np.testing.assert_array_equal(ours, biased)


def test_the_paper_divides_scores_by_less():
    """By the root of the keys' 16, not of the hidden width: the same where both are 16."""
    for hidden, same in ((16, True), (64, False)):
        of_program, of_paper = (
            core_step(TarMACCore(hidden, 3, score_scale=scale), [1, 1, 1])[0][-1]
            for scale in ("hidden", "key")
        )
        assert np.allclose(of_program, of_paper, atol=1e-7) == same


def test_one_agent_alone_hears_itself():
    (_, _, _, _, attention), *_ = core_step(CORE, [1])
    np.testing.assert_array_equal(attention, [[[1]]])


def test_the_gate_is_chosen_one_step_ahead():
    policy = small("tarmac-ic3net")
    params, start = parameters(policy), policy.initial_carry()
    np.testing.assert_array_equal(start.gate, [0, 0, 0])
    noise = greedy(policy)
    noise["gate"] = jnp.array([[0.0, 9.0], [9.0, 0.0], [0.0, 9.0]])
    carry, output = stepper(policy)(params, start, observe(PREY_THREE, 0), noise)
    np.testing.assert_array_equal(output.decisions["gate"].choice, [1, 0, 1])
    np.testing.assert_array_equal(output.communication, [0, 0, 0])
    np.testing.assert_array_equal(output.attention, np.zeros((3, 3)))
    _, output = stepper(policy)(params, carry, observe(PREY_THREE, 1), noise)
    np.testing.assert_array_equal(output.communication, [1, 0, 1])
    np.testing.assert_array_equal(output.attention > 0, [[1, 0, 1]] * 3)
    np.testing.assert_allclose(output.attention.sum(-1), np.ones(3), rtol=1e-6)


@pytest.mark.parametrize("name", ["ic3net", "tarmac-ic3net"])
def test_a_gate_that_is_taken_as_open_is_drawn_all_the_same(name):
    """From the second step on; in the first nobody talks."""
    policy = small(name, talk_always=True)
    params, start, noise = parameters(policy), policy.initial_carry(), greedy(policy)
    np.testing.assert_array_equal(start.gate, [0, 0, 0])
    noise["gate"] = jnp.array([[9.0, 0.0]] * 3)
    carry, output = stepper(policy)(params, start, observe(PREY_THREE, 0), noise)
    np.testing.assert_array_equal(output.decisions["gate"].choice, [0, 0, 0])
    np.testing.assert_array_equal(carry.gate, [1, 1, 1])


def test_what_is_decided_besides_the_action():
    for name, decisions in {"tarmac-ic3net": {"action", "gate"}, "tarmac": {"action"}}.items():
        policy = small(name)
        _, output = stepper(policy)(
            parameters(policy), policy.initial_carry(), observe(PREY_THREE, 0), greedy(policy)
        )
        assert set(output.decisions) == decisions


@pytest.mark.parametrize(("passes", "parameter_count"), [(1, 245_128), (2, 261_640)])
def test_size_is_the_specified_one(passes, parameter_count):
    env = PredatorPrey(size=10, num_predators=5)
    assert size(make_policy("tarmac-ic3net", env, comm_passes=passes)) == parameter_count
