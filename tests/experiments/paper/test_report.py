"""Tables, figures and report, from kept files alone."""

import shutil

import pytest

from experiments.paper import report as made
from experiments.paper.claims import NOT_RUN
from experiments.paper.program import Options, run
from experiments.paper.published import EXPERIMENTS
from experiments.paper.report import (
    costs,
    on_the_way,
    report,
    table_1,
    times,
)
from experiments.paper.results import KEY, Results
from experiments.paper.table2 import table_2

from .rows import RESULTS, arms

IC3NET = EXPERIMENTS["pp-ic3net"]


@pytest.fixture
def kept(tmp_path):
    """Results of two experiments, on file."""
    results = Results.read(tmp_path / "results")
    rows = arms(
        "pp-ic3net",
        "fast",
        source=[[50, 6]] * 3,
        source_plain=[[50, 5]] * 3,
        transfer=[[60, 20], [50, 18], [40, 22]],
        scratch=[[199, 150], [198, 140], [197, 160]],
    )
    rows += arms("pcp-hetnet-2p1c", "fast", source=[[50, 6]] * 3, scratch=[[199, 190]] * 3)
    results.replace("curves", rows, KEY)
    level = {"random_steps_taken": 198.0, "random_success": 0.04, "shortest_paths": 10.5}
    results.replace(
        "references",
        [{"experiment": "pp-ic3net", "task": "target", **level}],
        ("experiment", "task"),
    )
    timed = {"epochs": 100, "seconds": 0.5, "standard_error": 0.01, "load_before": 0.0}
    about = {"experiment": "pp-ic3net", "arm": "scratch", "preset": "fast", "pass": 1}
    where = {"machine": "two cores", "commit": "abc"}
    results.replace("seconds_per_epoch", [{**about, **timed, **where}], ("experiment", "arm"))
    results.write()
    return results


def test_kept_files_are_read_as_they_were_written(kept):
    assert Results.read(kept.directory).rows == kept.rows


def test_everything_is_made_again_from_them(kept):
    run(Options(rebuild=True, output=kept.directory))
    names = {path.name for path in kept.directory.iterdir()}
    tables = {f"{t}.{end}" for t in ("table1", "table2", "ablations") for end in ("md", "csv")}
    assert names >= tables | {"statistics.csv", "statistics.md", "README.md"}
    for figure in ("figure2-fast-hours.png", "figure2-fast-env-steps.png", "transfer-fast.png"):
        assert (kept.directory / figure).read_bytes()[:4] == b"\x89PNG"
    assert not any("paper" in name for name in names)
    assert ".lock" not in names
    again = report(Results.read(kept.directory))
    assert (kept.directory / "README.md").read_text() == again


def test_what_is_not_run_says_so(kept):
    rows = {(row["experiment"], row["preset"]): row for row in table_1(kept.rows["curves"])}
    assert rows[IC3NET.title, "paper"]["ratio"] == NOT_RUN
    assert rows[EXPERIMENTS["pcp-hetnet-2p1c"].title, "fast"]["transfer"] == NOT_RUN
    ours = rows[IC3NET.title, "fast"]
    assert ours["scratch"].startswith(
        "174.0 (169.0-"
    )  # the mean of both epochs of 199 and 150, ...
    timed = table_2(kept.rows["seconds_per_epoch"])[2]
    assert timed["paper (s)"] == "143.13 ± 0.51"
    assert timed["ours, fast (s)"] == "0.500 ± 0.010 (286x as fast)"
    assert timed["ours, paper (s)"] == NOT_RUN


def test_both_arms_at_equal_steps(kept):
    (uncounted, counted) = on_the_way(kept.rows["curves"])
    assert uncounted["source"] == "not counted"
    assert set(counted.values()) >= {"-"}


def test_every_comparison_stands_under_each_accounting(kept):
    """Minutes only where all three arms were measured."""
    rows = costs(kept)
    assert [row["equal"] for row in rows] == ["the paper's hours", "M environment steps"]
    for arm, seconds in (("source", 0.2), ("transfer", 0.4)):
        row = {**kept.rows["seconds_per_epoch"][0], "arm": arm, "seconds": seconds}
        kept.replace("seconds_per_epoch", [row], ("experiment", "arm"))
    assert costs(kept)[2]["equal"] == "minutes here"
    (at_30, at_20) = times(kept)
    assert at_30["never: scratch, transfer"] == "3 of 3, 0 of 3"
    assert at_30["target alone, M environment steps"].startswith("never (never-never) -> 0.0400")
    assert at_20["never: scratch, transfer"] == "3 of 3, 1 of 3"
    assert "not measured" not in at_20.values()


def test_the_kept_results_are_what_their_files_say(tmp_path, monkeypatch):
    """The tables in the repository, made again from the files beside them; figures by name alone,
    as their bytes are matplotlib's."""

    def draw(*given):
        given[-1].touch()

    monkeypatch.setattr(made, "figure_2", draw)
    monkeypatch.setattr(made, "targets", draw)
    ours = tmp_path / "results"
    shutil.copytree(RESULTS, ours)
    for file in [*ours.glob("*.md"), *ours.glob("*.png")]:
        file.unlink()
    run(Options(rebuild=True, output=ours))
    before, after = (
        {path.name: path for path in directory.glob("*.*") if not path.name.startswith(".")}
        for directory in (RESULTS, ours)
    )
    assert before.keys() == after.keys()
    for name in before:
        if not name.endswith(".png"):
            assert after[name].read_text() == before[name].read_text(), name
