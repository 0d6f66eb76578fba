"""Why the directory of checkpoints is ours: what Orbax's own `Checkpointer` does not promise.

It names, keeps and removes a sequence of checkpoints as ours does. These tests fail when it learns
what is missing; then it may take over.
"""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from orbax.checkpoint import v1 as ocp

STATE = {"w": np.arange(4.0), "k": np.ones(3)}

WATCHED: list[tuple[str, str]] = []
OPERATIONS = {"os.rename", "os.remove", "os.rmdir"}


def watch(event: str, arguments: tuple) -> None:
    if event in OPERATIONS and isinstance(arguments[0], (str, os.PathLike)):
        WATCHED.append((event, str(arguments[0])))


sys.addaudithook(watch)


def keeping(directory: Path, count: int) -> ocp.training.Checkpointer:
    policy = ocp.training.preservation_policies.LatestN(count)
    return ocp.training.Checkpointer(directory, preservation_policy=policy)


def test_after_going_back_to_an_earlier_step_it_saves_nothing(tmp_path):
    """A run that goes on from an earlier good checkpoint saves steps that were there before."""
    with keeping(tmp_path / "c", 3) as checkpointer:
        assert checkpointer.save(20, STATE)
        assert not checkpointer.save(10, STATE)
        assert checkpointer.latest.step == 20


def test_it_removes_in_place(tmp_path):
    """Killed within it, half a checkpoint is left under the name of a whole one."""
    with keeping(tmp_path / "c", 1) as checkpointer:
        checkpointer.save(1, STATE)
        WATCHED.clear()
        checkpointer.save(2, STATE)
    old = str(tmp_path / "c" / "1")
    assert {event for event, path in WATCHED if path == old} == {"os.rmdir"}, "not renamed first"


def test_what_cannot_be_read_counts_and_replaces_what_could(tmp_path):
    """Of a path that its glob does not find, it keeps the unreadable one and removes the rest."""
    with keeping(tmp_path / "pp[seed0]", 1) as checkpointer:
        checkpointer.save(1, STATE)
        checkpointer.save(2, STATE)
        assert [found.step for found in checkpointer.checkpoints] == [2]
        with pytest.raises(KeyError):
            checkpointer.load(2, {"w": np.zeros(4), "k": np.zeros(3)})
