"""Reading executes nothing, follows no lie and is bounded."""

import contextlib
import hashlib
import json
import os
import pickle
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refusal
from saved_states import META, bits, files_of, sealed, train_state

from sumajax import checkpoint
from sumajax.checkpoint import CheckpointError, latest, load, read_meta, save
from sumajax.checkpoint.orbax import save_arrays


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
            assert not re.search("allow_pickle(?!=False)", module.read_text())

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
            {"files": {"../x": {"bytes": 1, "sha256": ""}}},
            {"files": {"state/../../x": {"bytes": 1, "sha256": ""}}},
            {"files": {"/etc/passwd": {"bytes": 1, "sha256": ""}}},
            {"files": {"state//x": {"bytes": 1, "sha256": ""}}},
            {"files": {"./x": {"bytes": 1, "sha256": ""}}},
            {"files": {"": {"bytes": 1, "sha256": ""}}},
        ],
    )
    def test_descriptions_sealed_by_somebody_else(self, damaged, changes):
        sealed(latest(damaged), **changes)
        assert "describes no state" in refusal(load, damaged)

    def test_links_to_what_is_no_file(self, damaged):
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
