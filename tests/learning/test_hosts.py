"""Devices and hosts: the same parameters however a stage is spread, and checkpoints between all."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from layouts import NUM_ENVS, SEED

from sumajax import checkpoint, hosts

SCRIPT = Path(__file__).with_name("layouts.py")


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def run(*layouts):
    """Runs processes side by side to their end; what each wrote to standard error."""
    running = [
        subprocess.Popen(
            [sys.executable, SCRIPT, json.dumps(layout)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for layout in layouts
    ]
    try:
        outputs = [process.communicate(timeout=900) for process in running]
    finally:
        for process in running:
            process.kill()
    for process, (_, errors) in zip(running, outputs, strict=True):
        assert process.returncode == 0, errors
    return [errors for _, errors in outputs]


def run_hosts(cache, stages):
    layout = {"hosts": 2, "coordinator": f"127.0.0.1:{free_port()}", "devices": 1}
    layout |= {"cache": cache, "stages": stages}
    return run(*({**layout, "host": host} for host in range(2)))


def saved(directory):
    """Parameters and environments after the last epoch, as numbers."""
    state, meta = checkpoint.load(directory)
    assert meta["epoch"] == 2
    assert meta["seeds"] == [SEED]
    assert jax.tree.leaves(state["actors"])[0].shape[:2] == (1, NUM_ENVS)
    return state["params"]


def difference(a, b):
    """The largest of all leaves, relative to 1 or to the number itself."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(float((np.abs(x - y) / np.maximum(np.abs(x), 1)).max()) for x, y in pairs)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return str(tmp_path_factory.mktemp("compiled"))


@pytest.fixture(scope="module")
def on_devices(cache, tmp_path_factory):
    """Directories of checkpoints by layout: "1-4" began on one device and went on with four."""
    root = tmp_path_factory.mktemp("layouts")
    layouts = {"1": (1, 1), "4": (4, 4), "1-4": (1, 4), "4-1": (4, 1)}
    stages = [
        [str(root / name), devices, epochs]
        for name, spread in layouts.items()
        for epochs, devices in enumerate(spread, start=1)
    ]
    run({"devices": 4, "cache": cache, "stages": stages})
    return {name: root / name for name in layouts}


@pytest.mark.parametrize("layout", ["4", "1-4", "4-1"])
def test_the_same_parameters_on_any_number_of_devices(on_devices, layout):
    assert difference(saved(on_devices["1"]), saved(on_devices[layout])) < 1e-5


def test_the_comparison_would_see_a_difference(on_devices):
    first = checkpoint.load_params(sorted(on_devices["1"].iterdir())[0])
    assert difference(saved(on_devices["1"]), first) > 1e-3


@pytest.mark.slow
def test_the_same_parameters_on_two_hosts(cache, on_devices, tmp_path):
    """And a checkpoint of two hosts goes on with one, and the other way."""
    both, then_one, then_both = (str(tmp_path / name) for name in ("both", "one", "after"))
    run({"devices": 1, "cache": cache, "stages": [[then_both, 1, 1]]})
    first, second = run_hosts(cache, [[both, 2, 2], [then_one, 2, 1], [then_both, 2, 2]])
    run({"devices": 1, "cache": cache, "stages": [[then_one, 1, 2]]})
    assert "waiting for 1 more" in first
    assert "waiting" not in second
    for directory in (both, then_one, then_both):
        assert difference(saved(on_devices["1"]), saved(directory)) < 1e-5


def test_one_process_tells_itself():
    assert not hosts.several()
    assert hosts.is_first()
    assert hosts.everyone_says([1]) == [[1]]
    assert hosts.first_does(lambda: 5) == 5
    assert hosts.first_makes(lambda: (1, [2]), like=None) == (1, [2])
    hosts.meet()


@pytest.mark.parametrize("text", ["here", ":80", "here:", "here:0", "here:65536", "here:-1", ""])
def test_no_address(text):
    with pytest.raises(ValueError, match="coordinator is the HOST:PORT of host 0, got "):
        hosts.address(text)


def test_addresses():
    assert hosts.address("127.0.0.1:1234") == ("127.0.0.1", 1234)
    assert hosts.address("[::1]:1234") == ("::1", 1234)


def test_a_port_that_is_taken():
    with socket.socket() as listener:
        listener.bind(("", 0))
        listener.listen()
        port = listener.getsockname()[1]
        with pytest.raises(OSError, match=f"host 0 cannot listen on port {port}"):
            hosts.connect(2, 0, f"127.0.0.1:{port}")


def test_a_host_0_that_does_not_answer():
    port = free_port()
    with pytest.raises(OSError, match=f"host 0 does not answer at 127.0.0.1:{port}"):
        hosts.connect(2, 1, f"127.0.0.1:{port}", seconds=0)
