"""Runs of `sumajax transfer pp` that are killed: a server that forks a process for each.

Reads a line of JSON for each run: its `arguments`, the `directory` it writes to, its `log`, and
when to kill it: `event`, the number of the file operation in that directory at whose beginning it
gets the `signal`, or, with SIGKILL, `seconds` after its start; null for never. Answers with its
exit `status`, minus the signal if that ended or stopped it, the `events` it came to and its `pid`.
Imports are made once; everything after them is the program's own.
"""

import json
import mmap
import os
import signal
import struct
import sys
import time

import matplotlib.pyplot  # noqa: F401
from orbax.checkpoint import v1  # noqa: F401

from sumajax import cli
from sumajax.cli import evaluate, transfer  # noqa: F401

OPERATIONS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate", "os.scandir"}


def serve() -> None:
    for line in sys.stdin:
        request = json.loads(line)
        # The child dies without a word: what it counted is in memory that both see.
        counter = mmap.mmap(-1, 8)
        began = time.monotonic()
        child = os.fork()
        if child == 0:
            run(request, counter)
        status = wait(child, began, request["seconds"])
        (events,) = struct.unpack("q", counter)
        print(json.dumps({"status": status, "events": events, "pid": child}), flush=True)


def run(request: dict, counter: mmap.mmap) -> None:
    log = os.open(request["log"], os.O_CREAT | os.O_APPEND | os.O_WRONLY)
    os.dup2(log, 1)
    os.dup2(log, 2)

    def count(event: str, args: tuple) -> None:
        if event in OPERATIONS and request["directory"] in str(args[0]):
            (events,) = struct.unpack("q", counter[:8])
            counter[:8] = struct.pack("q", events + 1)
            if events + 1 == request["event"]:
                os.kill(os.getpid(), request["signal"])

    sys.addaudithook(count)
    arguments = ["transfer", "pp", *request["arguments"]]
    status = 0
    try:
        cli.main(arguments)
    except SystemExit as stop:
        status = int(stop.code or 0)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def wait(child: int, began: float, seconds: float | None) -> int:
    """Its exit status, or minus the signal."""
    while seconds is not None and time.monotonic() - began < seconds:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    if seconds is not None:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, os.WUNTRACED)
    if os.WIFSTOPPED(status):
        return -os.WSTOPSIG(status)
    return os.waitstatus_to_exitcode(status)


if __name__ == "__main__":
    serve()
