"""The whole experiment on a toy scale: its files, its table, going on after a stop, refusing."""

import contextlib
import csv
import io
import json
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from pp_transfer import PPTransfer
from stopping import stopped_in

from sumajax import evaluate, load_agent
from sumajax.environments import PredatorPrey
from sumajax.experiment import run as transfer_run
from sumajax.experiment.directory import claimed
from sumajax.learning import LearnerConfig
from sumajax.policies import make_policy

COLUMNS = (
    "arm,seed,epoch,env_steps,seconds,steps_taken,success,return,entropy,policy_loss,value_loss,"
    "gradient_norm,communication"
)


class Stopped(Exception):
    """Stands for whatever ends a run in its middle."""


@pytest.fixture(autouse=True, scope="module")
def small():
    """A small policy and few held-out episodes: the same program in seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            transfer_run, "make_policy", lambda name, env: make_policy(name, env, hidden=8)
        )
        patch.setattr(transfer_run, "evaluate", partial(evaluate, episodes=16))
        yield


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    return PPTransfer(
        source=PredatorPrey(size=3, num_predators=2, max_steps=10),
        target=PredatorPrey(size=6, num_predators=3, max_steps=20),
        seeds=(0, 1),
        source_epochs=2,
        target_epochs=2,
        evaluate_every=1,
        devices=1,
        learner=LearnerConfig(num_envs=100, rollout_length=20),
        output=tmp_path_factory.mktemp("runs") / "toy",
    )


@pytest.fixture(scope="module")
def finished(toy):
    """What the run of `toy` returned and printed, after its end."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        summary = transfer_run.run_experiment(toy)
    return summary, printed.getvalue()


def rows(directory):
    with open(directory / "metrics.csv") as file:
        return list(csv.DictReader(file))


def without_clock(directory):
    return [{name: row[name] for name in row if name != "seconds"} for row in rows(directory)]


def test_the_rate_is_lower_after_a_transfer(toy):
    run = transfer_run.Run.of(toy)
    arms = ("source", "transfer", "scratch")
    rates = {arm: run.stage(arm).learner.config.learning_rate for arm in arms}
    full = toy.learner.learning_rate
    assert rates == {"source": full, "transfer": toy.learner.transfer_rate * full, "scratch": full}
    assert rates["transfer"] < full


def test_a_run_from_start_to_end(toy, finished):
    summary, table = finished
    directory = toy.directory
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
    assert {r["env_steps"] for r in rows(directory)} == {"20000", "40000"}
    written = json.loads((directory / "summary.json").read_text())
    assert written["experiment"] == "pp_transfer"
    assert written["seeds"] == [0, 1]
    for arm in ("source", "transfer", "scratch"):
        assert written[arm]["env_steps"] == 40_000
        assert written[arm]["env_steps_per_second"] > 0
        for mode in ("sampled", "greedy"):
            assert len(written[arm]["evaluation"][mode]["steps_taken"]) == 2
    assert set(written["comparison"]["env_steps_to_threshold"]) == {"transfer", "scratch"}
    assert len(written["zero_shot"]["success"]) == 2
    assert summary["arms"]["source"]["epochs"] == 2
    for row in ("source", "zero shot", "transfer", "scratch", "shortest"):
        assert row in table


@pytest.mark.usefixtures("finished")
def test_the_table_marks_a_seed_that_stopped(toy):
    summary = json.loads((toy.directory / "summary.json").read_text())
    arms = {arm: summary[arm] for arm in ("source", "transfer", "scratch")}
    stops = {"transfer": [{"seed": 1, "epoch": 12, "fault": "gradient became NaN"}]}
    rows = transfer_run.table(transfer_run.Run.of(toy), {**summary, "arms": arms, "stops": stops})
    names = [row["policy"] for row in rows]
    assert "transfer (seed 1 stopped) 6x6" in names
    assert "scratch 6x6" in names


@pytest.mark.usefixtures("finished")
def test_a_finished_run_is_not_overwritten(toy):
    before = (toy.directory / "summary.json").read_bytes()
    with pytest.raises(ValueError, match="holds a finished run"):
        transfer_run.run_experiment(toy)
    with pytest.raises(ValueError, match=r"holds a run with seeds \[0, 1\], not \[2\]"):
        transfer_run.run_experiment(replace(toy, seeds=(2,)))
    assert (toy.directory / "summary.json").read_bytes() == before


@pytest.mark.usefixtures("finished")
def test_the_policy_of_a_run_can_be_used(toy):
    agent = load_agent(toy.directory, seed=1)
    assert agent.env == toy.target
    with pytest.raises(ValueError, match="holds 2 seeds; there is no seed 2"):
        load_agent(toy.directory, seed=2)


@pytest.mark.usefixtures("finished")
def test_a_stopped_run_goes_on_to_the_same_end(toy, tmp_path):
    whole = without_clock(toy.directory)
    again = replace(toy, output=tmp_path / "again")
    with stopped_in("transfer", Stopped):
        transfer_run.run_experiment(again)
    transfer_run.run_experiment(again)
    assert without_clock(again.directory) == whole
    first, second = (load_agent(t.directory).params for t in (toy, again))
    for a, b in zip(*map(jax.tree.leaves, (first, second)), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.usefixtures("finished")
def test_a_source_made_elsewhere(toy, tmp_path):
    target_only = replace(
        toy,
        source_checkpoint=toy.directory / "checkpoints" / "source",
        scratch=False,
        output=tmp_path / "target",
    )
    transfer_run.run_experiment(target_only)
    whole = [row for row in without_clock(toy.directory) if row["arm"] == "transfer"]
    assert without_clock(target_only.directory) == whole
    summary = json.loads((target_only.directory / "summary.json").read_text())
    assert summary["source"] is None
    assert summary["scratch"] is None


def test_a_source_alone(toy, tmp_path):
    source_only = replace(toy, target_epochs=0, output=tmp_path / "source")
    transfer_run.run_experiment(source_only)
    assert {row["arm"] for row in rows(source_only.directory)} == {"source"}


def test_a_second_run_in_the_same_directory_is_refused(toy, tmp_path):
    config = replace(toy, output=tmp_path / "busy")
    with claimed(config), pytest.raises(ValueError, match="in use by another run"):
        transfer_run.run_experiment(config)
