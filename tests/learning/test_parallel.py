"""Several seeds and several devices: the same numbers however they are spread."""

import json
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trajectories import TINY_TASK, tiny_learner

from sumajax.learning import parallel

SEEDS = [0, 5]


def raw(leaf):
    """Keys as numbers."""
    key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if key else leaf)


def test_several_seeds_are_each_alone():
    """In one program, one after the other, as if the others were not there."""
    learner = tiny_learner(TINY_TASK, num_envs=200, rollout_length=20)
    mesh = parallel.make_mesh(len(SEEDS), 200, devices=1)
    states = parallel.place(parallel.init_seeds(learner, SEEDS), mesh)
    states, metrics = parallel.make_train(learner, mesh, epochs=1)(states)
    assert metrics.env_steps.shape == (len(SEEDS), 1)
    for i, seed in enumerate(SEEDS):
        alone = learner.train(jax.jit(learner.init)(jax.random.key(seed)), 1)
        together = jax.tree.map(lambda x, i=i: x[i], (states, metrics))
        close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)
        jax.tree.map(close, *jax.tree.map(raw, (alone, together)))


@pytest.fixture(scope="module")
def two_devices():
    script = Path(__file__).with_name("two_devices.py")
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_seeds_over_two_devices(two_devices):
    assert two_devices["devices"] == 2
    assert two_devices["seeds_mesh"] == {"seeds": 2, "envs": 1}
    assert two_devices["over_seeds"] < 1e-5


def test_environments_of_a_seed_over_two_devices(two_devices):
    """Gradients and figures are added up, advantages normalised over all environments."""
    assert two_devices["envs_mesh"] == {"seeds": 1, "envs": 2}
    assert two_devices["over_envs"] < 1e-4
    assert two_devices["between_seeds"] > 1e-2, "the comparison would see a difference"


def test_more_devices_than_there_are():
    with pytest.raises(ValueError, match=r"64 devices asked for, but JAX sees \d+;"):
        parallel.make_mesh(1, 64, devices=64)


def test_environments_that_do_not_spread(monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 4)
    with pytest.raises(ValueError, match="25 environments do not spread over 4 devices"):
        parallel.make_mesh(3, 25, devices=4)


@pytest.mark.parametrize(
    ("num_seeds", "num_envs", "most", "expected"),
    [(1, 50, 8, 5), (3, 50, 8, 6), (3, 50, 2, 2), (1, 49, 6, 1), (7, 49, 14, 7), (2, 4, 64, 8)],
)
def test_the_most_devices_that_seeds_and_environments_spread_over(
    num_seeds, num_envs, most, expected
):
    assert parallel.most_devices(num_seeds, num_envs, most) == expected
    over_seeds, over_envs = parallel.spread(num_seeds, num_envs, expected)
    assert over_seeds * over_envs == expected
    assert num_seeds % over_seeds == num_envs % over_envs == 0
