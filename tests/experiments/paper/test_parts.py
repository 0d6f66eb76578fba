"""Which parts a selection has, how long each is trained, and that each can be run."""

from dataclasses import replace
from typing import get_args

import pytest

from experiments.paper.arms import (
    ABLATIONS,
    SCRATCH,
    SOURCE,
    SOURCE_PLAIN,
    TRANSFER,
    TRANSFER_BRIEF,
    AblationName,
)
from experiments.paper.parts import (
    SELECTIONS,
    TABLE_1,
    Budget,
    Part,
    experiment_of,
    parts_of,
    unchanged_arms,
)
from experiments.paper.published import EXPERIMENTS
from experiments.paper.results import Results
from sumajax import StateUpsampled
from sumajax.experiment.run import Run, Where

from .rows import RESULTS

MASS, SHORT = (next(iter(ABLATIONS[name].variants.values())) for name in ("mass", "short-source"))


def test_every_selection_has_parts_in_order():
    for selection in SELECTIONS:
        parts = parts_of([selection], "fast")
        before = set()
        for part in parts:
            assert part.source is None or part.source in before
            before.add(part)
    everything = parts_of(SELECTIONS, "fast")
    assert len(set(everything)) == len(everything)
    assert Part("pcp-hetnet-2p1c", SOURCE) in parts_of(["pcp-hetnet-3p2c"], "fast")


def test_every_experiment_and_ablation_can_be_selected():
    assert (*EXPERIMENTS, "q1") == TABLE_1
    assert tuple(ABLATIONS) == get_args(AblationName)


def test_the_names_of_rows_belong_to_one_arm_each():
    arms = {part.arm for part in parts_of(SELECTIONS, "fast") + parts_of(SELECTIONS, "paper")}
    names = [arm.name for arm in arms]
    assert len(set(names)) == len(names)
    kept = Results.read(RESULTS)
    assert {row["arm"] for row in kept.rows["curves"]} == set(names)
    evaluated = {row["arm"] for row in kept.rows["evaluations"]} - set(names)
    assert evaluated == {arm.zero_shot for arm in arms if arm.zero_shot}


def test_budgets_of_parts():
    fast, paper = Budget("fast"), Budget("paper")
    scratch = Part("pp-ic3net", SCRATCH)
    assert (fast.epochs(scratch), paper.epochs(scratch)) == (125, 252)
    assert Budget("paper", scale=0.1).epochs(scratch) == 25
    assert Budget("paper", target=7).epochs(scratch) == 7
    assert fast.epochs(Part("pp-hetnet", TRANSFER)) == 150
    assert fast.epochs(Part("pp-hetnet", MASS)) == 60
    assert fast.epochs(Part("pp-hetnet", SHORT.start)) == 12
    assert paper.epochs(Part("pp-hetnet", MASS)) == paper.epochs(Part("pp-hetnet", TRANSFER))


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_an_ablation_is_compared_with_an_unchanged_arm_of_its_budget(preset):
    budget = Budget(preset)
    transferred = [part for part in parts_of(["encoder", "mass"], preset) if part.source]
    assert {part.experiment for part in transferred} == {"pp-ic3net", "pp-hetnet"}
    for part in transferred:
        unchanged = Part(part.experiment, unchanged_arms(part.experiment, preset)[0])
        assert unchanged in parts_of(["encoder"], preset)
        assert budget.epochs(part) == budget.epochs(unchanged)


def test_what_an_arm_says_is_what_its_stage_does():
    row = EXPERIMENTS["pp-hetnet"]
    upsampled = StateUpsampled(row.source, row.target.size)
    assert Part("pp-hetnet", SOURCE).env == upsampled
    assert Part("pp-hetnet", SOURCE_PLAIN).env == row.source
    assert Part("pp-hetnet", MASS.start).env == replace(upsampled, scale="mass")
    assert Part("pp-hetnet", TRANSFER_BRIEF).env == row.target
    (corner,) = ABLATIONS["corner"].variants.values()
    assert Part("pp-hetnet", corner.start).env == replace(upsampled, fill="corner")
    _, native, scratch = ABLATIONS["lab-gap"].variants.values()
    assert Part("pp-hetnet", native.start).env == row.source

    def made(arm):
        return experiment_of(Part("pp-hetnet", arm), Budget("fast"), (0, 1), None)

    assert made(TRANSFER).policy_settings == {}
    assert made(scratch).policy_settings == made(native).policy_settings == {"encoder": "lab_gap"}
    (optimiser,) = ABLATIONS["optimiser"].variants.values()
    (encoder,) = ABLATIONS["encoder"].variants.values()
    assert made(optimiser).stages[0].carry_optimiser
    assert made(encoder).stages[0].leave_out == ("state_encoder",)


@pytest.mark.parametrize("selection", SELECTIONS)
def test_every_part_is_a_run_that_is_accepted(selection, tmp_path):
    for part in parts_of([selection], "fast"):
        experiment = experiment_of(part, Budget("fast"), (0, 1), None)
        (stage,) = experiment.stages
        if part.source is not None:  # as one experiment with the part that it goes on from
            (source,) = experiment_of(part.source, Budget("fast"), (0, 1), None).stages
            stage = replace(stage, start=source.name)
            experiment = replace(experiment, stages=(source, stage))
        run = Run(experiment, tmp_path / "run", Where(devices=1))
        run.check()
        assert run.stage_run(stage).epochs == Budget("fast").epochs(part)
