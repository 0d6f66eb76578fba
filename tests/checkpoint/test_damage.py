"""Whatever was written and is missing or altered is found."""

import json
import os
import random
import shutil
from pathlib import Path

import pytest
from refusals import refusal
from saved_states import bits, files_of, sealed, train_state

from sumajax.checkpoint import CheckpointError, latest, load, load_params, read_meta, save
from sumajax.checkpoint.leaves import host_arrays
from sumajax.checkpoint.orbax import save_arrays


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


def link_to_an_altered_copy(file: Path) -> None:
    elsewhere = Path(shutil.copy(file, file.parents[3] / f"{file.name}.elsewhere"))
    flip(elsewhere)
    file.unlink()
    file.symlink_to(elsewhere)


def link_to_nothing(file: Path) -> None:
    file.unlink()
    file.symlink_to("gone")


HARMS = [truncate, empty, extend, flip, Path.unlink, link_to_an_altered_copy, link_to_nothing]


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
