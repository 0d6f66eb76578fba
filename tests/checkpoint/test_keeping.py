"""Which checkpoints of a directory stay, and what is refused before anything is written."""

import os
import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refusal
from saved_states import META, train_state

from sumajax.checkpoint import identity, latest, load, load_params, read_meta, reading, save


class TestKeeping:
    def test_the_last_few_stay_and_the_newest_is_loaded(self, tmp_path):
        for epoch in range(5):
            path = save(tmp_path / "c", {"w": np.full(3, epoch)}, {"epoch": epoch}, keep=2)
            assert latest(tmp_path / "c") == path
        names = sorted(os.listdir(tmp_path / "c"))
        assert names == ["000004-step-3", "000005-step-4"]
        assert read_meta(tmp_path / "c") == {"epoch": 4}

    def test_after_going_back_the_newest_is_what_was_saved_last(self, tmp_path):
        for step in (10, 20, 15):
            save(tmp_path / "c", {"w": np.full(3, step)}, META, step=step, keep=3)
        assert load(tmp_path / "c")[0]["w"][0] == 15

    def test_nothing_to_go_on_from(self, tmp_path):
        assert latest(tmp_path) is None
        assert latest(tmp_path / "missing") is None

    def test_keep_and_step_are_checked(self, tmp_path):
        for wrong in ({"keep": 0}, {"keep": 1.5}, {"step": -1}, {"step": "3"}, {"step": True}):
            assert "whole number" in refusal(save, tmp_path / "c", {"w": np.ones(1)}, {}, **wrong)
        assert not (tmp_path / "c").exists()

    @pytest.mark.parametrize(
        ("state", "meta", "words"),
        [
            ({"w": "text"}, {}, "leaf w"),
            ({"w": np.array([None])}, {}, "dtype object"),
            ({"w": 2**70}, {}, "leaf w"),
            ({"a b/c": np.ones(1)}, {}, "a b/c"),
            ({"a": {1: np.ones(1), "1": np.ones(1)}}, {}, "keys"),
            ({"a": [np.ones(1)], "a/0": np.ones(1)}, {}, "'a/0'"),
            (np.ones(1), {}, "cannot name"),
            ({}, {}, "no arrays"),
            ({"w": np.ones(1)}, {"env": object()}, "JSON"),
            ({"w": np.ones(1)}, ["no", "dictionary"], "dictionary"),
        ],
    )
    def test_what_cannot_be_saved_is_refused_before_anything_is_written(
        self, tmp_path, state, meta, words
    ):
        assert words in refusal(save, tmp_path / "c", state, meta)
        assert not (tmp_path / "c").exists()


class TestIdentity:
    def test_is_of_the_content_and_not_of_the_place(self, damaged, tmp_path):
        before = identity(damaged)
        moved = Path(shutil.copytree(damaged, tmp_path / "elsewhere"))
        assert identity(moved) == identity(latest(moved)) == before
        shutil.rmtree(moved / "000001-step-1")
        assert identity(moved) == before

    def test_changes_with_what_is_saved(self, damaged):
        before = identity(damaged)
        after = [
            identity(damaged)
            for state, meta in (
                (train_state(2), {"epoch": 3}),
                (train_state(3), {"epoch": 2}),
            )
            if save(damaged, state, meta)
        ]
        assert len({before, *after}) == 3

    def test_is_of_the_newest_good_one(self, damaged):
        before = identity(damaged)
        earlier = identity(damaged / "000001-step-1")
        (latest(damaged) / "state" / "state" / "manifest.ocdbt").unlink()
        said: list[str] = []
        assert identity(damaged, say=said.append) == earlier != before
        assert "going on from the earlier" in said[0]


class TestDifferentState:
    def test_the_leaf_and_both_shapes_are_named_before_any_array_is_read(
        self, damaged, monkeypatch
    ):
        monkeypatch.setattr(reading, "load_arrays", None)
        sentence = refusal(load, damaged, train_state(seeds=2))
        assert "params/dense/kernel" in sentence
        assert "float32[3, 4, 5]" in sentence
        assert "float32[2, 4, 5]" in sentence

    def test_dtype_more_and_fewer_leaves(self, two_checkpoints):
        state = train_state()
        wide = state.replace(key=jnp.zeros((3, 2), jnp.uint32))
        assert "key is key<fry>[3]" in refusal(load, two_checkpoints, wide)
        more = state.replace(counters={**state.counters, "carry": jnp.zeros(2)})
        assert "no leaf counters/carry" in refusal(load, two_checkpoints, more)
        fewer = state.replace(opt_state=())
        assert "a leaf opt_state/0/count" in refusal(load, two_checkpoints, fewer)

    def test_parameters_of_another_shape(self, two_checkpoints):
        like = {**train_state().params, "half": jnp.zeros(8, jnp.bfloat16)}
        sentence = refusal(load_params, two_checkpoints, like)
        assert "params/half is bfloat16[7]" in sentence
        assert "bfloat16[8]" in sentence

    def test_no_parameters(self, tmp_path):
        save(tmp_path / "c", {"weights": np.ones(2)}, META)
        assert "holds no params" in refusal(load_params, tmp_path / "c")
