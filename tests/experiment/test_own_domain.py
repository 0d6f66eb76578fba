"""The line domain and the reflex policy of docs/extending.md through a whole experiment."""

import re
import sys
import types
from dataclasses import replace
from pathlib import Path

import jax
import pytest
from stopping import stopped_in

from sumajax import load_agent
from sumajax.description import CheckpointError
from sumajax.evaluation import evaluate
from sumajax.experiment import Experiment, Stage, run_experiment
from sumajax.learning import LearnerConfig
from sumajax.policies import Policy, TeamSpec
from sumajax.upsampling import StateUpsampled

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
LEARNER = LearnerConfig(num_envs=100, rollout_length=10)


class Stopped(Exception):
    """Stands for whatever ends a run in its middle."""


@pytest.fixture(scope="module")
def mine():
    """A program with the definitions of the page: those blocks that begin with them."""
    module = types.ModuleType("mine")
    sys.modules["mine"] = module
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    for block in blocks:
        if "class Line" in block:
            exec(block, module.__dict__)
        if "class Reflex" in block:
            exec(block.split("\n\npolicy = ")[0], module.__dict__)
    yield module
    del sys.modules["mine"]


@pytest.fixture(scope="module")
def finished(mine, tmp_path_factory):
    """A run of two stages that was stopped in the second one, and went on."""
    small, large = mine.Line(4, max_steps=8), mine.Line(8, max_steps=16)
    experiment = Experiment(
        stages=(
            Stage("short", StateUpsampled(small, (1, 8)), 1, learner=LEARNER),
            Stage("long", large, 1, start="short", learner=LEARNER),
        ),
        policy=Policy("reflex", mine.Reflex(TeamSpec.of(large), hidden=8)),
        name="lines",
        episodes=16,
    )
    directory = tmp_path_factory.mktemp("own") / "run"
    with stopped_in("long", Stopped):
        run_experiment(experiment, directory)
    return directory, experiment, run_experiment(experiment, directory)


def test_it_is_evaluated_before_and_after_each_stage(finished):
    _, _, summary = finished
    assert summary["policy"] == "reflex"
    assert summary["source"]["env_steps"] == summary["transfer"]["env_steps"] == 2_000
    for evaluation in (summary["zero_shot"], summary["transfer"]["evaluation"]["greedy"]):
        assert evaluation["episodes"] == 16
    assert summary["references"]["long"]["shortest_path_steps"] is None


def test_a_domain_without_anything_to_draw_has_no_replay(finished):
    directory, _, _ = finished
    assert (directory / "curves.png").exists()
    assert not (directory / "replay.gif").exists()


def test_it_is_loaded_by_object_and_acts(finished):
    directory, experiment, _ = finished
    env = experiment.target.env
    agent = load_agent(directory, env=env, policy=experiment.policy)
    assert evaluate(env, agent.policy, agent.params, jax.random.key(0), episodes=8)

    @jax.jit
    def acted(start, key):
        return agent.act(agent.initial_carry(), env.observe(env.reset(start)), key)[1]

    action = acted(*jax.random.split(jax.random.key(1)))
    assert action.shape == (2,)


def test_without_the_objects_the_error_says_so(finished):
    with pytest.raises(CheckpointError, match=r"pass env=\.\.\. and policy=\.\.\. to load_agent"):
        load_agent(finished[0])
    with pytest.raises(CheckpointError, match=r"policy 'reflex' is not one of .*policy="):
        load_agent(finished[0], env=finished[1].target.env)


def test_objects_that_do_not_fit_are_refused(finished, mine):
    directory, experiment, _ = finished
    with pytest.raises(CheckpointError, match="the policy's grid differs"):
        load_agent(directory, env=mine.Line(5), policy=experiment.policy)
    wide = Policy("reflex", mine.Reflex(TeamSpec.of(experiment.target.env), hidden=9))
    with pytest.raises(CheckpointError, match="policy setting hidden differs: 8 in"):
        load_agent(directory, env=experiment.target.env, policy=wide)


def test_another_plan_does_not_go_on_there(finished):
    directory, experiment, _ = finished
    with pytest.raises(ValueError, match=r"holds a run with seeds \[0\], not \[3\]"):
        run_experiment(replace(experiment, seeds=(3,)), directory)
