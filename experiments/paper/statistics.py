"""The numbers behind tables and claims: means, ranges and failures over seeds, and few intervals.

With three or five seeds a trimmed mean is the mean, or hides a failed seed, and a bootstrap has far
less than its coverage. So a number over seeds is its mean with the least and the greatest of them;
times until something is reached, which may be infinite (never), are compared by medians. Of two
arms there is an interval of the ratio, Student's on logarithms, which has its 95% at these sizes
while the seeds of each arm are of one kind; where some of an arm's seeds failed and others did not
there is none. `pairs` needs no distribution: every run of one arm against every run of the other.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.stats import t as student_t

from experiments.paper.arms import SCRATCH, SOURCE, TRANSFER, Arm
from experiments.paper.published import EXPERIMENTS, PaperExperiment
from sumajax.reporting.metrics import seed_curves

CONFIDENCE = 0.95
LEAST_SEEDS = 3
"""Below it a sample is no evidence: nothing is concluded from it and it has no interval."""
SOLVED = 30.0
"""Steps taken that count as success on the target: the paper's transferred policies got there."""
THRESHOLDS = (30.0, 20.0)
WINDOW_EPOCHS = 10
"""Epochs that a value is the mean of, where nothing else is said: one alone may be luck."""
NEVER = math.inf

Row = dict[str, Any]
Sample = np.ndarray  # (S,) a number per seed


@dataclass(frozen=True)
class Spread:
    """A number over seeds: its mean or, of times, its median, and the seeds' range."""

    value: float
    least: float
    most: float
    seeds: int


@dataclass(frozen=True)
class Ratio:
    """Of two arms' numbers; the interval is None where none has its coverage."""

    value: float
    low: float | None = None
    high: float | None = None
    at_least: bool = False  # a lower bound: the first arm's median is `never`, its budget stands in


def mean_of(sample: Sample) -> Spread:
    """Mean and range."""
    return Spread(float(sample.mean()), float(sample.min()), float(sample.max()), len(sample))


def median_of(times: Sample) -> Spread:
    """Median and range of times; infinite where half of them or more are `never`."""
    ordered, many = np.sort(times), len(times)
    # Not np.median, whose middle between two that are both `never` is no number.
    middle = float(ordered[(many - 1) // 2] + ordered[many // 2]) / 2
    return Spread(middle, float(times.min()), float(times.max()), len(times))


def ratio_of_means(first: Sample, second: Sample, of_one_kind: bool = True) -> Ratio:
    """The first sample's mean over the second's, with Student's interval on logarithms.

    Args:
      of_one_kind: in neither arm some seeds failed and others did not; else there is no interval.
    """
    value = float(first.mean() / second.mean())
    if not of_one_kind or min(len(first), len(second)) < LEAST_SEEDS:
        return Ratio(value)
    low, high = log_interval(first, second)
    return Ratio(value, float(low), float(high))


def log_interval(first: np.ndarray, second: np.ndarray) -> tuple[Any, Any]:
    """95% interval of the ratio of two samples' geometric means, from Student's t on logarithms.

    With the degrees of freedom of the smaller sample, whatever their spreads: never less than 95%
    (Mickey and Brown 1966), where Welch's has less at three seeds.

    Args:
      first, second: (..., S) and (..., S') positive numbers.

    Returns:
      (...) its two ends.
    """
    logs = [np.log(sample) for sample in (first, second)]
    sizes = [log.shape[-1] for log in logs]
    middle = logs[0].mean(-1) - logs[1].mean(-1)
    variances = [log.var(-1, ddof=1) / size for log, size in zip(logs, sizes, strict=True)]
    half = student_t.ppf((1 + CONFIDENCE) / 2, min(sizes) - 1) * np.sqrt(sum(variances))
    return np.exp(middle - half), np.exp(middle + half)


def pairs(first: Sample, second: Sample) -> np.ndarray:
    """(S * S',) every seed of the first sample over every seed of the second."""
    return (first[:, None] / second[None, :]).ravel()


def ratio_of_medians(first: Sample, second: Sample, budget: float) -> Ratio:
    """Of times; NaN where the second's median is `never`.

    Args:
      budget: the first arm's, which stands for a median that is `never`: the ratio is then a bound.
    """
    above, below = median_of(first).value, median_of(second).value
    if math.isinf(below):
        return Ratio(math.nan)
    return Ratio(min(above, budget) / below, at_least=math.isinf(above))


@dataclass(frozen=True)
class Accounting:
    """A way to count what training costs.

    Attributes:
      window: cost over which a value is averaged, before the cost at which arms are compared.
      limit: the largest cost that is compared.
      transfer, scratch: (S, E) cost at the end of each epoch, with the source's for `transfer`.
    """

    name: str
    window: float
    limit: float
    transfer: np.ndarray
    scratch: np.ndarray


@dataclass(frozen=True)
class Curves:
    """The curves of an arm: S seeds, E epochs."""

    rows: tuple[Row, ...]
    row: PaperExperiment
    arm: Arm
    epochs: np.ndarray  # (E,)
    env_steps: np.ndarray  # (S, E)
    steps_taken: np.ndarray  # (S, E)

    @property
    def hours(self) -> np.ndarray:
        """(E,) the paper's hours at the end of each epoch."""
        return self.row.hours_of(self.arm.like, 1) * self.epochs

    @property
    def step_limit(self) -> int:
        task = self.row.source if self.arm.task == "source" else self.row.target
        return task.max_steps

    @cached_property
    def filled(self) -> np.ndarray:
        """(S, E) steps taken; where no episode ended, and for a seed that stopped, the limit."""
        return np.where(np.isnan(self.steps_taken), self.step_limit, self.steps_taken)

    @property
    def tenth(self) -> int:
        """Epochs in a tenth of the budget."""
        return max(1, len(self.epochs) // 10)

    @property
    def last(self) -> Sample:
        """Mean over the last tenth of the epochs."""
        return self.filled[:, -self.tenth :].mean(-1)

    @property
    def moves(self) -> Sample:
        """Mean over the tenth of the epochs before the last one, over that of the last.

        Infinite where there is one epoch alone: nothing is known of where it goes.
        """
        if len(self.epochs) < 2:
            return np.full(len(self.filled), math.inf)
        return self.filled[:, -2 * self.tenth : -self.tenth].mean(-1) / self.last

    @property
    def best(self) -> tuple[float, float]:
        """The least mean of `WINDOW_EPOCHS` in a row, and the environment steps until then."""
        curve = self.filled.mean(0)
        length = min(WINDOW_EPOCHS, len(curve))
        means = sliding_window_view(curve, length).mean(-1)
        first = int(means.argmin())
        return float(means[first]), float(self.env_steps[:, first + length - 1].mean())

    def before(self, at: float, costs: np.ndarray, window: float) -> Sample | None:
        """(S,) mean over the epochs that end within `window` before the cost `at`, the last at
        least; None where none has ended.

        Args:
          costs: (E,) at the end of each epoch.
        """
        known = costs <= at + 1e-9
        if not known.any():
            return None
        inside = known & (costs > at - window + 1e-9)
        if not inside.any():  # an epoch costs more than the window
            inside = costs == costs[known].max()
        return self.filled[:, inside].mean(-1)

    def cost_to(self, threshold: float, costs: np.ndarray) -> Sample:
        """(S,) cost at the end of the first epoch with a mean that low; never is infinite.

        Args:
          costs: (S, E) at the end of each epoch.
        """
        below = self.steps_taken <= threshold  # NaN compares false
        return np.where(below, costs, NEVER).min(-1)

    def env_steps_to(self, threshold: float) -> Sample:
        """Millions of the arm's own environment steps until an epoch's mean is that low."""
        return self.cost_to(threshold, self.env_steps / 1e6)

    def came_to(self, threshold: float) -> int:
        """Seeds that did within their budget."""
        return int(np.isfinite(self.env_steps_to(threshold)).sum())

    @property
    def of_one_kind(self) -> bool:
        """Whether all seeds came to `SOLVED`, or none."""
        return self.came_to(SOLVED) in (0, len(self.filled))


def curves_of(rows: Iterable[Row], experiment: str, arm: Arm, preset: str) -> Curves | None:
    """An arm's curves from the kept rows, as far as all of its seeds go; None without any."""
    wanted = (experiment, arm.name, preset)
    chosen = [r for r in rows if (r["experiment"], r["arm"], r["preset"]) == wanted]
    if not chosen:
        return None
    epochs, values = seed_curves(chosen, arm.name, "env_steps", "steps_taken")
    whole = np.isfinite(values["env_steps"]).all(axis=0)
    curves = {name: value[:, whole] for name, value in values.items()}
    return Curves(tuple(chosen), EXPERIMENTS[experiment], arm, epochs[whole], **curves)


@dataclass(frozen=True)
class Equal:
    """Both arms where they have cost the same.

    Attributes:
      at: the cost, in the accounting's unit.
      scratch, transfer: (S,) steps taken; transfer None where the source alone costs that much.
      scratch_epochs, transfer_epochs: that each has had on the target.
    """

    at: float
    scratch: Sample
    transfer: Sample | None
    scratch_epochs: int
    transfer_epochs: int


@dataclass(frozen=True)
class Comparison:
    """Transfer against scratch, and what the transfer's source cost."""

    row: PaperExperiment
    preset: str
    source: Curves
    transfer: Curves
    scratch: Curves

    @property
    def papers_hours(self) -> Accounting:
        """Epochs at the seconds of the paper's Table II, up to its fixed hour T, source in."""
        return self._by_epochs(
            "the paper's hours",
            1.0,
            self.row.hours,
            {arm.arm.name: self.row.hours_of(arm.arm.like, 1) for arm in self._arms},
        )

    def minutes_here(self, seconds: Mapping[str, float]) -> Accounting | None:
        """Epochs at this machine's own seconds, source in; None if an arm is not measured.

        Args:
          seconds: per epoch, by the arm's name.
        """
        if any(arm.arm.name not in seconds for arm in self._arms):
            return None
        window = WINDOW_EPOCHS * seconds[self.scratch.arm.name] / 60
        epoch = {name: value / 60 for name, value in seconds.items()}
        return self._by_epochs("minutes here", window, NEVER, epoch)

    @property
    def env_steps(self) -> Accounting:
        """Environment steps, those of the source in."""
        scratch, transfer = self.scratch.env_steps / 1e6, self.transfer.env_steps / 1e6
        source = float(self.source.env_steps[:, -1].mean()) / 1e6
        window = WINDOW_EPOCHS * float(scratch.mean(0)[-1]) / len(self.scratch.epochs)
        return Accounting("M environment steps", window, NEVER, source + transfer, scratch)

    @property
    def _arms(self) -> tuple[Curves, Curves, Curves]:
        return self.source, self.transfer, self.scratch

    def _by_epochs(
        self, name: str, window: float, limit: float, epoch: Mapping[str, float]
    ) -> Accounting:
        """Args:
        epoch: an epoch's cost, by the arm's name.
        """
        source = epoch[self.source.arm.name] * float(self.source.epochs[-1])
        transfer = source + epoch[self.transfer.arm.name] * self.transfer.epochs
        scratch = epoch[self.scratch.arm.name] * self.scratch.epochs
        return Accounting(
            name,
            window,
            limit,
            np.broadcast_to(transfer, self.transfer.filled.shape),
            np.broadcast_to(scratch, self.scratch.filled.shape),
        )

    def end(self, by: Accounting) -> float:
        """The accounting's limit or, where a budget ends before it, the last cost that both have.

        A budget is a whole number of epochs, so it may end up to one before the limit it is for.
        """
        ends = []
        for costs in (by.scratch.mean(0), by.transfer.mean(0)):
            epoch = (costs[-1] - costs[0]) / max(1, len(costs) - 1)
            ends.append(by.limit if costs[-1] + epoch > by.limit else float(costs[-1]))
        return min(by.limit, *ends)

    def equal(self, by: Accounting) -> Equal:
        """Both arms at the largest cost that both have."""
        at, scratch, transfer = self.end(by), by.scratch.mean(0), by.transfer.mean(0)
        taken = self.scratch.before(at, scratch, by.window)
        assert taken is not None  # it is the end of an epoch of one of them, or of both budgets
        return Equal(
            at,
            taken,
            self.transfer.before(at, transfer, by.window),
            int((scratch <= at + 1e-9).sum()),
            int((transfer <= at + 1e-9).sum()),
        )

    def times_to(self, threshold: float, by: Accounting) -> tuple[Sample, Sample]:
        """(S,) cost until an epoch's mean is that low: scratch, and transfer with its source."""
        return (
            self.scratch.cost_to(threshold, by.scratch),
            self.transfer.cost_to(threshold, by.transfer),
        )

    @property
    def hour(self) -> float:
        return self.end(self.papers_hours)

    @property
    def at_the_papers_hour(self) -> bool:
        return self.hour == self.row.hours

    @property
    def of_one_kind(self) -> bool:
        return self.scratch.of_one_kind and self.transfer.of_one_kind

    @property
    def seeds(self) -> int:
        """Of the arm that has fewer."""
        return min(len(self.scratch.filled), len(self.transfer.filled))

    @property
    def common(self) -> int:
        """Target epochs that both arms have."""
        return min(len(self.transfer.epochs), len(self.scratch.epochs))

    @property
    def areas(self) -> tuple[Sample, Sample]:
        """Mean steps taken over the target epochs that both have: the area under the curve."""
        scratch, transfer = (a.filled[:, : self.common] for a in (self.scratch, self.transfer))
        return scratch.mean(-1), transfer.mean(-1)

    def on_the_way(self, counted: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(K,) environment steps that both arms came to, and the means there of the steps taken
        from scratch and after transfer.

        Args:
          counted: whether the source's steps count for the transferred arm.
        """
        shift = float(self.source.env_steps[:, -1].mean()) if counted else 0.0
        x = self.transfer.env_steps.mean(0) + shift
        other = self.scratch.env_steps.mean(0)
        both = x <= other[-1] + 1e-9
        scratch = np.interp(x[both], other, self.scratch.filled.mean(0))
        return x[both], scratch, self.transfer.filled.mean(0)[both]


def comparison_of(rows: Iterable[Row], name: str, preset: str) -> Comparison | None:
    """Of an experiment; None while an arm is missing."""
    rows, row = list(rows), EXPERIMENTS[name]
    source = curves_of(rows, row.source_of, SOURCE, preset)
    transfer = curves_of(rows, name, TRANSFER, preset)
    scratch = curves_of(rows, name, SCRATCH, preset)
    if source is None or transfer is None or scratch is None:
        return None
    return Comparison(row, preset, source, transfer, scratch)


def accountings(comparison: Comparison, seconds: Mapping[str, float]) -> list[Accounting]:
    """The three, as far as they are known.

    Args:
      seconds: this machine's per epoch, by the arm's name; empty where none was measured.
    """
    here = comparison.minutes_here(seconds)
    return [comparison.papers_hours, comparison.env_steps, *([here] if here else [])]


STATISTICS_COLUMNS = (
    "preset",
    "experiment",
    "quantity",
    "of",
    "seeds",
    "came",
    "value",
    "least",
    "most",
    "low",
    "high",
    "at_least",
    "at",
)
"""`value`: mean over seeds, of times the median; `came`: seeds that did, of a time; `low`, `high`:
95% interval of a ratio; `at`: where it was taken, in the unit the quantity names."""


def statistics(comparison: Comparison, seconds: Mapping[str, float]) -> list[Row]:
    """Every quantity of one experiment under one preset, scratch, transfer and their ratio."""
    rows: list[Row] = []
    for by in accountings(comparison, seconds):
        found = comparison.equal(by)
        name = f"steps taken at equal cost, source in: {by.name}"
        if found.transfer is None:
            rows.append(_spread_row(name, "scratch", mean_of(found.scratch), at=found.at))
            continue
        samples = (found.scratch, found.transfer)
        rows += pair_rows(name, samples, comparison.of_one_kind, at=found.at)
    steps = float(comparison.env_steps.scratch.mean(0)[comparison.common - 1])
    name = "mean steps taken until this many M target steps"
    rows += pair_rows(name, comparison.areas, comparison.of_one_kind, at=steps)
    for threshold in THRESHOLDS:
        alone = (
            comparison.scratch.env_steps_to(threshold),
            comparison.transfer.env_steps_to(threshold),
        )
        budget = float(comparison.env_steps.scratch.mean(0)[-1])
        name = f"time to {threshold:g} steps, target alone: M environment steps"
        rows += _time_rows(name, alone, budget)
        for by in accountings(comparison, seconds):
            name = f"time to {threshold:g} steps, source in: {by.name}"
            budget = float(by.scratch.mean(0)[-1])
            rows += _time_rows(name, comparison.times_to(threshold, by), budget)
    about = {"preset": comparison.preset, "experiment": comparison.row.name}
    return [{**about, **row} for row in rows]


def pair_rows(
    quantity: str,
    samples: tuple[Sample, Sample],
    of_one_kind: bool,
    at: float | None = None,
    names: tuple[str, str] = ("scratch", "transfer"),
) -> list[Row]:
    """Both arms and their ratio."""
    rows = [
        _spread_row(quantity, of, mean_of(sample), at=at)
        for of, sample in zip(names, samples, strict=True)
    ]
    ratio = ratio_of_means(*samples, of_one_kind)
    return [*rows, _ratio_row(quantity, "/".join(names), ratio, min(map(len, samples)), at)]


def _time_rows(quantity: str, times: tuple[Sample, Sample], budget: float) -> list[Row]:
    rows = [
        _spread_row(quantity, of, median_of(sample), came=int(np.isfinite(sample).sum()))
        for of, sample in zip(("scratch", "transfer"), times, strict=True)
    ]
    ratio = ratio_of_medians(*times, budget)
    return [*rows, _ratio_row(quantity, "scratch/transfer", ratio, min(map(len, times)))]


def _blank(quantity: str, of: str, seeds: int, at: float | None) -> Row:
    blank: Row = dict.fromkeys(STATISTICS_COLUMNS[2:])
    return {**blank, "quantity": quantity, "of": of, "seeds": seeds, "at": at, "at_least": ""}


def _spread_row(
    quantity: str, of: str, found: Spread, at: float | None = None, came: int | None = None
) -> Row:
    numbers = {"value": found.value, "least": found.least, "most": found.most, "came": came}
    return {**_blank(quantity, of, found.seeds, at), **numbers}


def _ratio_row(quantity: str, of: str, found: Ratio, seeds: int, at: float | None = None) -> Row:
    at_least = "yes" if found.at_least else ""
    numbers = {"value": found.value, "low": found.low, "high": found.high, "at_least": at_least}
    return {**_blank(quantity, of, seeds, at), **numbers}
