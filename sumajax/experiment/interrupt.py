"""Ctrl-C while training: finish the chunk, keep its checkpoint, then stop."""

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType

ASKED = "stopping after this chunk, with a checkpoint; Ctrl-C again stops at once."


@contextlib.contextmanager
def stop_when_asked(say: Callable[[str], None]) -> Iterator[Callable[[], bool]]:
    """Inside, the first Ctrl-C is only noted, and a second one stops as usual.

    A chunk is one compiled call: stopped in its middle, it would be lost.

    Args:
      say: is told the first time.

    Yields:
      a function that tells whether a stop was asked for.
    """
    asked = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        say(ASKED)

    try:
        before = signal.signal(signal.SIGINT, note)
    except ValueError:  # only a program's main thread may do this; elsewhere nothing changes
        yield lambda: False
        return
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)
