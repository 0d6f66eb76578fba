"""Ends a run in the middle of an arm, as a kill between its rows and its checkpoint would."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from sumajax.experiment.run import Recorder


@contextmanager
def stopped_in(arm: str, error: type[BaseException]) -> Iterator[None]:
    """`error` is raised, and expected, after the first rows of `arm` and before its checkpoint."""
    record = Recorder._record

    def stop(self, stage, stage_run, chunk):
        record(self, stage, stage_run, chunk)
        if stage.name == arm:
            raise error

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Recorder, "_record", stop)
        with pytest.raises(error):
            yield
