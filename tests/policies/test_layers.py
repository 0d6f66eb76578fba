"""Layers: the originals' formulas and the originals' initial weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import drawn

from sumajax.policies.layers import (
    Dense,
    LSTMCell,
    lstm_gates,
    side_by_side,
    straight_through_bit,
)


@pytest.fixture(scope="module")
def cell():
    """An LSTM of 3 inputs and 4 features with a carry and an input of 5 agents, and its weights."""
    random = np.random.default_rng(0)
    lstm = LSTMCell(features=4, in_features=3)
    h, s, x = (random.normal(size=(5, width)).astype(np.float32) for width in (4, 4, 3))
    return lstm, drawn(lstm.init, (h, s), x), (h, s), x


def plain_lstm(weights, h, s, x):
    sigmoid = jax.nn.sigmoid
    z = x @ weights["w_ih"] + weights["b_ih"] + h @ weights["w_hh"] + weights["b_hh"]
    i, f, g, o = (z[:, block * 4 : block * 4 + 4] for block in range(4))
    s = sigmoid(f) * s + sigmoid(i) * jnp.tanh(g)
    return sigmoid(o) * jnp.tanh(s), s


def test_lstm_is_the_published_one(cell):
    lstm, params, (h, s), x = cell
    ours = jax.jit(lstm.apply)(params, (h, s), x)
    expected = jax.jit(plain_lstm)(params["params"], h, s, x)
    for mine, theirs in zip(ours, expected, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-6)


def test_lstm_gradient_is_that_of_its_formula(cell):
    """The derivative is written out by hand: compare it with the one derived from the formula."""
    _, params, (h, s), x = cell
    weights = params["params"]

    def ours(weights, h, s, x):
        z = x @ weights["w_ih"] + weights["b_ih"] + h @ weights["w_hh"] + weights["b_hh"]
        return lstm_gates(z, s)

    def loss(lstm):
        def of(*inputs):
            next_h, next_s = lstm(*inputs)
            return (next_h * jnp.arange(4.0)).sum() + (next_s**2).sum()

        return jax.jit(jax.grad(of, argnums=(0, 1, 2, 3)))(weights, h, s, x)

    mine, theirs = jax.tree.leaves(loss(ours)), jax.tree.leaves(loss(plain_lstm))
    for one, other in zip(mine, theirs, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_lstm_input_can_be_projected_beforehand(cell):
    lstm, params, carry, x = cell
    projected = lstm.apply(params, x, method=lstm.project_input)
    assert projected.shape == (5, 16)
    later = lstm.apply(params, carry, projected, method=lstm.step_projected)
    np.testing.assert_allclose(later, lstm.apply(params, carry, x), atol=1e-6)


def test_lstm_starts_with_two_biases_uniform_in_its_width():
    lstm = LSTMCell(features=25, in_features=400)
    zeros = jnp.zeros((1, 25))
    weights = jax.jit(lstm.init)(jax.random.key(0), (zeros, zeros), jnp.zeros((1, 400)))["params"]
    assert {k: v.shape for k, v in weights.items()} == {
        "w_ih": (400, 100),
        "w_hh": (25, 100),
        "b_ih": (100,),
        "b_hh": (100,),
    }
    for weight in weights.values():
        assert 0.9 / 5 < np.abs(weight).max() <= 1 / 5


def test_dense_starts_uniform_in_its_fan_in():
    x = jnp.zeros((1, 100))
    own = jax.jit(Dense(50).init)(jax.random.key(0), x)["params"]
    part = jax.jit(Dense(50, fan_in=400).init)(jax.random.key(0), x)["params"]
    for weights, bound in ((own, 1 / 10), (part, 1 / 20)):
        assert 0.95 * bound < np.abs(weights["kernel"]).max() <= bound
        assert 0.8 * bound < np.abs(weights["bias"]).max() <= bound


def test_dense_before_a_relu_keeps_the_size_of_its_input():
    """He et al. 2015: the mean square after the ReLU is that of the input; no bias."""
    x = np.random.default_rng(0).normal(size=(500, 300)).astype(np.float32)
    layer = Dense(400, before_relu=True)
    y, params = jax.jit(layer.init_with_output)(jax.random.key(1), x)
    assert not np.asarray(params["params"]["bias"]).any()
    np.testing.assert_allclose((np.maximum(y, 0) ** 2).mean(), 1.0, rtol=0.03)


def test_dense_without_bias_is_linear():
    layer = Dense(3, use_bias=False)
    params = layer.init(jax.random.key(0), jnp.ones((1, 2)))
    assert set(params["params"]) == {"kernel"}
    np.testing.assert_array_equal(layer.apply(params, jnp.zeros((1, 2))), np.zeros((1, 3)))


def test_layers_side_by_side_are_the_layers_one_by_one():
    x = np.random.default_rng(0).normal(size=(6, 4)).astype(np.float32)
    layers = [Dense(3), Dense(1), Dense(2)]
    weights = [drawn(layer.init, x, seed=i) for i, layer in enumerate(layers)]
    bound = [layer.bind(params) for layer, params in zip(layers, weights, strict=True)]
    together = side_by_side(bound, x)
    for layer, params, y in zip(layers, weights, together, strict=True):
        np.testing.assert_allclose(y, layer.apply(params, x), atol=1e-6)


def test_bit_is_one_where_the_noisy_difference_is_positive():
    logits = jnp.array([[0.0, 1.0], [0.0, 1.0], [2.0, 0.0], [0.0, 0.0]])
    noise = jnp.array([0.0, -1.5, 2.5, 0.0])
    np.testing.assert_array_equal(straight_through_bit(logits, noise), [1, 0, 1, 0])


def test_bit_is_exactly_zero_or_one_in_float32():
    z = jnp.linspace(-20, 20, 100_001)
    bits = straight_through_bit(jnp.stack([jnp.zeros_like(z), z], axis=-1), jnp.zeros_like(z))
    np.testing.assert_array_equal(bits, z > 0)


def test_bit_has_the_derivative_of_the_sigmoid():
    logits, noise = jnp.array([0.3, -0.4]), jnp.array(1.2)
    slope = jax.grad(straight_through_bit)(logits, noise)
    expected = jax.grad(lambda y: jax.nn.sigmoid(y[1] - y[0] + noise))(logits)
    np.testing.assert_allclose(slope, expected, rtol=1e-6)


def test_bits_are_drawn_with_the_probability_of_their_logits():
    logits = jnp.log(jnp.array([0.3, 0.7]))
    noise = jax.random.logistic(jax.random.key(0), (20_000,))
    bits = straight_through_bit(jnp.broadcast_to(logits, (20_000, 2)), noise)
    np.testing.assert_allclose(bits.mean(), 0.7, atol=0.01)
