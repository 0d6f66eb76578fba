"""Checkpoints that tests may look at, and copies that they may harm."""

import shutil
from pathlib import Path

import pytest
from saved_states import train_state

from sumajax.checkpoint import save


@pytest.fixture(scope="session")
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
