"""What the study trains: equal steps for rivals, one learner, settings by rules alone."""

import jax
import numpy as np
import pytest

from experiments.scaling import plans
from experiments.scaling.plans import PARTS, PP, RIVALS, VARIANTS, Study, limits, studies
from experiments.scaling.results import task_label
from experiments.scaling.rivals import BlankState
from sumajax.environments import PredatorPrey
from sumajax.environments.states import listed_states
from sumajax.environments.wrapper import unwrapped
from sumajax.experiment.plan import described
from sumajax.learning import preset
from sumajax.policies.encoder import StateEncoder
from sumajax.upsampling import StateUpsampled

STUDIES = [study for part in PARTS for study in studies(part)]


def chain(study: Study):
    return study.experiment([0]).chain


def steps(stages):
    return sum(stage.epochs for stage in stages)


def is_scratch(study: Study) -> bool:
    return [stage.name for stage in study.stages] == [plans.SCRATCH]


def test_names_are_of_one_experiment_each_and_of_files():
    names = [study.name for study in STUDIES]
    assert len(set(names)) == len(names)
    assert all(set(name) <= set("abcdefghijklmnopqrstuvwxyz0123456789-") for name in names)


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.name)
def test_a_plan_fits_together_and_ends_on_its_target(study):
    experiment = study.experiment([0, 1])
    experiment.check()
    assert described(experiment)["seeds"] == [0, 1]
    assert experiment.target.env == experiment.chain[-1].env
    from_nothing = study.name.startswith("rivals-mixed") or is_scratch(study)
    assert (len(experiment.chain) == 1) == from_nothing


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.name)
def test_scratch_and_rivals_have_the_steps_of_the_chain(study):
    experiment = study.experiment([0])
    if is_scratch(study):
        name = study.name.removesuffix(f"-{plans.SCRATCH}")
        beside = next(other for other in STUDIES if other.name == name)
        assert steps(experiment.chain) == steps(chain(beside))
        assert experiment.target.env == chain(beside)[-1].env
    if study.part in ("rivals", "dilution"):
        assert steps(experiment.chain) == sum(plans.PP20_EPOCHS)
        assert task_label(experiment.target.env) == "20x20 10P"


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.name)
def test_no_stage_has_a_learner_of_its_own(study):
    learner = preset("fast", VARIANTS[study.variant].policy, **plans.LEARNER)
    assert {stage.learner for stage in study.stages} == {learner}


def test_teams_on_large_grids_are_reported_at_two_limits():
    assert [limits(task) for task in PP] == [(80,), (200,), (80, 200), (160, 400)]


def rival(name):
    return next(s for s in studies("rivals", ["hetnet"]) if s.name == f"rivals-{name}-hetnet")


def test_each_rival_changes_one_thing_of_the_chain():
    (own,) = studies("dilution", ["hetnet"])
    for name in RIVALS:
        if name in ("direct", "mixed", "team-alone", "grid-alone"):
            continue
        for ours, theirs in zip(chain(own), chain(rival(name)), strict=True):
            assert (ours.name, ours.epochs, ours.learner) == (
                theirs.name,
                theirs.epochs,
                theirs.learner,
            )
            assert unwrapped(ours.env) == unwrapped(theirs.env)
    assert {stage.env.scale for stage in chain(rival("none"))[:-1]} == {"none"}
    assert {stage.env.fill for stage in chain(rival("corner"))[:-1]} == {"corner"}
    assert [s.leave_out for s in chain(rival("fresh-encoder"))] == [(), *[("state_encoder",)] * 2]
    assert [s.resize for s in chain(rival("bilinear"))] == [None, "bilinear", "bilinear"]
    assert [s.env for s in chain(rival("nearest"))] == list(PP[:3])
    assert rival("coordinates").settings == {**own.settings, "encoder": "coordinates"}
    assert {type(stage.env) for stage in chain(rival("blank"))} == {BlankState}


def test_rivals_that_change_the_tasks():
    (own,) = studies("dilution", ["hetnet"])
    first, _, last = chain(own)
    source, target = chain(rival("direct"))
    assert source == first
    assert (target.env, target.start) == (last.env, source.name)
    (mixed,) = chain(rival("mixed"))
    assert (task_label(mixed.env), task_label(mixed.beside)) == ("20x20 10P", "10x10 5P")
    assert [task_label(s.env) for s in chain(rival("team-alone"))] == ["20x20 5P", "20x20 10P"]
    teams = [task_label(s.env) for s in chain(rival("grid-alone"))]
    assert teams == ["5x5 10P", "10x10 10P", "20x20 10P"]


def test_stages_of_the_chain_are_seen_at_the_targets_size_with_the_mass_of_a_cell():
    for stage in chain(studies("pp40", ["hetnet"])[0])[:-1]:
        assert isinstance(stage.env, StateUpsampled)
        assert (stage.env.size, stage.env.scale) == (40, plans.SCALE)


# --- Nobody is told where it stands -------------------------------------------------------------


def test_a_blank_task_is_the_task_without_where_anybody_is():
    task = PredatorPrey(size=4, num_predators=3)
    blank = BlankState(task)
    state = blank.reset(jax.random.key(0))
    seen, whole = blank.observe(state), task.observe(state)
    assert seen.state.shape == (3, *blank.state_shape) == (3, 1, 1, 1)
    assert not np.any(seen.state)
    np.testing.assert_array_equal(seen.view, whole.view)
    assert blank.state_table().shape == (16, 1, 1, 1)
    assert not np.any(listed_states(blank).dense())
    assert len(listed_states(blank)) == 16


@pytest.mark.parametrize("kind", ["flat", "linear"])
def test_all_cells_of_a_blank_task_have_one_code(kind):
    blank = BlankState(PredatorPrey(size=3, num_predators=2))
    encoder = StateEncoder(kind)
    code, _ = encoder.init_with_output(jax.random.key(0), listed_states(blank))
    np.testing.assert_array_equal(code, np.broadcast_to(code[:1], code.shape))
