"""A full disk: one sentence, nothing after it, and everything as it was."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from saved_states import environment

PROGRAM = """
import json, resource, sys, time
import numpy as np
from sumajax import checkpoint

directory, limits = sys.argv[1], json.loads(sys.argv[2])
noise = np.random.default_rng(0)
small = {"w": np.ones(3)}
large = {f"w{i}": noise.normal(size=2**14) for i in range(8)}  # 1 MiB

def attempt():
    try:
        checkpoint.save(directory, large, {})
    except checkpoint.CheckpointError as error:
        return str(error)
    return "saved"

checkpoint.save(directory, small, {})
said = []
for limit in limits:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    said.append(attempt())
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert (checkpoint.load(directory)[0]["w"] == 1).all()
if not limits:
    said.append(attempt())
time.sleep(0.3)  # whoever is still at work may speak
print(json.dumps(said))
"""


def sentences(directory: Path, limits: list[int]) -> list[str]:
    """What a program said that saves under each limit on the size of a file."""
    program = [sys.executable, "-c", PROGRAM, str(directory), json.dumps(limits)]
    said = subprocess.run(program, env=environment(), capture_output=True, text=True)
    assert said.stderr == ""
    assert said.returncode == 0
    return json.loads(said.stdout)


def assert_refused(said: list[str], why: str) -> None:
    for sentence in said:
        assert f"could not be written: {why}; free space" in sentence
        assert sentence.endswith("(the earlier checkpoints are as they were).")


def test_at_any_moment_of_a_save(tmp_path):
    """A limit on the size of files stands in for it: writing fails halfway, as there."""
    limits = [0, 100, 2**10, 2**12, 2**14, 2**16, 2**17, 2**19, 2**20]
    assert_refused(sentences(tmp_path / "c", limits), "File too large")
    assert [path.name for path in (tmp_path / "c").iterdir()] == ["000001-step-0"]


def test_a_real_one(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(disk)]
    try:
        mounted = subprocess.run(mount, capture_output=True).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("needs to mount a small disk")
    try:
        assert_refused(sentences(disk / "c", []), "No space left on device")
        assert [path.name for path in (disk / "c").iterdir()] == ["000001-step-0"]
    finally:
        subprocess.run(["umount", str(disk)], check=True)
