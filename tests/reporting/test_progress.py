import io
import sys
import types

import numpy as np
import pytest

from sumajax.reporting import Progress, print_table, result_table

STAGES = {"source": 4, "transfer": 10, "scratch": 0}


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self):
        return True


def train(progress, clock, seconds_per_epoch=1.0, compile_seconds=10.0):
    """Two stages, an update per epoch; compiling goes before the first of each."""
    for stage, state in progress.stages.items():
        progress.begin(stage)
        clock.now += compile_seconds
        for epoch in range(1, state.epochs + 1):
            clock.now += seconds_per_epoch
            metrics = {"steps_taken": 100 / epoch, "success": epoch / state.epochs}
            progress.advance(stage, epoch, metrics)


def test_a_file_gets_plain_lines_not_more_often_than_the_interval():
    file, clock = io.StringIO(), Clock()
    with Progress(STAGES, file, interval=3.0, clock=clock) as progress:
        train(progress, clock)
        progress.say("transfer: greedy 13.5 steps [evaluated]")
    text = file.getvalue()
    assert all(character.isprintable() or character == "\n" for character in text)
    assert text.splitlines() == [
        "source: 0/4 epochs, compiling",
        "source: 1/4 epochs, 1,818 steps/s, steps 100.00, success 25.0%, 2:23 left",
        "source: 4/4 epochs, 20k steps/s, steps 25.00, success 100.0%, 0:10 left",
        "transfer: 0/10 epochs, compiling",
        "transfer: 1/10 epochs, 1,818 steps/s, steps 100.00, success 10.0%, 1:39 left",
        "transfer: 4/10 epochs, 20k steps/s, steps 25.00, success 40.0%, 0:06 left",
        "transfer: 7/10 epochs, 20k steps/s, steps 14.29, success 70.0%, 0:03 left",
        "transfer: 10/10 epochs, 20k steps/s, steps 10.00, success 100.0%, 0:00 left",
        "transfer: greedy 13.5 steps [evaluated]",
    ]


def test_time_left_counts_all_stages_and_leaves_compiling_out():
    clock = Clock()
    progress = Progress(STAGES, io.StringIO(), clock=clock)
    assert progress.seconds_left() is None
    progress.begin("source")
    clock.now += 30
    progress.advance("source", 1, {})
    assert progress.seconds_left() == pytest.approx(13 * 30)  # nothing better is known yet
    clock.now += 2
    progress.advance("source", 2, {})
    assert progress.seconds_left() == pytest.approx(12 * 2)
    progress.begin("transfer", epochs_done=8)  # resumed
    assert progress.seconds_left() == pytest.approx(4 * 2)


def test_a_given_speed_is_shown_rather_than_the_measured_one():
    progress = Progress({"source": 4}, io.StringIO(), clock=Clock())
    progress.advance("source", 1, {"env_steps_per_second": 123_456.0, "success": np.float32("nan")})
    assert progress.fields("source") == {
        "epochs": "1/4",
        "speed": "123k steps/s",
        "steps_taken": "steps -",
        "success": "success -",
        "left": "- left",
    }


def test_an_unknown_stage_is_refused():
    with pytest.raises(ValueError, match="'target' is not one of source, transfer"):
        Progress(STAGES, io.StringIO()).advance("target", 1, {})


def test_a_terminal_gets_live_bars_that_fit_and_leave_the_cursor_visible(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm-256color")
    file, clock = Terminal(), Clock()

    def interrupted_run():
        with Progress(STAGES, file, clock=clock) as progress:
            train(progress, clock)
            progress.say("evaluated [greedy]")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted_run()
    text = file.getvalue()
    assert "\x1b[?25l" in text
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")
    assert "evaluated [greedy]" in text
    last = text[text.rindex("source ") :]
    assert "4/4" in last
    assert "10/10" in last
    assert "success 100.0%" in last


def test_a_dumb_terminal_gets_lines(monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    file = Terminal()
    with Progress({"source": 2}, file, clock=Clock()) as progress:
        progress.advance("source", 2, {})
    assert file.getvalue().startswith("source: 2/2 epochs")


def test_a_notebook_gets_one_line_for_each_stage_rewritten_in_place(monkeypatch):
    shown: list[list[str]] = []

    class Handle:
        def __init__(self, index):
            self.index = index

        def update(self, content, raw):
            shown[self.index].append(content["text/plain"])

    def display(content, raw, display_id):
        shown.append([content["text/plain"]])
        return Handle(len(shown) - 1)

    shell = type("ZMQInteractiveShell", (), {})()
    ipython = types.ModuleType("IPython")
    ipython.get_ipython = lambda: shell
    ipython.display = types.ModuleType("IPython.display")
    ipython.display.display = display
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", ipython.display)
    file, clock = io.StringIO(), Clock()
    with Progress(STAGES, file, clock=clock) as progress:
        train(progress, clock)
    assert file.getvalue() == ""
    assert [len(lines) for lines in shown] == [5, 11]
    assert shown[0][0] == "source: 0/4 epochs, compiling"
    assert shown[1][-1].startswith("transfer: 10/10 epochs")


ROWS = [
    {"policy": "transfer", "sampled": [14.2, 14.5, None], "success": 1.0, "steps": 3_500_000},
    {"policy": "scratch [x]", "sampled": 28.31, "success": np.float32(0.992), "steps": None},
]


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_a_table_in_a_file_is_plain_and_fits_80_columns(encoding, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    raw = io.BytesIO()
    file = io.TextIOWrapper(raw, encoding=encoding)
    print_table(ROWS, "Predator-Prey", file)
    lines = raw.getvalue().decode(encoding).splitlines()
    assert lines[0] == "Predator-Prey"
    assert all(len(line) <= 80 and line == line.rstrip() for line in lines)
    assert not any("\x1b" in line for line in lines)
    words = " ".join(lines).split()
    for cell in ("14.35", "(14.2-14.5)", "28.31", "1.000", "0.9920", "3,500,000", "[x]", "-"):
        assert cell in words


def test_nothing_of_a_wide_table_is_cut_off_in_a_file():
    file = io.StringIO()
    row = {f"a rather long heading {i}": f"{i} words and words" for i in range(6)}
    print_table([row], None, file)
    text = file.getvalue()
    assert all(heading in text and value in text for heading, value in row.items())
    assert result_table([]).row_count == 0
