"""Ends a run in the middle of an arm, as a kill between its rows and its checkpoint would."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from sumajax.experiment import run as transfer_run


@contextmanager
def stopped_in(arm: str, error: type[BaseException]) -> Iterator[None]:
    """`error` is raised, and expected, after the first rows of `arm` and before its checkpoint."""
    record = transfer_run.Recorder._record

    def stop(self, stage, chunk):
        record(self, stage, chunk)
        if stage.arm == arm:
            raise error

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(transfer_run.Recorder, "_record", stop)
        with pytest.raises(error):
            yield
