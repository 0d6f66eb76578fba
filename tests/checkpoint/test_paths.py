"""Any path a file system allows works, or is refused before anything depends on it."""

import os
import shutil
import string
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusals import refusal
from saved_states import META, bits, environment, listing, train_state

from sumajax.checkpoint import (
    CheckpointError,
    check_directory,
    latest,
    load,
    orbax,
    read_meta,
    save,
    writing,
)

NAMES = [
    "pp[seed0]",
    "[a-z]",
    "[",
    "a\\b",
    "\\",
    "with spaces",
    " ",
    "it's",
    'so "called"',
    "*",
    "**",
    "st*r",
    "wh?t",
    "{a,b}",
    "new\nline",
    "tab\t",
    "\x01\x1b[31m",
    "-rf",
    "--output",
    "ümläut",
    "u\u0308",
    "日本語",
    "\u202e",
    "\udcff not UTF-8",
    "%20%zz",
    "#1",
    "a&b;c|d",
    "<>",
    "$HOME",
    "~",
    "`id`",
    "gs:",
    "file:",
    "a:b",
    "...",
    ".hidden",
    "x" * 255,
]
STATE = {"params": {"w": np.arange(3.0), "k": np.ones((2, 2), np.float32)}}


def assert_works(root: Path, name: str) -> None:
    """Found good, saved and read, and nothing else left beside it."""
    directory = root / name / "checkpoints"
    check_directory(directory)
    assert os.listdir(root) == []
    save(directory, STATE, {"epoch": 2})
    assert bits(load(directory, STATE, say=pytest.fail)[0]) == bits(STATE)
    assert read_meta(latest(directory), say=pytest.fail) == {"epoch": 2}
    assert os.listdir(root) == [name]
    assert os.listdir(root / name) == ["checkpoints"]
    assert os.listdir(directory) == ["000001-step-2"]


@pytest.mark.parametrize("name", NAMES, ids=ascii)
def test_name(tmp_path, name):
    (tmp_path / "root").mkdir()
    assert_works(tmp_path / "root", name)


SPECIAL = st.text(string.punctuation.replace("/", "") + " \n\t\x7fäß", min_size=1, max_size=8)
ANY = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="/\0"), min_size=1)


@settings(
    max_examples=10,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(st.one_of(SPECIAL, ANY).filter(lambda name: name not in (".", "..")))
def test_any_name(tmp_path, name):
    root = Path(tempfile.mkdtemp(dir=tmp_path))
    if len(os.fsencode(name)) <= 255:
        assert_works(root, name)
    else:
        refusal(check_directory, root / name)


def test_a_pattern_does_not_take_its_neighbour(tmp_path):
    """`st*r` means `st*r`, and not `star` beside it."""
    save(tmp_path / "star", train_state(1), META)
    save(tmp_path / "st*r", train_state(2), META)
    assert bits(load(tmp_path / "star", train_state())[0]) == bits(train_state(1))
    assert bits(load(tmp_path / "st*r", train_state())[0]) == bits(train_state(2))


def test_renamed_and_seen_from_within(two_checkpoints, tmp_path, monkeypatch):
    run = tmp_path / "pp[seed0]"
    shutil.copytree(two_checkpoints, run / "-c")
    monkeypatch.chdir(run)
    for place in ("-c", "../pp[seed0]/-c", run / "-c"):
        assert bits(load(place, train_state(), say=pytest.fail)[0]) == bits(train_state(2))
    save("-c", train_state(3), META, keep=1)
    assert bits(load("-c", train_state())[0]) == bits(train_state(3))


def test_no_temporary_files_stay(tmp_path, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    assert_works(Path(tempfile.mkdtemp(dir=tmp_path)), "pp[seed0]")
    assert os.listdir(tmp_path / "temporary") == []


class TestRefused:
    @pytest.mark.parametrize("name", ["x" * 256, "ä" * 128, "nul\0", "y/" * 2500], ids=len)
    def test_what_no_file_system_takes(self, tmp_path, name):
        for refused in (check_directory, lambda path: save(path, STATE, META)):
            assert "written" in refusal(refused, tmp_path / name)
        assert os.listdir(tmp_path) == []
        assert latest(tmp_path / name) is None

    def test_a_path_just_too_long_for_the_files_in_it(self, tmp_path):
        """At every length where it begins to be too long: works and can be read, or is refused."""
        refusals = []
        base = tmp_path / "/".join(["x" * 200] * ((3800 - len(str(tmp_path))) // 201))
        for length in (3850, 3910, 3940, 3970, 4050):
            directory = base / ("y" * (length - len(str(base)) - 1))
            try:
                check_directory(directory)
            except CheckpointError as error:
                refusals.append(str(error))
                continue
            save(directory, STATE, META, step=10**17)
            load(directory, STATE, say=pytest.fail)
        assert 1 <= len(refusals) <= 4
        assert all("too long" in sentence for sentence in refusals)

    def test_a_file_and_a_folder_that_cannot_be_written(self, tmp_path):
        (tmp_path / "file").write_text("mine")
        for path in (tmp_path / "file", tmp_path / "file" / "below", Path("/proc/x")):
            assert "written" in refusal(check_directory, path)
        assert listing(tmp_path).keys() == {"file"}

    def test_a_temporary_folder_that_is_no_better(self, tmp_path, monkeypatch):
        (tmp_path / "te[m]p").mkdir()
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "te[m]p"))
        assert "TMPDIR" in refusal(check_directory, tmp_path / "pp[seed0]")
        assert os.listdir(tmp_path) == ["te[m]p"]
        save(tmp_path / "plain", STATE, META)

    def test_what_cannot_be_read_back_does_not_count(self, tmp_path, monkeypatch):
        """Whatever the reason may be: here, Orbax writes other values than it was given."""
        save(tmp_path / "c", STATE, META)
        before = listing(tmp_path)

        def wrong(path: Path, arrays: dict[str, np.ndarray]) -> None:
            orbax.save_arrays(path, {name: array + 1 for name, array in arrays.items()})

        monkeypatch.setattr(writing, "save_arrays", wrong)
        for refused in (check_directory, lambda path: save(path, STATE, META)):
            assert "cannot be read back" in refusal(refused, tmp_path / "c")
            assert listing(tmp_path) == before
        monkeypatch.setattr(writing, "save_arrays", lambda path, arrays: path.mkdir())
        assert "cannot be read back" in refusal(save, tmp_path / "new", STATE, META)
        assert os.listdir(tmp_path / "new") == []

    def test_a_sentence_stays_one_and_can_be_printed(self, tmp_path):
        for name in ("new\nline", "\udcff", "\x1b[31m"):
            sentence = refusal(load, tmp_path / name)
            assert sentence.isprintable()
            sentence.encode()


def test_checking_leaves_everything_as_it_was(damaged, tmp_path):
    before = sorted(tmp_path.rglob("*")), listing(tmp_path)
    for directory in (damaged, tmp_path / "new", tmp_path / "new" / "in" / "new"):
        check_directory(directory)
        assert (sorted(tmp_path.rglob("*")), listing(tmp_path)) == before


def test_checking_does_not_disturb_another_programs_save(damaged):
    (damaged / ".unfinished-000003-step-3").mkdir()
    check_directory(damaged)
    assert (damaged / ".unfinished-000003-step-3").exists()


def test_nothing_is_said(tmp_path):
    """By a program of its own, whose logs nobody has set up."""
    code = (
        "import sys, numpy as np; from sumajax import checkpoint\n"
        "checkpoint.save(sys.argv[1], {'w': np.ones(3)}, {}); checkpoint.load(sys.argv[1])"
    )
    program = [sys.executable, "-c", code, str(tmp_path / "pp[seed0]")]
    said = subprocess.run(program, env=environment(), capture_output=True, text=True)
    assert (said.returncode, said.stdout, said.stderr) == (0, "", "")
