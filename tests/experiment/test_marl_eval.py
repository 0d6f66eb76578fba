"""Results in the JSON form of marl-eval: what a run's files become; test_run.py has a real one."""

import csv
import json

import pytest

from sumajax.cli import main
from sumajax.description import describe_task
from sumajax.environments import PredatorPrey
from sumajax.experiment.marl_eval import marl_eval
from sumajax.experiment.records import COLUMNS as EVALUATED
from sumajax.reporting.metrics import append_rows, rows_of
from sumajax.upsampling import StateUpsampled

SMALL = PredatorPrey(size=3, num_predators=2, max_steps=10)
LARGE = PredatorPrey(size=6, num_predators=3, max_steps=20)
STAGES = {"source": StateUpsampled(SMALL, 6), "transfer": LARGE}


def evaluation(*steps_taken):
    zeros = [0.0] * len(steps_taken)
    return {"episodes": 8, "steps_taken": list(steps_taken), "success": zeros, "return": zeros}


def run_at(directory, seeds=(0, 5), policy="ic3net"):
    """The files of a finished run of two epochs a stage, evaluated on the way in the second."""
    directory.mkdir()
    stages = [{"name": name, "task": describe_task(env)} for name, env in STAGES.items()]
    plan = {"policy": {"name": policy}, "seeds": list(seeds), "stages": stages}
    at_the_end = {"sampled": evaluation(*range(4, 4 + len(seeds))), "greedy": None}
    result = {"env_steps": 40_000, "evaluation": at_the_end}
    records = {
        "source": {"result": result},
        "transfer": {"result": result, "zero_shot": {"sampled": evaluation(*[9.0] * len(seeds))}},
    }
    (directory / "config.json").write_text(json.dumps({"experiment": plan}))
    (directory / "stages.json").write_text(json.dumps(records))
    for name in STAGES:
        values = {"env_steps": [20_000, 40_000], "seconds": [1.5, 3.0]}
        append_rows(directory / "metrics.csv", rows_of(name, seeds, 1, values))
    with open(directory / "evaluations.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(EVALUATED)
        rows.writerows(["transfer", seed, 1, 20_000, 6.0, 0.5, -1.0] for seed in seeds)
    (directory / "summary.json").write_text("{}")
    return directory


def test_every_evaluation_is_a_step(tmp_path):
    found = marl_eval([run_at(tmp_path / "run")])
    of_seed = found["PredatorPrey"]["6x6, 3 agents"]["ic3net, transfer"]["seed_5"]
    assert of_seed == {
        "step_0": {
            "step_count": 0,
            "elapsed_time": 0.0,
            "steps_taken": [9.0],
            "success": [0.0],
            "return": [0.0],
        },
        "step_1": {
            "step_count": 20_000,
            "elapsed_time": 1.5,
            "steps_taken": [6.0],
            "success": [0.5],
            "return": [-1.0],
        },
        "step_2": {
            "step_count": 40_000,
            "elapsed_time": 3.0,
            "steps_taken": [5],
            "success": [0.0],
            "return": [0.0],
        },
        "absolute_metrics": {"steps_taken": [5], "success": [0.0], "return": [0.0]},
    }


def test_a_stage_without_any_on_the_way_has_its_last(tmp_path):
    found = marl_eval([run_at(tmp_path / "run")])
    of_seed = found["PredatorPrey"]["3x3, 2 agents, seen at 6x6"]["ic3net, source"]["seed_0"]
    assert set(of_seed) == {"step_0", "absolute_metrics"}
    assert of_seed["step_0"]["step_count"] == 40_000


def test_runs_of_other_seeds_and_policies_stand_side_by_side(tmp_path):
    runs = [
        run_at(tmp_path / "a"),
        run_at(tmp_path / "b", seeds=(7,)),
        run_at(tmp_path / "c", policy="magic"),
    ]
    of_task = marl_eval(runs)["PredatorPrey"]["6x6, 3 agents"]
    assert set(of_task["ic3net, transfer"]) == {"seed_0", "seed_5", "seed_7"}
    assert set(of_task["magic, transfer"]) == {"seed_0", "seed_5"}


def test_a_seed_that_two_runs_have_is_refused(tmp_path):
    runs = [run_at(tmp_path / "a"), run_at(tmp_path / "b")]
    with pytest.raises(ValueError, match=r"b has seed 0 of ic3net, source .* a run before"):
        marl_eval(runs)


def test_a_run_that_is_not_finished_is_refused(tmp_path):
    (run_at(tmp_path / "a") / "summary.json").unlink()
    with pytest.raises(ValueError, match=r"a is no finished run; its summary\.json is not there"):
        marl_eval([tmp_path / "a"])


def test_the_command_writes_it(tmp_path, capsys):
    run, file = run_at(tmp_path / "run"), tmp_path / "m.json"
    main(["marl-eval", str(run), "--output", str(file)])
    assert json.loads(file.read_text()) == marl_eval([run])
    with pytest.raises(SystemExit) as exit_status:
        main(["marl-eval", str(run), "--output", str(file)])
    assert exit_status.value.code == 2
    assert "nothing is overwritten" in capsys.readouterr().err
