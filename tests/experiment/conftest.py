"""Runs of toys: what is checked is how they go on and what they write, not how well they learn."""

import pytest

from sumajax.learning import config, parallel
from sumajax.learning.learner import Learner

TOY_EPOCH_STEPS = 2_000
"""One update of the toys' 100 environments x 20 steps."""


def forget_programs():
    """Epochs of another length are other programs, of learners that are the same."""
    parallel.make_train.cache_clear()
    Learner.train.clear_cache()


@pytest.fixture(scope="module", autouse=True)
def short_epochs():
    """Epochs of a tenth of the package's 20,000 steps, in all of this folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config, "EPOCH_STEPS", TOY_EPOCH_STEPS)
        forget_programs()
        yield
    forget_programs()
