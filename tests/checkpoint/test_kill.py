"""A save may be killed at any moment."""

import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from saved_states import META, environment

from sumajax.checkpoint import load, read_meta, save

CHILD = """
import os, signal, sys
import numpy as np
from sumajax import checkpoint
if "orbax" in sys.modules:
    sys.exit("importing sumajax.checkpoint imports Orbax")
from orbax.checkpoint import v1

directory = sys.argv[1]

def say(word):
    os.write(1, f"{word}\\n".encode())  # at once: two processes share the pipe

def save_forever(fatal_event):
    events = [0]
    def hook(event, args):
        if event in ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.scandir"):
            events[0] += 1
            if events[0] == fatal_event:
                os.kill(os.getpid(), signal.SIGKILL)
    found = checkpoint.latest(directory)
    start = int(checkpoint.load(directory)[0]["step"]) + 1 if found else 0
    # Whatever is opened on first use is not to be counted.
    checkpoint.save(directory + "-warm", {"step": np.ones(2)}, {})
    if fatal_event:
        sys.addaudithook(hook)
    for step in range(start, start + 10_000):
        state = {"step": np.array(step), "w": np.full((64, 64), float(step))}
        checkpoint.save(directory, state, {"epoch": step}, keep=2)
        say(step)

for line in sys.stdin:
    go, ready = os.pipe()
    if (child := os.fork()) == 0:
        signal.alarm(60)  # should forking ever go wrong, fail and do not hang
        os.read(go, 1)
        save_forever(int(line))
    say(f"pid {child}")
    os.write(ready, b".")
    os.waitpid(child, 0)
    say("dead")
"""


class TestKill:
    def test_sigkill_at_any_moment_of_saving(self, tmp_path):
        """A process that does nothing but save is killed again and again, and always goes on."""
        directory, moments = tmp_path / "c", random.Random(0)
        code = [sys.executable, "-W", "ignore", "-c", CHILD, str(directory)]
        last, unfinished = -1, 0
        with subprocess.Popen(
            code, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment()
        ) as parent:
            for kill in range(14):
                # At a moment of the clock or, every other time, at a file operation of a save.
                fatal_event = 0 if kill % 2 else moments.randrange(1, 150)
                parent.stdin.write(f"{fatal_event}\n")
                parent.stdin.flush()
                for line in iter(parent.stdout.readline, "dead\n"):
                    word, *pid = line.split()
                    if word == "pid":
                        child = int(*pid)
                    elif int(word) > last:
                        last = int(word)
                        if not fatal_event:
                            time.sleep(moments.uniform(0, 0.1))
                            os.kill(child, signal.SIGKILL)
                            fatal_event = -1
                unfinished += any(name.startswith(".") for name in os.listdir(directory))
                for path in directory.glob("0*"):  # nothing half written or half removed
                    assert read_meta(path)["epoch"] <= last + 1
                if last >= 0:
                    state, meta = load(directory, say=pytest.fail)
                    assert last <= state["step"] == meta["epoch"] <= last + 1
                    np.testing.assert_array_equal(state["w"], float(meta["epoch"]))
                    last = meta["epoch"]  # the next child goes on from it, said or not
            parent.stdin.close()
        assert last >= 7
        assert unfinished >= 5, "the kills are meant to fall into saves"
        save(directory, {"w": np.ones(1)}, META, keep=1)
        assert len(os.listdir(directory)) == 1
