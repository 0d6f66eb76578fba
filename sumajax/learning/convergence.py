"""When a stage may end before its budget: its policy has learnt the task and gets no better."""

import numpy as np
from numpy.typing import ArrayLike

WINDOW = 10
"""Epochs whose means are compared: single ones differ by a few per cent from noise alone."""
GAIN = 0.02
"""Share of the steps taken that a window has to save on the one before it."""
SUCCESS = 0.9
"""Share of episodes that succeed: before it, standing still is no sign of being done."""


def has_converged(steps_taken: ArrayLike, success: ArrayLike) -> bool:
    """Whether every seed's last `WINDOW` epochs are good and hardly better than those before.

    A function of the epochs' metrics alone, so a resumed run ends where an uninterrupted one does.

    Args:
      steps_taken, success: (..., epochs) of `Metrics`, from the stage's first epoch on. An epoch
        in which no episode ended has NaN there, and is no reason to stop.
    """
    steps, successes = np.asarray(steps_taken, float), np.asarray(success, float)
    if steps.shape != successes.shape:
        raise ValueError(f"steps_taken {steps.shape} and success {successes.shape} differ.")
    if steps.shape[-1] < 2 * WINDOW:
        return False
    last, before = steps[..., -WINDOW:].mean(-1), steps[..., -2 * WINDOW : -WINDOW].mean(-1)
    learnt = successes[..., -WINDOW:].mean(-1) >= SUCCESS
    return bool((learnt & (last > (1 - GAIN) * before)).all())
