"""Statistics by hand, and what their intervals are worth at three and five seeds."""

from math import inf, isnan, nan

import numpy as np
import pytest
from scipy.stats import bootstrap

from experiments.paper.claims import number, said, spread
from experiments.paper.statistics import (
    Ratio,
    comparison_of,
    log_interval,
    mean_of,
    median_of,
    pairs,
    ratio_of_means,
    ratio_of_medians,
    statistics,
)

from .rows import arms, curve

DRAWS = 20_000
# Logarithms of our own samples scatter by 0.005 (five seeds, `fast`) to 0.4 (IC3Net, `paper`).
SCATTER = [(0.01, 0.01), (0.02, 0.1), (0.1, 0.4)]


def test_a_number_over_seeds_is_its_mean_and_its_range():
    """A failed seed is in both; a trimmed mean of five would leave it out."""
    found = mean_of(np.array([15.0, 15, 15, 15, 90]))
    assert (found.value, found.least, found.most, found.seeds) == (30, 15, 90, 5)
    assert spread(found) == "30.00 (15.00-90.00)"
    assert spread(mean_of(np.array([3.0]))) == "3.000"


def coverage(first, second, ratio):
    """Share of the draws whose interval holds the true ratio."""
    low, high = log_interval(first, second)
    return np.mean((low <= ratio) & (ratio <= high))


@pytest.mark.parametrize("seeds", [3, 5])
@pytest.mark.parametrize(("first", "second"), SCATTER)
def test_the_interval_has_its_coverage_at_these_sizes(seeds, first, second):
    rng = np.random.default_rng(0)
    samples = [np.exp(rng.normal(0, scale, (DRAWS, seeds))) for scale in (first, second)]
    error = np.sqrt(0.95 * 0.05 / DRAWS)
    assert coverage(*samples, 1.0) >= 0.95 - 3 * error


def test_why_not_a_bootstrap():
    """The percentile bootstrap, which was here before: far from 95% of three seeds."""
    rng = np.random.default_rng(0)

    def percentile(sample):
        found = bootstrap((sample,), np.mean, n_resamples=200, method="percentile", rng=rng)
        return found.confidence_interval

    samples = rng.normal(0, 1, (300, 3))
    covered = [low <= 0 <= high for low, high in map(percentile, samples)]
    assert np.mean(covered) < 0.85


def test_there_is_no_interval_where_seeds_are_of_two_kinds():
    """Of runs of which one in five fails (90 steps, not 15) it has no 95% of the mean either."""
    rng = np.random.default_rng(0)
    samples = [
        np.where(rng.random((DRAWS, 5)) < 0.2, 90, 15) * np.exp(rng.normal(0, 0.02, (DRAWS, 5)))
        for _ in range(2)
    ]
    fixed = [15 * np.exp(rng.normal(0, 0.02, (DRAWS, 5)))]
    assert coverage(samples[0], fixed[0], 2.0) < 0.9
    failed = ratio_of_means(samples[0][0], fixed[0][0], of_one_kind=False)
    assert (failed.low, failed.high) == (None, None)


def test_an_interval_needs_three_seeds_in_each_arm():
    assert ratio_of_means(np.array([4.0, 6]), np.array([1.0, 2, 3])) == Ratio(2.5)
    found = ratio_of_means(np.array([4.0, 5, 6]), np.array([1.9, 2, 2.1]))
    assert found.low < found.value == 2.5 < found.high
    equal = ratio_of_means(np.full(3, 6.0), np.full(3, 2.0))
    assert (equal.value, equal.low, equal.high) == pytest.approx((3, 3, 3))


def test_every_run_against_every_run():
    assert pairs(np.array([2.0, 4]), np.array([1.0, 2])).tolist() == [2, 1, 4, 2]


def test_never_is_infinite_and_not_interpolated():
    found = median_of(np.array([0.1, 0.2, inf]))
    assert (found.value, found.least, found.most) == (0.2, 0.1, inf)
    assert spread(found, 3) == "0.200 (0.100-never)"
    assert median_of(np.array([0.1, inf])).value == inf
    assert median_of(np.array([inf, inf])).value == inf


def test_the_median_of_two_lies_between_them():
    assert median_of(np.array([7.5, 9.0])).value == 8.25


def test_a_ratio_of_medians_is_a_bound_only_where_a_median_is_never():
    """One seed of five that never came leaves the median what it is (3P/2C from scratch)."""
    transfer = np.array([0.1, 0.1, 0.1])
    assert ratio_of_medians(np.array([1.0, 2, inf]), transfer, 3.0) == Ratio(20)
    bound = ratio_of_medians(np.array([1.0, inf, inf]), transfer, 3.0)
    assert said(bound, 3) == "> 30.0"
    assert isnan(ratio_of_medians(np.array([1.0]), np.array([inf]), 3.0).value)


def compared(preset="paper", **steps):
    return comparison_of(arms("pp-ic3net", preset, **steps), "pp-ic3net", preset)


def test_the_hour_is_the_one_before_the_papers():
    rows = curve("pp-ic3net", "scratch", 0, range(1, 61))
    found = comparison_of(
        [*rows, *arms("pp-ic3net", source=[[5]], transfer=[[5]])], "pp-ic3net", "paper"
    )
    # 3600 s are 25.15 epochs of 143.13 s: epochs 26 to 50 end in the second hour.
    hour = found.scratch.before(2.0, found.scratch.hours, 1.0)
    assert hour.tolist() == [np.mean(range(26, 51))]


def test_a_budget_that_ends_early_moves_the_hour():
    whole = {"source": [[5] * 350], "transfer": [[20] * 139], "scratch": [[50] * 252]}
    found = compared(**whole)
    assert found.at_the_papers_hour
    assert found.hour == 10
    short = compared(**{**whole, "scratch": [[50] * 100]})
    assert short.hour == pytest.approx(100 * 143.13 / 3600)
    assert not short.at_the_papers_hour


def test_equal_cost_under_each_accounting():
    """Source 10 epochs; scratch 40; the transferred arm gets what is left."""
    steps = {"source": [[5] * 10], "transfer": [range(101, 141)], "scratch": [range(1, 41)]}
    found = compared(**steps)
    equal = found.equal(found.env_steps)
    assert (equal.at, equal.scratch_epochs, equal.transfer_epochs) == (0.8, 40, 30)
    assert equal.scratch.tolist() == [np.mean(range(31, 41))]
    assert equal.transfer.tolist() == [np.mean(range(121, 131))]
    # An epoch takes 3 s on the source and 1 s on the target: of 40 s 10 are left.
    here = found.minutes_here({"source": 3.0, "transfer": 1.0, "scratch": 1.0})
    assert found.equal(here).transfer_epochs == 10
    assert found.minutes_here({"source": 3.0}) is None
    # 10 epochs of 50.03 s, then 132.62 s each; scratch 143.13 s.
    hours = found.equal(found.papers_hours)
    assert hours.transfer_epochs == int((40 * 143.13 - 10 * 50.03) / 132.62)


def test_a_source_that_costs_more_than_all_of_scratch():
    found = compared(source=[[5] * 50], transfer=[[20] * 10], scratch=[[60] * 40])
    equal = found.equal(found.env_steps)
    assert equal.transfer is None
    assert equal.transfer_epochs == 0


def test_an_epoch_without_a_value_counts_as_the_step_limit():
    found = compared(source=[[5]], transfer=[[nan, 20]], scratch=[[100, 50]])
    assert found.transfer.filled.tolist() == [[200, 20]]


def test_an_arm_that_still_moves():
    falling = [60.0] * 10 + [50.0] * 8 + [50.0, 40.0]
    found = compared(source=[[5]], transfer=[[20] * 20] * 2, scratch=[[50] * 20, falling])
    assert found.transfer.moves.tolist() == [1, 1]
    assert found.scratch.moves.tolist() == [1, 50 / 45]


def test_steps_until_a_threshold_with_and_without_the_source():
    found = compared(
        source=[[9, 5], [9, 5]],
        transfer=[[29, 19, 14], [31, 19, 14]],
        scratch=[[100, 60, 30], [100, 60, 31]],
    )
    assert not found.of_one_kind  # one seed from scratch never came to 30
    rows = {
        (row["quantity"], row["of"]): row
        for row in statistics(found, {"source": 30.0, "transfer": 60.0, "scratch": 60.0})
    }
    name = "time to 30 steps, target alone: M environment steps"
    assert rows[name, "transfer"]["most"] == pytest.approx(0.04)
    assert rows[name, "scratch"]["value"] == inf  # half of them never came
    assert rows[name, "scratch"]["came"] == 1
    ratio = rows[name, "scratch/transfer"]
    assert (ratio["value"], ratio["at_least"]) == (pytest.approx(2), "yes")  # 0.06 over 0.03
    counted = rows["time to 30 steps, source in: M environment steps", "transfer"]
    assert (counted["least"], counted["value"]) == pytest.approx((0.06, 0.07))
    here = rows["time to 30 steps, source in: minutes here", "transfer"]
    assert (here["least"], here["value"]) == pytest.approx((2, 2.5))
    ways = rows["mean steps taken until this many M target steps", "scratch/transfer"]
    assert ways["value"] == pytest.approx((190 + 191) / (62 + 64))
    assert ways["low"] is None


def test_numbers():
    assert [number(x, 3) for x in (nan, inf, 0.1234, 12.0)] == ["-", "never", "0.123", "12.0"]
