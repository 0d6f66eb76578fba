"""A run may be killed at any moment: the same command goes on and ends in the very same files."""

import csv
import json
import os
import random
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from signal import SIGKILL, SIGSTOP

import jax
import numpy as np
import pytest

from sumajax import checkpoint

TASKS = {
    "source": {"size": 3, "num-predators": 2, "max-steps": 10},
    "target": {"size": 6, "num-predators": 3, "max-steps": 20},
    "learner": {"num-envs": 100, "rollout-length": 20},
}
SHORT = {"source-epochs": 2, "target-epochs": 2, "seeds": 0, "scratch": False}
SOURCE_ALONE = {**SHORT, "target-epochs": 0}
LONGER = {"source-epochs": 4, "target-epochs": 3, "seeds": (0, 1), "scratch": True}
CLOCK = ("compile_seconds", "train_seconds", "env_steps_per_second")


def arguments(settings: dict, directory: Path) -> list[str]:
    """The command line of a tiny transfer in `directory`."""
    given = ["--devices", "1", "--evaluate-every", "1", "--output", str(directory)]
    given += ["--policy-settings.hidden", "8", "--encoder", "linear", "--episodes", "16"]
    given += ["--checkpoint-every", "1"]
    for task, fields in TASKS.items():
        for name, value in fields.items():
            given += [f"--{task}.{name}", str(value)]
    for name in ("source-epochs", "target-epochs"):
        given += [f"--{name}", str(settings[name])]
    given += ["--seeds", *map(str, np.atleast_1d(settings["seeds"]))]
    return given if settings["scratch"] else [*given, "--no-scratch"]


class Server:
    """Starts runs, kills them, and says how they ended; see `killed_runs.py`."""

    def __init__(self, pipe: subprocess.Popen, settings: dict) -> None:
        self.pipe, self.settings = pipe, settings

    def run(
        self,
        directory: Path,
        event: int | None = None,
        seconds: float | None = None,
        signal: int = SIGKILL,
    ) -> dict[str, int]:
        """Its exit `status`, the number of its file `events`, its `pid`."""
        request = {
            "arguments": arguments(self.settings, directory),
            "directory": str(directory),
            "log": str(directory.with_suffix(".log")),
            "event": event,
            "seconds": seconds,
            "signal": signal,
        }
        self.pipe.stdin.write(json.dumps(request) + "\n")
        self.pipe.stdin.flush()
        return json.loads(self.pipe.stdout.readline())

    def finish(self, directory: Path) -> int:
        """Runs to the end; how many file operations that took."""
        answer = self.run(directory)
        assert answer["status"] == 0, said(directory)
        return answer["events"]


def said(directory: Path) -> str:
    return directory.with_suffix(".log").read_text()


@contextmanager
def server(settings: dict, cache: Path):
    """Every run compiles anew what an earlier one has not finished compiling."""
    environment = {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    program = [sys.executable, "-W", "ignore", str(Path(__file__).with_name("killed_runs.py"))]
    with subprocess.Popen(
        program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as pipe:
        yield Server(pipe, settings)
        pipe.stdin.close()


@pytest.fixture
def cache(request):
    return request.config.cache.mkdir("jax-runs")


def assert_same_end(ours: Path, theirs: Path) -> None:
    """Files, figures and parameters of two runs are the same, but for what a clock said."""
    assert names(ours) == names(theirs)
    assert without_clock(ours) == without_clock(theirs)
    for name in {"evaluations.csv", "replay.gif"} & set(names(ours)):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes()
    assert summary(ours) == summary(theirs)
    for arm in sorted(path.name for path in (ours / "checkpoints").iterdir()):
        for ours_path, theirs_path in zip(
            *(sorted((run / "checkpoints" / arm).iterdir()) for run in (ours, theirs)), strict=True
        ):
            assert ours_path.name == theirs_path.name
            (a, a_meta), (b, b_meta) = (checkpoint.load(p) for p in (ours_path, theirs_path))
            assert a_meta == b_meta
            assert jax.tree.structure(a) == jax.tree.structure(b)
            for x, y in zip(*map(jax.tree.leaves, (raw(a), raw(b))), strict=True):
                np.testing.assert_array_equal(x, y)


def names(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def raw(tree):
    return {**tree, "key": jax.random.key_data(tree["key"])}


def without_clock(directory: Path) -> list[dict[str, str]]:
    with open(directory / "metrics.csv") as file:
        return [
            {k: v for k, v in row.items() if not k.endswith("seconds")}
            for row in csv.DictReader(file)
        ]


def summary(directory: Path) -> dict:
    content = json.loads((directory / "summary.json").read_text())
    for arm in ("source", "transfer", "scratch"):
        for name in CLOCK:
            (content[arm] or {}).pop(name, None)
    return content


@pytest.mark.slow
def test_killed_in_each_stage(tmp_path, cache):
    """Within a save of the first stage and, after going on, within one of the second."""
    with server(SHORT, cache) as runs:
        events = runs.finish(tmp_path / "whole")
        for share in (0.3, 0.5):
            killed = runs.run(tmp_path / "run", event=int(share * events))
            assert killed["status"] == -SIGKILL
        runs.finish(tmp_path / "run")
    assert_same_end(tmp_path / "run", tmp_path / "whole")
    assert "source: going on from epoch" in said(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_killed_at_random_moments(seed, tmp_path, cache):
    """At file operations, most of them of saves, and every third time at a moment of the clock."""
    moments, kills = random.Random(seed), 0
    with server(LONGER, cache) as runs:
        events = runs.finish(tmp_path / "whole")
        for attempt in range(int(os.environ.get("SUMAJAX_KILLS", "12"))):
            if attempt % 3 == 2:
                moment = {"seconds": moments.uniform(0.1, 8)}
            else:
                moment = {"event": moments.randrange(1, events // 3)}
            status = runs.run(tmp_path / "run", **moment)["status"]
            kills += status == -SIGKILL
            if status != -SIGKILL:
                break
        if not (tmp_path / "run" / "summary.json").exists():
            runs.finish(tmp_path / "run")
    print(f"survived {kills} kills")
    assert kills >= 3
    assert_same_end(tmp_path / "run", tmp_path / "whole")


def test_killed_while_a_second_run_is_refused(tmp_path, cache):
    """Real processes: the first is held in its middle, the second refused, the first killed."""
    with server(SOURCE_ALONE, cache) as runs:
        events = runs.finish(tmp_path / "whole")
        first = runs.run(tmp_path / "run", event=events // 2, signal=SIGSTOP)
        assert first["status"] == -SIGSTOP
        try:
            before = sorted(tmp_path.joinpath("run").rglob("*"))
            assert runs.run(tmp_path / "run")["status"] == 2
            assert f"error: {tmp_path}/run is in use by another run" in said(tmp_path / "run")
            assert sorted(tmp_path.joinpath("run").rglob("*")) == before
        finally:
            os.kill(first["pid"], SIGKILL)
        runs.finish(tmp_path / "run")
    assert_same_end(tmp_path / "run", tmp_path / "whole")
