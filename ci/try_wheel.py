"""The installed command, away from the clone: a chain that is killed, goes on, and is evaluated.

python ci/try_wheel.py ENVIRONMENT/bin/sumajax
"""

import json
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

CHAIN = (
    "transfer pp --sizes 5 10 20 --teams 3 5 10 --epochs 2 2 2 --scratch-epochs 2 "
    "--episodes 64 --output r"
)
EVALUATE = "evaluate r --sizes 20 --teams 10 --episodes 64 --json e.json"
PATIENCE = 1200
"""Seconds for a stage to have begun."""


def main(command: str) -> None:
    """Raises where anything is not as promised."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "r"
        first = subprocess.Popen([command, *shlex.split(CHAIN)], cwd=folder)
        wait_for_second_stage(run / "metrics.csv", first)
        first.kill()
        first.wait()
        assert not (run / "summary.json").exists(), "killed before its end"
        subprocess.run([command, *shlex.split(CHAIN)], cwd=folder, check=True)
        check_summary(json.loads((run / "summary.json").read_text()))
        subprocess.run([command, *shlex.split(EVALUATE)], cwd=folder, check=True)
        report = json.loads((Path(folder) / "e.json").read_text())
        assert next(iter(report["policies"])) == "20x20-10", report["policies"]


def wait_for_second_stage(metrics: Path, process: "subprocess.Popen[bytes]") -> None:
    """Until the second stage has left rows."""
    began = time.monotonic()
    while not (metrics.exists() and "10x10-5" in metrics.read_text()):
        assert process.poll() is None, "the run ended before it could be killed"
        assert time.monotonic() - began < PATIENCE
        time.sleep(0.2)


def check_summary(summary: dict) -> None:
    """Three stages in order, each evaluated before and after, with what they cost."""
    stages = summary["stages"]
    assert [stage["name"] for stage in stages] == ["5x5-3", "10x10-5", "20x20-10"]
    assert [stage["zero_shot"] is None for stage in stages] == [True, False, False]
    for stage in stages:
        assert stage["env_steps"] == 40_000
        assert stage["evaluation"]["sampled"]["episodes"] == 64
    assert summary["scratch"]["env_steps"] == 40_000
    assert summary["cost"]["env_steps"] == [40_000] * 3
    assert all(seconds > 0 for seconds in summary["cost"]["cpu_seconds"])


if __name__ == "__main__":
    main(str(Path(sys.argv[1]).absolute()))
