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


@pytest.mark.parametrize("policy", ["ic3net", "magic", "hetnet"])
def test_seeds_side_by_side_learn_what_they_learn_one_after_the_other(policy):
    learner = tiny_learner(TINY_TASK, policy, num_envs=200, rollout_length=20)
    mesh = parallel.make_mesh(len(SEEDS), 200, devices=1)
    ways = []
    for together, unroll in ((False, 1), (True, 4)):
        states = parallel.place(parallel.init_seeds(learner, SEEDS), mesh)
        way = parallel.Execution(together, unroll)
        ways.append(parallel.make_train(learner, mesh, 1, way)(states))
    close = partial(np.testing.assert_allclose, rtol=1e-3, atol=2e-5)
    jax.tree.map(close, *jax.tree.map(raw, [states.params for states, _ in ways]))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-3), *(metrics for _, metrics in ways))


def test_seeds_side_by_side_share_every_product():
    """One batch for all seeds where one seed has one product, and no loop over seeds."""
    learner = tiny_learner(TINY_TASK, "ic3net", num_envs=200, rollout_length=20)
    mesh, found = parallel.make_mesh(3, 200, devices=1), []
    for num_seeds, together in ((1, False), (3, True)):
        states = jax.eval_shape(lambda n=num_seeds: parallel.init_seeds(learner, list(range(n))))
        train = parallel.make_train(learner, mesh, 1, parallel.Execution(together))
        program = train.lower(states).as_text()
        products = [line for line in program.splitlines() if "stablehlo.dot_general" in line]
        found.append((program.count("stablehlo.while"), len(products)))
        of_weights = [line for line in products if "contracting_dims = [1] x [0]" not in line]
        if together:
            assert all("batching_dims = [0" in line for line in of_weights)
    alone, side_by_side = found
    assert side_by_side == (alone[0] - 1, alone[1])


def test_a_cpu_trains_seeds_one_after_the_other_and_an_accelerator_side_by_side():
    assert not parallel.execution_on("cpu").together
    assert parallel.execution_on("gpu").together
    assert parallel.execution_on("tpu").together


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
