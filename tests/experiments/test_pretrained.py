"""Entries of the store from a finished run: the best seed, and a card that says how it was made."""

import json

import jax
import numpy as np
import pytest

from experiments import pretrained
from experiments.pretrained import command_of, entries_of, name_of, of_one_plan
from sumajax import PredatorPrey, StateUpsampled, checkpoint, make_policy, store
from sumajax.environments import PredatorCapturePrey
from sumajax.evaluation import EPISODES, held_out_keys, load_agent
from sumajax.keys import key_of
from sumajax.learning import make_learner, parallel

TASK = StateUpsampled(PredatorPrey(size=2, num_predators=1, max_steps=6), 4)
SEEDS = (3, 8)
LATER = 2
"""A seed that was added; among the three it takes the fewest steps."""
FEW = 16


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The files of a finished run: two seeds, neither of them trained."""
    return finished(tmp_path_factory.mktemp("runs") / "run", SEEDS)


@pytest.fixture(scope="module")
def later(tmp_path_factory):
    """Of a run of the same plan with a seed that was added."""
    return finished(tmp_path_factory.mktemp("runs") / "later", (LATER,))


def finished(directory, seeds):
    policy = make_policy("iric", TASK, hidden=4, encoder="linear")
    meta = checkpoint.describe(TASK, policy, arm="source", seeds=list(seeds), epoch=1, stops=[])
    state = {"params": parallel.init_seeds(make_learner(TASK, policy), list(seeds)).params}
    checkpoint.save(directory / "checkpoints" / "source", state, meta)
    command = [
        "/somewhere/sumajax",
        "transfer",
        "pp",
        "--output",
        "/somewhere/run",
        "--seeds",
        *map(str, seeds),
    ]
    plan = {"name": "pp_transfer", "seeds": list(seeds)}
    config = {"command": command, "experiment": plan, "versions": {"python": "3.11"}}
    (directory / "config.json").write_text(json.dumps(config))
    (directory / "stages.json").write_text(json.dumps({"source": {"result": {"env_steps": 7}}}))
    (directory / "summary.json").write_text("{}")
    return directory


@pytest.fixture(scope="module")
def made(run, tmp_path_factory):
    """Name, card and parameters of its entry."""
    return entry([run], tmp_path_factory.mktemp("store"))


def entry(runs, folder):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pretrained, "EPISODES", FEW)
        patch.setattr(pretrained, "CHECK_EPISODES", FEW // 2)
        patch.setattr(store, "FOLDER", folder)
        (name,) = entries_of(runs, "abc1234", folder=folder)
        return name, store.card(name), load_agent(name).params


def test_it_is_the_seed_that_takes_fewest_steps_as_the_store_keeps_it(run, made):
    name, card, params = made
    assert name == card["name"] == "pp-2x2-at-4x4-iric"
    assert card["seeds_tried"] == list(SEEDS)
    by_seed = card["chosen_by"]["by_seed"]
    assert card["seed"] == SEEDS[int(np.argmin(by_seed))]
    assert card["meta"]["seeds"] == [card["seed"]]
    kept = store.as_kept(load_agent(run, seed=card["seed"]).params)
    assert all(map(np.array_equal, jax.tree.leaves(kept), jax.tree.leaves(params)))


def test_seeds_that_were_added_later_are_chosen_among_too(run, later, made, tmp_path):
    _, card, params = entry([run, later], tmp_path)
    _, before, _ = made
    assert card["seeds_tried"] == [*SEEDS, LATER]
    assert card["chosen_by"]["by_seed"][:2] == before["chosen_by"]["by_seed"]
    assert card["seed"] == LATER
    assert card["command"] == f"sumajax transfer pp --seeds {LATER}"
    kept = store.as_kept(load_agent(later).params)
    assert all(map(np.array_equal, jax.tree.leaves(kept), jax.tree.leaves(params)))


def test_runs_are_taken_together_where_only_their_seeds_differ(run, later, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    config = json.loads((run / "config.json").read_text())
    config["experiment"]["name"] = "another"
    (other / "config.json").write_text(json.dumps(config))
    assert of_one_plan([run, other, later]) == [[run, later], [other]]


def test_the_card_says_how_it_came_about(made):
    _, card, _ = made
    assert card["command"] == "sumajax transfer pp --seeds 3 8"
    assert (card["commit"], card["env_steps"]) == ("abc1234", 7)
    assert card["trained_with"] == {"python": "3.11"}
    assert set(card["held_out"]["greedy"]) == {"steps_taken", "success", "return"}
    assert len(card["check"]["sampled"]) == FEW // 2


def test_a_seed_is_chosen_on_starts_that_the_card_does_not_show():
    """The first of twice as many starts are the card's."""
    words = np.asarray(jax.random.key_data(held_out_keys(2 * EPISODES)))
    np.testing.assert_array_equal(words[:EPISODES], jax.random.key_data(held_out_keys()))
    assert pretrained.CHOICE_SEED != pretrained.CARD_SEED


def test_parameters_that_nothing_trained_are_named(made):
    """Here all of them: the run's seeds are as they are drawn."""
    _, card, params = made
    assert len(card["meta"]["untrained"]) == len(jax.tree.leaves(params))


@pytest.mark.parametrize(
    ("env", "name"),
    [
        (PredatorPrey(size=10, num_predators=5), "pp-10x10-magic"),
        (StateUpsampled(PredatorPrey(size=5, num_predators=3), 10), "pp-5x5-at-10x10-magic"),
        (PredatorCapturePrey(size=(4, 8), num_predators=2, num_capturers=1), "pcp-4x8-magic"),
    ],
)
def test_names(env, name):
    assert name_of(env, "magic") == name


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        (["transfer", "pp"], "sumajax transfer pp"),
        (["transfer", "--output", "a b", "--seeds", "0", "1"], "sumajax transfer --seeds 0 1"),
        (["transfer", "--output=/a", "--scale", "mass"], "sumajax transfer --scale mass"),
        (["transfer", "--seeds", "0", "--output", "/a"], "sumajax transfer --seeds 0"),
    ],
)
def test_a_command_says_no_places(given, kept):
    assert command_of(["/home/somebody/bin/sumajax", *given]) == kept
    of_study = command_of(["experiments/scale.py", "--seeds", "0", "1", "--runs", "/tmp/runs"])
    assert of_study == "python -m experiments.scale --seeds 0 1"
    of_pcp = command_of(["experiments/pcp_transfer.py", "--seeds", "2"])
    assert of_pcp == "sumajax transfer pcp --seeds 2"


def test_a_run_that_is_not_finished_is_refused(run, tmp_path):
    with pytest.raises(ValueError, match="is no finished run"):
        entries_of([tmp_path], "abc1234", folder=tmp_path)
    with pytest.raises(ValueError, match="no arm 'target'; it has source"):
        entries_of([run], "abc1234", ["target"], tmp_path)


def test_an_entry_is_renewed_not_doubled(tmp_path):
    params = jax.jit(make_policy("iric", TASK, hidden=4).init)(key_of(0))
    for _ in range(2):
        store.write("a", {}, params, tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.json", "a.npz"]
