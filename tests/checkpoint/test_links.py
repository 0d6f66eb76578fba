"""Checkpoints in stores that keep each file once and link to it, as caches of shared files do."""

import hashlib
import os
import shutil
from pathlib import Path

import pytest
from refusals import refusal
from saved_states import META, bits, files_of, listing, sealed, train_state

from sumajax.checkpoint import latest, load, load_params, read_meta, save


def link_files(directory: Path, store: Path) -> None:
    """Every file of every checkpoint moves into `store`, named after its content."""
    store.mkdir()
    for file in files_of(directory):
        kept = store / hashlib.sha256(file.read_bytes()).hexdigest()
        shutil.move(file, kept)
        file.symlink_to(os.path.relpath(kept, file.parent))


def link_folder(folder: Path, store: Path) -> None:
    store.mkdir()
    shutil.move(folder, store / "kept")
    folder.symlink_to(store / "kept", target_is_directory=True)


def link_whole_directory(directory: Path, store: Path) -> None:
    link_folder(directory, store)


def link_checkpoint(directory: Path, store: Path) -> None:
    link_folder(latest(directory), store)


def link_state(directory: Path, store: Path) -> None:
    link_folder(latest(directory) / "state", store)


def link_values(directory: Path, store: Path) -> None:
    link_folder(latest(directory) / "state" / "state" / "d", store)


def link_description(directory: Path, store: Path) -> None:
    store.mkdir()
    file = latest(directory) / "checkpoint.json"
    shutil.move(file, store / "blob")
    file.symlink_to(store / "blob")


LINKS = [
    link_files,
    link_whole_directory,
    link_checkpoint,
    link_state,
    link_values,
    link_description,
]


@pytest.mark.parametrize("link", LINKS, ids=lambda link: link.__name__)
def test_are_read(damaged, tmp_path, link):
    link(damaged, tmp_path / "store [of all]")
    for directory in (damaged, latest(damaged)):
        assert bits(load(directory, train_state(), say=pytest.fail)[0]) == bits(train_state(2))
        assert bits(load_params(directory, say=pytest.fail)) == bits(train_state(2).params)
        assert read_meta(directory, say=pytest.fail) == {"epoch": 2}


@pytest.mark.parametrize("link", LINKS, ids=lambda link: link.__name__)
def test_what_they_lead_to_is_verified(damaged, tmp_path, link):
    link(damaged, tmp_path / "store")
    file = latest(damaged) / ("state/state/manifest.ocdbt" if link is not link_values else "")
    file = file if file.is_file() else next((latest(damaged) / "state/state/d").iterdir())
    file = latest(damaged) / "checkpoint.json" if link is link_description else file
    real = file.resolve()
    real.write_bytes(real.read_bytes()[:-1] + b"?")
    said: list[str] = []
    state, _ = load(damaged, train_state(), say=said.append)
    assert bits(state) == bits(train_state(1))
    assert file.name in said[0]


@pytest.mark.parametrize("link", LINKS, ids=lambda link: link.__name__)
def test_the_store_keeps_what_it_has_when_a_checkpoint_goes(damaged, tmp_path, link):
    link(damaged, tmp_path / "store")
    kept = {k: v for k, v in listing(tmp_path / "store").items() if not k.startswith("kept/0")}
    save(damaged, train_state(3), META, keep=1)
    assert bits(load(damaged, train_state(), say=pytest.fail)[0]) == bits(train_state(3))
    assert [name for name in os.listdir(damaged) if name != "000003-step-1"] == []
    assert kept.items() <= listing(tmp_path / "store").items()


def test_a_description_does_not_lead_out_of_the_checkpoint(damaged):
    newest = latest(damaged)
    (damaged / "x").write_bytes(b"x")
    digest = {"bytes": 1, "sha256": hashlib.sha256(b"x").hexdigest()}
    sealed(newest, files={"../x": digest})
    assert "not below the checkpoint" in refusal(load, newest)


def test_links_in_a_circle(damaged):
    newest = latest(damaged)
    shutil.rmtree(newest / "state")
    (newest / "state").symlink_to("state")
    assert "symbolic links" in refusal(load, newest)
