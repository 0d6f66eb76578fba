"""IC3Net and its special cases: who hears what, and when."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax.environments import PredatorPrey
from sumajax.policies import make_policy
from sumajax.policies.ic3net import (
    IC3NetCarry,
    IC3NetCore,
    heard_by_all,
    max_message,
    mean_message,
    talking_message,
    weights_of_senders,
)

from .teams import PREY_THREE, greedy, listener, observe, parameters, size, small, stepper

OTHERS = ~np.eye(3, dtype=bool)


def heard_later(name, **talk):
    """(N, N) bool: whose view of the first step moves whose logits of the second."""
    return listener(small(name), steps=2)(observe(PREY_THREE, 0), **talk)


def test_everybody_hears_everybody_who_talks():
    assert heard_later("ic3net", gate=[1, 1, 1]).all()


def test_a_silent_agent_is_not_heard_and_hears_nothing():
    heard = heard_later("ic3net", gate=[1, 0, 1])
    np.testing.assert_array_equal(heard, [[1, 0, 1], [0, 1, 0], [1, 0, 1]])


def test_nobody_hears_a_silent_team():
    assert not heard_later("ic3net", gate=[0, 0, 0])[OTHERS].any()


def test_without_a_gate_everybody_always_talks():
    assert heard_later("commnet").all()


@pytest.mark.parametrize("name", ["iric", "ic"])
def test_independent_controllers_hear_nothing(name):
    assert not heard_later(name)[OTHERS].any()


@pytest.mark.parametrize(("passes", "heard"), [(1, np.eye(3)), (2, np.ones((3, 3)))])
def test_messages_are_one_step_old_unless_there_is_a_second_pass(passes, heard):
    policy = small("commnet", comm_passes=passes)
    np.testing.assert_array_equal(listener(policy)(observe(PREY_THREE, 0)), heard)


def test_a_message_is_the_mean_over_all_others_not_over_those_who_talk():
    h = jnp.array([[1.0, 10.0], [2.0, 20.0], [4.0, 40.0]])
    np.testing.assert_allclose(
        mean_message(h, jnp.array([1.0, 1.0, 0.0])), [[1, 10], [0.5, 5], [0, 0]]
    )
    np.testing.assert_allclose(mean_message(h, jnp.ones(3))[2], [1.5, 15])


SAID = jnp.array([[0.1, 0.6], [0.2, -0.5], [0.4, 0.9]])
MESSAGES = ("mean", "talking", "max")


def test_on_request_a_message_is_the_mean_over_those_who_talk():
    two = talking_message(SAID, jnp.array([1.0, 1.0, 0.0]), None)
    np.testing.assert_allclose(two, [[0.2, -0.5], [0.1, 0.6], [0, 0]], rtol=1e-6)
    all_talk = jnp.ones(3)
    np.testing.assert_allclose(
        talking_message(SAID, all_talk, None), mean_message(SAID, all_talk, None), rtol=1e-6
    )
    alone = talking_message(SAID, jnp.array([1.0, 0.0, 0.0]), None)
    np.testing.assert_array_equal(alone, np.zeros_like(SAID))


def test_on_request_a_message_is_the_largest_of_those_who_talk():
    all_talk = max_message(SAID, jnp.ones(3), None)
    np.testing.assert_allclose(all_talk, [[0.4, 0.9]] * 3)
    two = max_message(SAID, jnp.array([1.0, 1.0, 0.0]), None)
    np.testing.assert_allclose(two, [[0.2, 0.6], [0.2, 0.6], [0, 0]])
    np.testing.assert_array_equal(max_message(SAID, jnp.zeros(3), None), np.zeros_like(SAID))


def test_who_is_not_there_is_no_voice_of_any_message():
    there, gone = jnp.array([True, True, False]), jnp.array([1.0, 1.0, 0.0])
    for message in MESSAGES[1:]:
        np.testing.assert_array_equal(
            heard_by_all(message, SAID, jnp.ones(3), there), heard_by_all(message, SAID, gone, None)
        )


@pytest.mark.parametrize(("message", "kept"), [("mean", 1 / 9), ("talking", 1.0), ("max", 1.0)])
def test_how_much_of_one_voice_is_left_in_a_team_of_ten(message, kept):
    """The first agent talks and says 0.5; of the others, who say nothing, the last one listens."""
    gate = jnp.zeros(10).at[jnp.array([0, 9])].set(1.0)
    said = jnp.zeros((10, 1)).at[0].set(0.5)
    heard = heard_by_all(message, said, gate, None)
    np.testing.assert_allclose(heard[9], [0.5 * kept], rtol=1e-6)


@pytest.mark.parametrize("message", MESSAGES)
def test_attention_is_each_senders_share_in_what_is_heard(message):
    gate = jnp.array([1.0, 1.0, 0.0])
    weights = weights_of_senders(message, SAID, gate, None)
    expected = {
        "mean": [[0, 0.5, 0], [0.5, 0, 0], [0, 0, 0]],
        "talking": [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        "max": [[0.5, 0.5, 0], [0.5, 0.5, 0], [0, 0, 0]],
    }[message]
    np.testing.assert_allclose(weights, expected)


@pytest.mark.parametrize("message", MESSAGES)
def test_the_policy_hears_what_its_setting_says(message):
    heard = listener(small("ic3net", message=message), steps=2)(
        observe(PREY_THREE, 0), gate=[1, 0, 1]
    )
    np.testing.assert_array_equal(heard, [[1, 0, 1], [0, 1, 0], [1, 0, 1]])


def test_the_kind_of_message_changes_no_parameter():
    published, other = (
        jax.eval_shape(small("ic3net", message=m).init, jax.random.key(0)) for m in ("mean", "max")
    )
    assert published == other


def test_one_agent_alone_hears_nothing():
    np.testing.assert_array_equal(mean_message(jnp.ones((1, 4)), jnp.ones(1)), np.zeros((1, 4)))


def test_the_gate_is_chosen_one_step_ahead():
    policy = small("ic3net")
    params, start = parameters(policy), policy.initial_carry()
    np.testing.assert_array_equal(start.gate, [0, 0, 0])
    noise = greedy(policy)
    noise["gate"] = jnp.array([[0.0, 9.0], [9.0, 0.0], [0.0, 9.0]])
    carry, output = stepper(policy)(params, start, observe(PREY_THREE, 0), noise)
    np.testing.assert_array_equal(output.decisions["gate"].choice, [1, 0, 1])
    np.testing.assert_array_equal(carry.gate, [1, 0, 1])
    np.testing.assert_array_equal(output.communication, [0, 0, 0])
    np.testing.assert_array_equal(output.attention, np.zeros((3, 3)))
    _, output = stepper(policy)(params, carry, observe(PREY_THREE, 1), noise)
    np.testing.assert_array_equal(output.communication, [1, 0, 1])
    np.testing.assert_array_equal(output.attention, [[0, 0, 0.5], [0, 0, 0], [0.5, 0, 0]])


@pytest.mark.parametrize(("name", "share"), [("commnet", 1), ("iric", 0)])
def test_without_a_gate_the_share_is_that_of_the_kind(name, share):
    policy = small(name)
    carry, obs, noise = policy.initial_carry(), observe(PREY_THREE, 0), greedy(policy)
    for _ in range(2):
        carry, output = stepper(policy)(parameters(policy), carry, obs, noise)
        np.testing.assert_array_equal(output.communication, [share] * 3)


def test_what_is_decided_besides_the_action():
    for name, decisions in {"ic3net": {"action", "gate"}, "commnet": {"action"}}.items():
        policy = small(name)
        _, output = stepper(policy)(
            parameters(policy), policy.initial_carry(), observe(PREY_THREE, 0), greedy(policy)
        )
        assert set(output.decisions) == decisions


def test_the_message_layer_speaks_even_without_a_message():
    """Its bias is always added, so that silence is not the absence of the layer."""
    core = IC3NetCore(hidden=4, num_actions=5, gated=False)
    zeros, x = jnp.zeros((3, 4)), jnp.ones((3, 4))
    silent = IC3NetCarry(zeros, zeros, jnp.zeros(3))
    params = core.init(jax.random.key(0), silent, x)
    bias = params["params"]["C_0"]["bias"]
    independent = IC3NetCore(hidden=4, num_actions=5, communicates=False, gated=False)
    weights = {k: v for k, v in params["params"].items() if k != "C_0"}
    h, *_ = core.apply(params, silent, x)
    expected, *_ = independent.apply({"params": weights}, silent, x + bias)
    np.testing.assert_allclose(h, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "parameter_count"), [("ic3net", 224_488), ("commnet", 224_230), ("iric", 207_718)]
)
def test_size_is_the_specified_one(name, parameter_count):
    policy = make_policy(name, PredatorPrey(size=10, num_predators=5))
    assert size(policy) == parameter_count
