"""Statistics by hand."""

from math import inf, nan

import numpy as np
import pytest

from experiments.paper.claims import number, said
from experiments.paper.statistics import (
    Estimate,
    comparison_of,
    estimate,
    iqm,
    middle,
    ratio_of,
    ratio_of_times,
    statistics,
)

from .rows import arms, curve


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end():
    assert iqm(np.array([100.0, 1, 2, 3, 4, 5, 6, 0])) == (2 + 3 + 4 + 5) / 4
    assert iqm(np.array([1.0, 2, 6])) == 3  # too few to leave any out


def test_an_interval_holds_its_value_and_has_none_of_one_seed():
    found = estimate(iqm, np.array([1.0, 2, 3, 4]))
    assert found.value == 2.5
    assert found.low < 2.5 < found.high
    assert estimate(iqm, np.array([3.0])) == Estimate(3.0, None, None, 1)


def test_equal_seeds_leave_no_doubt():
    found = estimate(ratio_of(iqm), np.full(3, 6.0), np.full(3, 2.0))
    assert (found.value, found.low, found.high) == (3, 3, 3)


def test_never_is_infinite_and_not_interpolated():
    found = estimate(middle, np.array([1e5, 2e5, inf]))
    assert (found.value, found.low, found.high) == (2e5, 1e5, inf)
    assert said(found) == "0.2 M [0.1 M, never]"


def test_the_hour_is_the_one_before_the_papers():
    rows = curve("pp-ic3net", "scratch", 0, range(1, 61))
    arm = comparison_of(
        [*rows, *arms("pp-ic3net", source=[[5]], transfer=[[5]])], "pp-ic3net", "paper"
    ).scratch
    # 3600 s are 25.15 epochs of 143.13 s: epochs 26 to 50 end in the second hour.
    assert arm.in_hour(2.0).tolist() == [np.mean(range(26, 51))]


def test_a_budget_that_ends_early_moves_the_hour():
    whole = {"source": [[5] * 350], "transfer": [[20] * 139], "scratch": [[50] * 252]}
    compared = comparison_of(arms("pp-ic3net", **whole), "pp-ic3net", "paper")
    assert compared.at_the_papers_hour
    assert compared.hour == 10
    short = comparison_of(
        arms("pp-ic3net", **{**whole, "scratch": [[50] * 100]}), "pp-ic3net", "paper"
    )
    assert short.hour == pytest.approx(100 * 143.13 / 3600)
    assert not short.at_the_papers_hour


def test_an_epoch_without_a_value_counts_as_the_step_limit():
    rows = arms("pp-ic3net", source=[[5]], transfer=[[nan, 20]], scratch=[[100, 50]])
    compared = comparison_of(rows, "pp-ic3net", "paper")
    assert compared.transfer.filled.tolist() == [[200, 20]]


def test_steps_until_a_threshold_with_and_without_the_source():
    rows = arms(
        "pp-ic3net",
        source=[[9, 5], [9, 5]],
        transfer=[[29, 19, 14], [31, 19, 14]],
        scratch=[[100, 60, 30], [100, 60, 31]],
    )
    found = {
        (row["quantity"], row["of"]): row
        for row in statistics(comparison_of(rows, "pp-ic3net", "paper"))
    }
    name = "env steps to 30, source not counted"
    assert found[name, "transfer"]["value"] == 30_000  # of 20,000 and 40,000
    assert found[name, "scratch"]["value"] == inf  # of 60,000 and never
    assert found[name, "scratch"]["reached"] == 1
    ratio = found[name, "scratch/transfer"]
    assert (ratio["value"], ratio["at_least"]) == (2.0, "yes")  # the budget over 30,000
    counted = found["env steps to 30, source counted", "transfer"]
    assert counted["value"] == 70_000
    ways = found["mean steps taken on the way", "scratch/transfer"]
    assert ways["value"] == pytest.approx((190 + 191) / (62 + 64))
    best = found["largest ratio on the way, source not counted", "scratch/transfer"]
    assert (best["value"], best["at"]) == (pytest.approx(100 / 30), 20_000)


def test_a_transfer_that_never_gets_there_has_no_ratio():
    rows = arms("pp-ic3net", source=[[5]], transfer=[[100]], scratch=[[100]])
    compared = comparison_of(rows, "pp-ic3net", "paper")
    found = ratio_of_times(compared, np.array([inf]), np.array([inf]))
    assert said(found) == number(nan) == "-"
