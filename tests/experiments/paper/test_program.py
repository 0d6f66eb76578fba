"""The paper's reproduction: statistics by hand, tables and figures from kept files, going on."""

import json
import shutil
import sys
from dataclasses import asdict, replace
from functools import partial
from math import inf, nan

import numpy as np
import paper_parts
import paper_results
import paper_speed
import pytest
import reproduce_paper
from paper_claims import FAILS, HOLDS, IN_PART, NOT_RUN, claims, number, said
from paper_parts import SELECTIONS, Budget, Part, config_of, parts_of, unchanged_arms
from paper_report import on_the_way, report, statistics_rows, table_1, table_2
from paper_results import Results, recognised
from paper_statistics import (
    Estimate,
    comparison_of,
    estimate,
    iqm,
    middle,
    ratio_of,
    ratio_of_times,
    statistics,
)
from published import EXPERIMENTS, SOURCES
from reproduce_paper import Options, run
from stopping import stopped_in

from sumajax import checkpoint, evaluate
from sumajax.environments import PredatorPrey
from sumajax.experiment import run as transfer_run
from sumajax.experiment.directory import plain
from sumajax.learning import LearnerConfig
from sumajax.policies import make_policy
from sumajax.transfer import StoppedError

IC3NET = EXPERIMENTS["pp-ic3net"]


def curve(experiment, arm, seed, steps, preset="paper"):
    """Rows of one seed: an epoch of 20,000 environment steps and 2 s for each of `steps`."""
    return [
        {
            "experiment": experiment,
            "arm": arm,
            "preset": preset,
            "seed": seed,
            "epoch": epoch,
            "env_steps": 20_000 * epoch,
            "seconds": 2.0 * epoch,
            "seeds_at_once": 2,
            "steps_taken": float(taken),
            "success": 1.0,
        }
        for epoch, taken in enumerate(steps, start=1)
    ]


def arms(name, preset="paper", **steps):
    """Rows of whole arms: for each the (seeds, epochs) steps taken."""
    return [
        row
        for arm, seeds in steps.items()
        for seed, taken in enumerate(seeds)
        for row in curve(name, arm.replace("_", "-"), seed, taken, preset)
    ]


class TestPublished:
    def test_budgets_are_those_of_the_specification(self):
        target = {n: (r.epochs["scratch"], r.epochs["transfer"]) for n, r in EXPERIMENTS.items()}
        assert target == {
            "pp-ic3net": (252, 139),
            "pp-magic": (344, 178),
            "pp-hetnet": (620, 558),
            "pcp-hetnet-2p1c": (918, 631),
            "pcp-hetnet-3p2c": (1508, 1227),
        }
        assert [EXPERIMENTS[n].pretraining for n in SOURCES] == [350, 590, 500, 700]

    def test_ratios_are_those_of_the_paper(self):
        assert [r.ratio for r in EXPERIMENTS.values()] == [2.68, 2.76, 6.99, 6.11, 7.88]


class TestStatistics:
    def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end(self):
        assert iqm(np.array([100.0, 1, 2, 3, 4, 5, 6, 0])) == (2 + 3 + 4 + 5) / 4
        assert iqm(np.array([1.0, 2, 6])) == 3  # too few to leave any out

    def test_an_interval_holds_its_value_and_has_none_of_one_seed(self):
        found = estimate(iqm, np.array([1.0, 2, 3, 4]))
        assert found.value == 2.5
        assert found.low < 2.5 < found.high
        assert estimate(iqm, np.array([3.0])) == Estimate(3.0, None, None, 1)

    def test_equal_seeds_leave_no_doubt(self):
        found = estimate(ratio_of(iqm), np.full(3, 6.0), np.full(3, 2.0))
        assert (found.value, found.low, found.high) == (3, 3, 3)

    def test_never_is_infinite_and_not_interpolated(self):
        found = estimate(middle, np.array([1e5, 2e5, inf]))
        assert (found.value, found.low, found.high) == (2e5, 1e5, inf)
        assert said(found) == "0.2 M [0.1 M, never]"

    def test_the_hour_is_the_one_before_the_papers(self):
        rows = curve("pp-ic3net", "scratch", 0, range(1, 61))
        arm = comparison_of(
            [*rows, *arms("pp-ic3net", source=[[5]], transfer=[[5]])], "pp-ic3net", "paper"
        ).scratch
        # 3600 s are 25.15 epochs of 143.13 s: epochs 26 to 50 end in the second hour.
        assert arm.in_hour(2.0).tolist() == [np.mean(range(26, 51))]

    def test_a_budget_that_ends_early_moves_the_hour(self):
        whole = {"source": [[5] * 350], "transfer": [[20] * 139], "scratch": [[50] * 252]}
        compared = comparison_of(arms("pp-ic3net", **whole), "pp-ic3net", "paper")
        assert compared.at_the_papers_hour
        assert compared.hour == 10
        short = comparison_of(
            arms("pp-ic3net", **{**whole, "scratch": [[50] * 100]}), "pp-ic3net", "paper"
        )
        assert short.hour == pytest.approx(100 * 143.13 / 3600)
        assert not short.at_the_papers_hour

    def test_an_epoch_without_a_value_counts_as_the_step_limit(self):
        rows = arms("pp-ic3net", source=[[5]], transfer=[[nan, 20]], scratch=[[100, 50]])
        compared = comparison_of(rows, "pp-ic3net", "paper")
        assert compared.transfer.filled.tolist() == [[200, 20]]

    def test_steps_until_a_threshold_with_and_without_the_source(self):
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

    def test_a_transfer_that_never_gets_there_has_no_ratio(self):
        rows = arms("pp-ic3net", source=[[5]], transfer=[[100]], scratch=[[100]])
        compared = comparison_of(rows, "pp-ic3net", "paper")
        found = ratio_of_times(compared, np.array([inf]), np.array([inf]))
        assert said(found) == number(nan) == "-"


class TestClaims:
    WHOLE = {
        "source": [[5] * 350] * 3,
        "source_plain": [[5] * 350] * 3,
        "transfer": [[20] * 139] * 3,
        "scratch": [[60] * 252] * 3,
    }

    def verdicts(self, name="pp-ic3net", **changed):
        rows = arms(name, **{**self.WHOLE, **changed})
        return {claim.name: claim.verdict for claim in claims(rows, "paper")}

    def test_all_of_one_row(self):
        found = self.verdicts()
        assert found["Q1, PP, IC3Net on the source: upsampling does no harm"] == HOLDS
        assert found["Q2, PP, IC3Net, 10x10 5P"] == HOLDS
        assert found["Up to 7.88x"] == NOT_RUN  # the other rows may be larger
        assert found["Scratch fails where transfer succeeds"] == NOT_RUN
        assert found["Q2, PP, MAGIC, 10x10 5P"] == NOT_RUN

    def test_a_smaller_ratio_holds_in_part_and_none_does_not(self):
        q2 = "Q2, PP, IC3Net, 10x10 5P"
        assert self.verdicts(scratch=[[40] * 252] * 3)[q2] == IN_PART
        assert self.verdicts(scratch=[[21] * 252] * 3)[q2] == FAILS
        assert self.verdicts(scratch=[[60] * 252] * 2)[q2] == IN_PART  # too few seeds
        assert self.verdicts(scratch=[[60] * 99] * 3)[q2] == IN_PART  # too short

    def test_an_arm_that_falls_back_is_told_of(self):
        jump = [100] * 120 + [30] * 12 + [100] * 120
        rows = arms("pp-ic3net", **{**self.WHOLE, "scratch": [jump] * 3})
        (reason,) = (c.reason for c in claims(rows, "paper") if c.name.startswith("Q2, PP, IC3Net"))
        assert "scratch fell back from 30 steps at 2.60 M to 100" in reason
        assert "transferred fell back" not in reason

    def test_upsampling_that_harms(self):
        q1 = "Q1, PP, IC3Net on the source: upsampling does no harm"
        assert self.verdicts(source=[[6] * 350] * 3)[q1] == FAILS

    def test_scratch_that_succeeds_too(self):
        epochs = EXPERIMENTS["pp-hetnet"].epochs
        transfer, name = [[20] * epochs["transfer"]] * 3, "Scratch fails where transfer succeeds"
        source = {"source": [[5] * 500] * 3, "transfer": transfer}
        failing = self.verdicts("pp-hetnet", **source, scratch=[[190] * epochs["scratch"]] * 3)
        assert failing[name] == IN_PART  # two rows are not run
        learning = self.verdicts("pp-hetnet", **source, scratch=[[25] * epochs["scratch"]] * 3)
        assert learning[name] == FAILS


def test_every_selection_has_parts_in_order():
    for selection in SELECTIONS:
        parts = parts_of([selection], "fast")
        before = set()
        for part in parts:
            assert part.source is None or part.source in before
            before.add((part.experiment, part.arm))
    everything = parts_of(SELECTIONS, "fast")
    assert len({(part.experiment, part.arm) for part in everything}) == len(everything)
    assert Part("pcp-hetnet-2p1c", "source") in parts_of(["pcp-hetnet-3p2c"], "fast")


def test_budgets_of_parts():
    fast, paper = Budget("fast"), Budget("paper")
    scratch = Part("pp-ic3net", "scratch")
    assert (fast.epochs(scratch), paper.epochs(scratch)) == (125, 252)
    assert Budget("paper", scale=0.1).epochs(scratch) == 25
    assert Budget("paper", target=7).epochs(scratch) == 7
    assert fast.epochs(Part("pp-hetnet", "transfer", "source")) == 150
    assert fast.epochs(Part("pp-hetnet", "transfer-mass", "source-mass")) == 60
    assert fast.epochs(Part("pp-hetnet", "source-25", share=0.25)) == 12


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_an_ablation_is_compared_with_an_unchanged_arm_of_its_budget(preset):
    budget = Budget(preset)
    for part in parts_of(["encoder", "mass"], preset):
        if part.stage == "transfer":
            unchanged, _ = unchanged_arms(part.experiment, preset)
            assert unchanged in parts_of(["encoder"], preset)
            assert budget.epochs(part) == budget.epochs(unchanged)


@pytest.mark.parametrize("selection", SELECTIONS)
def test_every_part_is_a_run_that_is_accepted(selection, tmp_path):
    for part in parts_of([selection], "fast"):
        config = config_of(part, Budget("fast"), (0, 1), tmp_path / "run", None, 1)
        stage = transfer_run.Run.of(config).stage(part.stage)
        assert stage.epochs == Budget("fast").epochs(part)


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
    results.replace("curves", rows, paper_results.KEY)
    level = {"random_steps_taken": 198.0, "random_success": 0.04, "shortest_paths": 10.5}
    results.replace(
        "references",
        [{"experiment": "pp-ic3net", "task": "target", **level}],
        ("experiment", "task"),
    )
    timed = {"epochs": 100, "seconds": 0.5, "standard_error": 0.01, "load_before": 0.0}
    about = {"experiment": "pp-ic3net", "arm": "scratch", "preset": "fast"}
    where = {"machine": "two cores", "commit": "abc"}
    results.replace("seconds_per_epoch", [{**about, **timed, **where}], ("experiment", "arm"))
    results.write()
    return results


class TestReport:
    def test_kept_files_are_read_as_they_were_written(self, kept):
        assert Results.read(kept.directory).rows == kept.rows

    def test_everything_is_made_again_from_them(self, kept):
        run(Options(rebuild=True, output=kept.directory))
        names = {path.name for path in kept.directory.iterdir()}
        tables = {f"{t}.{end}" for t in ("table1", "table2", "ablations") for end in ("md", "csv")}
        assert names >= tables | {"statistics.csv", "statistics.md", "README.md"}
        assert (kept.directory / "figure2-fast.png").read_bytes()[:4] == b"\x89PNG"
        assert "figure2-paper.png" not in names
        assert ".lock" not in names
        again = report(Results.read(kept.directory))
        assert (kept.directory / "README.md").read_text() == again

    def test_what_is_not_run_says_so(self, kept):
        rows = {(row["experiment"], row["preset"]): row for row in table_1(kept.rows["curves"])}
        assert rows[IC3NET.title, "paper"]["ratio"] == NOT_RUN
        assert rows[EXPERIMENTS["pcp-hetnet-2p1c"].title, "fast"]["transfer"] == NOT_RUN
        ours = rows[IC3NET.title, "fast"]
        assert ours["scratch"].startswith("174.0 [")  # the mean of both epochs of 199 and 150, ...
        timed = table_2(kept.rows["seconds_per_epoch"])[2]
        assert timed["paper (s)"] == "143.13 ± 0.51"
        assert timed["ours, fast (s)"] == "0.500 ± 0.010 (286x as fast)"
        assert timed["ours, paper (s)"] == NOT_RUN

    def test_both_arms_at_equal_steps(self, kept):
        (uncounted, counted) = on_the_way(kept.rows["curves"])
        assert uncounted["source"] == "not counted"
        assert set(counted.values()) >= {"-"}

    def test_the_aggregate_is_between_a_random_policy_and_the_bound(self, kept):
        scores = [r for r in statistics_rows(kept) if r["quantity"] == "score at the hour"]
        assert [row["of"] for row in scores] == ["scratch", "transfer"]
        assert 0 < scores[0]["value"] < scores[1]["value"] < 1


@pytest.fixture
def tiny(monkeypatch, tmp_path):
    """The first experiment on a toy scale, its runs and results in `tmp_path`."""
    row = replace(
        IC3NET,
        source=PredatorPrey(size=3, num_predators=2, max_steps=10),
        target=PredatorPrey(size=6, num_predators=3, max_steps=20),
    )
    monkeypatch.setitem(EXPERIMENTS, "pp-ic3net", row)
    monkeypatch.setattr(
        transfer_run, "make_policy", lambda name, env, **s: make_policy(name, env, hidden=8, **s)
    )
    monkeypatch.setattr(transfer_run, "evaluate", partial(evaluate, episodes=16))
    # What other tests look at: the same run in seconds.
    level = {"random_steps_taken": 20.0, "random_success": 0.1, "shortest_path_steps": 5.0}
    monkeypatch.setattr(transfer_run, "_references", lambda run: {"source": level, "target": level})
    monkeypatch.setattr(transfer_run.Recorder, "_replay", lambda self, arm: None)
    monkeypatch.setattr(transfer_run.reporting, "learning_curves", lambda *args, **more: None)
    monkeypatch.setattr(reproduce_paper, "write_report", lambda results: None)
    quick = LearnerConfig(num_envs=100, rollout_length=20)
    monkeypatch.setattr(paper_parts, "preset", lambda name, policy: quick)
    return Options(
        experiments=("pp-ic3net",),
        seeds=(0,),
        source_epochs=1,
        target_epochs=1,
        devices=1,
        output=tmp_path / "results",
        runs=tmp_path / "runs",
    )


def pretend(directory, arm, epochs):
    """Leaves what a finished run leaves, without training."""
    directory.mkdir(parents=True)
    (directory / "checkpoints" / arm).mkdir(parents=True)
    options = {"seeds": list(reproduce_paper.seeds_of(directory)), "preset": "fast"}
    (directory / "config.json").write_text(json.dumps({"options": options}))
    lines = [
        f"{arm},{seed},{epoch},{20_000 * epoch},{epoch}.0,9.5,1,-1,,,,,"
        for epoch in range(1, epochs + 1)
        for seed in options["seeds"]
    ]
    header = ",".join(transfer_run.metrics_file.COLUMNS)
    (directory / "metrics.csv").write_text("\n".join([header, *lines]) + "\n")
    (directory / "summary.json").write_text("{}")


def test_only_what_is_missing_is_run(tiny, monkeypatch):
    ran = []
    monkeypatch.setattr(paper_parts, "ABLATED", ("pp-ic3net",))

    def run_experiment(config):
        arm = "transfer" if config.source_checkpoint else "source"
        ran.append(str(config.directory.relative_to(tiny.runs / "fast" / "pp-ic3net")))
        if len(ran) == 2:
            raise KeyboardInterrupt
        pretend(config.directory, arm, 1)

    monkeypatch.setattr(reproduce_paper, "run_experiment", run_experiment)
    monkeypatch.setattr(checkpoint, "latest", lambda directory: directory)
    with pytest.raises(KeyboardInterrupt):
        run(tiny)
    run(tiny)
    assert ran == ["source/seeds-0", *["transfer/seeds-0"] * 2, "scratch/seeds-0"]
    run(replace(tiny, seeds=(0, 1, 2)))
    assert ran[4:] == [f"{arm}/seeds-1-2" for arm in ("source", "transfer", "scratch")]
    run(replace(tiny, seeds=(0, 1, 2), experiments=("optimiser",)))
    assert ran[7:] == ["transfer-optimiser/seeds-0", "transfer-optimiser/seeds-1-2"]
    with pytest.raises(ValueError, match=r"holds 1 epochs of pp-ic3net source, .* not 2; choose"):
        run(replace(tiny, source_epochs=2))


def test_a_part_without_a_seed_left_is_told_of_and_the_others_go_on(tiny, monkeypatch, capsys):
    def run_experiment(config):
        if config.source_checkpoint:
            raise StoppedError("no seed of the transfer stage is left.")
        pretend(config.directory, "source", 1)

    monkeypatch.setattr(reproduce_paper, "run_experiment", run_experiment)
    monkeypatch.setattr(checkpoint, "latest", lambda directory: directory)
    run(tiny)
    assert "pp-ic3net transfer: no seed of the transfer stage" in capsys.readouterr().out
    assert {r["arm"] for r in Results.read(tiny.output).rows["curves"]} == {"source", "scratch"}


def test_the_kept_results_are_what_their_files_say(tmp_path):
    """The tables and figures in the repository, made again from the files beside them."""
    ours = tmp_path / "results"
    shutil.copytree(reproduce_paper.RESULTS, ours)
    for made in [*ours.glob("*.md"), *ours.glob("*.png")]:
        made.unlink()
    run(Options(rebuild=True, output=ours))
    before, after = (
        {path.name: path for path in directory.glob("*.*") if not path.name.startswith(".")}
        for directory in (reproduce_paper.RESULTS, ours)
    )
    assert before.keys() == after.keys()
    for name in before:
        if not name.endswith(".png"):  # whose bytes are matplotlib's
            assert after[name].read_text() == before[name].read_text(), name


@pytest.mark.slow
def test_a_part_that_was_stopped_goes_on_and_its_rows_are_kept(tiny, monkeypatch):
    parts = [Part("pp-ic3net", "source"), Part("pp-ic3net", "transfer", "source")]
    monkeypatch.setattr(reproduce_paper, "parts_of", lambda *chosen: parts)
    with stopped_in("transfer", KeyboardInterrupt):
        run(tiny)
    assert [row["arm"] for row in Results.read(tiny.output).rows["curves"]] == ["source"]
    run(tiny)
    kept = Results.read(tiny.output)
    rows = [(row["arm"], row["seed"], row["epoch"]) for row in kept.rows["curves"]]
    assert rows == [("source", 0, 1), ("transfer", 0, 1)]
    assert {row["arm"] for row in kept.rows["evaluations"]} == {"source", "transfer", "zero-shot"}
    (file,) = (tiny.output / "provenance").glob("fast-pp-ic3net-transfer-*.json")
    said_of = json.loads(file.read_text())
    assert len(said_of["sessions"]) == 2
    assert {"command", "commit", "versions", "machine"} <= set(said_of["sessions"][0])


def test_seeds_that_are_added_are_run_alone_beside_what_was_begun(tiny, tmp_path):
    part = Part("pp-ic3net", "transfer", "source")
    sources = [((0, 1), tmp_path / "a"), ((2,), tmp_path / "b")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reproduce_paper, "checkpoints_of", lambda *args: sources)
        patch.setattr(reproduce_paper, "_begun", lambda *args: [(1,)])
        found = reproduce_paper.groups(part, {0, 1, 2}, tiny, Results.read(tmp_path))
    assert found == [((1,), tmp_path / "a"), ((0,), tmp_path / "a"), ((2,), tmp_path / "b")]


def test_runs_of_the_transfer_programs_are_imported(tmp_path, monkeypatch):
    directory = tmp_path / "run"
    directory.mkdir()
    config = config_of(Part("pp-ic3net", "source"), Budget("fast"), (0,), directory, None, 1)
    options = plain(asdict(replace(config, target_epochs=1)))
    options |= {"source_epochs": 1}
    (directory / "config.json").write_text(
        json.dumps({"command": ["x"], "versions": {}, "options": options})
    )
    header = ",".join(transfer_run.metrics_file.COLUMNS)
    rows = ["source,0,1,20000,2.0,9.5,1,-1,,,,,", "transfer,0,1,20000,3.0,19.5,1,-1,,,,,"]
    (directory / "metrics.csv").write_text("\n".join([header, *rows]) + "\n")
    assert recognised(directory).names == {
        "source": ("pp-ic3net", "source"),
        "transfer": ("pp-ic3net", "transfer"),
    }
    output = tmp_path / "results"
    run(Options(import_runs=(directory,), output=output, import_commit="abc"))
    kept = Results.read(output)
    assert [(r["arm"], r["steps_taken"]) for r in kept.rows["curves"]] == [
        ("source", 9.5),
        ("transfer", 19.5),
    ]
    assert "abc" in (output / "README.md").read_text()
    missing = reproduce_paper.missing_seeds(
        Part("pp-ic3net", "source"), Options(seeds=(0, 1), source_epochs=1, output=output), kept
    )
    assert missing == {1}
    options["policy"] = "ic"
    (directory / "config.json").write_text(json.dumps({"options": options}))
    with pytest.raises(ValueError, match="none of the paper's experiments"):
        recognised(directory)


MISTAKES = {
    "--experiments pong": "invalid choice 'pong' for argument '--experiments'",
    "--experiments q1 q1": "experiments must be distinct names of pp-ic3net, ",
    "--seeds 1 1": "seeds must be distinct numbers from 0 to 2147483647, got [1, 1].",
    "--preset slow": "invalid choice 'slow' for argument '--preset'",
    "--epochs-scale 0": "epochs-scale must lie between 0 and 100, got 0.0.",
    "--source-epochs 0": "source-epochs must lie between 1 and 100000, got 0.",
    "--devices 0": "devices must lie between 1 and 256, got 0.",
    "--rebuild": "holds no results; run experiments or import runs.",
    "--rebuild --measure-speed": "rebuild and measure-speed do different things; give one of them.",
    "--import-runs missing": "missing is no run of pp_transfer.py or pcp_transfer.py; give its",
    "--spam": "Unrecognized options: --spam; --help lists all there are.",
}


@pytest.mark.parametrize(("options", "sentence"), MISTAKES.items())
def test_a_mistake_gets_one_sentence(options, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(reproduce_paper, "prepare_jax", lambda devices: None)
    monkeypatch.setattr(
        sys, "argv", ["reproduce_paper.py", *options.split(), "--output", "results"]
    )
    with pytest.raises(SystemExit) as stop:
        reproduce_paper.main()
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error: ")
    assert line.endswith(".")
    assert sentence in line


def test_a_file_of_other_columns_is_refused(tmp_path):
    (tmp_path / "curves.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"curves\.csv does not have the columns experiment, arm"):
        Results.read(tmp_path)


def test_checkpoints_are_found_in_imported_runs(tiny, tmp_path, monkeypatch):
    source = tmp_path / "imported" / "checkpoints" / "source"
    source.mkdir(parents=True)
    note = reproduce_paper.Provenance.of(["pp-ic3net source"], "fast", (0,), tmp_path / "imported")
    note.write(tiny.output, {})
    monkeypatch.setattr(checkpoint, "latest", lambda directory: directory)
    results = Results.read(tiny.output)
    found = reproduce_paper.checkpoints_of(Part("pp-ic3net", "source"), tiny, results)
    assert found == [((0,), source)]


def test_speed_is_measured_from_a_source_that_holds_its_seed(tiny, tmp_path, monkeypatch):
    """Not from the first that is found, which may be of other seeds."""
    others, ours = (tmp_path / name / "checkpoints" / "source" for name in ("others", "ours"))
    monkeypatch.setattr(
        reproduce_paper, "checkpoints_of", lambda *_: [((3, 4), others), ((0, 1, 2), ours)]
    )
    seen = {}

    def timed(config, arm, epochs):
        seen[arm] = (config.seeds, config.source_checkpoint)
        return {"epochs": epochs, "seconds": 1.0, "standard_error": 0.1, "load_before": 0.0}

    monkeypatch.setattr(paper_speed, "seconds_per_epoch", timed)
    options = replace(tiny, experiments=("pp-ic3net",), measure_speed=True)
    reproduce_paper.measure(options, Results.read(tiny.output))
    assert seen == {"source": ((0,), None), "transfer": ((0,), ours)}
