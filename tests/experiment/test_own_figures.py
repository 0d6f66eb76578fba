"""A domain with figures of merit of its own, from training to every file that shows them."""

import contextlib
import io
import json

import jax
import numpy as np
import pytest
from drawn import drawn_parameters

from sumajax.cli import evaluate as program
from sumajax.environments import PredatorPrey, TrafficJunction
from sumajax.evaluation import evaluate, load_agent
from sumajax.experiment import Experiment, Stage, run_experiment
from sumajax.experiment.records import EVALUATION_SEED
from sumajax.learning import LearnerConfig
from sumajax.policies import make_policy
from sumajax.upsampling import StateUpsampled

SMALL = TrafficJunction("easy", 6, num_cars=3, max_steps=9)
LARGE = TrafficJunction("medium", 14, num_cars=3, max_steps=16)
FIGURES = ("collisions_per_car", "mean_delay", "cars_through")
EPISODES = 16


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A toy run's directory, summary and table."""
    learner = LearnerConfig(num_envs=100, rollout_length=20)
    experiment = Experiment(
        stages=(
            Stage("source", StateUpsampled(SMALL, 14), 1, learner=learner),
            Stage("transfer", LARGE, 1, start="source", learner=learner),
        ),
        policy="commnet",
        policy_settings={"hidden": 4, "encoder": "linear"},
        threshold=0.001,
        episodes=EPISODES,
    )
    directory, printed = tmp_path_factory.mktemp("run") / "tj", io.StringIO()
    with contextlib.redirect_stdout(printed):
        summary = run_experiment(experiment, directory)
    return directory, summary, printed.getvalue()


def test_they_stand_beside_what_every_evaluation_has(run):
    _, summary, printed = run
    for role in ("source", "transfer"):
        for figures in summary[role]["evaluation"].values():
            assert set(FIGURES) < set(figures)
    for name in FIGURES:
        assert len(summary["zero_shot"][name]) == 1
        assert name.replace("_", " ") in printed
    sampled = summary["transfer"]["evaluation"]["sampled"]
    assert sampled["steps_taken"] == [LARGE.max_steps]


def test_they_are_all_amounts_over_all_counts(run):
    """Not a mean of episodes' means: an episode with few cars weighs little."""
    directory, summary, _ = run
    agent = load_agent(directory)
    key = jax.random.key(EVALUATION_SEED)
    result = evaluate(agent.env, agent.policy, agent.params, key, episodes=EPISODES)
    amount, count = np.asarray(result.measured).sum(0).T
    sampled = summary["transfer"]["evaluation"]["sampled"]
    np.testing.assert_allclose([sampled[name][0] for name in FIGURES], amount / count)
    assert count[2] == EPISODES
    assert count[0] == count[1] > amount[2]  # who is through has come


def test_solved_is_by_success_where_all_episodes_last_as_long(run):
    _, summary, _ = run
    comparison = summary["comparison"]
    assert comparison["merit"] == "success"
    assert comparison["threshold"] == 0.001


def test_sumajax_evaluate_shows_them(run, tmp_path, capsys):
    directory, summary, _ = run
    out = tmp_path / "all.json"
    options = program.EvaluateConfig(
        directory, episodes=EPISODES, modes=("sampled",), json=out, arms=("transfer",)
    )
    program.run_evaluation(options)
    (entry,) = json.loads(out.read_text())["tasks"]
    shown = entry["policies"]["transfer"]["sampled"]
    assert shown == summary["transfer"]["evaluation"]["sampled"]
    said = capsys.readouterr().out
    assert entry["label"] == "14x14, 3"
    for name in FIGURES:
        assert f"sampled, {name.replace('_', ' ')}" in said


def test_a_domain_without_any_is_as_it_was():
    env = PredatorPrey(size=3, num_predators=2, max_steps=4)
    policy = make_policy("iric", env, hidden=4, encoder="linear")
    params = drawn_parameters(policy)
    result = evaluate(env, policy, params, jax.random.key(1), episodes=4)
    assert result.measured.shape == (4, 0, 2)
    assert result.figures(env) == {}
