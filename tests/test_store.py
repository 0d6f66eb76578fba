"""The trained policies of the package: each holds to its card, and stands wherever a run can."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest
from refusals import refusal

import sumajax
from experiments.pretrained import (
    CARD_SEED,
    CHECK_EPISODES,
    END,
    LICENCE,
    MODES,
    PAGE,
    TABLE,
    name_of,
    steps_of_each,
    table,
)
from sumajax import PredatorPrey, StateUpsampled, checkpoint, load_agent, make_policy, store
from sumajax.experiment.plan import Experiment, Stage, described
from sumajax.keys import key_of
from sumajax.learning import LearnerConfig, make_learner
from sumajax.sources import source_of
from sumajax.transfer import StageRun, transferred_states, untrained_parameters

MOST_BYTES = 4 * 2**20
"""Of all trained policies together: everybody who installs the package gets them."""
ALL_BUT_CHANCE = CHECK_EPISODES - 2
"""Another compiler, or another processor, rounds otherwise: a choice in thousands then differs, and
with it its episode."""
SOURCE = StateUpsampled(PredatorPrey(size=3, num_predators=2, max_steps=10), 6)
TARGET = PredatorPrey(size=6, num_predators=3, max_steps=20)
NAME = "pp-3x3-at-6x6-iric"


@pytest.fixture(scope="module")
def params():
    return jax.jit(policy_on(SOURCE).init)(key_of(3))


@pytest.fixture
def stored(params, tmp_path, monkeypatch):
    """A store of one policy; its parameters as they are kept."""
    monkeypatch.setattr(store, "FOLDER", tmp_path)
    meta = checkpoint.describe(SOURCE, policy_on(SOURCE), seeds=[4], epoch=1, untrained=["a/b"])
    store.write(NAME, {"meta": meta, "licence": LICENCE}, params, tmp_path)
    return store.as_kept(params)


def policy_on(env):
    return make_policy("iric", env, hidden=8)


def equal(a, b):
    return all(map(np.array_equal, jax.tree.leaves(a), jax.tree.leaves(b)))


# --- Those that the package has ----------------------------------------------------------------


@pytest.mark.parametrize("name", store.names())
def test_a_policy_holds_to_its_card(name):
    """Played again with the card's key, episode by episode."""
    agent, card = sumajax.pretrained(name), store.card(name)
    assert card["check"]["episodes"] == CHECK_EPISODES
    for mode in MODES:
        steps, expected = steps_of_each(agent, mode), card["check"][mode]
        same = np.equal(steps, expected)
        assert len(expected) == CHECK_EPISODES
        assert same.sum() >= ALL_BUT_CHANCE, (mode, steps, expected)


@pytest.mark.parametrize("name", store.names())
def test_a_card_says_what_has_to_be_known(name):
    card, agent = store.card(name), sumajax.pretrained(name)
    assert name_of(agent.env, agent.policy.name) == card["name"] == name
    assert card["seed"] in card["seeds_tried"]
    assert len(card["seeds_tried"]) == len(card["chosen_by"]["by_seed"]) >= 3
    assert card["chosen_by"]["key"] != card["held_out"]["key"] == card["check"]["key"] == CARD_SEED
    assert card["command"].startswith(("sumajax transfer ", "python -m experiments.scale "))
    assert "/" not in card["command"], "a place on somebody's machine"
    assert len(card["commit"]) >= 7
    assert card["licence"] == LICENCE
    assert {"python", "sumajax", "jax", "flax"} <= set(card["trained_with"])
    for mode in MODES:
        figures = card["held_out"][mode]
        assert figures["steps_taken"] >= card["held_out"]["shortest_path_steps"]
        assert figures["success"] > 0.9
        few = np.mean(card["check"][mode])
        assert abs(few - figures["steps_taken"]) < 0.5 * figures["steps_taken"]


def test_the_page_has_the_figures_of_the_cards():
    assert f"{TABLE}\n\n{table()}\n{END}" in PAGE.read_text()


@pytest.mark.parametrize("page", ["docs/pretrained.md", "docs/export.md", "README.md"])
def test_policies_that_pages_name_are_there(page):
    named = re.findall(r"\bp(?:cp|p)-\d+x\d+[\w-]*", (PAGE.parents[1] / page).read_text())
    assert set(named) <= set(store.names())


def test_all_together_they_are_small():
    assert sum(file.stat().st_size for file in store.FOLDER.iterdir()) <= MOST_BYTES


def test_every_file_belongs_to_a_policy():
    files = {file.name for file in store.FOLDER.iterdir()}
    assert files == {f"{name}.{kind}" for name in store.names() for kind in ("json", "npz")}


# --- What one can do with them -----------------------------------------------------------------


def test_it_is_an_agent(stored):
    agent = sumajax.pretrained(NAME)
    assert (agent.env, agent.policy) == (SOURCE, policy_on(SOURCE))
    assert equal(agent.params, stored)
    assert load_agent(NAME) == agent
    assert load_agent(NAME, seed=4) == agent


def test_a_seed_that_it_is_not_is_refused(stored):
    assert "has no seed 0; its seeds are 4" in refusal(load_agent, NAME, seed=0)


def test_unknown_names_are_answered_with_the_known(stored):
    with pytest.raises(ValueError, match=f"no trained policy 'pp'; it has {NAME}"):
        sumajax.pretrained("pp")
    with pytest.raises(ValueError, match=NAME):
        store.card("../secrets")
    assert NAME in refusal(load_agent, "pp")


def test_a_directory_goes_before_a_name(stored, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    checkpoint.save(NAME, {"params": {"w": np.ones(2)}}, {"seeds": [9]})
    assert source_of(NAME).meta == {"seeds": [9]}


def test_every_seed_of_a_stage_goes_on_from_it(stored, tmp_path):
    states = transferred_states(stage_run(tmp_path), NAME)
    for leaf, kept in zip(jax.tree.leaves(states.params), jax.tree.leaves(stored), strict=True):
        assert leaf.shape[0] == 2
        for copy in leaf:
            np.testing.assert_array_equal(copy, kept)


def test_the_optimisers_memory_is_not_kept(stored, tmp_path):
    run = stage_run(tmp_path)
    said = refusal(transferred_states, run, NAME, carry_optimiser=True)
    assert "holds no opt_state" in said


def test_a_policy_of_other_settings_is_refused(stored, tmp_path):
    said = refusal(transferred_states, stage_run(tmp_path, hidden=16), NAME)
    assert "policy setting hidden differs: 8 in pp-3x3-at-6x6-iric, 16" in said


def test_what_its_training_had_no_use_for_is_on_the_card(stored, tmp_path):
    run = stage_run(tmp_path)
    params = transferred_states(run, NAME).params
    assert untrained_parameters(NAME, run.learner, params, run.seeds) == ["a/b"]


def test_a_plan_knows_it_by_its_content(stored):
    """Config.json: the same policy under another name is the same start."""
    stage = Stage("transfer", TARGET, 1, start=Path(NAME))
    experiment = Experiment((stage,), policy="iric", policy_settings={"hidden": 8})
    (plan,) = described(experiment)["stages"]
    assert plan["start"] == {"checkpoint": store.card(NAME)["file"]["sha256"]}


def test_a_damaged_file_is_refused(stored, tmp_path):
    file = tmp_path / f"{NAME}.npz"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    store._arrays.cache_clear()
    assert "is damaged" in refusal(load_agent, NAME)


def stage_run(directory, hidden=8):
    policy = make_policy("iric", TARGET, hidden=hidden)
    learner = make_learner(TARGET, policy, LearnerConfig(num_envs=100, rollout_length=20))
    return StageRun("transfer", learner, 1, (0, 1), directory / "checkpoints")


# --- How they are kept -------------------------------------------------------------------------


def test_a_matrix_is_a_byte_for_each_number(params):
    kept = store.rounded(params)
    leaves = dict(checkpoint.leaves.named_leaves(params))
    assert sum(array.dtype == np.int8 for array in kept.values()) > 3
    for name, leaf in leaves.items():
        assert kept[name].shape == leaf.shape
        assert kept[name].dtype == (np.int8 if leaf.ndim > 1 else np.float32), name


def test_numbers_come_back_within_half_a_step_of_their_column(params):
    kept = store.rounded(params)
    back = store.restored(kept)
    for name, leaf in checkpoint.leaves.named_leaves(params).items():
        step = kept.get(name + store.SCALE, np.float32(0))
        assert (np.abs(back[name] - leaf) <= step * 0.5001).all(), name
        assert back[name].dtype == np.float32


def test_what_was_kept_once_is_kept_as_it_is(params):
    """Entries can be renewed from themselves."""
    once = store.as_kept(params)
    for twice, leaf in zip(
        jax.tree.leaves(store.as_kept(once)), jax.tree.leaves(once), strict=True
    ):
        np.testing.assert_allclose(twice, leaf, rtol=1e-6)


def test_columns_of_zeros_stay_zeros():
    matrix = np.zeros((3, 2), np.float32)
    matrix[:, 1] = [-1, 0.5, 1]
    back = store.as_kept({"w": matrix})["w"]
    np.testing.assert_array_equal(back[:, 0], 0)
    np.testing.assert_allclose(back[:, 1], matrix[:, 1], atol=0.5 / store.LARGEST)
