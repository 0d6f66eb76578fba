"""The numbers behind tables and claims: interquartile means over seeds with bootstrap intervals.

Means over seeds leave out the lowest and the highest quarter (Agarwal et al. 2021, *Deep RL at the
Edge of the Statistical Precipice*); intervals are percentile bootstraps of 95% in which each sample
(an arm, or in the aggregate an experiment) is drawn again on its own, which is their stratified
bootstrap. Numbers of environment steps until something is reached can be infinite, never, and are
compared by medians, which then still mean something.
"""

import math
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.stats import bootstrap, trim_mean

from experiments.paper.arms import SCRATCH, SOURCE, TRANSFER, Arm
from experiments.paper.published import EXPERIMENTS, PaperExperiment
from sumajax.reporting.metrics import env_steps_to_threshold, seed_curves

CONFIDENCE = 0.95
RESAMPLES = 5000
BOOTSTRAP_SEED = 0
THRESHOLDS = (30.0, 25.0, 20.0, 15.0)
BEST_EPOCHS = 10
"""In a row, that an arm's best is the mean of: one epoch alone may be luck."""
NEVER = math.inf

Row = dict[str, Any]
Sample = np.ndarray  # (S,) a number per seed
Statistic = Callable[..., Any]  # samples (..., S) and axis -> (...)


@dataclass(frozen=True)
class Estimate:
    """A number over seeds with its interval; None where too few seeds give none."""

    value: float
    low: float | None = None
    high: float | None = None
    seeds: int = 0
    at_least: bool = False  # the number is a lower bound: an arm never came so far


def iqm(sample: Any, axis: int = -1) -> Any:
    """Mean of the middle half; of fewer than four numbers the plain mean."""
    return trim_mean(sample, 0.25, axis=axis)


def middle(sample: Any, axis: int = -1) -> Any:
    """The median, infinite where half of the numbers or more are."""
    return np.median(sample, axis=axis)


def ratio_of(mean: Statistic) -> Statistic:
    """Of the first sample's mean over the second's."""

    def ratio(first: Any, second: Any, axis: int = -1) -> Any:
        with np.errstate(invalid="ignore"):
            return mean(first, axis=axis) / mean(second, axis=axis)

    return ratio


def estimate(statistic: Statistic, *samples: Sample) -> Estimate:
    """The statistic of the samples, with its interval where each has two seeds or more."""
    value = float(statistic(*samples))
    seeds = min(map(len, samples))
    if seeds < 2 or math.isnan(value):
        return Estimate(value, seeds=seeds)
    with warnings.catch_warnings(), np.errstate(invalid="ignore"):
        warnings.simplefilter("ignore")  # of infinite values, which quantiles below may be
        resampled = bootstrap(
            samples,
            statistic,
            n_resamples=RESAMPLES,
            confidence_level=CONFIDENCE,
            method="percentile",
            vectorized=True,
            rng=np.random.default_rng(BOOTSTRAP_SEED),
        ).bootstrap_distribution
    if np.isnan(resampled).any():
        return Estimate(value, seeds=seeds)
    tail = (1 - CONFIDENCE) / 2
    # No interpolation: between a number and `never` there is nothing.
    low, high = np.quantile(resampled, [tail, 1 - tail], method="inverted_cdf")
    return Estimate(value, float(low), float(high), seeds)


@dataclass(frozen=True)
class Curves:
    """The curves of an arm: S seeds, E epochs."""

    rows: tuple[Row, ...]
    row: PaperExperiment
    arm: Arm
    epochs: np.ndarray  # (E,)
    env_steps: np.ndarray  # (S, E)
    seconds: np.ndarray  # (S, E) of one seed: wall time over the seeds that trained side by side
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
    def last(self) -> Sample:
        """Mean over the last tenth of the epochs."""
        return self.filled[:, -max(1, len(self.epochs) // 10) :].mean(-1)

    @property
    def best(self) -> tuple[float, float]:
        """The least mean of `BEST_EPOCHS` epochs in a row, and the environment steps until then."""
        curve = iqm(self.filled, axis=0)
        length = min(BEST_EPOCHS, len(curve))
        means = sliding_window_view(curve, length).mean(-1)
        first = int(means.argmin())
        return float(means[first]), float(self.env_steps[:, first + length - 1].mean())

    def in_hour(self, at: float, offset: float = 0.0) -> Sample:
        """Mean over the epochs that end in the hour before `at` (the paper's section VII-C)."""
        hours = self.hours + offset
        inside = (hours > at - 1 + 1e-9) & (hours <= at + 1e-9)
        if not inside.any():  # an epoch is longer than an hour
            inside = hours == hours[hours <= at + 1e-9].max(initial=hours[0])
        return self.filled[:, inside].mean(-1)

    def env_steps_to(self, threshold: float) -> Sample:
        """Environment steps of the arm until an epoch's mean is that low; never is infinite."""
        found = env_steps_to_threshold(self.rows, self.arm.name, threshold)
        return np.array([NEVER if steps is None else steps for steps in found], float)


def curves_of(rows: Iterable[Row], experiment: str, arm: Arm, preset: str) -> Curves | None:
    """An arm's curves from the kept rows, as far as all of its seeds go; None without any."""
    wanted = (experiment, arm.name, preset)
    chosen = [r for r in rows if (r["experiment"], r["arm"], r["preset"]) == wanted]
    if not chosen:
        return None
    names = ("env_steps", "seconds", "steps_taken", "seeds_at_once")
    epochs, values = seed_curves(chosen, arm.name, *names)
    whole = np.isfinite(values["env_steps"]).all(axis=0)
    curves = {name: value[:, whole] for name, value in values.items()}
    curves["seconds"] = curves["seconds"] / curves.pop("seeds_at_once")
    row = EXPERIMENTS[experiment]
    return Curves(tuple(chosen), row, arm, epochs[whole], **curves)


@dataclass(frozen=True)
class Comparison:
    """Transfer against scratch, and what the transfer's source cost."""

    row: PaperExperiment
    preset: str
    source: Curves
    transfer: Curves
    scratch: Curves

    @property
    def offset(self) -> float:
        """The paper's hours of pre-training."""
        return float(self.source.hours[-1])

    @property
    def source_steps(self) -> float:
        """Environment steps of pre-training."""
        return float(self.source.env_steps[:, -1].mean())

    @property
    def hour(self) -> float:
        """The paper's fixed hour or, where a budget ends before it, the last that both arms have.

        A budget is a whole number of epochs, so it may end up to one before the hour it is for.
        """
        ends = []
        for arm, offset in ((self.scratch, 0.0), (self.transfer, self.offset)):
            end, epoch = float(arm.hours[-1]) + offset, float(arm.hours[0])
            ends.append(self.row.hours if end + epoch > self.row.hours else end)
        return min(self.row.hours, *ends)

    @property
    def at_the_papers_hour(self) -> bool:
        return self.hour == self.row.hours

    @property
    def common(self) -> int:
        """Target epochs that both arms have."""
        return min(len(self.transfer.epochs), len(self.scratch.epochs))

    @property
    def final(self) -> tuple[Sample, Sample]:
        """Scratch and transfer in the hour that is compared."""
        return self.scratch.in_hour(self.hour), self.transfer.in_hour(self.hour, self.offset)

    @property
    def areas(self) -> tuple[Sample, Sample]:
        """Mean steps taken over the target epochs that both have: the area under the curve."""
        scratch, transfer = (a.filled[:, : self.common] for a in (self.scratch, self.transfer))
        return scratch.mean(-1), transfer.mean(-1)

    def on_the_way(self, counted: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(K,) environment steps that both arms came to, and the interquartile means there of the
        steps taken from scratch and after transfer.

        Args:
          counted: whether the source's steps count for the transferred arm.
        """
        x = self.transfer.env_steps.mean(0) + (self.source_steps if counted else 0.0)
        other = self.scratch.env_steps.mean(0)
        both = x <= other[-1] + 1e-9
        scratch = np.interp(x[both], other, iqm(self.scratch.filled, axis=0))
        return x[both], scratch, iqm(self.transfer.filled, axis=0)[both]

    def largest(self, counted: bool) -> tuple[float, float]:
        """The largest ratio on the way, and at how many environment steps; NaN without any."""
        x, scratch, transfer = self.on_the_way(counted)
        if not x.size:
            return math.nan, math.nan
        best = int((scratch / transfer).argmax())
        return float((scratch / transfer)[best]), float(x[best])


def comparison_of(rows: Iterable[Row], name: str, preset: str) -> Comparison | None:
    """Of an experiment; None while an arm is missing."""
    rows, row = list(rows), EXPERIMENTS[name]
    source = curves_of(rows, row.source_of, SOURCE, preset)
    transfer = curves_of(rows, name, TRANSFER, preset)
    scratch = curves_of(rows, name, SCRATCH, preset)
    if source is None or transfer is None or scratch is None:
        return None
    return Comparison(row, preset, source, transfer, scratch)


STATISTICS_COLUMNS = (
    "preset",
    "experiment",
    "quantity",
    "of",
    "seeds",
    "value",
    "low",
    "high",
    "at_least",
    "reached",
    "at",
)
"""`at`: where the quantity was taken, in the unit its name says; `reached`: seeds of all."""


def statistics(comparison: Comparison) -> list[Row]:
    """Every quantity of one experiment under one preset, scratch, transfer and their ratio."""
    rows: list[Row] = []
    hour = comparison.hour
    rows += _pair("steps taken at the hour", comparison.final, at=hour)
    ends = (
        arm.filled[:, comparison.common - 1] for arm in (comparison.scratch, comparison.transfer)
    )
    scratch, transfer = ends
    steps = float(comparison.scratch.env_steps[:, comparison.common - 1].mean())
    rows += _pair("steps taken at equal target env steps", (scratch, transfer), at=steps)
    rows += _pair("mean steps taken on the way", comparison.areas, at=steps)
    for counted in (False, True):
        for threshold in THRESHOLDS:
            rows += _time_to(comparison, threshold, counted)
        value, at = comparison.largest(counted)
        name = f"largest ratio on the way, source {_words(counted)}"
        rows.append(_row(name, "scratch/transfer", Estimate(value), at=at))
    about = {"preset": comparison.preset, "experiment": comparison.row.name}
    return [{**about, **row} for row in rows]


def _words(counted: bool) -> str:
    return "counted" if counted else "not counted"


def _pair(quantity: str, samples: tuple[Sample, Sample], at: float) -> Iterator[Row]:
    for of, sample in zip(("scratch", "transfer"), samples, strict=True):
        yield _row(quantity, of, estimate(iqm, sample), at=at)
    yield _row(quantity, "scratch/transfer", estimate(ratio_of(iqm), *samples), at=at)


def _time_to(comparison: Comparison, threshold: float, counted: bool) -> list[Row]:
    """Environment steps until `threshold`, by arm, and their ratio.

    Where scratch never came so far, its budget stands for it in the ratio, which is then a bound.
    """
    shift = comparison.source_steps if counted else 0.0
    scratch = comparison.scratch.env_steps_to(threshold)
    transfer = comparison.transfer.env_steps_to(threshold) + shift
    quantity = f"env steps to {threshold:g}, source {_words(counted)}"
    rows = [
        _row(quantity, of, estimate(middle, times), reached=int(np.isfinite(times).sum()))
        for of, times in (("scratch", scratch), ("transfer", transfer))
    ]
    return [
        *rows,
        _row(quantity, "scratch/transfer", ratio_of_times(comparison, scratch, transfer)),
    ]


def ratio_of_times(comparison: Comparison, scratch: Sample, transfer: Sample) -> Estimate:
    """Median over median; NaN where the transferred median is `never`."""
    if math.isinf(middle(transfer)):
        return Estimate(math.nan, seeds=min(len(scratch), len(transfer)))
    budget = float(comparison.scratch.env_steps[:, -1].mean())
    bounded = np.where(np.isinf(scratch), budget, scratch)
    found = estimate(ratio_of(middle), bounded, transfer)
    at_least = bool(np.isinf(scratch).any())
    return Estimate(found.value, found.low, found.high, found.seeds, at_least)


def _row(
    quantity: str,
    of: str,
    found: Estimate,
    at: float | None = None,
    reached: int | None = None,
) -> Row:
    return {
        "quantity": quantity,
        "of": of,
        "seeds": found.seeds or None,
        "value": found.value,
        "low": found.low,
        "high": found.high,
        "at_least": "yes" if found.at_least else "",
        "reached": reached,
        "at": at,
    }


def aggregate(comparisons: list[Comparison], levels: dict[str, tuple[float, float]]) -> list[Row]:
    """All experiments of a preset together, at their hours: 0 is a random policy, 1 the bound.

    Args:
      levels: (random, shortest paths) steps on the target, by experiment.
    """
    known = [c for c in comparisons if c.row.name in levels]
    if not known:
        return []
    rows = []
    for index, of in enumerate(("scratch", "transfer")):
        samples = [_score(c.final[index], *levels[c.row.name]) for c in known]
        rows.append(_row("score at the hour", of, estimate(_pooled, *samples)))
    about = {"preset": known[0].preset, "experiment": f"all {len(known)}"}
    return [{**about, **row} for row in rows]


def _score(steps: Sample, random: float, bound: float) -> Sample:
    return (random - steps) / (random - bound)


def _pooled(*samples: Any, axis: int = -1) -> Any:
    return iqm(np.concatenate(samples, axis=axis), axis=axis)
