"""What was saved comes back, bit for bit, in whatever form and place it is asked for."""

import os
import shutil
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from saved_states import META, abstract, bits, environment, listing, train_state

from sumajax.checkpoint import (
    check_compatible,
    describe,
    latest,
    load,
    load_params,
    read_meta,
    save,
)
from sumajax.environments import PredatorPrey
from sumajax.policies import make_policy
from sumajax.upsampling import StateUpsampled


class TestRoundTrip:
    def test_every_bit_comes_back_in_the_structure_asked_for(self, tmp_path):
        state = train_state(7)
        save(tmp_path / "c", state, {"epoch": 3, "seeds": [0, 1]})
        for like in (state, jax.tree.map(abstract, state)):
            restored, meta = load(tmp_path / "c", like)
            assert jax.tree.structure(restored) == jax.tree.structure(state)
            assert bits(restored) == bits(state)
            assert meta == {"epoch": 3, "seeds": [0, 1]}

    def test_restored_keys_draw_the_same_numbers(self, tmp_path):
        for name in ("threefry2x32", "rbg", "unsafe_rbg"):
            key = jax.random.key(5, impl=name)
            save(tmp_path / name, {"key": key}, META)
            restored, _ = load(tmp_path / name)
            assert jax.random.key_impl(restored["key"]) == jax.random.key_impl(key)
            np.testing.assert_array_equal(
                jax.random.normal(restored["key"], (4,)), jax.random.normal(key, (4,))
            )

    def test_without_a_structure_it_is_nested_dicts_of_host_arrays(self, tmp_path):
        state = train_state(7)
        save(tmp_path / "c", state, META)
        restored, _ = load(tmp_path / "c")
        assert set(restored) == {"params", "opt_state", "key", "counters"}
        assert bits(restored["params"]) == bits(state.params)
        assert bits(restored["counters"]["python"]["1"]) == bits(0.5)
        assert type(restored["params"]["half"]) is np.ndarray

    def test_only_the_parameters(self, tmp_path):
        state = train_state(7)
        save(tmp_path / "c", state, META)
        like = jax.eval_shape(lambda: state.params)
        assert bits(load_params(tmp_path / "c", like)) == bits(state.params)
        assert bits(load_params(tmp_path / "c")) == bits(state.params)
        assert bits(load_params(tmp_path / "c", state.opt_state, field="opt_state")) == bits(
            state.opt_state
        )

    def test_one_checkpoint_of_a_directory_can_be_used_alone(self, two_checkpoints, tmp_path):
        earlier = sorted(two_checkpoints.iterdir())[0]
        alone = shutil.copytree(earlier, tmp_path / "taken elsewhere %20 é")
        for place in (earlier, alone):
            assert bits(load(place, train_state())[0]) == bits(train_state(1))
            assert latest(place) == place

    def test_relative_paths(self, two_checkpoints, monkeypatch):
        monkeypatch.chdir(two_checkpoints.parent)
        assert bits(load("checkpoints", train_state())[0]) == bits(train_state(2))

    def test_saving_leaves_nothing_running_and_says_nothing(self, tmp_path, capfd, caplog):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            save(tmp_path / "c", train_state(), META)
            before = listing(tmp_path)
            load(tmp_path / "c")
        assert os.listdir(tmp_path / "c") == ["000001-step-1"]
        assert listing(tmp_path) == before
        assert capfd.readouterr() == ("", "")
        assert [r.message for r in caplog.records if r.levelname != "INFO"] == []


DEVICES = """
import sys
import jax, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from sumajax.checkpoint import load, save

assert len(jax.devices()) == 2
state, meta = load(sys.argv[1])
split = NamedSharding(Mesh(np.array(jax.devices()), "seeds"), PartitionSpec("seeds"))
state = jax.device_put(state, split)
assert all(len(leaf.sharding.device_set) == 2 for leaf in jax.tree.leaves(state))
state = jax.jit(lambda tree: {**tree, "w": tree["w"] * 2})(state)
save(sys.argv[1], state, meta)
"""


def test_another_number_of_devices(tmp_path):
    keys = jax.random.split(jax.random.key(3), 4)
    save(tmp_path / "c", {"w": jnp.arange(8.0).reshape(4, 2), "key": keys}, META)
    env = environment(XLA_FLAGS="--xla_force_host_platform_device_count=2")
    subprocess.run([sys.executable, "-c", DEVICES, str(tmp_path / "c")], env=env, check=True)
    restored, _ = load(tmp_path / "c")
    assert len(os.listdir(tmp_path / "c")) == 2
    np.testing.assert_array_equal(restored["w"], 2 * np.arange(8.0).reshape(4, 2))
    np.testing.assert_array_equal(jax.random.key_data(restored["key"]), jax.random.key_data(keys))


def test_parameters_go_from_task_to_task(tmp_path):
    source, target = StateUpsampled(PredatorPrey(size=2), size=4), PredatorPrey(size=4)
    policies = [make_policy("ic3net", env, hidden=8) for env in (source, target)]
    like, target_like = (jax.eval_shape(p.init, jax.random.key(0)) for p in policies)
    params = jax.tree.map(lambda leaf: np.full(leaf.shape, 0.5, leaf.dtype), like)
    save(tmp_path / "c", {"params": params}, describe(source, policies[0]))
    check_compatible(read_meta(tmp_path / "c"), target, policies[1], tmp_path / "c")
    assert bits(load_params(tmp_path / "c", target_like)) == bits(params)
