"""Costs, tables and figures from kept rows: sources counted, seeds that never arrive shown."""

import math

import numpy as np
import pytest

from experiments.scaling.costs import arms
from experiments.scaling.figures import band, cost_lines
from experiments.scaling.report import above_zero_shot, cost_cell, spread, write_report
from experiments.scaling.results import COLUMNS, Results


def stage(name, seed, after="", **more):
    row = {
        "experiment": "pp20-hetnet",
        "stage": name,
        "seed": seed,
        "part": "pp20",
        "policy": "hetnet",
        "words": "chain",
        "after": after,
        "task": "20x20 10P",
        "side": 20,
        "max_steps": 200,
        "epochs": 2,
        "env_steps": 40_000,
        "cpu_seconds": 8.0,
        "bound": 10.0,
        "random": 190.0,
    }
    return row | more


def point(name, seed, env_steps, steps_taken, **more):
    row = {"experiment": "pp20-hetnet", "stage": name, "seed": seed, "env_steps": env_steps}
    row |= {"cpu_seconds": env_steps / 5000, "steps_taken": steps_taken, "success": 1.0}
    return row | more


def held_out(name, seed, when, steps_taken, task="20x20 10P", limit=200, mode="sampled"):
    row = {"when": when, "task": task, "mode": mode, "limit": limit, "episodes": 16}
    return point(name, seed, 0, steps_taken, **row)


@pytest.fixture
def results(tmp_path):
    """Two seeds of a source and a target; the second seed's target never gets anywhere."""
    small = {"task": "5x5 3P", "side": 5, "max_steps": 80, "bound": 5.0}
    rows = {name: [] for name in COLUMNS}
    for seed, (first, last) in enumerate([(25.0, 14.0), (180.0, 170.0)]):
        rows["stages"] += [
            stage("5x5", seed, env_steps=20_000, cpu_seconds=2.0, **small),
            stage("20x20", seed, after="5x5"),
            stage("scratch", seed),
        ]
        rows["curves"] += [point("5x5", seed, 20_000, 9.0, epoch=1, cpu_seconds=2.0)]
        rows["evaluations"] += [
            point("20x20", seed, 20_000, first),
            point("20x20", seed, 40_000, last + 0.5),
            point("scratch", seed, 40_000, 190.0),
        ]
        rows["held_out"] += [
            held_out("5x5", seed, "end", 8.0, task="5x5 3P", limit=80),
            held_out("20x20", seed, "zero shot", 60.0),
            held_out("20x20", seed, "end", last),
            held_out("20x20", seed, "end", min(last, 80.0), limit=80),
            held_out("scratch", seed, "end", 185.0),
        ]
    return Results(tmp_path, rows)


def arm_of(results, name):
    return next(arm for arm in arms(results) if arm.about["stage"] == name)


def test_a_cost_counts_the_sources_and_is_infinite_where_a_seed_never_was_there(results):
    arm = arm_of(results, "20x20")
    np.testing.assert_array_equal(arm.cost_to(3.0, "env_steps"), [20_000 + 20_000, math.inf])
    np.testing.assert_array_equal(arm.cost_to(2.0, "env_steps"), [20_000 + 40_000, math.inf])
    np.testing.assert_array_equal(arm.cost_to(2.0, "cpu_seconds"), [2.0 + 8.0, math.inf])
    np.testing.assert_array_equal(arm.cost_to(6.0, "env_steps"), [20_000] * 2)  # zero shot
    np.testing.assert_array_equal(arm.total("env_steps"), [60_000, 60_000])


def test_a_first_stage_has_trainings_own_figures(results):
    np.testing.assert_array_equal(arm_of(results, "5x5").cost_to(2.0, "env_steps"), [20_000] * 2)


def test_scratch_counts_itself_alone(results):
    np.testing.assert_array_equal(arm_of(results, "scratch").total("env_steps"), [40_000] * 2)


def test_cells_say_who_arrived_and_take_no_mean_over_who_did_not():
    total, said = np.array([9.0, 9.0]), "{:.0f}".format
    assert cost_cell(np.array([2.0, 4.0]), total, said) == "3 (2-4; 2 of 2)"
    assert cost_cell(np.array([2.0, math.inf]), total, said) == "2-2, > 9 (1 of 2)"
    assert cost_cell(np.array([math.inf] * 2), total, said) == "> 9 (0 of 2)"
    assert cost_cell(np.array([2.0]), total[:1], said) == "2 (1 of 1)"


def test_a_figure_has_its_least_and_greatest_seed_and_its_success():
    rows = [{"steps_taken": 30.0, "success": 1.0}, {"steps_taken": 34.0, "success": 0.9}]
    assert spread(rows) == "32.0 (30.0-34.0; 0.950)"
    assert spread(rows[:1]) == "30.0 (1.000)"


def test_lines_of_the_figure_are_chain_and_scratch_from_one_first_stage(results):
    lines = cost_lines(arms(results))
    named = {
        kind: {s: arm.about["stage"] for s, arm in lines["hetnet", kind].items()}
        for kind in ("chain", "scratch")
    }
    assert named == {
        "chain": {5: "5x5", 20: "20x20"},
        "scratch": {5: "5x5", 20: "scratch"},
    }


def test_a_policy_that_was_tried_on_large_teams_alone_has_its_line(results):
    for row in results.rows["stages"]:
        row.update(part="dilution", policy="magic")
    lines = cost_lines(arms(results))
    assert list(lines["magic", "chain"]) == [20, 5]


def test_scratch_that_is_kept_alone_is_no_chain(results):
    for rows in results.rows.values():
        rows[:] = [row for row in rows if row["stage"] == "scratch"]
    lines = cost_lines(arms(results))
    assert {kind: list(by_side) for (_, kind), by_side in lines.items()} == {
        "chain": [],
        "scratch": [20],
    }
    write_report(results)


def test_a_band_is_the_mean_and_range_over_seeds_at_each_point(results):
    cost, low, middle, high = band(arm_of(results, "20x20"), 0)
    np.testing.assert_array_equal(cost, [20_000, 40_000, 60_000, 60_000])
    np.testing.assert_array_equal(low, [60.0, 25.0, 14.5, 14.0])
    np.testing.assert_array_equal(high, [60.0, 180.0, 170.5, 170.0])
    np.testing.assert_array_equal(middle, (low + high) / 2)


def test_who_fell_below_what_a_transfer_brought_is_told(results):
    """Both seeds begin at 60; the second is at 180 after 0.02 M steps and at 170.5 after 0.04 M."""
    assert above_zero_shot(results) == (2, [])  # not looked at then
    for row in results.rows["evaluations"]:
        row["env_steps"] *= 5
    (row,) = above_zero_shot(results)[1]
    assert row == {
        "experiment": "pp20-hetnet",
        "stage": "20x20",
        "seed": 1,
        "zero shot": "60.0",
        "0.1 M": "180.0",
        "0.3 M": "",
        "1.0 M": "",
    }


def test_the_report_is_made_of_the_kept_files_alone(results):
    results.write()
    write_report(Results.read(results.directory))
    text = (results.directory / "tables.md").read_text()
    assert "| hetnet | 20x20 | 20x20 10P | 10.0 | 2 |" in text
    assert "92.0 (14.0-170.0; 1.000) at 200" in text
    assert "47.0 (14.0-80.0; 1.000) at 80" in text
    assert "0.06-0.06, > 0.06 (1 of 2)" in text
    assert "Not run: pp10, pp40, pcp20, rect, rivals, dilution, brief, short, still." in text
    files = {path.name for path in results.directory.iterdir()}
    assert {"cost.png", "curves-pp20.png", "matrix-pp20.png", "stages.csv"} <= files


def test_a_run_replaces_its_own_rows_and_no_others(results):
    before = len(results.rows["stages"])
    new = {name: [] for name in COLUMNS} | {"stages": [stage("20x20", 0, env_steps=1)]}
    results.add("pp20-hetnet", [0], new)
    assert [r["env_steps"] for r in results.rows["stages"] if r["seed"] == 0] == [1]
    assert len(results.rows["stages"]) == before - 3 + 1
