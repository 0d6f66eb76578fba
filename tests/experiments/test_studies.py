"""Runs by seeds, and kept rows."""

import math
from dataclasses import dataclass

import pytest

from experiments.studies import curves_of, read_csv, replaced, study_runs
from sumajax.reporting import metrics


@dataclass(frozen=True)
class Toy:
    name: str = "toy"

    def experiment(self, seeds):
        raise AssertionError("nothing is trained")


def test_seeds_that_are_added_have_a_run_of_their_own(tmp_path):
    def groups(*seeds):
        return [found.seeds for found in study_runs(Toy(), seeds, tmp_path, 1)]

    assert groups(0, 1) == [(0, 1)]
    for name in ("seeds-0-1", "seeds-4"):
        (tmp_path / "toy" / name).mkdir(parents=True)
        (tmp_path / "toy" / name / "config.json").write_text("{}")
    assert groups(0, 1) == [(0, 1)]
    assert groups(1, 2, 3) == [(0, 1), (2, 3)]
    assert groups(4) == [(4,)]


def test_rows_are_read_with_their_types(tmp_path):
    file = tmp_path / "rows.csv"
    file.write_text("experiment,seed,limit,success,return\ntoy,3,80,1,\n")
    (row,) = read_csv(file)
    assert math.isnan(row.pop("return"))
    assert row == {"experiment": "toy", "seed": 3, "limit": 80, "success": 1.0}
    assert isinstance(row["success"], float)
    assert read_csv(tmp_path / "none.csv") == []


def test_a_run_replaces_the_rows_of_its_own_seeds_alone():
    def row(experiment, seed, stage):
        return {"experiment": experiment, "seed": seed, "stage": stage}

    kept = [row("toy", 0, "old"), row("toy", 1, "other seed"), row("else", 0, "other")]
    new = [row("toy", 0, "second"), row("toy", 0, "a third")]
    assert replaced(kept, "toy", (0,), new) == [
        row("else", 0, "other"),
        row("toy", 0, "second"),
        row("toy", 0, "a third"),
        row("toy", 1, "other seed"),
    ]


def test_seeds_share_the_time_of_their_process(tmp_path):
    (found,) = study_runs(Toy(), (0, 1), tmp_path, 1)
    found.directory.mkdir(parents=True)
    known = {"arm": "5x5", "epoch": 1, "env_steps": 20_000, "cpu_seconds": 8.0}
    rows = [
        dict.fromkeys(metrics.COLUMNS, 0.0) | known | {"seed": seed, "success": success}
        for seed, success in ((0, 0.5), (1, 0.25))
    ]
    metrics.append_rows(found.directory / "metrics.csv", rows)
    first, second = curves_of(found, ("success",))
    assert first["stage"] == "5x5"
    assert first["cpu_seconds"] == second["cpu_seconds"] == pytest.approx(4)
    assert (first["success"], second["success"]) == (0.5, 0.25)
