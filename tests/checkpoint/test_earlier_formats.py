"""What earlier versions saved is read: `data/format-1` was made by the code of 0.1.0."""

import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

from sumajax.checkpoint import check_compatible, latest, load, load_params, read_meta, rebuild, save
from sumajax.environments import PredatorPrey
from sumajax.policies import make_policy

SAVED = Path(__file__).parent / "data" / "format-1"
ENV = PredatorPrey(3, num_predators=2, max_steps=10)
POLICY = make_policy("ic3net", ENV, hidden=2)


def saved_params():
    """Whole numbers in order, for the second of two seeds half more."""
    leaves, structure = jax.tree.flatten(jax.eval_shape(POLICY.init, jax.random.key(0)))
    ends = np.cumsum([leaf.size for leaf in leaves])
    values = [
        np.arange(end - leaf.size, end, dtype=leaf.dtype).reshape(leaf.shape)
        for leaf, end in zip(leaves, ends, strict=True)
    ]
    return jax.tree.unflatten(structure, [np.stack([value, value + 0.5]) for value in values])


@pytest.mark.filterwarnings("error")
def test_format_1():
    meta = read_meta(SAVED)
    assert (meta["epoch"], meta["seeds"]) == (2, [0, 1])
    assert rebuild(meta) == (ENV, POLICY)
    check_compatible(meta, ENV, POLICY)
    state, _ = load(SAVED)
    jax.tree.map(np.testing.assert_array_equal, state["params"], saved_params())
    jax.tree.map(np.testing.assert_array_equal, load_params(SAVED, saved_params()), saved_params())
    np.testing.assert_array_equal(state["updates"], [2, 2])
    np.testing.assert_array_equal(state["half"].astype(np.float32), [1.5, 1.5])
    assert state["empty"].shape == (2, 0)
    keys = jax.random.split(jax.random.key(3), 2)
    assert (jax.random.key_data(state["key"]) == jax.random.key_data(keys)).all()


def test_saving_goes_on_beside_them(tmp_path):
    directory = shutil.copytree(SAVED, tmp_path / "c")
    save(directory, {"w": np.ones(2)}, {})
    assert latest(directory).name == "000003-step-0"
    assert load(directory)[0]["w"].tolist() == [1, 1]
    assert read_meta(directory / "000002-step-2")["epoch"] == 2
