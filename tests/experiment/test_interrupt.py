"""Ctrl-C: noted once, obeyed at once the second time, as it was before afterwards."""

import signal
import threading

import pytest

from sumajax.experiment.interrupt import ASKED, stop_when_asked


def test_the_first_is_noted_and_the_second_stops():
    said = []
    with stop_when_asked(said.append) as asked:
        assert not asked()
        signal.raise_signal(signal.SIGINT)
        assert asked()
        assert said == [ASKED]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_outside_everything_is_as_before():
    before = signal.getsignal(signal.SIGINT)
    with stop_when_asked(print):
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


def test_in_another_thread_nothing_changes():
    told = []

    def work():
        with stop_when_asked(print) as asked:
            told.append(asked())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert told == [False]
