"""Nothing that is printed can end a run."""

import io
import os
import subprocess
import sys

import pytest

from sumajax.reporting.output import Outlet, outlet, unfailing_output

PROGRAM = """
import sys
from pathlib import Path
from sumajax.reporting import Progress, print_table
from sumajax.reporting.output import unfailing_output

with unfailing_output():
    with Progress({"source": 1}, interval=0) as progress:
        progress.begin("source")
        progress.say("läuft nach " + sys.argv[1])
        progress.advance("source", 1, {"steps_taken": 3.0, "success": 1.0})
    print_table([{"Läufe": "größer \\u2026 \\udc80", "steps": 3.0}], title="Übersicht")
    print("schön " * 10_000, flush=True)
    Path(sys.argv[1]).write_text("whole")
"""


def ran(tmp_path, *, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **variables):
    """The program's end, and whether it came to its last line."""
    written, program = tmp_path / "größe.txt", tmp_path / "program.py"
    program.write_text(PROGRAM, encoding="utf-8")
    ended = subprocess.run(
        [sys.executable, str(program), str(written)],
        stdout=stdout,
        stderr=stderr,
        env={**os.environ, **variables},
    )
    return ended, written.exists() and written.read_text() == "whole"


@pytest.mark.parametrize(
    "variables",
    [
        {"PYTHONIOENCODING": "ascii"},
        {"PYTHONIOENCODING": "cp1252"},
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        {"PYTHONIOENCODING": "utf-8"},
    ],
    ids=["ascii", "cp1252", "C", "POSIX", "utf-8"],
)
def test_a_terminal_without_the_characters(variables, tmp_path):
    ended, whole = ran(tmp_path, **variables)
    assert (ended.returncode, whole) == (0, True), ended.stderr
    assert b"steps" in ended.stdout
    assert b"\\udc80" in ended.stdout, "what no encoding has is an escape"
    assert b"Traceback" not in ended.stderr


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no full device")
def test_a_full_disk(tmp_path):
    with open("/dev/full", "wb") as full:
        ended, whole = ran(tmp_path, stdout=full, stderr=full)
    assert (ended.returncode, whole) == (0, True)


def test_a_reader_that_has_gone(tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    ended, whole = ran(tmp_path, stdout=writing)
    os.close(writing)
    assert (ended.returncode, whole) == (0, True), ended.stderr
    assert b"Broken" not in ended.stderr


def test_no_standard_streams_at_all(tmp_path):
    program = f"import os; os.close(1); os.close(2)\n{PROGRAM}"
    written = tmp_path / "written.txt"
    ended = subprocess.run([sys.executable, "-c", program, str(written)])
    assert (ended.returncode, written.read_text()) == (0, "whole")


class TestOutlet:
    def test_what_the_encoding_has_is_left_alone(self):
        raw = io.BytesIO()
        file = outlet(io.TextIOWrapper(raw, encoding="latin-1"))
        print("größer \u2026", file=file, flush=True)
        assert raw.getvalue() == "größer \\u2026\n".encode("latin-1")

    def test_a_closed_file(self):
        file = io.StringIO()
        file.close()
        taken = outlet(file)
        assert not taken.isatty()
        print("into nothing", file=taken, flush=True)

    def test_one_is_enough(self):
        file = outlet(io.StringIO())
        assert outlet(file) is file

    def test_no_file(self):
        print("into nothing", file=outlet(None), flush=True)

    def test_a_command_has_its_own_streams_back(self, monkeypatch):
        file = io.StringIO()
        monkeypatch.setattr(sys, "stdout", file)
        with unfailing_output():
            assert isinstance(sys.stdout, Outlet)
            print("said")
        assert sys.stdout is file
        assert file.getvalue() == "said\n"
