"""Encoders: what they can tell apart, and that their shortcuts change nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax.environments import PredatorPrey
from sumajax.policies.encoder import (
    ENCODERS,
    STATE_FEATURES,
    VIEW_FEATURES,
    Conv,
    ObservationEncoder,
    StateEncoder,
    ViewEncoder,
)
from sumajax.upsampling import StateUpsampled

NATIVE = PredatorPrey(size=10).state_table()
UPSAMPLED = StateUpsampled(PredatorPrey(size=5), size=10).state_table()


def count(params):
    return sum(leaf.size for leaf in jax.tree.leaves(params))


def distinct_codes(kind, states):
    """How many different codes an untrained encoder gives to the states of a table."""
    encoder = StateEncoder(kind)
    params = jax.jit(encoder.init)(jax.random.key(0), states)
    codes = np.asarray(jax.jit(encoder.apply)(params, states), np.float64)
    assert codes.shape == (len(states), STATE_FEATURES)
    gap = np.abs(codes[:, None] - codes[None]).max(-1)
    return len({tuple(row) for row in gap < 1e-6})


@pytest.mark.parametrize("size", [10, 20])
def test_where_an_agent_is_shows_from_the_start_whatever_the_grid(size):
    """Measured 0.2 with native cells; 0.003 and 0.002 with the published layers' initialisation."""
    states = PredatorPrey(size=size).state_table()
    spreads = []
    for seed in range(3):
        code, _ = StateEncoder().init_with_output(jax.random.key(seed), states)
        spreads.append(code.std(0).mean())
    assert 0.1 < np.mean(spreads) < 0.4


@pytest.mark.parametrize(("kind", "native"), [("flat", 100), ("linear", 100), ("lab_gap", 49)])
def test_which_cells_of_a_grid_can_be_told_apart(kind, native):
    """`lab_gap` pools over the grid, so that inner cells look alike on a native 10x10 grid."""
    assert distinct_codes(kind, NATIVE) == native
    assert distinct_codes(kind, UPSAMPLED) == 25


@pytest.mark.parametrize(("kind", "size"), [("flat", 52_576), ("lab_gap", 33_536)])
def test_state_encoder_has_the_specified_size(kind, size):
    assert kind in ENCODERS
    assert count(jax.eval_shape(StateEncoder(kind).init, jax.random.key(0), NATIVE)) == size


@pytest.mark.parametrize(("channels", "size"), [(2, 1_664), (3, 1_952)])
def test_view_encoder_has_the_specified_size(channels, size):
    view = jnp.zeros((1, channels, 3, 3))
    assert count(jax.eval_shape(ViewEncoder().init, jax.random.key(0), view)) == size


@pytest.mark.parametrize(
    ("side", "kernel", "stride", "padding"),
    [
        (10, 3, 1, "SAME"),
        (10, 3, 2, "SAME"),
        (5, 3, 2, "SAME"),
        (5, 2, 1, "VALID"),
        (1, 1, 1, "VALID"),
    ],
)
def test_convolution_is_a_convolution(side, kernel, stride, padding):
    """It is written as a product over patches; here the library's own does it."""
    x = jax.random.normal(jax.random.key(1), (2, side, side, 3))
    conv = Conv(4, kernel, stride, padding)
    y, params = conv.init_with_output(jax.random.key(0), x)
    (dense,) = params["params"].values()
    expected = jax.lax.conv_general_dilated(
        x,
        dense["kernel"].reshape(kernel, kernel, 3, 4),
        (stride, stride),
        padding,
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    np.testing.assert_allclose(y, expected + dense["bias"], atol=1e-5)


@pytest.mark.parametrize("vision", [0, 1, 2])
def test_a_view_of_any_size_is_encoded(vision):
    view = jnp.zeros((4, 2, 2 * vision + 1, 2 * vision + 1))
    code, _ = jax.eval_shape(ViewEncoder().init_with_output, jax.random.key(0), view)
    assert code.shape == (4, VIEW_FEATURES)


def test_view_encoder_serves_an_empty_class():
    view = jnp.zeros((7, 0, 3, 3, 3))
    codes, params = ViewEncoder().init_with_output(jax.random.key(0), view)
    assert codes.shape == (7, 0, VIEW_FEATURES)
    assert count(params) == 1_952


def test_observation_is_one_dense_layer_on_state_and_view():
    encoder, view = ObservationEncoder(24), jax.random.normal(jax.random.key(1), (5, 2, 3, 3))
    states, sighted = UPSAMPLED[:5], np.array([True, True, False, True, True])

    def both(encoder):
        return encoder(encoder.encode_states(states), view, sighted)

    params = encoder.init(jax.random.key(0), method=both)
    parts = params["params"]
    s = StateEncoder().apply({"params": parts["state_encoder"]}, states)
    o = ViewEncoder().apply({"params": parts["view_encoder"]}, view) * sighted[:, None]
    kernel = jnp.concatenate([parts["merge_state"]["kernel"], parts["merge_view"]["kernel"]])
    expected = jnp.concatenate([s, o], axis=-1) @ kernel + parts["merge_state"]["bias"]
    np.testing.assert_allclose(encoder.apply(params, method=both), expected, atol=1e-5)
