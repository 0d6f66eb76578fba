"""Encoding known states by the places they light is encoding them whole."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import drawn

from sumajax.environments import PredatorPrey, SparseStates
from sumajax.environments.states import listed_states
from sumajax.policies.encoder import StateEncoder
from sumajax.policies.lit_places import lit_places, sum_by_state
from sumajax.upsampling import StateUpsampled


def random_states(share, size=7):
    random = np.random.default_rng(3)
    values = random.normal(size=(6, 1, size, size)).astype(np.float32)
    return values * (random.random(values.shape) < share)


STATES = {
    "native": PredatorPrey(size=10).state_table(),
    "native, odd side": PredatorPrey(size=7).state_table(),
    "not square": PredatorPrey(size=(4, 6)).state_table(),
    "upsampled": StateUpsampled(PredatorPrey(size=5), size=10).state_table(),
    "upsampled, mass": StateUpsampled(PredatorPrey(size=3), size=9, scale="mass").state_table(),
    "corner": StateUpsampled(PredatorPrey(size=5), size=10, fill="corner").state_table(),
    "empty": jnp.zeros((3, 1, 5, 5)),
    "some lit": random_states(0.1),
    "all lit": random_states(1.0),
    "one cell": jnp.ones((1, 1, 1, 1)),
    "two channels": np.concatenate([random_states(0.1), random_states(0.3)], axis=1),
}


def parameters(states):
    """Of the encoder, biases and all, so that an empty grid has features too."""
    return drawn(StateEncoder().init, states)


@pytest.mark.parametrize("name", STATES)
def test_known_states_have_the_features_and_gradients_of_states_given(name):
    states, encoder = STATES[name], StateEncoder()
    cotangent = np.random.default_rng(2).normal(size=(len(states), 128)).astype(np.float32)

    def gradient(params, states):
        def loss(params):
            features = encoder.apply(params, states)
            return (features * cotangent).sum(), features

        return jax.grad(loss, has_aux=True)(params)

    @jax.jit
    def both(params, given):
        return gradient(params, given), gradient(params, np.asarray(states))

    expected, known = both(parameters(states), np.asarray(states))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), known, expected
    )


def test_only_lit_places_are_kept():
    """A one-hot cell of a 20x20 grid lights at most 3x3 of 10x10 places."""
    encoder = StateEncoder().bind(parameters(jnp.zeros((1, 1, 20, 20))))
    states = PredatorPrey(size=20).sparse_states()
    places = lit_places(states, encoder.conv1.patches, encoder.conv2.patches)
    of_state = np.bincount(places.state.ravel(), minlength=401)
    assert places.num_states == 400
    assert of_state[:400].min() >= 1
    assert of_state[:400].max() == 9
    assert places.seen.shape[0] == 100
    assert places.seen[places.state == 400].any(-1).any(-1).sum() == 0
    assert not places.exists[-1].all()  # the last place reaches over the edge
    assert places.exists[0].all()


def test_sums_by_state_leave_out_what_fills_up():
    states = SparseStates(np.array([[0], [0]]), np.array([[0.0], [1.0]]), (1, 4, 4))
    encoder = StateEncoder().bind(parameters(jnp.zeros((1, 1, 4, 4))))
    places = lit_places(states, encoder.conv1.patches, encoder.conv2.patches)
    ones = np.ones((*places.state.shape, 3), np.float32)
    lit = (places.state == 1).sum()
    np.testing.assert_array_equal(sum_by_state(ones, places), [[0] * 3, [lit] * 3])


@pytest.mark.parametrize(
    "task", [PredatorPrey, lambda size: StateUpsampled(PredatorPrey(size=size // 2), size)]
)
def test_tables_grow_with_the_cells_and_not_with_their_square(task):
    encoder = StateEncoder().bind(parameters(jnp.zeros((1, 1, 4, 4))))
    per_cell = []
    for size in (20, 40, 60):
        places = lit_places(listed_states(task(size)), encoder.conv1.patches, encoder.conv2.patches)
        tables = (places.seen, places.exists, places.state)
        per_cell.append(sum(table.nbytes for table in tables) / size**2)
    np.testing.assert_allclose(per_cell, per_cell[0], rtol=0.01)


FIRST_UPDATE = """
import resource
import jax
from sumajax import make_learner, make_policy
from sumajax.environments import PredatorPrey

env = PredatorPrey(size=100, num_predators=50)
learner = make_learner(env, make_policy("ic3net", env))
state, tally = jax.jit(learner.update)(jax.jit(learner.init)(jax.random.key(0)))
assert int(tally.updates) == 1
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
MOST_GIGABYTES = 4
"""Measured: 1.2 GB."""


@pytest.mark.slow
def test_the_first_update_of_fifty_agents_on_100x100_fits_a_small_machine():
    done = subprocess.run([sys.executable, "-c", FIRST_UPDATE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) / 2**20 < MOST_GIGABYTES
