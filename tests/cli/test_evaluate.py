"""Evaluating what a run left: every policy on every task, files, mistakes in one sentence."""

import json

import jax
import numpy as np
import pytest
from drawn import drawn_parameters
from PIL import Image

from sumajax import checkpoint, load_agent
from sumajax.cli import evaluate as program
from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.evaluation import evaluate
from sumajax.policies import make_policy
from sumajax.upsampling import StateUpsampled

SMALL = PredatorPrey(size=3, num_predators=2, max_steps=6)
LARGE = PredatorPrey(size=6, num_predators=2, max_steps=8)
PCP = PredatorCapturePrey(size=3, num_predators=1, num_capturers=1, max_steps=6)
FEW = 8


def save(directory, env, arm, seeds=(0, 4)):
    """A checkpoint of untrained policies, as a stage writes it."""
    policy = make_policy("ic3net", env, hidden=4, encoder="linear")
    params = [drawn_parameters(policy, seed) for seed in seeds]
    state = {"params": jax.tree.map(lambda *leaves: np.stack(leaves), *params)}
    meta = checkpoint.describe(env, policy, arm=arm, seeds=list(seeds), epoch=3)
    return checkpoint.save(directory, state, meta)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """No config.json: only task and policy in the checkpoints count."""
    directory = tmp_path_factory.mktemp("run")
    save(directory / "checkpoints" / "source", StateUpsampled(SMALL, 6), "source")
    save(directory / "checkpoints" / "transfer", LARGE, "transfer")
    return directory


@pytest.fixture(scope="module")
def pcp(tmp_path_factory):
    directory = tmp_path_factory.mktemp("pcp")
    save(directory, PCP, "transfer", seeds=(0,))
    return directory


def evaluated(path, **options):
    return program.run_evaluation(program.EvaluateConfig(path, episodes=FEW, **options))


def test_every_policy_on_the_tasks_of_the_run(run, tmp_path, capsys):
    report = evaluated(run, json=tmp_path / "all.json")
    assert [entry["label"] for entry in report["tasks"]] == ["3x3, 2", "6x6, 2"]
    assert list(report["policies"]) == ["transfer", "source"]
    assert report["policies"]["source"] == {
        "trained_on": "3x3, 2",
        "policy": "ic3net",
        "epoch": 3,
        "seeds": [0, 4],
    }
    for entry in report["tasks"]:
        for of_mode in entry["policies"].values():
            for figures in of_mode.values():
                assert figures["episodes"] == FEW
                assert len(figures["steps_taken"]) == len(figures["success"]) == 2
                assert min(figures["steps_taken"]) >= entry["shortest_path_steps"]
    assert json.loads((tmp_path / "all.json").read_text()) == report
    said = capsys.readouterr().out
    assert "…" not in said, "nothing is cut off at 80 columns"
    for text in ("transfer", "source", "3x3, 2", "greedy", "sampled", "bound"):
        assert text in said


def test_figures_are_those_of_the_package(run):
    report = evaluated(run, arms=("source",), sizes=("3",), seeds=(4,), modes=("greedy",))
    agent = load_agent(run / "checkpoints" / "source", seed=4)
    expected = evaluate(
        agent.env, agent.policy, agent.params, jax.random.key(7), episodes=FEW, greedy=True
    )
    (entry,) = report["tasks"]
    assert entry["policies"]["source"]["greedy"]["steps_taken"] == [
        pytest.approx(float(expected.steps_taken.mean()))
    ]
    assert list(entry["policies"]["source"]) == ["greedy"]


def test_every_grid_with_every_team(run):
    options = program.EvaluateConfig(run, sizes=("3", "6", "2x3"), teams=("1", "3"), max_steps=5)
    tasks = program.tasks_of(options, program.load(options))
    assert [program.label(task) for task in tasks] == [
        f"{grid}, {team}" for grid in ("3x3", "6x6", "2x3") for team in (1, 3)
    ]
    assert {task.max_steps for task in tasks} == {5}


def test_a_grid_of_the_run_keeps_its_step_limit(run):
    options = program.EvaluateConfig(run, sizes=("3", "2"), teams=("3",))
    assert [t.max_steps for t in program.tasks_of(options, program.load(options))] == [6, 8]


def test_one_checkpoint_alone(run, capsys):
    for path in (run / "checkpoints" / "transfer", *(run / "checkpoints" / "transfer").iterdir()):
        report = evaluated(path, seeds=(0,), modes=("sampled",))
        assert list(report["policies"]) == ["transfer"]
        assert [entry["label"] for entry in report["tasks"]] == ["6x6, 2"]
        assert capsys.readouterr().out


def test_capture_agents(pcp, capsys):
    report = evaluated(pcp, teams=("2+1",), modes=("sampled",))
    assert report["tasks"][0]["label"] == "3x3, 2+1"
    assert "3x3, 2+1" in capsys.readouterr().out


@pytest.mark.parametrize(("name", "kind"), [("a.gif", "GIF"), ("a.png", "PNG")])
def test_replay(run, tmp_path, name, kind):
    evaluated(
        run, arms=("transfer",), sizes=("3",), modes=("greedy",), seeds=(0,), replay=tmp_path / name
    )
    with Image.open(tmp_path / name) as image:
        assert image.format == kind


BAD = {
    "nothing there": (["{tmp}/none"], "{tmp}/none is no directory of a run or of checkpoints"),
    "not a run": (["{tmp}/other"], "{tmp}/other"),
    "unknown arm": (["{run}", "--arms", "best"], "has no arm 'best'; it has transfer, source"),
    "arm of one policy": (["{pcp}", "--arms", "source"], "is one policy; --arms is for a whole"),
    "unknown seed": (["{run}", "--seeds", "1"], "holds seeds [0, 4], not 1"),
    "size does not divide": (["{run}", "--sizes", "4"], "sees a 6x6 grid, and 4x4 does not divide"),
    "too large": (["{run}", "--sizes", "12"], "policy transfer sees a 6x6 grid, and 12x12"),
    "no size": (["{run}", "--sizes", "big"], "size 'big' is no side of a grid"),
    "no team": (["{run}", "--teams", "-1"], "team '-1' is no number of agents"),
    "too many": (["{run}", "--sizes", "3", "--teams", "30"], "30 agents and a prey need 31"),
    "capture": (
        ["{run}", "--teams", "3+2"],
        "team 3+2 has 2 numbers, and PredatorPrey has predators",
    ),
    "which": (
        ["{pcp}", "--teams", "3"],
        "team 3 has 1 numbers, and PredatorCapturePrey has",
    ),
    "episodes": (["{run}", "--episodes", "0"], "episodes must be 1 to 65536, got 0"),
    "step limit": (["{run}", "--max-steps", "0"], "max_steps must be at least 1, got 0"),
    "existing": (["{run}", "--json", "{tmp}/mine.json"], "mine.json exists; choose another --json"),
    "no folder": (["{run}", "--json", "{tmp}/a/b.json"], "{tmp}/a is no directory; make it or"),
    "no picture": (["{run}", "--replay", "{tmp}/a.txt"], "replay a.txt must end in .gif, or .png"),
}


@pytest.mark.parametrize(("arguments", "sentence"), BAD.values(), ids=BAD)
def test_a_mistake_gets_one_sentence(arguments, sentence, run, pcp, tmp_path, monkeypatch, capsys):
    (tmp_path / "other").mkdir()
    (tmp_path / "mine.json").write_text("mine")
    monkeypatch.setattr(program, "keep_compiled", lambda: None)
    names = {"tmp": tmp_path, "run": run, "pcp": pcp}
    arguments = [argument.format(**names) for argument in arguments]
    with pytest.raises(SystemExit) as stop:
        program.main(arguments)
    said = capsys.readouterr().err.strip().splitlines()
    assert stop.value.code == 2
    assert len(said) == 1
    assert said[0].startswith("error: ")
    assert sentence.format(**names) in said[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.json", "other"]
    assert (tmp_path / "mine.json").read_text() == "mine"


def test_help_is_readable(capsys):
    with pytest.raises(SystemExit) as stop:
        program.main(["--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0
    for option in ("PATH", "--sizes", "--teams", "--arms", "--seeds", "--json", "--replay"):
        assert option in text


def test_a_corner_source_is_evaluated_as_a_corner(tmp_path):
    """In the wrapper that it was trained in, whatever the task."""
    corner = StateUpsampled(SMALL, 6, fill="corner")
    save(tmp_path / "corner", corner, "source", seeds=(0,))
    (trained,) = program.load(program.EvaluateConfig(tmp_path / "corner"))
    assert trained.on(SMALL)[0] == corner
    other = PredatorPrey(size=2, num_predators=2)
    assert trained.on(other)[0] == StateUpsampled(other, 6, fill="corner")
