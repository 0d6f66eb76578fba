"""Encoders: what they can tell apart, and that their shortcuts change nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import drawn

from sumajax.environments import PredatorPrey
from sumajax.environments.states import SparseStates
from sumajax.policies.encoder import (
    ENCODERS,
    STATE_FEATURES,
    VIEW_FEATURES,
    Conv,
    ObservationEncoder,
    StateEncoder,
    ViewEncoder,
    fourier_features,
    lit_centres,
    resized_table,
    table_grid,
)
from sumajax.upsampling import StateUpsampled

NATIVE = PredatorPrey(size=10).state_table()
UPSAMPLED = StateUpsampled(PredatorPrey(size=5), size=10).state_table()


def count(params):
    return sum(leaf.size for leaf in jax.tree.leaves(params))


def distinct_codes(kind, states):
    """How many different codes an untrained encoder gives to the states of a table."""
    encoder = StateEncoder(kind)
    codes, _ = jax.jit(encoder.init_with_output)(jax.random.key(0), states)
    codes = np.asarray(codes, np.float64)
    assert codes.shape == (len(states), STATE_FEATURES)
    gap = np.abs(codes[:, None] - codes[None]).max(-1)
    return len({tuple(row) for row in gap < 1e-6})


@pytest.mark.parametrize("size", [10, 20])
@pytest.mark.parametrize(
    ("kind", "least", "most"), [("flat", 0.1, 0.4), ("flat_published", 0.001, 0.005)]
)
def test_how_much_shows_from_the_start_of_where_an_agent_is_whatever_the_grid(
    kind, least, most, size
):
    """Measured 0.2 with native cells; 0.003 and 0.002 with the published layers' initialisation."""
    states = PredatorPrey(size=size).state_table()
    spread = jax.jit(lambda key: StateEncoder(kind).init_with_output(key, states)[0].std(0).mean())
    spreads = [spread(jax.random.key(seed)) for seed in range(3)]
    assert least < np.mean(spreads) < most


@pytest.mark.parametrize(
    ("encoder", "example", "layer", "inputs"),
    [
        (StateEncoder("flat_published"), NATIVE, ("conv1", "dense"), 9),
        (StateEncoder("flat_published"), NATIVE, ("conv2", "dense"), 72),
        (StateEncoder("flat_published"), NATIVE, ("dense",), 400),
        (ViewEncoder("flat_published"), np.zeros((1, 2, 3, 3)), ("conv", "dense"), 18),
        (ViewEncoder("flat_published"), np.zeros((1, 2, 3, 3)), ("dense",), 32),
    ],
)
def test_the_published_start_is_uniform_with_biases_as_large(encoder, example, layer, inputs):
    """Within 1/sqrt(inputs), the default of the originals' layers."""
    params = jax.jit(lambda key: encoder.init(key, example))(jax.random.key(0))["params"]
    for name in layer:
        params = params[name]
    bound = inputs**-0.5
    assert 0.9 * bound < np.abs(params["kernel"]).max() <= bound
    assert 0.5 * bound < np.abs(params["bias"]).max() <= bound


@pytest.mark.parametrize(
    ("kind", "native"), [("flat", 100), ("linear", 100), ("coordinates", 100), ("lab_gap", 49)]
)
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
    x = np.random.default_rng(1).normal(size=(2, side, side, 3)).astype(np.float32)
    conv = Conv(4, kernel, stride, padding)
    params = drawn(conv.init, x)
    (dense,) = params["params"].values()
    y = jax.jit(conv.apply)(params, x)
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
    codes, params = jax.jit(ViewEncoder().init_with_output)(jax.random.key(0), view)
    assert codes.shape == (7, 0, VIEW_FEATURES)
    assert count(params) == 1_952


def test_observation_is_one_dense_layer_on_state_and_view():
    encoder = ObservationEncoder(24)
    view = np.random.default_rng(1).normal(size=(5, 2, 3, 3)).astype(np.float32)
    states, sighted = UPSAMPLED[:5], np.array([True, True, False, True, True])

    def both(encoder):
        return encoder(encoder.encode_states(states), view, sighted)

    params = drawn(encoder.init, method=both)
    parts = params["params"]
    s = jax.jit(StateEncoder().apply)({"params": parts["state_encoder"]}, states)
    o = jax.jit(ViewEncoder().apply)({"params": parts["view_encoder"]}, view) * sighted[:, None]
    kernel = np.concatenate([parts["merge_state"]["kernel"], parts["merge_view"]["kernel"]])
    expected = np.concatenate([s, o], axis=-1) @ kernel + parts["merge_state"]["bias"]
    ours = jax.jit(lambda params: encoder.apply(params, method=both))(params)
    np.testing.assert_allclose(ours, expected, atol=1e-5)


def test_coordinates_are_shares_of_the_grid_whatever_its_size():
    """First, middle and last cell of a side have one code each on 5x5, 9x9 and 5x9."""
    codes = []
    for rows, columns in ((5, 5), (9, 9), (5, 9)):
        states = PredatorPrey(size=(rows, columns)).state_table()
        cells = [r * columns + c for r in (0, rows // 2, rows - 1) for c in (0, columns // 2)]
        codes.append(np.asarray(jax.jit(fourier_features)(states))[cells])
    np.testing.assert_allclose(codes[1], codes[0], atol=1e-6)
    np.testing.assert_allclose(codes[2], codes[0], atol=1e-6)


def test_coordinates_of_a_block_are_those_of_its_middle():
    states = StateUpsampled(PredatorPrey(size=2, vision=1), 4).state_table()
    at, lit = jax.jit(lit_centres)(states)
    np.testing.assert_allclose(at[:, 0], [[i, j] for i in (1 / 6, 5 / 6) for j in (1 / 6, 5 / 6)])
    np.testing.assert_array_equal(lit, np.ones((4, 1)))


def test_coordinates_of_what_a_task_lists_are_those_of_its_tensors():
    states = np.asarray(UPSAMPLED)
    np.testing.assert_allclose(
        fourier_features(SparseStates.of(states)), jax.jit(fourier_features)(states), atol=1e-6
    )


def test_coordinates_of_a_channel_in_which_nothing_is_lit_are_zeros():
    states = np.zeros((1, 2, 3, 3), np.float32)
    states[0, 1, 2, 2] = 1.0
    dark, lit = np.split(np.asarray(jax.jit(fourier_features)(states))[0], 2)
    assert not dark.any()
    assert lit.any()


def test_coordinates_have_the_same_parameters_on_every_grid():
    shapes = [
        jax.eval_shape(StateEncoder("coordinates").init, jax.random.key(0), states)
        for states in (NATIVE, PredatorPrey(size=(3, 7)).state_table())
    ]
    assert shapes[0] == shapes[1]


def resized(params, kind, before, after, method):
    kernel = params["params"]["dense"]["kernel"][None]
    grids = [table_grid(kind, (1, *size)) for size in (before, after)]
    table = resized_table(kernel, *grids, method)[0]
    return {"params": {"dense": {**params["params"]["dense"], "kernel": table}}}


@pytest.mark.parametrize("size", [(4, 4), (2, 6)])
def test_nearest_resized_weights_are_upsampling_with_scale_mass(size):
    """A linear encoder gives a small state, seen upsampled, what the small grid's gave it; and a
    cell of the large grid what the cell of the small one gave that it is a part of."""
    small = PredatorPrey(size=2, vision=1)
    encoder = StateEncoder("linear")
    params = drawn(encoder.init, small.state_table())
    code = jax.jit(encoder.apply)(params, small.state_table())
    large = resized(params, "linear", (2, 2), size, "nearest")
    upsampled = StateUpsampled(small, size, scale="mass").state_table()
    np.testing.assert_allclose(encoder.apply(large, upsampled), code, rtol=1e-5, atol=1e-7)
    rows, columns = size
    native = encoder.apply(large, PredatorPrey(size=size, vision=1).state_table())
    part_of = [2 * (r * 2 // rows) + c * 2 // columns for r in range(rows) for c in range(columns)]
    np.testing.assert_array_equal(native, code[np.array(part_of)])


def test_bilinear_resized_weights_lie_between_those_of_the_cells_around():
    kernel = jnp.array([0.0, 1.0, 2.0, 3.0]).reshape(1, 4, 1)  # 2x2: 2 r + c
    large = resized_table(kernel, (2, 2, 1), (4, 4, 1), "bilinear")[0].reshape(4, 4)
    np.testing.assert_allclose(large[0], [0, 0.25, 0.75, 1], atol=1e-6)
    np.testing.assert_allclose(large[:, 0], [0, 0.5, 1.5, 2], atol=1e-6)


def test_channels_of_a_place_keep_to_themselves_when_a_table_is_resized():
    """`flat` has 16 of its second convolution at each place, a quarter as many as cells."""
    assert table_grid("flat", (1, 5, 10)) == (3, 5, 16)
    kernel = jnp.broadcast_to(jnp.arange(16.0)[None, :, None], (15, 16, 2)).reshape(1, 240, 2)
    large = resized_table(kernel, (3, 5, 16), (5, 10, 16), "bilinear").reshape(50, 16, 2)
    np.testing.assert_allclose(large, jnp.broadcast_to(large[:1], large.shape), atol=1e-5)
    np.testing.assert_allclose(large[0, :, 0], np.arange(16), atol=1e-5)


@pytest.mark.parametrize("kind", ["lab_gap", "coordinates"])
def test_an_encoder_of_no_grids_size_has_no_table_to_resize(kind):
    with pytest.raises(ValueError, match=f"encoder '{kind}' has no position table"):
        table_grid(kind, (1, 5, 5))
