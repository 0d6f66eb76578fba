"""Files that nobody wrote here: desktops, sync programs and file systems leave them anywhere.

Which files are ours is what the description lists; whatever else there is, is not looked at.
"""

import os
import shutil
from pathlib import Path

import pytest
from refusals import refusal
from saved_states import META, bits, listing, train_state

from sumajax.checkpoint import identity, latest, load, load_params, read_meta, save

STRANGERS = [
    ".DS_Store",
    "Thumbs.db",
    "desktop.ini",
    "._checkpoint.json",
    "~lock.checkpoint.json#",
    "checkpoint.sync-conflict-20260101-120000-ABCDEFG.json",
    "checkpoint (conflicted copy).json",
    ".nfs000000000123456700000001",
    "anything at all [1]*",
    # What Orbax would take for its own if it saw it.
    "_sharding",
    "commit_success.txt",
    "ocdbt.process_1",
    "manifest.ocdbt",
    "_METADATA",
]
PLACES = {
    "directory": ".",
    "checkpoint": "000002-step-2",
    "state": "000002-step-2/state",
    "inner_state": "000002-step-2/state/state",
    "values": "000002-step-2/state/state/d",
}


def strange(place: Path) -> None:
    """Leaves everything of which there is not already something of ours."""
    for name in STRANGERS:
        if not (place / name).exists():
            (place / name).write_bytes(b"strange")
    for name in (".stfolder", ".dropbox.cache", "ocdbt.process_7", "array_metadatas"):
        if not (place / name).exists():
            (place / name).mkdir()
            (place / name / "process_0").write_bytes(b"strange")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("place", PLACES)
def test_are_ignored_at_every_level(damaged, place):
    before = identity(damaged)
    strange(damaged / PLACES[place])
    for directory in (damaged, latest(damaged)):
        assert bits(load(directory, train_state(), say=pytest.fail)[0]) == bits(train_state(2))
        assert bits(load_params(directory, say=pytest.fail)) == bits(train_state(2).params)
        assert read_meta(directory) == {"epoch": 2}
        assert identity(directory) == before


@pytest.mark.parametrize("place", PLACES)
def test_do_not_stay_with_a_checkpoint_that_goes(damaged, place):
    strange(damaged / PLACES[place])
    kept = {name for name in os.listdir(damaged) if not name.startswith("0")}
    path = save(damaged, train_state(3), META, keep=1)
    assert set(os.listdir(damaged)) == {path.name} | kept
    assert bits(load(damaged, train_state(), say=pytest.fail)[0]) == bits(train_state(3))


def test_do_not_hide_what_is_missing_or_altered(damaged):
    for place in PLACES.values():
        strange(damaged / place)
    said: list[str] = []
    manifest = latest(damaged) / "state" / "state" / "manifest.ocdbt"
    content = manifest.read_bytes()
    for harm in (Path.unlink, lambda file: file.write_bytes(content[:-1] + b"?")):
        harm(manifest)
        assert bits(load(damaged, train_state(), say=said.append)[0]) == bits(train_state(1))
        assert "manifest.ocdbt" in said[-1]
    shutil.rmtree(damaged / "000001-step-1")
    assert "manifest.ocdbt" in refusal(load, damaged)


def test_a_directory_of_strangers_is_empty(tmp_path):
    strange(tmp_path)
    for name in ("_METADATA", "ocdbt.process_7"):
        assert (tmp_path / name).exists()
    before = listing(tmp_path)
    assert latest(tmp_path) is None
    assert "holds no checkpoint" in refusal(load, tmp_path)
    path = save(tmp_path, train_state(), META)
    assert path.name == "000001-step-1"
    assert {k: v for k, v in listing(tmp_path).items() if not k.startswith(path.name)} == before


def test_that_look_like_ours(damaged):
    """Copies beside a checkpoint, and files under the name of one."""
    shutil.copytree(latest(damaged), damaged / "000009-step-9 (conflicted copy)")
    (damaged / "._000002-step-2").write_bytes(b"strange")
    (damaged / "000007-step-3").write_bytes(b"strange")
    (damaged / ".unfinished-000003-step-3").write_bytes(b"strange")
    (damaged / "checkpoint.json").write_bytes(b"strange")
    assert latest(damaged).name == "000002-step-2"
    assert bits(load(damaged, train_state(), say=pytest.fail)[0]) == bits(train_state(2))
    (damaged / "checkpoint.json").unlink()
    assert save(damaged, train_state(3), META).name == "000008-step-1"
    assert (damaged / "000007-step-3").read_bytes() == b"strange"
