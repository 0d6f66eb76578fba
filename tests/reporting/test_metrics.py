import json
import math
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from sumajax.reporting import metrics
from sumajax.reporting.metrics import COLUMNS, append_rows, read_metrics, rows_of, truncate_after

HEADER = ",".join(COLUMNS) + "\n"


def chunk(arm, first_epoch, epochs, seeds=(0, 1)):
    epoch = np.arange(first_epoch, first_epoch + epochs)
    taken = np.array(seeds)[:, None] + 100.0 / epoch
    values = {"env_steps": epoch * 20_000, "seconds": epoch * 0.1, "steps_taken": taken}
    return rows_of(arm, seeds, first_epoch, values)


def keys(rows, arm):
    return [(row["epoch"], row["seed"]) for row in rows if row["arm"] == arm]


def test_the_file_has_the_agreed_columns_and_a_row_per_arm_seed_and_epoch(tmp_path):
    path = tmp_path / "metrics.csv"
    append_rows(path, chunk("source", 1, 2))
    lines = path.read_text().splitlines()
    assert lines[0] == (
        "arm,seed,epoch,env_steps,seconds,steps_taken,success,return,entropy,"
        "policy_loss,value_loss,gradient_norm,communication,cpu_seconds"
    )
    assert [line.split(",")[:4] for line in lines[1:]] == [
        ["source", "0", "1", "20000"],
        ["source", "1", "1", "20000"],
        ["source", "0", "2", "40000"],
        ["source", "1", "2", "40000"],
    ]


def test_numbers_round_trip_in_the_precision_they_came_in(tmp_path):
    path = tmp_path / "metrics.csv"
    numbers = np.random.default_rng(0).normal(size=10) * 10.0 ** np.arange(-20, 20, 4)
    row = dict(zip(COLUMNS[4:], numbers, strict=True))
    double = {
        "arm": "source",
        "seed": np.int64(3),
        "epoch": 1,
        "env_steps": np.int32(20_000),
        **row,
    }
    single = {**double, "epoch": 2, **{name: np.float32(value) for name, value in row.items()}}
    append_rows(path, [double, single])
    first, second = read_metrics(path)
    assert first == double
    for name, value in row.items():
        assert np.float32(second[name]) == np.float32(value)
    assert all(isinstance(first[name], int) for name in ("seed", "epoch", "env_steps"))


@pytest.mark.parametrize("nothing", [math.nan, None, np.float32("nan")])
def test_an_epoch_without_a_finished_episode_is_an_empty_cell(tmp_path, nothing):
    path = tmp_path / "metrics.csv"
    (row,) = chunk("source", 1, 1, seeds=(0,))
    append_rows(path, [{**row, "steps_taken": nothing}])
    assert "nan" not in path.read_text().lower()
    assert ",0.1,,," in path.read_text()
    assert math.isnan(read_metrics(path)[0]["steps_taken"])


def test_rows_of_lays_arrays_out_epoch_by_epoch():
    rows = rows_of(
        "scratch", [7, 8], 5, {"env_steps": [10, 20], "success": [[0.1, 0.2], [0.3, 0.4]]}
    )
    assert [(r["seed"], r["epoch"], r["env_steps"], r["success"]) for r in rows] == [
        (7, 5, 10, 0.1),
        (8, 5, 10, 0.3),
        (7, 6, 20, 0.2),
        (8, 6, 20, 0.4),
    ]
    with pytest.raises(ValueError, match="'sucess' is no column"):
        rows_of("scratch", [0], 1, {"env_steps": [1], "sucess": [1.0]})
    with pytest.raises(ValueError, match="env_steps"):
        rows_of("scratch", [0], 1, {"success": [1.0]})


def test_a_row_torn_by_a_kill_is_neither_read_nor_kept(tmp_path):
    path = tmp_path / "metrics.csv"
    append_rows(path, chunk("source", 1, 2))
    whole = path.read_text()
    for torn in ("source,0,3,600", HEADER[:9]):
        path.write_text(whole + torn)
        assert keys(read_metrics(path), "source") == [(1, 0), (1, 1), (2, 0), (2, 1)]
    append_rows(path, chunk("source", 3, 1))
    assert path.read_text().startswith(whole + "source,0,3,60000,0.3")
    assert keys(read_metrics(path), "source") == [(e, s) for e in (1, 2, 3) for s in (0, 1)]
    path.write_text(HEADER[:9])
    assert read_metrics(path) == []
    append_rows(path, chunk("source", 1, 1, seeds=(0,)))
    assert keys(read_metrics(path), "source") == [(1, 0)]


def test_a_killed_writer_leaves_whole_rows_only(tmp_path):
    path = tmp_path / "metrics.csv"
    program = (
        "from sumajax.reporting.metrics import append_rows, rows_of\n"
        "for epoch in range(1, 100000):\n"
        f"    append_rows({str(path)!r}, rows_of('source', range(20), epoch, {{'env_steps': 1}}))\n"
    )
    writer = subprocess.Popen([sys.executable, "-c", program], cwd=os.getcwd())
    try:
        deadline = time.monotonic() + 120
        while not (path.exists() and path.stat().st_size > 5_000):
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        os.kill(writer.pid, signal.SIGKILL)
        writer.wait()
    assert path.read_text().endswith("\n")
    epochs = {row["epoch"] for row in read_metrics(path)}
    assert epochs == set(range(1, max(epochs) + 1))
    assert len(read_metrics(path)) == 20 * len(epochs)


def test_resuming_leaves_neither_gaps_nor_doubles(tmp_path):
    path = tmp_path / "metrics.csv"
    append_rows(path, chunk("source", 1, 4))
    append_rows(path, chunk("transfer", 1, 6))
    assert truncate_after(path, "transfer", 3) == 3
    append_rows(path, chunk("transfer", 4, 3))
    rows = read_metrics(path)
    assert keys(rows, "source") == [(e, s) for e in range(1, 5) for s in (0, 1)]
    assert keys(rows, "transfer") == [(e, s) for e in range(1, 7) for s in (0, 1)]
    untouched = chunk("source", 1, 4) + chunk("transfer", 1, 6)
    assert [row["steps_taken"] for row in rows] == [row["steps_taken"] for row in untouched]


def test_truncation_mends_doubles_and_reports_gaps(tmp_path):
    path = tmp_path / "metrics.csv"
    append_rows(path, chunk("source", 1, 2))
    append_rows(path, [{**row, "success": 0.5} for row in chunk("source", 2, 1)])
    append_rows(path, chunk("source", 4, 1))
    assert truncate_after(path, "source", 4) == 2  # epoch 3 is missing
    rows = read_metrics(path)
    assert keys(rows, "source") == [(1, 0), (1, 1), (2, 0), (2, 1), (4, 0), (4, 1)]
    assert rows[2]["success"] == 0.5
    assert truncate_after(path, "source", 0) == 0
    assert path.read_text() == HEADER
    assert truncate_after(tmp_path / "none.csv", "source", 3) == 0


def test_a_foreign_file_is_refused_and_left_alone(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("step,loss\n1,0.5\n")
    for use in (
        lambda: read_metrics(path),
        lambda: append_rows(path, chunk("source", 1, 1)),
        lambda: truncate_after(path, "source", 1),
    ):
        with pytest.raises(ValueError, match="not a metrics file"):
            use()
    assert path.read_text() == "step,loss\n1,0.5\n"
    path.write_text(HEADER + "source,0,1,twenty,,,,,,,,,\n")
    with pytest.raises(ValueError, match="line 2"):
        read_metrics(path)
    with pytest.raises(ValueError, match="exactly the columns"):
        append_rows(tmp_path / "new.csv", [{"arm": "source"}])


def test_seed_curves_are_arrays_with_nan_where_nothing_is(tmp_path):
    rows = chunk("source", 1, 3) + chunk("transfer", 1, 1)
    del rows[2]  # seed 0, epoch 2
    epochs, values = metrics.seed_curves(rows, "source", "steps_taken")
    assert epochs.tolist() == [1, 2, 3]
    np.testing.assert_allclose(
        values["steps_taken"], [[100, np.nan, 100 / 3], [101, 51, 1 + 100 / 3]]
    )


def test_the_comparison_is_that_of_target_steps_alone():
    slow = [{**row, "steps_taken": 2 * row["steps_taken"]} for row in chunk("scratch", 1, 10)]
    rows = chunk("transfer", 1, 6) + slow
    found = metrics.comparison(rows, threshold=20.5)
    assert found["env_steps_to_threshold"] == {
        "transfer": [100_000, 120_000],
        "scratch": [200_000, None],
    }
    assert found["steps_taken_ratio"] == pytest.approx(2.0)  # at epoch 6, the last of both
    assert "merit" not in found
    alone = metrics.comparison(chunk("transfer", 1, 6), threshold=1.0)
    assert alone["steps_taken_ratio"] is None
    assert alone["env_steps_to_threshold"] == {"transfer": [None, None], "scratch": []}


def test_a_comparison_by_success_says_so():
    """Where all episodes last as long: solved is what has come to the threshold or beyond."""
    rows = [{**row, "success": 0.1 * row["epoch"]} for row in chunk("transfer", 1, 6)]
    found = metrics.comparison(rows, threshold=0.35, merit="success")
    assert found["merit"] == "success"
    assert found["env_steps_to_threshold"] == {"transfer": [80_000, 80_000], "scratch": []}
    never = metrics.comparison(rows, threshold=0.8, merit="success")
    assert never["env_steps_to_threshold"]["transfer"] == [None, None]


def test_an_evaluation_may_have_figures_of_the_domains_own():
    shown = metrics.evaluation_summary(8, [3.0], [1.0], [-1.0], mean_delay=[0.25])
    assert tuple(shown) == (*metrics.EVAL, "mean_delay")
    assert shown["mean_delay"] == [0.25]


def test_an_arm_of_summary_json_has_the_agreed_form(tmp_path):
    path = tmp_path / "summary.json"
    evaluation = metrics.evaluation_summary(
        1024, np.float32([14.5, np.nan]), [1.0, 0.0], [-2.0, -9]
    )
    arm = metrics.arm_summary(
        env_steps=np.int64(2_500_000),
        epochs=125,
        compile_seconds=12.0,
        train_seconds=50.0,
        sampled=evaluation,
        greedy=None,
    )
    metrics.write_json(path, arm)
    assert json.loads(path.read_text()) == {
        "env_steps": 2_500_000,
        "epochs": 125,
        "compile_seconds": 12.0,
        "train_seconds": 50.0,
        "env_steps_per_second": 50_000.0,
        "evaluation": {
            "sampled": {
                "episodes": 1024,
                "steps_taken": [14.5, None],
                "success": [1.0, 0.0],
                "return": [-2.0, -9.0],
            },
            "greedy": None,
        },
    }


class TestFilesOfEarlierVersions:
    """Without the column cpu_seconds."""

    @pytest.fixture
    def old(self, tmp_path):
        path = tmp_path / "metrics.csv"
        metrics.append_rows(path, chunk("source", 1, 2))
        lines = [line.rpartition(",")[0] for line in path.read_text().splitlines()]
        path.write_text("\n".join(lines) + "\n")
        return path

    def test_are_read(self, old):
        rows = metrics.read_metrics(old)
        assert [row["epoch"] for row in rows][-1] == 2
        assert all(math.isnan(row["cpu_seconds"]) for row in rows)

    def test_are_gone_on_with(self, old):
        metrics.append_rows(old, chunk("source", 3, 1))
        assert old.read_text().splitlines()[0] == ",".join(metrics.COLUMNS)
        assert metrics.complete_epochs(metrics.read_metrics(old), "source") == 3


def test_files_are_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "config.json"
    metrics.write_json(path, {"size": (5, 5), "rate": np.float32(0.5), "limit": math.inf})
    assert json.loads(path.read_text()) == {"size": [5, 5], "rate": 0.5, "limit": None}
    before = path.read_text()

    def full_disk(handle):
        raise OSError("no space left")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="no space"):
        metrics.write_text(path, "half")
    assert path.read_text() == before
    assert [file.name for file in tmp_path.iterdir()] == ["config.json"]
