"""Printing that cannot end a run: whatever becomes of a terminal, the training is what matters."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO, cast

STANDARD = (1, 2)
"""File descriptors of standard output and standard error."""


class Outlet:
    """A text stream that takes all that is written to it and raises nothing.

    Characters that its encoding lacks become escapes, as in `\\xfc`. Where nothing more can be
    written (a full disk, a pipe whose reader has gone, a closed file), what follows is dropped. The
    rest is the stream's own.
    """

    def __init__(self, file: TextIO | None) -> None:
        self._file = file

    def write(self, text: str) -> int:
        if self._file is not None:
            encoding = getattr(self._file, "encoding", None) or "utf-8"
            shown = text.encode(encoding, "backslashreplace").decode(encoding)
            try:
                self._file.write(shown)
            except (OSError, ValueError):
                self._give_up()
        return len(text)

    def flush(self) -> None:
        try:
            if self._file is not None:
                self._file.flush()
        except (OSError, ValueError):
            self._give_up()

    def isatty(self) -> bool:
        try:
            return self._file is not None and self._file.isatty()
        except ValueError:  # it is closed
            return False

    def _give_up(self) -> None:
        """Python writes what a stream still holds when it ends, and would then fail: for the two
        standard streams there is nothing left to fail from here on.
        """
        with contextlib.suppress(OSError, ValueError, AttributeError):
            descriptor = cast(TextIO, self._file).fileno()
            if descriptor in STANDARD:
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, descriptor)
                os.close(nowhere)
        self._file = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def outlet(file: TextIO | None) -> TextIO:
    """`file` as one that raises nothing."""
    return cast(TextIO, file if isinstance(file, Outlet) else Outlet(file))


@contextlib.contextmanager
def unfailing_output() -> Iterator[None]:
    """While a command runs: nothing that it prints, by whatever means, can end it."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = outlet(sys.stdout), outlet(sys.stderr)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before
