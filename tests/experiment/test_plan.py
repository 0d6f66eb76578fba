"""A plan: stages that start from others, one target, refused before anything is trained."""

from dataclasses import replace
from pathlib import Path

import pytest

from sumajax.description import CheckpointError
from sumajax.environments import PredatorPrey
from sumajax.experiment import Experiment, Stage, chain
from sumajax.experiment.plan import described
from sumajax.learning import LearnerConfig, preset
from sumajax.upsampling import StateUpsampled

SMALL = PredatorPrey(size=3, num_predators=2, max_steps=10)
MIDDLE = PredatorPrey(size=6, num_predators=3, max_steps=20)
LARGE = PredatorPrey(size=12, num_predators=4, max_steps=30)
SEEN = [StateUpsampled(SMALL, 12), StateUpsampled(MIDDLE, 12), LARGE]
LEARNER = LearnerConfig()
STAGES = chain(SEEN, ["a", "b", "c"], [1, 2, 3], LEARNER, scratch_epochs=9)


def test_a_chain_starts_each_stage_from_the_one_before():
    assert [(s.name, s.start, s.epochs) for s in STAGES] == [
        ("a", None, 1),
        ("b", "a", 2),
        ("c", "b", 3),
        ("scratch", None, 9),
    ]


def test_roles_follow_from_where_stages_start_not_from_names():
    experiment = Experiment(STAGES)
    assert experiment.target.name == "c"
    assert [stage.name for stage in experiment.chain] == ["a", "b", "c"]
    assert experiment.scratch is not None
    assert experiment.scratch.name == "scratch"
    renamed = Experiment((*STAGES[:3], replace(STAGES[3], name="zeta")))
    assert renamed.scratch is not None
    assert renamed.scratch.name == "zeta"
    other_task = Experiment((*STAGES[:3], replace(STAGES[3], env=SEEN[1])))
    assert other_task.scratch is None


def test_all_stages_are_evaluated_on_the_way_but_the_first_of_a_chain():
    experiment = Experiment(STAGES, evaluate_every=5)
    every = {stage.name: experiment.evaluates_every(stage) for stage in STAGES}
    assert every == {"a": 0, "b": 5, "c": 5, "scratch": 5}
    assert Experiment(STAGES[:1], evaluate_every=5).evaluates_every(STAGES[0]) == 5


def test_one_stage_is_its_own_target():
    experiment = Experiment(STAGES[:1])
    assert experiment.target.name == "a"
    assert experiment.scratch is None


def test_checkpoints_made_elsewhere_begin_a_chain():
    (stage,) = chain([LARGE], ["c"], [1], LEARNER, start=Path("somewhere"))
    experiment = Experiment((stage,))
    assert experiment.chain == (stage,)
    assert stage.trained_with.learning_rate == LEARNER.learning_rate * LEARNER.transfer_rate


def test_stages_of_one_plan_may_learn_differently():
    slow = replace(LEARNER, learning_rate=1e-4, anneal_epochs=0)
    stages = (STAGES[0], replace(STAGES[1], learner=slow))
    trained = [stage["learner"] for stage in described(Experiment(stages))["stages"]]
    assert trained[0]["anneal_epochs"] == 1
    assert trained[1]["anneal_epochs"] == 0
    assert trained[1]["learning_rate"] == 1e-4 * LEARNER.transfer_rate


def test_preset_paper_is_not_annealed_and_transfers_at_its_full_rate():
    stage = replace(STAGES[1], learner=preset("paper", "ic3net"))
    assert stage.trained_with == replace(stage.learner, transfer_rate=1.0)


@pytest.mark.parametrize(
    ("stages", "sentence"),
    [
        ((), "needs stages of distinct names"),
        ((STAGES[0], STAGES[0]), "needs stages of distinct names"),
        (STAGES[1:], "stage b starts from 'a', which is no earlier stage"),
        ((STAGES[1], STAGES[0]), "which is no earlier stage"),
    ],
)
def test_stages_that_do_not_follow_are_refused(stages, sentence):
    with pytest.raises(ValueError, match=sentence):
        Experiment(stages)


@pytest.mark.parametrize("name", ["", "../up", "a/b", "a b", ".hidden", "x" * 101])
def test_names_that_are_no_file_names_are_refused(name):
    with pytest.raises(ValueError, match="stage name"):
        Stage(name, SMALL, 1)


def test_parameters_that_do_not_fit_the_next_stage_are_refused():
    stages = chain([SMALL, LARGE], ["a", "b"], [1, 1], LEARNER)
    with pytest.raises(CheckpointError, match="the policy's grid differs: 3x3 in the a stage"):
        Experiment(stages).check()
    Experiment(STAGES).check()
