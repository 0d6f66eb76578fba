"""A stage ends by itself when its policy has stopped improving, and resumes to the same end."""

import json
from unittest.mock import Mock

import numpy as np
import pytest
from stopping import stopped_in

from sumajax.environments import PredatorPrey
from sumajax.experiment import Experiment, Stage, Still, chain, run_experiment
from sumajax.experiment.plan import described
from sumajax.experiment.run import Recorder, Where
from sumajax.learning import LearnerConfig
from sumajax.reporting.metrics import read_metrics
from sumajax.transfer import _chunk_length

RULE = Still(window=2, gain=0.1, success=0.9)
SOLVED = np.ones((1, 6))


def steps(*windows):
    """(1, 2 n) of one seed, two epochs a window."""
    return np.repeat(np.array([windows], float), 2, axis=1)


@pytest.mark.parametrize(
    ("curve", "still"),
    [
        (steps(20, 20, 20), True),
        (steps(20, 25, 19), True),  # by less than a tenth
        (steps(20, 17, 20), False),  # the window before the last improved
        (steps(20, 20, 18), False),  # the last one did, by a tenth
        (steps(20, 20), False),  # too short to tell
        (steps(20, 15, 15), False),
        (steps(20, 15, 15, 15), True),  # what counts is the best of all before
        (steps(20, 20, 20)[:, :5], False),  # looked at where a window ends alone
    ],
)
def test_a_seed_is_still_when_two_windows_bring_nothing(curve, still):
    assert RULE.holds(curve, np.ones_like(curve)) is still


def test_a_seed_that_does_not_succeed_is_not_still():
    success = SOLVED.copy()
    success[:, -1] = 0.7
    assert RULE.holds(steps(20, 20, 20), SOLVED)
    assert not RULE.holds(steps(20, 20, 20), success)


def test_a_stage_ends_when_all_its_seeds_are_still():
    curves = np.concatenate([steps(20, 20, 20), steps(20, 20, 15)])
    assert RULE.holds(curves[:1], SOLVED)
    assert not RULE.holds(curves, np.ones_like(curves))
    assert not RULE.holds(curves[:0], SOLVED[:0])


def rows(arm="a", seed=0, epochs=range(1, 7), steps_taken=5.0, success=1.0):
    values = {"arm": arm, "seed": seed, "steps_taken": steps_taken, "success": success}
    return [{**values, "epoch": epoch} for epoch in epochs]


def test_the_rule_reads_the_metrics_of_its_stage_as_far_as_it_has_come():
    assert RULE.ends(rows(), "a", [0], 6, max_steps=20)
    assert not RULE.ends(rows(arm="b"), "a", [0], 6, max_steps=20)
    ahead = [*rows(), *rows(epochs=[7, 8], steps_taken=1.0)]
    assert RULE.ends(ahead, "a", [0], 6, max_steps=20)
    assert not RULE.ends(ahead, "a", [0], 8, max_steps=20)
    both = [*rows(), *rows(seed=1, success=0.0)]
    assert not RULE.ends(both, "a", [0, 1], 6, max_steps=20)
    assert RULE.ends(both, "a", [0], 6, max_steps=20)


def test_an_epoch_in_which_no_episode_ended_is_a_failure():
    silent = [*rows(epochs=range(1, 6)), *rows(epochs=[6], steps_taken=np.nan, success=np.nan)]
    assert not RULE.ends(silent, "a", [0], 6, max_steps=20)


def test_what_is_compiled_ends_where_the_stage_is_looked_at():
    assert _chunk_length(20, 0, 5) == 5
    assert _chunk_length(20, 0, 5, looked_at=2) == 2
    assert _chunk_length(60, 0, 5, looked_at=10) == 5
    assert _chunk_length(20, 10, 5, looked_at=10) == 5


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"window": 0}, "window must be at least 1 epoch, got 0"),
        ({"gain": 2.0}, "gain must lie between 0 and 1, got 2.0"),
        ({"success": -0.1}, "success must lie between 0 and 1, got -0.1"),
    ],
)
def test_rules_that_are_none_are_refused(values, sentence):
    with pytest.raises(ValueError, match=sentence):
        Still(**values)


def test_a_chain_may_end_early_but_not_its_rival():
    task, rule = PredatorPrey(size=6, num_predators=3, max_steps=20), Still()
    stages = chain([task], ["a"], [9], LearnerConfig(), scratch_epochs=9, until=rule)
    assert [stage.until for stage in stages] == [rule, None]
    plan = described(Experiment(stages))
    assert [stage["until"] for stage in plan["stages"]] == [
        {"window": 10, "gain": 0.01, "success": 0.95},
        None,
    ]
    assert stages[0].trained_with.anneal_epochs == 9


ENDS_EARLY = Experiment(
    stages=(
        Stage(
            "a",
            PredatorPrey(size=3, num_predators=2, max_steps=10),
            12,
            learner=LearnerConfig(num_envs=100, rollout_length=20),
            until=Still(window=1, gain=1.0, success=0.0),
        ),
    ),
    policy_settings={"hidden": 8, "encoder": "linear"},
    evaluate_every=0,
    episodes=16,
)
"""Still as soon as there are three windows, since nothing improves by all there is."""


class Stopped(Exception):
    """Stands for whatever ends a run."""


def figures(directory):
    rows = read_metrics(directory / "metrics.csv")
    return [(row["epoch"], row["steps_taken"], row["value_loss"]) for row in rows]


def result_in(directory):
    return json.loads((directory / "stages.json").read_text())["a"]["result"]


def test_a_stage_that_is_still_ends_early_and_resumes_to_the_same_end(
    tmp_path, capsys, monkeypatch
):
    """Stopped once within an epoch, and once between its last checkpoint and its result."""
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    run_experiment(ENDS_EARLY, whole, Where(devices=1))
    assert "a: still after epoch 3 of 12." in "".join(capsys.readouterr())
    assert (result_in(whole)["epochs"], result_in(whole)["env_steps"]) == (3, 3 * 2_000)
    assert [epoch for epoch, *_ in figures(whole)] == [1, 2, 3]
    with stopped_in("a", Stopped):
        run_experiment(ENDS_EARLY, resumed, Where(devices=1))
    with monkeypatch.context() as patch:
        patch.setattr(Recorder, "_evaluate", Mock(side_effect=Stopped))
        with pytest.raises(Stopped):
            run_experiment(ENDS_EARLY, resumed, Where(devices=1))
    run_experiment(ENDS_EARLY, resumed, Where(devices=1))
    assert figures(resumed) == figures(whole)
    assert result_in(resumed)["evaluation"] == result_in(whole)["evaluation"]
