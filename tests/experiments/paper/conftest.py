"""An experiment of the paper on a toy scale."""

from dataclasses import replace

import pytest

from experiments.paper import program
from experiments.paper.parts import experiment_of
from experiments.paper.program import Options
from experiments.paper.published import EXPERIMENTS
from sumajax.environments import PredatorPrey
from sumajax.learning import LearnerConfig

QUICK = LearnerConfig(num_envs=100, rollout_length=20)


def small_experiment_of(*args):
    """The part's experiment with a small policy, quick updates and few held-out episodes."""
    experiment = experiment_of(*args)
    stages = tuple(replace(stage, learner=QUICK) for stage in experiment.stages)
    return replace(experiment, stages=stages, policy_settings={"hidden": 8}, episodes=16)


@pytest.fixture
def tiny(monkeypatch, tmp_path):
    """The first experiment in seconds, its runs and results in `tmp_path`, no report of them."""
    row = replace(
        EXPERIMENTS["pp-ic3net"],
        source=PredatorPrey(size=3, num_predators=2, max_steps=10),
        target=PredatorPrey(size=6, num_predators=3, max_steps=20),
    )
    monkeypatch.setitem(EXPERIMENTS, "pp-ic3net", row)
    monkeypatch.setattr(program, "experiment_of", small_experiment_of)
    monkeypatch.setattr(program, "write_report", lambda results: None)
    return Options(
        experiments=("pp-ic3net",),
        seeds=(0,),
        source_epochs=1,
        target_epochs=1,
        devices=1,
        output=tmp_path / "results",
        runs=tmp_path / "runs",
    )
