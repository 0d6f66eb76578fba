"""State tensors by what is not zero in them."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax.environments import PredatorCapturePrey, PredatorPrey, SparseStates, Wrapper
from sumajax.environments.states import listed_states
from sumajax.upsampling import StateUpsampled


def random_states(shape, share=0.3):
    values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    return values * (np.random.default_rng(1).uniform(size=shape) < share)


@pytest.mark.parametrize("shape", [(6, 1, 4, 4), (3, 2, 2, 5), (1, 1, 1, 1), (4, 3, 1, 2)])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_dense_states_come_back(shape, share):
    states = random_states(shape, share)
    sparse = SparseStates.of(states)
    assert (len(sparse), sparse.shape) == (shape[0], shape[1:])
    np.testing.assert_array_equal(sparse.dense(), states)


def test_what_fills_up_changes_nothing():
    sparse = SparseStates(np.array([[0, 0], [3, 0]]), np.array([[5.0, 0], [7.0, 0]]), (1, 2, 2))
    assert sparse.dense().reshape(2, 4).tolist() == [[5, 0, 0, 0], [0, 0, 0, 7]]


@pytest.mark.parametrize(
    ("cell", "value", "sentence"),
    [
        ([[0, 1]], [[1.0]], r"one shape \(states, entries\), got \(1, 2\) and \(1, 1\)"),
        ([[4]], [[1.0]], r"lie in 0..3, got 4..4"),
        ([[-1]], [[1.0]], r"lie in 0..3, got -1..-1"),
    ],
)
def test_what_is_no_list_of_states_is_refused(cell, value, sentence):
    with pytest.raises(ValueError, match=sentence):
        SparseStates(np.array(cell), np.array(value), (1, 2, 2))


PLAIN = PredatorPrey(size=(4, 6), num_predators=2)
TASKS = {
    "PP": PLAIN,
    "PCP": PredatorCapturePrey(size=3, num_predators=1, num_capturers=1),
    "upsampled": StateUpsampled(PLAIN, (8, 18)),
    "mass": StateUpsampled(PLAIN, (12, 6), scale="mass"),
    "corner": StateUpsampled(PLAIN, (8, 12), fill="corner"),
    "twice": StateUpsampled(StateUpsampled(PLAIN, (8, 12), scale="mass"), 24, scale="mass"),
}


@pytest.mark.parametrize("name", TASKS)
def test_what_a_task_lists_is_its_table(name):
    task = TASKS[name]
    sparse = listed_states(task)
    assert sparse.shape == task.state_shape
    np.testing.assert_array_equal(sparse.dense(), task.state_table())


def test_the_bytes_of_a_list_grow_with_the_cells():
    def size(task):
        sparse = listed_states(task)
        return sparse.cell.nbytes + sparse.value.nbytes

    for side in (20, 40, 100):
        assert size(PredatorPrey(size=side)) == 8 * side**2
        assert size(StateUpsampled(PredatorPrey(size=10), side * 10)) == 8 * (side * 10) ** 2


@dataclass(frozen=True)
class OwnTable(PredatorPrey):
    def state_table(self):
        return 2 * super().state_table()


@dataclass(frozen=True)
class Unlisted(PredatorPrey):
    def state_table(self):
        return None


@dataclass(frozen=True)
class Doubled(Wrapper):
    def state_table(self):
        return 2 * self.env.state_table()


def test_a_table_defined_anew_is_meant():
    """Not the list of the class it is derived from, or of the task it is around."""
    table = np.asarray(PLAIN.state_table())
    for task in (OwnTable(size=(4, 6)), Doubled(PLAIN)):
        np.testing.assert_array_equal(listed_states(task).dense(), 2 * table)
    assert listed_states(Unlisted()) is None
    assert listed_states(StateUpsampled(Unlisted(size=5), 10)) is None
    larger = StateUpsampled(OwnTable(size=(4, 6)), (8, 6))
    np.testing.assert_array_equal(listed_states(larger).dense(), larger.state_table())
    assert jnp.asarray(larger.observe(larger.reset(jax.random.key(0))).state).max() == 1
