"""When a stage has stopped improving, by its own training metrics, so that it may end by itself."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Still:
    """A rule by which a stage ends before its budget of epochs.

    Training is looked at in windows of `window` epochs, from the first epoch on. A seed is still
    when in each of its last two windows the mean steps taken are above `1 - gain` times the least
    of the windows before, and the success in the last one is at least `success`. The stage ends
    at the first end of a window at which all its seeds are still; never before its third.

    An epoch without the end of an episode counts as one that failed at the step limit, and a seed
    that has stopped for good does not count. The rule reads nothing but what is in metrics.csv, so
    a resumed stage ends where an uninterrupted one does, however often it saves.

    Attributes:
      window: epochs.
      gain: share by which steps taken must fall to count as improvement.
      success: least share of episodes that succeed; a stage that has not learnt its task goes on to
        the end of its budget.

    Raises:
      ValueError: for a value out of range.
    """

    window: int = 10
    gain: float = 0.01
    success: float = 0.95

    def __post_init__(self) -> None:
        if self.window < 1:
            raise ValueError(f"window must be at least 1 epoch, got {self.window}.")
        for name in ("gain", "success"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must lie between 0 and 1, got {getattr(self, name)}.")

    def holds(self, steps_taken: np.ndarray, success: np.ndarray) -> bool:
        """Whether a stage ends here.

        Args:
          steps_taken, success: (S, E) of every seed and epoch so far, all of them numbers.
        """
        seeds, epochs = np.shape(steps_taken)
        if not seeds or epochs % self.window or epochs < 3 * self.window:
            return False
        by_window = np.reshape(steps_taken, (seeds, -1, self.window)).mean(-1)
        least = by_window[:, :-2].min(-1, keepdims=True)
        improves = (by_window[:, -2:] <= (1 - self.gain) * least).any(-1)
        succeeds = np.asarray(success)[:, -self.window :].mean(-1) >= self.success
        return bool((~improves & succeeds).all())

    def ends(
        self,
        rows: Iterable[Mapping[str, Any]],
        arm: str,
        seeds: Sequence[int],
        epoch: int,
        max_steps: int,
    ) -> bool:
        """`holds` of the rows of metrics.csv.

        Args:
          arm: the stage, epoch: so many are done.
          seeds: those that have not stopped.
          max_steps: step limit of the task.
        """
        found = {
            name: np.full((len(seeds), epoch), failed)
            for name, failed in (("steps_taken", float(max_steps)), ("success", 0.0))
        }
        place = {seed: index for index, seed in enumerate(seeds)}
        for row in rows:
            if row["arm"] != arm or row["seed"] not in place or row["epoch"] > epoch:
                continue
            for name, values in found.items():
                if not np.isnan(row[name]):
                    values[place[row["seed"]], row["epoch"] - 1] = row[name]
        return self.holds(**found)
