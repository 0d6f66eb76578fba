"""What is kept of a run directory, and which runs are the paper's experiments."""

import json
from dataclasses import replace

import pytest

from experiments.paper import report
from experiments.paper.arms import SOURCE, TRANSFER, TRANSFER_BRIEF
from experiments.paper.parts import Part
from experiments.paper.program import Options, missing_seeds, run
from experiments.paper.results import FinishedRun, Results, changed_settings, recognised
from sumajax.cli.transfer import PCPTransfer, PPTransfer
from sumajax.experiment.directory import plain
from sumajax.experiment.plan import described
from sumajax.learning import preset
from sumajax.reporting import append_rows, rows_of

LEARNER = preset("fast", "ic3net")
OPTIONS = PPTransfer(source_epochs=1, target_epochs=1, scratch=False, learner=LEARNER)


@pytest.fixture
def directory(tmp_path):
    """A run of `pp_transfer.py` without an arm from scratch, as far as it is read here."""
    directory = tmp_path / "run"
    directory.mkdir()
    write_config(directory, OPTIONS)
    for stage, seconds, steps in (("source", 2.0, 9.5), ("transfer", 3.0, 19.5)):
        values = {"env_steps": 20_000, "seconds": seconds, "cpu_seconds": 5.0, "steps_taken": steps}
        append_rows(directory / "metrics.csv", rows_of(stage, [0], 1, {**values, "success": 1}))
    return directory


def write_config(directory, options):
    plan = plain(described(options.experiment()))
    config = {"command": ["x"], "versions": {}, "options": {}, "experiment": plan}
    (directory / "config.json").write_text(json.dumps(config))


def test_runs_of_the_transfer_programs_are_imported(directory, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "figure_2", lambda *_: None)  # drawn in test_report.py
    monkeypatch.setattr(report, "targets", lambda *_: None)
    assert recognised(directory).parts == {
        "source": Part("pp-ic3net", SOURCE),
        "transfer": Part("pp-ic3net", TRANSFER),
    }
    output = tmp_path / "results"
    run(Options(import_runs=(directory,), output=output, import_commit="abc"))
    kept = Results.read(output)
    assert [(r["arm"], r["steps_taken"]) for r in kept.rows["curves"]] == [
        ("source", 9.5),
        ("transfer", 19.5),
    ]
    assert "abc" in (output / "README.md").read_text()
    options = Options(seeds=(0, 1), source_epochs=1, output=output)
    assert missing_seeds(Part("pp-ic3net", SOURCE), options, kept) == {1}
    (file,) = (output / "provenance").glob("*.json")
    stages = json.loads(file.read_text())["experiment"]["stages"]
    assert [stage["learner"]["anneal_epochs"] for stage in stages] == [1, 1]


OTHERS = {
    "policy": {"policy": "ic", "learner": preset("fast", "ic")},
    "task": {"target": replace(OPTIONS.target, num_predators=4)},
    "scale": {"scale": "mass"},
    "fill": {"upsampling": "corner"},
    "encoder": {"encoder": "lab_gap"},
    "setting": {"policy_settings": {"hidden": 8}},
    "optimiser": {"carry_optimiser": True},
    "module": {"leave_out": ("state_encoder",)},
    "chain": {"sizes": ("5", "10", "10"), "teams": ("3", "3", "5"), "epochs": (1, 1, 1)},
}


@pytest.mark.parametrize("changes", OTHERS.values(), ids=OTHERS)
def test_a_run_of_anything_else_is_refused(changes, directory):
    write_config(directory, replace(OPTIONS, **changes))
    with pytest.raises(ValueError, match="none of the paper's experiments"):
        recognised(directory)


def test_a_run_without_a_plan_is_refused(directory):
    (directory / "config.json").write_text(json.dumps({"options": {}}))
    with pytest.raises(ValueError, match=r"is no run of pp_transfer\.py"):
        recognised(directory)


def test_a_stage_that_did_not_come_to_its_end_does_not_count(directory):
    write_config(directory, replace(OPTIONS, target_epochs=2))
    assert list(recognised(directory).parts) == ["source"]
    write_config(directory, replace(OPTIONS, source_epochs=2, target_epochs=2))
    with pytest.raises(ValueError, match="no stage that came to its end"):
        recognised(directory)


def test_two_experiments_have_one_source(directory):
    options = PCPTransfer(source_epochs=1, target_epochs=1, scratch=False)
    write_config(directory, options)
    assert recognised(directory).parts == {
        "source": Part("pcp-hetnet-2p1c", SOURCE),
        "transfer": Part("pcp-hetnet-3p2c", TRANSFER),
    }


def test_settings_that_are_not_the_presets_are_told():
    changed = replace(OPTIONS, learner=replace(LEARNER, learning_rate=1.0))
    plans = [plain(described(options.experiment())) for options in (OPTIONS, changed)]
    assert [changed_settings(plan) for plan in plans] == [[], ["learning_rate"]]


def test_evaluations_and_levels_of_a_run(tmp_path):
    """By the names that the run gives its stages; a zero shot has rows of its own."""
    looks = {"episodes": 16, "steps_taken": [20.0, 21.0], "success": [1, 1], "return": [-2.0, -3.0]}
    modes = {"sampled": looks, "greedy": looks}
    files = {
        "config.json": {"experiment": {"preset": "fast", "seeds": [4, 7]}},
        "stages.json": {
            "transfer-brief": {
                "zero_shot": modes,
                "result": {"env_steps": 40_000, "evaluation": modes},
            }
        },
        "summary.json": {
            "references": {
                "transfer-brief": {
                    "random_steps_taken": 198.0,
                    "random_success": 0.1,
                    "shortest_path_steps": None,
                }
            }
        },
    }
    for name, value in files.items():
        (tmp_path / name).write_text(json.dumps(value))
    finished = FinishedRun(tmp_path, {"transfer-brief": Part("pp-hetnet", TRANSFER_BRIEF)})
    rows = {(r["arm"], r["mode"], r["seed"]): r for r in finished.evaluations()}
    assert set(rows) == {
        (arm, mode, seed)
        for arm in ("transfer-brief", "zero-shot-brief")
        for mode in modes
        for seed in (4, 7)
    }
    assert rows["transfer-brief", "greedy", 7] == {
        "experiment": "pp-hetnet",
        "arm": "transfer-brief",
        "preset": "fast",
        "seed": 7,
        "env_steps": 40_000,
        "mode": "greedy",
        "episodes": 16,
        "steps_taken": 21.0,
        "success": 1,
        "return": -3.0,
    }
    assert rows["zero-shot-brief", "sampled", 4]["env_steps"] == 0
    (level,) = finished.references()
    assert (level["experiment"], level["task"]) == ("pp-hetnet", "target")
    assert (level["random_steps_taken"], level["shortest_paths"]) == (198.0, None)
    results = Results(tmp_path, {name: [] for name in ("evaluations", "references")})
    results.replace("evaluations", finished.evaluations(), ("arm", "seed", "mode"))
    assert len(results.rows["evaluations"]) == 8


def test_a_file_of_other_columns_is_refused(tmp_path):
    (tmp_path / "curves.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"curves\.csv does not have the columns experiment, arm"):
        Results.read(tmp_path)
