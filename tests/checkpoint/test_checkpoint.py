"""What a checkpoint promises: the very bits that were saved, or a sentence; never anything else."""

import contextlib
import hashlib
import json
import os
import pickle
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct
from refusals import refusal

from sumajax import checkpoint
from sumajax.checkpoint import (
    CheckpointError,
    check_compatible,
    describe,
    latest,
    load,
    load_params,
    read_meta,
    reading,
    save,
)
from sumajax.checkpoint.leaves import host_arrays
from sumajax.checkpoint.orbax import save_arrays
from sumajax.environments import PredatorPrey
from sumajax.policies import make_policy
from sumajax.upsampling import StateUpsampled

META = {"epoch": 1}


@struct.dataclass
class TrainState:
    """Of the same make as the learner's."""

    params: Any
    opt_state: Any
    key: Any
    counters: Any


def train_state(seed: int = 0, seeds: int = 3) -> TrainState:
    """Every kind of leaf that a state may have, with a leading axis of seeds on some."""
    values = np.random.default_rng(seed)
    params = {
        "dense": {"kernel": jnp.asarray(values.normal(size=(seeds, 4, 5)), jnp.float32)},
        "half": jnp.asarray(values.normal(size=7), jnp.bfloat16),
    }
    return TrainState(
        params=params,
        opt_state=optax.adam(1e-3).init(params),
        key=jax.random.split(jax.random.key(seed), seeds),
        counters={
            "updates": jnp.int32(seed),
            "env_steps": np.uint64(2**63 + seed),
            "alive": np.array([True, False, True]),
            "exact": np.array([np.pi, np.nan, -0.0, np.inf]),
            "phase": np.complex64(1 + 2j),
            "nothing_yet": jnp.zeros((0, 3)),
            "bytes": np.arange(256, dtype=np.uint8),
            "python": [seed, 0.5, True],
        },
    )


def bits(tree: Any) -> list[tuple[str, str, tuple[int, ...], bytes]]:
    """Names, dtypes, shapes and bytes: equal only if nothing at all differs."""
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        dtype = str(jnp.asarray(leaf).dtype if not hasattr(leaf, "dtype") else leaf.dtype)
        if dtype.startswith("key"):
            leaf = jax.random.key_data(leaf)
        leaf = np.asarray(leaf if hasattr(leaf, "dtype") else jnp.asarray(leaf))
        found.append((jax.tree_util.keystr(path), dtype, leaf.shape, leaf.tobytes()))
    return found


def abstract(leaf: Any) -> jax.ShapeDtypeStruct:
    leaf = leaf if hasattr(leaf, "dtype") else jnp.asarray(leaf)
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)


def listing(directory: Path) -> dict[str, str]:
    return {
        str(file.relative_to(directory)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in directory.rglob("*")
        if file.is_file()
    }


@pytest.fixture(scope="module")
def two_checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with an earlier and a newer checkpoint; copy it before changing it."""
    directory = tmp_path_factory.mktemp("saved") / "checkpoints"
    save(directory, train_state(1), {"epoch": 1})
    save(directory, train_state(2), {"epoch": 2})
    return directory


@pytest.fixture
def damaged(two_checkpoints: Path, tmp_path: Path) -> Path:
    """A copy of `two_checkpoints` that a test may harm."""
    return Path(shutil.copytree(two_checkpoints, tmp_path / "copy"))


def sealed(path: Path, **changes: Any) -> None:
    """Changes the description of a checkpoint and seals it again, as nobody does by accident.

    The format as documented: the checksum is the SHA-256 of the rest as canonical JSON; sizes and
    digests of the files are made anew from what is there.
    """
    content = json.loads((path / "checkpoint.json").read_text())
    content.pop("checksum")
    content["files"] = {
        file.relative_to(path).as_posix(): {
            "bytes": file.stat().st_size,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }
        for file in path.rglob("*")
        if file.is_file() and file.name != "checkpoint.json"
    }
    content |= changes
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    content["checksum"] = hashlib.sha256(canonical.encode()).hexdigest()
    (path / "checkpoint.json").write_text(json.dumps(content))


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


def files_of(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file())


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def empty(file: Path) -> None:
    file.write_bytes(b"")


def extend(file: Path) -> None:
    file.write_bytes(file.read_bytes() + b"\0")


def flip(file: Path) -> None:
    content, choose = bytearray(file.read_bytes() or b"\0"), random.Random(file.name)
    content[choose.randrange(len(content))] ^= 1 << choose.randrange(8)
    file.write_bytes(content)


def link(file: Path) -> None:
    """To a true copy: right bytes, but reading through links is how one is led astray."""
    elsewhere = Path(shutil.copy(file, file.parents[3] / f"{file.name}.elsewhere"))
    file.unlink()
    file.symlink_to(elsewhere)


HARMS = [truncate, empty, extend, flip, Path.unlink, link]


class TestDamage:
    @pytest.mark.parametrize("harm", HARMS, ids=lambda harm: harm.__name__)
    def test_every_file_in_turn(self, two_checkpoints, tmp_path, harm):
        """The earlier checkpoint is used and said, or the directory refused; both bit for bit."""
        count = len(files_of(latest(two_checkpoints)))
        assert count >= 8
        for index in range(count):
            directory = Path(shutil.copytree(two_checkpoints, tmp_path / f"{index}"))
            newest = latest(directory)
            file = files_of(newest)[index]
            before = file.read_bytes()
            harm(file)
            if harm in (truncate, empty) and before == b"":
                continue  # an empty file cannot be truncated
            said: list[str] = []
            state, meta = load(directory, train_state(), say=said.append)
            assert bits(state) == bits(train_state(1)), file
            assert meta == {"epoch": 1}
            assert len(said) == 1
            assert str(newest) in said[0]
            assert file.name in said[0]
            assert "earlier" in said[0]
            if file.name == "checkpoint.json" and not file.exists():
                continue  # alone, it is not even recognised
            assert file.name in refusal(load, newest, train_state())

    def test_any_flipped_bit_of_the_description(self, damaged):
        newest = latest(damaged)
        file = newest / "checkpoint.json"
        content = file.read_bytes()
        for position in random.Random(0).sample(range(len(content)), 300):
            changed = bytearray(content)
            changed[position] ^= 1 << position % 8
            file.write_bytes(changed)
            try:
                meta = read_meta(newest)
            except CheckpointError:
                continue
            assert meta == {"epoch": 2}  # white space: the content is the same
        file.write_bytes(content)
        assert read_meta(newest) == {"epoch": 2}

    def test_parameters_and_description_fall_back_too(self, damaged):
        truncate(files_of(latest(damaged))[-1])
        with pytest.warns(UserWarning, match="going on from the earlier"):
            assert read_meta(damaged) == {"epoch": 1}
        with pytest.warns(UserWarning, match="going on from the earlier"):
            assert bits(load_params(damaged)) == bits(train_state(1).params)

    def test_a_file_that_does_not_belong(self, damaged):
        (latest(damaged) / "state" / "state" / "d" / "more").write_bytes(b"")
        assert "d/more does not belong" in refusal(load, latest(damaged))

    def test_all_of_them(self, damaged):
        for path in damaged.iterdir():
            flip(path / "state" / "state" / "manifest.ocdbt")
        sentence = refusal(load, damaged)
        assert "manifest.ocdbt" in sentence
        assert "1 earlier ones are damaged too" in sentence

    def test_arrays_of_another_checkpoint(self, damaged):
        earlier, newest = sorted(damaged.iterdir())
        shutil.rmtree(newest / "state")
        shutil.copytree(earlier / "state", newest / "state")
        refusal(load, newest)
        sealed(newest)  # even if every file is as the description has it, the leaves are not
        assert "is not what was saved" in refusal(load, newest)

    def test_a_missing_leaf(self, damaged):
        newest = latest(damaged)
        shutil.rmtree(newest / "state")
        leaves = json.loads((newest / "checkpoint.json").read_text())["leaves"]
        _, arrays = host_arrays(train_state(2))
        arrays.pop("params/half")
        save_arrays(newest / "state", arrays)
        sealed(newest)
        assert "leaf params/half" in refusal(load, newest, train_state())
        del leaves["params/half"]
        sealed(newest, leaves=leaves)
        assert "no leaf params/half" in refusal(load, newest, train_state())

    def test_after_going_back_saving_goes_on(self, damaged):
        truncate(files_of(latest(damaged))[-1])
        save(damaged, train_state(3), {"epoch": 2}, keep=1)
        assert sorted(os.listdir(damaged)) == ["000003-step-2"]
        assert bits(load(damaged, train_state())[0]) == bits(train_state(3))


class TestNotOurs:
    def test_missing_empty_and_foreign_directories(self, tmp_path):
        assert "is no directory" in refusal(load, tmp_path / "missing")
        assert "holds no checkpoint" in refusal(load, tmp_path)
        (tmp_path / "file").write_text("x")
        assert "is no directory" in refusal(load, tmp_path / "file")
        (tmp_path / "000001-step-1").symlink_to(tmp_path)
        assert "holds no checkpoint" in refusal(load, tmp_path)

    def test_another_programs_orbax_checkpoint(self, tmp_path):
        from orbax.checkpoint import v1 as ocp

        ocp.save(tmp_path / "theirs", {"params": np.ones(3)})
        before = listing(tmp_path)
        assert "holds no checkpoint of sumajax" in refusal(load, tmp_path / "theirs")
        assert "holds other things" in refusal(save, tmp_path / "theirs", train_state(), META)
        assert listing(tmp_path) == before

    def test_nothing_foreign_is_touched(self, tmp_path):
        (tmp_path / "thesis.tex").write_text("years of work")
        assert "thesis.tex" in refusal(save, tmp_path, train_state(), META)
        assert "cannot be written" in refusal(save, tmp_path / "thesis.tex", train_state(), META)
        assert os.listdir(tmp_path) == ["thesis.tex"]

    def test_a_newer_format_is_refused_and_not_passed_over(self, damaged):
        sealed(latest(damaged), version=2)
        sentence = refusal(load, damaged)
        assert "format 2" in sentence
        assert "newer" in sentence

    def test_what_could_not_be_read_is_not_written(self, tmp_path):
        meta = {"notes": "x" * checkpoint.MAX_DESCRIPTION_BYTES}
        assert "shorten meta" in refusal(save, tmp_path / "c", {"w": np.ones(1)}, meta)
        assert os.listdir(tmp_path / "c") == []

    def test_another_format(self, damaged):
        sealed(latest(damaged), format="something else")
        assert "not of sumajax" in refusal(load, damaged)

    def test_directories_that_cannot_be_written_keep_what_they_have(self):
        """As an ordinary user, since root may write anywhere."""
        with tempfile.TemporaryDirectory() as place:
            directory = Path(place) / "checkpoints"
            save(directory, train_state(1), META)
            os.chmod(place, 0o755)
            for folder, _, names in os.walk(directory):
                os.chmod(folder, 0o555)
                for name in names:
                    os.chmod(Path(folder) / name, 0o444)
            before = listing(directory)
            user = os.geteuid()
            try:
                if user == 0:
                    os.seteuid(65534)
                sentence = refusal(save, directory, train_state(2), META)
                assert "Permission denied" in sentence
                assert str(directory) in sentence
                refusal(save, Path(place) / "new" if user == 0 else directory / "new", {}, META)
                assert bits(load(directory, train_state())[0]) == bits(train_state(1))
            finally:
                os.seteuid(user)
                for folder, _, _ in os.walk(directory):
                    os.chmod(folder, 0o755)
            assert listing(directory) == before

    def test_a_full_disk_keeps_what_was_there(self, tmp_path, capfd, caplog):
        """A limit on the size of files stands in for it: writing fails halfway, as there."""
        save(tmp_path / "c", train_state(1), META)
        before = listing(tmp_path)
        large = {"noise": np.random.default_rng(0).normal(size=2**17)}
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (2**18, hard))
            sentence = refusal(save, tmp_path / "c", large, META)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert "could not be written: File too large; free space" in sentence
        assert listing(tmp_path) == before
        noise = [record for record in caplog.records if record.levelname == "ERROR"]
        assert (capfd.readouterr(), noise) == (("", ""), []), "a traceback of Orbax's own"
        save(tmp_path / "c", large, META)
        assert bits(load(tmp_path / "c")[0]) == bits(large)


class Bomb:
    """What a pickle can do to whoever opens it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.putenv, ("SUMAJAX_TEST_BOMB", "exploded")


UNPICKLED: list[Any] = []
sys.addaudithook(lambda event, args: UNPICKLED.append(args) if "pickle" in event else None)


class TestUntrusted:
    # Orbax, giving up halfway, closes its event loop before its last reader has answered.
    @pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
    def test_nothing_is_ever_unpickled(self, damaged, monkeypatch):
        monkeypatch.setattr(np, "load", None)
        UNPICKLED.clear()
        load(damaged, train_state())
        newest = latest(damaged)
        for file in files_of(newest):
            kept = file.read_bytes()
            file.write_bytes(pickle.dumps(Bomb()))
            if file.name != "checkpoint.json":
                sealed(newest)
            # Orbax keeps files that it need not look at.
            with contextlib.suppress(CheckpointError):
                assert bits(load(newest, train_state())[0]) == bits(train_state(2))
            file.write_bytes(kept)
        assert UNPICKLED == []
        for module in Path(checkpoint.__file__).parent.glob("*.py"):
            assert "allow_pickle" not in module.read_text()

    @pytest.mark.parametrize(
        "content",
        [
            "",
            "[]",
            "null",
            "3",
            '"text"',
            "{}",
            "[" * 100_000,
            '{"checksum": ' + "9" * 5000 + "}",
            "\udc80",
        ],
        ids=lambda content: repr(content[:12]),
    )
    def test_any_description(self, damaged, content):
        newest = latest(damaged)
        (newest / "checkpoint.json").write_text(content, errors="surrogateescape")
        assert "checkpoint.json is damaged" in refusal(load, newest)

    def test_a_description_too_large_to_read(self, damaged):
        with open(latest(damaged) / "checkpoint.json", "a") as file:
            file.truncate(checkpoint.MAX_DESCRIPTION_BYTES + 1)
        assert "larger than" in refusal(load, latest(damaged))

    def test_descriptions_that_are_no_files(self, damaged):
        newest = latest(damaged)
        for make in (os.mkfifo, os.mkdir, lambda file: os.symlink("/dev/zero", file)):
            (newest / "checkpoint.json").unlink()
            make(newest / "checkpoint.json")
            with pytest.warns(UserWarning, match="not a regular file|directory"):
                assert read_meta(damaged) == {"epoch": 1}
            if make is os.mkdir:
                (newest / "checkpoint.json").rmdir()
                (newest / "checkpoint.json").touch()

    @pytest.mark.parametrize(
        "changes",
        [
            {"leaves": {"w": {"shape": [2**40], "dtype": "float32", "sha256": ""}}},
            {"leaves": {"w": {"shape": [-1], "dtype": "float32", "sha256": ""}}},
            {"leaves": {"w": {"shape": [1.5], "dtype": "float32", "sha256": ""}}},
            {"leaves": {"w": {"shape": [1] * 99, "dtype": "float32", "sha256": ""}}},
            {"leaves": {"w": {"shape": 3, "dtype": "float32", "sha256": ""}}},
            {"leaves": {"w": {"shape": [], "dtype": "object", "sha256": ""}}},
            {"leaves": {"w": {"shape": [], "dtype": ["int32"], "sha256": ""}}},
            {"leaves": {"../../w": {"shape": [], "dtype": "int32", "sha256": ""}}},
            {"leaves": {"w": None}},
            {"leaves": 3},
            {"meta": "text"},
            {"files": {"x": {"bytes": 2**60, "sha256": ""}}},
            {"files": {"state/d/x": {"bytes": 2**60, "sha256": ""}}},
            {"files": []},
        ],
    )
    def test_descriptions_sealed_by_somebody_else(self, damaged, changes):
        sealed(latest(damaged), **changes)
        assert "describes no state" in refusal(load, damaged)

    def test_links_are_not_followed_wherever_they_lead(self, damaged):
        newest = latest(damaged)
        (newest / "state" / "more").symlink_to("/dev/null")
        sealed(newest)
        files = json.loads((newest / "checkpoint.json").read_text())["files"]
        lie = {"bytes": len("/dev/null"), "sha256": hashlib.sha256(b"").hexdigest()}
        sealed(newest, files={**files, "state/more": lie})
        assert "more is not a regular file" in refusal(load, newest)

    def test_arrays_larger_than_described_are_not_read(self, tmp_path, monkeypatch):
        path = save(tmp_path / "c", {"w": np.ones(4)}, META)
        shutil.rmtree(path / "state")
        save_arrays(path / "state", {"w": np.zeros(2**22)})
        sealed(path)
        from orbax.checkpoint import v1 as ocp

        monkeypatch.setattr(ocp, "load", None)
        assert "leaf w is not as described" in refusal(load, path)


CHILD = """
import os, signal, sys
import numpy as np
from sumajax import checkpoint
if "orbax" in sys.modules:
    sys.exit("importing sumajax.checkpoint imports Orbax")
from orbax.checkpoint import v1

directory = sys.argv[1]

def say(word):
    os.write(1, f"{word}\\n".encode())  # at once: two processes share the pipe

def save_forever(fatal_event):
    events = [0]
    def hook(event, args):
        if event in ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.scandir"):
            events[0] += 1
            if events[0] == fatal_event:
                os.kill(os.getpid(), signal.SIGKILL)
    found = checkpoint.latest(directory)
    start = int(checkpoint.load(directory)[0]["step"]) + 1 if found else 0
    # Whatever is opened on first use is not to be counted.
    checkpoint.save(directory + "-warm", {"step": np.ones(2)}, {})
    if fatal_event:
        sys.addaudithook(hook)
    for step in range(start, start + 10_000):
        state = {"step": np.array(step), "w": np.full((64, 64), float(step))}
        checkpoint.save(directory, state, {"epoch": step}, keep=2)
        say(step)

for line in sys.stdin:
    go, ready = os.pipe()
    if (child := os.fork()) == 0:
        signal.alarm(60)  # should forking ever go wrong, fail and do not hang
        os.read(go, 1)
        save_forever(int(line))
    say(f"pid {child}")
    os.write(ready, b".")
    os.waitpid(child, 0)
    say("dead")
"""


class TestKill:
    def test_sigkill_at_any_moment_of_saving(self, tmp_path):
        """A process that does nothing but save is killed again and again, and always goes on."""
        directory, moments = tmp_path / "c", random.Random(0)
        code = [sys.executable, "-W", "ignore", "-c", CHILD, str(directory)]
        last, unfinished = -1, 0
        with subprocess.Popen(
            code, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment()
        ) as parent:
            for kill in range(14):
                # At a moment of the clock or, every other time, at a file operation of a save.
                fatal_event = 0 if kill % 2 else moments.randrange(1, 150)
                parent.stdin.write(f"{fatal_event}\n")
                parent.stdin.flush()
                for line in iter(parent.stdout.readline, "dead\n"):
                    word, *pid = line.split()
                    if word == "pid":
                        child = int(*pid)
                    elif int(word) > last:
                        last = int(word)
                        if not fatal_event:
                            time.sleep(moments.uniform(0, 0.1))
                            os.kill(child, signal.SIGKILL)
                            fatal_event = -1
                unfinished += any(name.startswith(".") for name in os.listdir(directory))
                for path in directory.glob("0*"):  # nothing half written or half removed
                    assert read_meta(path)["epoch"] <= last + 1
                if last >= 0:
                    state, meta = load(directory, say=pytest.fail)
                    assert last <= state["step"] == meta["epoch"] <= last + 1
                    np.testing.assert_array_equal(state["w"], float(meta["epoch"]))
                    last = meta["epoch"]  # the next child goes on from it, said or not
            parent.stdin.close()
        assert last >= 7
        assert unfinished >= 5, "the kills are meant to fall into saves"
        save(directory, {"w": np.ones(1)}, META, keep=1)
        assert len(os.listdir(directory)) == 1


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


def environment(**more: str) -> dict[str, str]:
    root = str(Path(checkpoint.__file__).parents[2])
    return {**os.environ, "PYTHONPATH": root, "JAX_PLATFORMS": "cpu", **more}


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
