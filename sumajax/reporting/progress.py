"""What a person sees while training runs: a bar in a terminal, plain lines in a log, tables."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, TextIO

import numpy as np
from rich import box
from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn
from rich.progress import Progress as Bars
from rich.table import Table
from rich.text import Text

from sumajax.reporting.output import outlet

WIDTH = 80
"""Columns of a table in a file, where there is no terminal to ask, or as many as it needs."""
WIDEST = 1000
"""And no more than that."""
ENV_STEPS_PER_EPOCH = 20_000
MISSING = "-"


@dataclass
class _Stage:
    """How far one stage of training has come."""

    epochs: int
    done: int = 0
    metrics: Mapping[str, float] | None = None
    began: tuple[float, int] | None = None  # clock and epochs done when the stage began
    last: tuple[float, int] | None = None  # the same at the latest update
    warm: tuple[float, int] | None = None  # and at the first: compiling lies before it
    env_steps_per_second: float | None = None

    def advance(self, now: float, done: int, metrics: Mapping[str, float]) -> None:
        before = self.last or self.began
        if before is not None and done > before[1] and now > before[0]:
            per_epoch = (now - before[0]) / (done - before[1])
            self.env_steps_per_second = ENV_STEPS_PER_EPOCH / per_epoch
        speed = metrics.get("env_steps_per_second")
        self.env_steps_per_second = self.env_steps_per_second if speed is None else float(speed)
        self.last = (now, done)
        self.warm = self.warm or self.last
        self.done, self.metrics = done, metrics

    def seconds_per_epoch(self) -> float | None:
        """Measured after the first update, which includes compiling, as soon as there is more."""
        if self.last is None:
            return None
        for start in (self.warm, self.began):
            if start is not None and self.last[1] > start[1]:
                return (self.last[0] - start[0]) / (self.last[1] - start[1])
        return None


class _Display(Protocol):
    def show(self, name: str, final: bool) -> None: ...

    def say(self, text: str) -> None: ...

    def close(self) -> None: ...


class Progress:
    """Progress of a training run in stages, as a context manager.

    In a terminal a live bar for each stage; in a notebook one line that is rewritten in place; in a
    file or a pipe one plain line at most every `interval` seconds, and one as a stage ends.

        with Progress({"source": 50, "transfer": 125}) as progress:
            progress.begin("source")
            ...
            progress.advance("source", 5, {"steps_taken": 12.3, "success": 0.97})

    Nothing that it prints can end a run (`reporting.output`).

    Args:
      stages: epochs of each stage, in the order they run; stages of 0 epochs do not appear.
      file: where to write; None is standard error, so that results can be piped.
      interval: seconds between two lines of a log.
      clock: seconds from any start, for tests.
    """

    def __init__(
        self,
        stages: Mapping[str, int],
        file: TextIO | None = None,
        *,
        interval: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.stages = {name: _Stage(epochs) for name, epochs in stages.items() if epochs > 0}
        self._file = outlet(sys.stderr if file is None else file)
        self._interval = interval
        self._clock = clock
        self._display: _Display | None = None

    def __enter__(self) -> "Progress":
        if self._file.isatty() and not Console(file=self._file).is_dumb_terminal:
            self._display = _Terminal(self, self._file)
        elif _in_notebook():
            self._display = _Notebook(self)
        else:
            self._display = _Lines(self, self._file, self._interval, self._clock)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._display is not None:
            self._display.close()
            self._display = None

    def begin(self, stage: str, epochs_done: int = 0) -> None:
        """Says that a stage starts, `epochs_done` of its epochs having been run before."""
        state = self._stage(stage)
        state.began, state.done = (self._clock(), epochs_done), epochs_done
        self._show(stage, final=False)

    def advance(self, stage: str, epochs_done: int, metrics: Mapping[str, float]) -> None:
        """Shows how far a stage has come.

        Args:
          epochs_done: epochs of the stage that are done in all, not since the last call.
          metrics: latest means; `steps_taken`, `success` and `env_steps_per_second` are shown, the
            speed measured between calls where it is not given; NaN shows as a dash.

        Raises:
          ValueError: for a stage that was not announced.
        """
        state = self._stage(stage)
        state.advance(self._clock(), epochs_done, metrics)
        self._show(stage, final=epochs_done >= state.epochs)

    def say(self, text: str) -> None:
        """Prints a line without disturbing the display."""
        if self._display is not None:
            self._display.say(text)
        else:
            print(text, file=self._file, flush=True)

    def seconds_left(self) -> float | None:
        """Of all stages; one that has not run yet is taken to be as fast as the latest."""
        rate: float | None = None
        for state in self.stages.values():
            rate = state.seconds_per_epoch() or rate
        if rate is None:
            return None
        return sum(
            (state.epochs - state.done) * (state.seconds_per_epoch() or rate)
            for state in self.stages.values()
        )

    def fields(self, stage: str) -> dict[str, Any]:
        """What is shown of a stage, as short texts; blank where there is nothing to say yet."""
        state = self._stage(stage)
        fields = {"epochs": f"{state.done}/{state.epochs}"}
        if state.metrics is None:
            blank = dict.fromkeys(("speed", "steps_taken", "success", "left"), "")
            return {**fields, **blank, "speed": "compiling" if state.began else ""}
        return {
            **fields,
            "speed": _speed(state.env_steps_per_second),
            "steps_taken": f"steps {_number(state.metrics.get('steps_taken'), '.2f')}",
            "success": f"success {_number(state.metrics.get('success'), '.1%')}",
            "left": f"{_duration(self.seconds_left())} left",
        }

    def _stage(self, name: str) -> _Stage:
        if name not in self.stages:
            raise ValueError(f"stage {name!r} is not one of {', '.join(self.stages)}.")
        return self.stages[name]

    def _show(self, stage: str, final: bool) -> None:
        if self._display is not None:
            self._display.show(stage, final)


class _Terminal:
    """Live bars, one for each stage."""

    def __init__(self, progress: Progress, file: TextIO) -> None:
        self._progress = progress
        self._bars = Bars(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            TextColumn("{task.fields[epochs]}", justify="right"),
            TextColumn("{task.fields[speed]}", justify="right", style="cyan"),
            TextColumn("{task.fields[steps_taken]}", justify="right"),
            TextColumn("{task.fields[success]}", justify="right", style="green"),
            TextColumn("{task.fields[left]}", justify="right", style="magenta"),
            console=Console(file=file, highlight=False),
            expand=True,
        )
        self._tasks: dict[str, TaskID] = {}
        for name, state in progress.stages.items():
            fields = progress.fields(name)
            self._tasks[name] = self._bars.add_task(name, total=state.epochs, **fields)
        self._bars.start()

    def show(self, name: str, final: bool) -> None:
        fields = self._progress.fields(name)
        if final:
            fields["left"] = ""  # it is the whole run's, and shown beside the running stage
        done = self._progress.stages[name].done
        self._bars.update(self._tasks[name], completed=done, **fields)

    def say(self, text: str) -> None:
        self._bars.console.print(text, markup=False)

    def close(self) -> None:
        self._bars.stop()


class _Lines:
    """Plain lines for log files and pipes: no control characters, no colours."""

    def __init__(
        self, progress: Progress, file: TextIO, interval: float, clock: Callable[[], float]
    ) -> None:
        self._progress, self._file = progress, file
        self._interval, self._clock = interval, clock
        self._next = -np.inf

    def show(self, name: str, final: bool) -> None:
        now = self._clock()
        starts = self._progress.stages[name].metrics is None
        if starts or final or now >= self._next:
            self.say(_line(name, self._progress.fields(name)))
            self._next = now + (0 if starts else self._interval)

    def say(self, text: str) -> None:
        print(text, file=self._file, flush=True)

    def close(self) -> None:
        pass


class _Notebook:
    """One output cell line for each stage, rewritten in place; needs no widgets."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._handles: dict[str, Any] = {}

    def show(self, name: str, final: bool) -> None:
        from IPython.display import display

        content = {"text/plain": _line(name, self._progress.fields(name))}
        if name in self._handles:
            self._handles[name].update(content, raw=True)
        else:
            self._handles[name] = display(content, raw=True, display_id=True)

    def say(self, text: str) -> None:
        print(text)

    def close(self) -> None:
        pass


def result_table(rows: Sequence[Mapping[str, Any]], title: str | None = None) -> Table:
    """A table for the end of a run; the keys of the first row are its columns.

    Numbers stand on the right; one per seed is shown as mean and range; None and NaN as a dash.
    """
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    if not rows:
        return table
    for name in rows[0]:
        left = any(isinstance(row.get(name), str) for row in rows)
        table.add_column(name, justify="left" if left else "right", no_wrap=left)
    for row in rows:
        table.add_row(*(Text(_value(row.get(name))) for name in rows[0]))
    return table


def print_table(
    rows: Sequence[Mapping[str, Any]], title: str | None = None, file: TextIO | None = None
) -> None:
    """Prints a `result_table`: in a terminal at its width, in a file whole and plain.

    Raises nothing, whatever becomes of the terminal or the file; see `reporting.output`.
    """
    file, table = outlet(sys.stdout if file is None else file), result_table(rows, title)
    if file.isatty():
        Console(file=file).print(table)
        return
    console = Console(
        file=file, width=WIDTH, color_system=None, force_terminal=False, force_jupyter=False
    )
    needed = console.measure(table, options=console.options.update(width=WIDEST)).maximum
    console.width = max(WIDTH, needed)
    with console.capture() as captured:
        console.print(table)
    lines = [line.rstrip() for line in captured.get().splitlines()]
    print("\n".join(lines).strip("\n"), file=file, flush=True)


def _in_notebook() -> bool:
    """Whether a Jupyter kernel runs this program."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return type(shell).__name__ == "ZMQInteractiveShell"


def _line(name: str, fields: Mapping[str, str]) -> str:
    texts = [f"{name}: {fields['epochs']} epochs", *list(fields.values())[1:]]
    return ", ".join(text for text in texts if text)


def _speed(env_steps_per_second: float | None) -> str:
    if env_steps_per_second is None:
        return f"{MISSING} steps/s"
    if env_steps_per_second >= 10_000:
        return f"{env_steps_per_second / 1000:,.0f}k steps/s"
    return f"{env_steps_per_second:,.0f} steps/s"


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return MISSING
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _number(value: Any, form: str) -> str:
    if value is None or not np.isfinite(float(value)):
        return MISSING
    return format(float(value), form)


def _value(value: Any) -> str:
    """A cell of a table."""
    if value is None or isinstance(value, str):
        return MISSING if value is None else value
    if isinstance(value, (bool, int, np.integer)):
        return f"{value:,}" if not isinstance(value, bool) else str(value)
    if np.ndim(value) == 0:
        return _short(float(value))
    numbers = [float(item) for item in value if item is not None and np.isfinite(item)]
    if not numbers:
        return MISSING
    mean = _short(float(np.mean(numbers)))
    return f"{mean} ({min(numbers):#.3g}-{max(numbers):#.3g})" if len(numbers) > 1 else mean


def _short(number: float) -> str:
    """Four digits, so that a column of like numbers lines up."""
    if not np.isfinite(number):
        return MISSING
    return f"{number:,.0f}" if abs(number) >= 1000 else f"{number:#.4g}"
