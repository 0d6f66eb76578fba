"""The program on a toy scale: trains, plays at every limit, keeps, and runs nothing twice."""

import json
from dataclasses import replace

import numpy as np
import pytest

from experiments import studies
from experiments.scaling import program, runs
from experiments.scaling.plans import Study, chain_of, with_scratch
from experiments.scaling.program import Options, run
from experiments.scaling.results import Results
from sumajax.environments import PredatorPrey
from sumajax.learning import LearnerConfig, config
from sumajax.upsampling import StateUpsampled

LEARNER = LearnerConfig(num_envs=100, rollout_length=20, scale_by_size=False)
SMALL = PredatorPrey(size=3, num_predators=2, max_steps=10)
LARGE = PredatorPrey(size=6, num_predators=3, max_steps=20)
TOY = Study(
    "toy-ic3net",
    "rect",
    "ic3net",
    "chain",
    with_scratch(chain_of([StateUpsampled(SMALL, 6), LARGE], (1, 1), LEARNER)),
    {"hidden": 8, "encoder": "linear"},
)
EPISODES = 16


@pytest.fixture
def options(monkeypatch, tmp_path):
    monkeypatch.setattr(Options, "studies", [TOY])
    monkeypatch.setattr(program, "REPLAYED", TOY.name)
    monkeypatch.setattr(config, "EPOCH_STEPS", 2_000)  # one update of the toy's
    monkeypatch.setattr(runs, "limits", lambda task: (task.max_steps // 2, task.max_steps))
    return Options(output=tmp_path / "results", runs=tmp_path / "runs")


def test_from_training_to_tables_and_nothing_twice(options, monkeypatch):
    run(options, EPISODES)
    results = Results.read(options.output)
    assert [row["stage"] for row in results.rows["stages"]] == ["3x3", "6x6", "scratch"]
    assert [row["env_steps"] for row in results.rows["stages"]] == [2_000, 2_000, 4_000]
    assert {row["after"] for row in results.rows["stages"]} == {"", "3x3"}
    assert all(row["cpu_seconds"] > 0 for row in results.rows["curves"])
    played = results.rows["held_out"]
    assert {(r["stage"], r["when"], r["task"]) for r in played} == {
        ("3x3", "end", "3x3 2P"),
        ("6x6", "zero shot", "6x6 3P"),
        ("6x6", "end", "6x6 3P"),
        ("6x6", "elsewhere", "3x3 2P"),
        ("scratch", "end", "6x6 3P"),
    }
    assert {(r["mode"], r["limit"]) for r in played if r["when"] == "zero shot"} == {
        (mode, limit) for mode in ("sampled", "greedy") for limit in (10, 20)
    }
    shorter, longer = (
        [r for r in played if (r["stage"], r["mode"], r["limit"]) == ("scratch", "sampled", limit)]
        for limit in (10, 20)
    )
    assert shorter[0]["steps_taken"] <= min(10, longer[0]["steps_taken"])
    assert shorter[0]["success"] <= longer[0]["success"]
    (file,) = (options.output / "provenance").iterdir()
    known = json.loads(file.read_text())
    assert known["plan"]["stages"][0]["learner"]["num_envs"] == 100
    assert {"command", "commit", "versions", "machine"} <= set(known["sessions"][0])
    assert (options.output / "replay-toy-ic3net.gif").exists()
    text = (options.output / "tables.md").read_text()

    def no_more(*args, **kwargs):
        raise AssertionError("nothing is left to do")

    monkeypatch.setattr(studies, "run_experiment", no_more)
    monkeypatch.setattr(runs, "evaluate", no_more)
    run(options, EPISODES)
    run(replace(options, rebuild=True), EPISODES)
    assert (options.output / "tables.md").read_text() == text
    assert len(json.loads(file.read_text())["sessions"]) == 1


def test_a_seed_without_an_end_is_told_of_and_the_others_go_on(options, monkeypatch, capsys):
    def stops(*args):
        raise program.StoppedError("no seed of the 3x3 stage is left")

    monkeypatch.setattr(program, "finish", stops)
    with pytest.raises(ValueError, match="holds no results; run a part first"):
        run(options, EPISODES)
    assert "toy-ic3net, seeds 0: no seed of the 3x3 stage is left" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"parts": ("pp30",)}, "part 'pp30' is unknown; choose one of pp10, pp20"),
        ({"policies": ("dqn",)}, "policy 'dqn' is unknown; choose one of hetnet"),
        ({"only": ("pp10-hetnet",)}, "experiment 'pp10-hetnet' is unknown; choose one of pp20-"),
        ({"devices": 0}, "devices must lie between 1 and"),
        ({"seeds": (1, 1)}, "seeds must be distinct"),
    ],
)
def test_options_that_mean_nothing_are_refused(given, sentence):
    with pytest.raises(ValueError, match=sentence):
        Options(**given)


def test_one_experiment_of_a_part_can_be_run_alone():
    options = Options(parts=("rivals",), only=("rivals-blank-hetnet",))
    assert [study.name for study in options.studies] == ["rivals-blank-hetnet"]
    assert np.isin(options.studies[0].words, "no position at all")
