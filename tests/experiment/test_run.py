"""The whole experiment on a toy scale: its files, its table, going on after a stop, refusing."""

import contextlib
import csv
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from stopping import stopped_in

from sumajax import load_agent
from sumajax.environments import PredatorPrey
from sumajax.experiment import Experiment, Stage, run_experiment
from sumajax.experiment.directory import claimed
from sumajax.experiment.marl_eval import marl_eval
from sumajax.experiment.plan import described
from sumajax.experiment.run import Where
from sumajax.experiment.summary import table, untrained_line
from sumajax.learning import LearnerConfig
from sumajax.upsampling import StateUpsampled

COLUMNS = (
    "arm,seed,epoch,env_steps,seconds,steps_taken,success,return,entropy,policy_loss,value_loss,"
    "gradient_norm,communication,cpu_seconds"
)
SMALL = PredatorPrey(size=3, num_predators=2, max_steps=10)
LARGE = PredatorPrey(size=6, num_predators=3, max_steps=20)
LEARNER = LearnerConfig(num_envs=100, rollout_length=20)
TOY = Experiment(
    stages=(
        Stage("source", StateUpsampled(SMALL, 6), 2, learner=LEARNER),
        Stage("transfer", LARGE, 2, start="source", learner=LEARNER),
        Stage("scratch", LARGE, 2, learner=LEARNER),
    ),
    policy_settings={"hidden": 8, "encoder": "linear"},
    seeds=(0, 1),
    name="toy",
    evaluate_every=1,
    episodes=16,
)


class Stopped(Exception):
    """Stands for whatever ends a run in its middle."""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Directory, summary and output of a run of `TOY`, after its end."""
    directory, printed = tmp_path_factory.mktemp("runs") / "toy", io.StringIO()
    with contextlib.redirect_stdout(printed):
        summary = run_experiment(TOY, directory)
    return directory, summary, printed.getvalue()


def rows(directory):
    with open(directory / "metrics.csv") as file:
        return list(csv.DictReader(file))


def without_clock(directory):
    return [{k: v for k, v in row.items() if not k.endswith("seconds")} for row in rows(directory)]


@pytest.mark.parametrize(
    ("count", "named"),
    [(1, "p0."), (3, "p0, p1, p2."), (38, "p0, p1, p2 and 35 more (stages.json).")],
)
def test_a_line_names_the_first_parameters_that_nobody_trained_and_counts_the_others(count, named):
    line = untrained_line([f"p{i}" for i in range(count)])
    assert line.endswith(f"so as random as they began: {named}")


def test_a_run_from_start_to_end(finished):
    directory, summary, table = finished
    assert {path.name for path in directory.iterdir()} >= {
        "config.json",
        "metrics.csv",
        "evaluations.csv",
        "summary.json",
        "curves.png",
        "replay.gif",
        "checkpoints",
    }
    assert (directory / "metrics.csv").read_text().splitlines()[0] == COLUMNS
    expected = [(a, s, e) for a in ("source", "transfer", "scratch") for e in "12" for s in "01"]
    assert [(r["arm"], r["seed"], r["epoch"]) for r in rows(directory)] == expected
    assert {r["env_steps"] for r in rows(directory)} == {"2000", "4000"}
    written = json.loads((directory / "summary.json").read_text())
    assert written == summary
    assert written["experiment"] == "toy"
    assert written["seeds"] == [0, 1]
    for arm in ("source", "transfer", "scratch"):
        assert written[arm]["env_steps"] == 4_000
        assert written[arm]["env_steps_per_second"] > 0
        for mode in ("sampled", "greedy"):
            assert len(written[arm]["evaluation"][mode]["steps_taken"]) == 2
    assert set(written["comparison"]["env_steps_to_threshold"]) == {"transfer", "scratch"}
    assert len(written["zero_shot"]["success"]) == 2
    assert "stages" not in written, "two stages leave the files they always left"
    for row in ("source", "zero shot", "transfer", "scratch", "shortest"):
        assert row in table


def test_the_clock_of_the_process_only_rises(finished):
    for arm in ("source", "transfer", "scratch"):
        clock = [float(r["cpu_seconds"]) for r in rows(finished[0]) if r["arm"] == arm]
        assert clock == sorted(clock)
        assert clock[0] > 0


def test_config_says_what_was_trained(finished):
    (source, transfer, _) = json.loads((finished[0] / "config.json").read_text())["experiment"][
        "stages"
    ]
    assert source["learner"]["learning_rate"] == LEARNER.learning_rate
    assert transfer["learner"]["learning_rate"] == LEARNER.learning_rate * LEARNER.transfer_rate
    assert transfer["learner"]["anneal_epochs"] == 2
    assert transfer["start"] == "source"


def test_the_table_marks_a_seed_that_stopped(finished):
    _, summary, _ = finished
    stop = {"seed": 1, "epoch": 12, "fault": "gradient became NaN"}
    records = {
        stage.name: {"result": summary[stage.name], "stops": [stop] * (stage.name == "transfer")}
        for stage in TOY.stages
    }
    names = [row["policy"] for row in table(TOY, summary, records)]
    assert "transfer (seed 1 stopped) 6x6" in names
    assert "scratch 6x6" in names


def test_a_finished_run_is_not_overwritten(finished):
    directory = finished[0]
    before = (directory / "summary.json").read_bytes()
    with pytest.raises(ValueError, match="holds a finished run"):
        run_experiment(TOY, directory)
    with pytest.raises(ValueError, match=r"holds a run with seeds \[0, 1\], not \[2\]"):
        run_experiment(replace(TOY, seeds=(2,)), directory)
    longer = (*TOY.stages[:2], replace(TOY.stages[2], epochs=3))
    with pytest.raises(ValueError, match=r"holds a run with scratch: epochs 2, not 3"):
        run_experiment(replace(TOY, stages=longer), directory)
    assert (directory / "summary.json").read_bytes() == before


def test_the_policy_of_a_run_can_be_used(finished):
    directory = finished[0]
    agent = load_agent(directory, seed=1)
    assert agent.env == LARGE, "of a run the last stage is meant"
    with pytest.raises(ValueError, match=r"has no seed 2; its seeds are 0, 1"):
        load_agent(directory, seed=2)


def test_a_stopped_run_goes_on_to_the_same_end_wherever_it_lies(finished, tmp_path, monkeypatch):
    whole = finished[0]
    with stopped_in("transfer", Stopped):
        run_experiment(TOY, tmp_path / "began")
    (tmp_path / "elsewhere").mkdir()
    shutil.move(tmp_path / "began", tmp_path / "elsewhere" / "again")
    monkeypatch.chdir(tmp_path / "elsewhere")
    run_experiment(TOY, "again")
    again = Path("again")
    assert without_clock(again) == without_clock(whole)
    first, second = (load_agent(directory).params for directory in (again, whole))
    for a, b in zip(*map(jax.tree.leaves, (first, second)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_source_made_elsewhere(finished, tmp_path):
    """A run is as good as its checkpoints, and is known by what it holds, not by its place."""
    whole = finished[0]
    shutil.copytree(whole / "checkpoints" / "source", tmp_path / "source")
    for start in (whole / "checkpoints" / "source", tmp_path / "source"):
        stages = (replace(TOY.stages[1], start=start),)
        experiment = replace(TOY, stages=stages)
        if start != tmp_path / "source":
            with stopped_in("transfer", Stopped):
                run_experiment(experiment, tmp_path / "target")
        else:
            run_experiment(experiment, tmp_path / "target")
    expected = [row for row in without_clock(whole) if row["arm"] == "transfer"]
    assert without_clock(tmp_path / "target") == expected
    summary = json.loads((tmp_path / "target" / "summary.json").read_text())
    assert summary["source"] is None
    assert summary["scratch"] is None


def test_a_stage_that_has_begun_needs_its_source_no_more(finished, tmp_path):
    shutil.copytree(finished[0] / "checkpoints" / "source", tmp_path / "source")
    experiment = replace(TOY, stages=(replace(TOY.stages[1], start=tmp_path / "source"),))
    with stopped_in("transfer", Stopped):
        run_experiment(experiment, tmp_path / "target")
    shutil.rmtree(tmp_path / "source")
    summary = run_experiment(experiment, tmp_path / "target")
    assert summary["transfer"]["epochs"] == 2


def test_a_source_alone_in_a_directory_of_any_name(tmp_path):
    directory = tmp_path / "pp[seed0] \\ *ü?"
    experiment = replace(TOY, stages=TOY.stages[:1])
    summary = run_experiment(experiment, directory)
    assert {row["arm"] for row in rows(directory)} == {"source"}
    assert summary["transfer"] is None
    assert load_agent(directory, seed=1).env == TOY.stages[0].env
    assert [path.name for path in tmp_path.iterdir()] == [directory.name], "no stray directory"


def test_a_second_run_in_the_same_directory_is_refused(tmp_path):
    busy = tmp_path / "busy"
    with (
        claimed(busy, described(TOY)),
        pytest.raises(ValueError, match="in use by another run"),
    ):
        run_experiment(TOY, busy)


LONG = PredatorPrey(size=(6, 12), num_predators=4, max_steps=30)
CHAIN = (
    Stage("3x3-2", StateUpsampled(SMALL, (6, 12)), 1, learner=LEARNER),
    Stage("6x6-3", StateUpsampled(LARGE, (6, 12)), 2, start="3x3-2", learner=LEARNER),
    Stage("6x12-4", LONG, 1, start="6x6-3", learner=LEARNER),
    Stage("scratch", LONG, 3, learner=LEARNER),
)


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    directory = tmp_path_factory.mktemp("chain") / "r"
    experiment = replace(TOY, stages=CHAIN, seeds=(0,), evaluate_every=0)
    with stopped_in("6x6-3", Stopped):
        run_experiment(experiment, directory, Where(chunk=1))
    return directory, run_experiment(experiment, directory, Where(chunk=1))


class TestChain:
    """Three stages: other teams, sides and step limits, and a rival with a budget of its own."""

    def test_summary_has_every_stage_and_what_it_cost(self, chain):
        directory, summary = chain
        assert json.loads((directory / "summary.json").read_text()) == summary
        assert [stage["name"] for stage in summary["stages"]] == ["3x3-2", "6x6-3", "6x12-4"]
        assert [stage["zero_shot"] is None for stage in summary["stages"]] == [True, False, False]
        for stage in summary["stages"]:
            assert stage["evaluation"]["sampled"]["episodes"] == 16
        assert summary["stages"][2]["task"]["fields"]["size"] == [6, 12]
        assert summary["cost"]["env_steps"] == [2_000, 4_000, 2_000]
        assert all(seconds > 0 for seconds in summary["cost"]["cpu_seconds"])
        assert summary["cost"]["total"]["env_steps"] == 8_000
        assert summary["scratch"]["env_steps"] == 6_000
        assert summary["source"]["env_steps"] == 2_000
        assert summary["transfer"] == {
            key: summary["stages"][2][key] for key in summary["transfer"]
        }

    def test_rows_are_named_after_the_stages(self, chain):
        arms = dict.fromkeys(row["arm"] for row in rows(chain[0]))
        assert list(arms) == ["3x3-2", "6x6-3", "6x12-4", "scratch"]

    def test_the_last_stage_is_the_policy_of_the_run(self, chain):
        assert load_agent(chain[0]).env == LONG
        first = load_agent(chain[0] / "checkpoints" / "3x3-2")
        assert first.env == CHAIN[0].env


def test_its_results_in_the_form_of_marl_eval(finished):
    """Environment, task, algorithm, seed, step; every step has the same metrics, each a list."""
    directory, summary, _ = finished
    found = marl_eval([directory])
    assert list(found) == ["PredatorPrey"]
    of_task = found["PredatorPrey"]["6x6, 3 agents"]
    assert set(of_task) == {"ic3net, transfer", "ic3net, scratch"}
    assert list(found["PredatorPrey"]["3x3, 2 agents, seen at 6x6"]) == ["ic3net, source"]
    for algorithm, of_seeds in of_task.items():
        assert list(of_seeds) == ["seed_0", "seed_1"]
        for place, of_seed in enumerate(of_seeds.values()):
            *steps, last = of_seed
            assert steps == [f"step_{i}" for i in range(len(steps))]
            assert last == "absolute_metrics"
            counts = [of_seed[step]["step_count"] for step in steps]
            times = [of_seed[step]["elapsed_time"] for step in steps]
            assert counts == sorted(set(counts))
            assert counts[-1] == 4_000
            assert times == sorted(times)
            metrics = {"steps_taken", "success", "return"}
            for step in steps:
                assert set(of_seed[step]) == {"step_count", "elapsed_time"} | metrics
                assert all(len(of_seed[step][name]) == 1 for name in metrics)
            role = algorithm.removeprefix("ic3net, ")
            evaluated = summary[role]["evaluation"]["sampled"]["steps_taken"]
            assert of_seed["absolute_metrics"]["steps_taken"] == [evaluated[place]]
    assert "step_0" in of_task["ic3net, transfer"]["seed_0"]
    assert of_task["ic3net, transfer"]["seed_0"]["step_0"]["step_count"] == 0, "zero shot"
