"""Source stage -> checkpoint -> target stage: what carries over, what does not, what is refused."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax import checkpoint
from sumajax.checkpoint import CheckpointError
from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.learning import LearnerConfig, config, make_learner, parallel
from sumajax.learning.guard import FAULTS
from sumajax.learning.learner import Metrics, Tally
from sumajax.learning.losses import LossParts
from sumajax.policies import make_policy
from sumajax.transfer import (
    StageRun,
    Stop,
    StoppedError,
    _chunk_length,
    fresh_states,
    run_stage,
    transferred_states,
    untrained_parameters,
)
from sumajax.upsampling import StateUpsampled

SOURCE = StateUpsampled(PredatorPrey(size=3, num_predators=2, max_steps=10), 6)
TARGET = PredatorPrey(size=6, num_predators=3, max_steps=20)
CONFIG = LearnerConfig(num_envs=100, rollout_length=20)


def stage(env, directory, seeds=(0, 1), epochs=1, **settings):
    policy = make_policy("ic3net", env, **{"hidden": 8, **settings})
    return StageRun("source", make_learner(env, policy, CONFIG), epochs, seeds, directory)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A trained source stage and its result."""
    trained = stage(SOURCE, tmp_path_factory.mktemp("source"))
    return trained, run_stage(trained, lambda: fresh_states(trained))


def equal(a, b):
    return all(map(np.array_equal, jax.tree.leaves(a), jax.tree.leaves(b)))


def test_parameters_carry_over_and_nothing_else(source, tmp_path):
    trained, result = source
    target = stage(TARGET, tmp_path)
    states, fresh = transferred_states(target, trained.directory), fresh_states(target)
    assert equal(states.params, result.states.params)
    assert not equal(states.params, fresh.params)
    assert equal(states.opt_state, fresh.opt_state)
    assert equal(jax.random.key_data(states.key), jax.random.key_data(fresh.key))
    assert states.updates.tolist() == [0, 0]


def test_the_optimisers_memory_by_choice(source, tmp_path):
    trained, result = source
    states = transferred_states(stage(TARGET, tmp_path), trained.directory, carry_optimiser=True)
    assert equal(states.opt_state, result.states.opt_state)
    assert states.updates.tolist() == [0, 0]  # the schedule starts anew


def test_one_source_seed_serves_several(source, tmp_path):
    trained, result = source
    single = tmp_path / "single"
    states = jax.tree.map(lambda x: x[:1], result.states)
    meta = checkpoint.describe(SOURCE, trained.learner.policy, seeds=[0], epoch=1)
    checkpoint.save(single, states, meta)
    started = transferred_states(stage(TARGET, tmp_path / "t", seeds=(3, 4)), single)
    for leaf, of_source in zip(
        jax.tree.leaves(started.params), jax.tree.leaves(result.states.params), strict=True
    ):
        for copy in leaf:
            np.testing.assert_array_equal(copy, of_source[0])


def test_some_of_the_sources_seeds_go_on_by_their_number(source, tmp_path):
    trained, result = source
    states = transferred_states(stage(TARGET, tmp_path, seeds=(1,)), trained.directory)
    second = jax.tree.map(lambda x: x[1:], result.states.params)
    assert equal(states.params, second)
    assert untrained_parameters(trained.directory, trained.learner, states.params, (1,)) == []


def test_a_critic_of_its_own_begins_anew_and_is_saved_with_the_rest(source, tmp_path):
    """After a source that had none; and a stage stopped half way comes to the same end."""
    trained, _ = source
    policy = make_policy("ic3net", TARGET, hidden=8)
    learner = make_learner(TARGET, policy, replace(CONFIG, critic="state"))
    whole = StageRun("target", learner, 2, (0, 1), tmp_path / "whole")
    stopped = replace(whole, directory=tmp_path / "stopped")
    start = partial(transferred_states, whole, trained.directory)
    assert equal(start().critic, fresh_states(whole).critic)
    end = run_stage(whole, start, chunk=1).states
    with pytest.raises(KeyboardInterrupt):
        run_stage(stopped, start, chunk=1, stop_asked=lambda: True)
    again = run_stage(stopped, lambda: pytest.fail("it had begun"), chunk=1)
    assert again.first_epoch == 1
    assert equal(again.states.critic, end.critic)
    assert equal(again.states.params, end.params)
    # Who goes on from it takes the policy alone.
    back = transferred_states(stage(TARGET, tmp_path / "back"), whole.directory)
    assert back.critic is None
    assert equal(back.params, end.params)


def test_modules_that_are_left_out_stay_fresh(source, tmp_path):
    trained, result = source
    target = stage(TARGET, tmp_path)
    params = transferred_states(target, trained.directory, leave_out=("state_encoder",)).params
    fresh = fresh_states(target).params["params"]
    carried = result.states.params["params"]
    left = params["params"]
    assert equal(left["observation"]["state_encoder"], fresh["observation"]["state_encoder"])
    assert equal(left["observation"]["view_encoder"], carried["observation"]["view_encoder"])
    assert equal(left["core"], carried["core"])
    with pytest.raises(ValueError, match=r"no module 'ear'; it has .*state_encoder"):
        transferred_states(target, trained.directory, leave_out=("ear",))


@pytest.mark.parametrize("seeds", [(0, 1, 2), (1, 2), (5,)])
def test_seeds_that_the_source_has_not_are_refused(source, tmp_path, seeds):
    """Taken by their position, they would start from another seed's policy without a word."""
    with pytest.raises(CheckpointError, match=r"holds seeds \[0, 1\], this stage has"):
        transferred_states(stage(TARGET, tmp_path, seeds=seeds), source[0].directory)


@pytest.mark.parametrize(
    ("env", "settings", "sentence"),
    [
        (PredatorPrey(size=6, num_predators=3, vision=2), {}, "vision differs: 1 in .*, 2 in this"),
        (PredatorPrey(size=9, num_predators=3), {}, "grid differs: 6x6 in .*, 9x9 in this stage"),
        (TARGET, {"hidden": 16}, "policy setting hidden differs: 8 in .*, 16 in this stage"),
    ],
    ids=["vision", "grid", "width"],
)
def test_what_does_not_fit_is_named(env, settings, sentence, source, tmp_path):
    with pytest.raises(CheckpointError, match=sentence):
        transferred_states(stage(env, tmp_path, **settings), source[0].directory)


def test_a_missing_source_is_named(tmp_path):
    with pytest.raises(CheckpointError, match="nowhere"):
        transferred_states(stage(TARGET, tmp_path), tmp_path / "nowhere")


def test_a_finished_stage_is_not_run_again(source):
    trained, result = source
    again = run_stage(trained, lambda: pytest.fail("started anew"))
    assert again.first_epoch == trained.epochs
    assert again.train_seconds == 0.0
    assert equal(again.states.params, result.states.params)


@pytest.mark.parametrize(
    ("epochs", "done", "longest", "expected"),
    [
        (125, 0, 5, 5),
        (7, 0, 5, 1),
        (12, 0, 5, 4),
        (125, 120, 5, 5),
        (3, 0, 5, 3),
        (5, 5, 5, 5),
        (18, 0, 5, 3),
        (18, 3, 5, 3),  # as before the interruption, though 15 are left
        (18, 4, 5, 2),
    ],
)
def test_chunks_reach_the_end_in_equal_parts(epochs, done, longest, expected):
    assert _chunk_length(epochs, done, longest) == expected


def train_until(ends, learner):
    """Stands for training in which seed i goes no further than `ends[i]` updates."""
    each = learner.config.updates_per_epoch

    def compile_train(learner, mesh, epochs, states):
        def train(states):
            wanted = np.asarray(states.updates) + each * epochs
            updates = np.minimum(wanted, ends)
            fault = np.where(updates < wanted, 1 + FAULTS.index("gradient became NaN"), 0)
            zeros = np.zeros((len(ends), epochs))
            loss = LossParts(*[zeros] * len(LossParts.__dataclass_fields__))
            sums = Tally(**dict.fromkeys(Tally.__dataclass_fields__, zeros) | {"loss": loss})
            metrics = Metrics(sums, np.tile(fault[:, None], epochs))
            return states.replace(updates=jnp.asarray(updates)), metrics

        return train

    return compile_train


def test_a_seed_that_stops_is_told_of_once_and_the_others_go_on(tmp_path, monkeypatch):
    chosen = stage(SOURCE, tmp_path, seeds=(4, 9), epochs=4)
    each = chosen.learner.config.updates_per_epoch
    ends = [10**6, each + 3]
    monkeypatch.setattr(parallel, "compile_train", train_until(ends, chosen.learner))
    said = []

    def run(epochs):
        longer = replace(chosen, epochs=epochs)
        start = lambda: fresh_states(longer)  # noqa: E731
        return run_stage(longer, start, on_stop=lambda stop: said.append(str(stop)), chunk=1)

    stopped = (Stop(9, 2, "gradient became NaN"),)
    sentence = "seed 9 stopped in epoch 2: its gradient became NaN; the last good state is kept"
    result = run(4)
    assert result.stops == stopped
    assert said == [sentence]
    assert result.states.updates.tolist() == [4 * each, each + 3]
    again = run(5)  # as after an interruption
    assert (again.first_epoch, again.stops, said) == (4, stopped, [sentence])
    ends[0] = 5 * each + 1
    for _ in range(2):
        with pytest.raises(StoppedError, match=f"no seed of the source stage is left .{sentence}"):
            run(9)
    assert len(said) == 2
    assert checkpoint.read_meta(tmp_path)["epoch"] == 6, "nothing is trained in vain"


def test_a_stage_killed_before_its_first_epoch_starts_from_what_it_saved(tmp_path, monkeypatch):
    """And saves no second checkpoint of epoch 0, which an uninterrupted run does not have."""
    chosen = stage(TARGET, tmp_path, epochs=2)
    monkeypatch.setattr(parallel, "compile_train", train_until([99, 99], chosen.learner))
    checkpoint.save(
        tmp_path,
        fresh_states(chosen),
        checkpoint.describe(chosen.learner.env, chosen.learner.policy, epoch=0),
    )
    run_stage(chosen, lambda: pytest.fail("started anew"), chunk=1)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["000001-step-0", "000002-step-1", "000003-step-2"]


def test_a_stop_that_is_asked_for_comes_after_a_checkpoint(tmp_path, monkeypatch):
    trained = stage(TARGET, tmp_path, epochs=6)
    monkeypatch.setattr(parallel, "compile_train", train_until([99, 99], trained.learner))
    answers, told = iter([False, True]), []
    with pytest.raises(KeyboardInterrupt):
        run_stage(
            trained,
            lambda: fresh_states(trained),
            on_chunk=lambda chunk: told.append(chunk.epoch),
            chunk=2,
            stop_asked=lambda: next(answers),
        )
    assert told == [2, 4]
    assert checkpoint.read_meta(tmp_path)["epoch"] == 4


class TestUntrainedParameters:
    def test_all_have_been_trained_where_the_team_uses_all(self, source):
        stage, result = source
        assert (
            untrained_parameters(stage.directory, stage.learner, result.states.params, stage.seeds)
            == []
        )

    @pytest.mark.slow  # compiles HetNet's learner
    def test_what_passes_between_capture_agents_waits_for_a_second_one(self, tmp_path, monkeypatch):
        monkeypatch.setattr(config, "EPOCH_STEPS", 2_000)  # one update is enough
        env = StateUpsampled(PredatorCapturePrey(3, 2, 1, max_steps=10), 6)
        policy = make_policy("hetnet", env)
        alone = StageRun("source", make_learner(env, policy, CONFIG), 1, (0,), tmp_path / "source")
        params = run_stage(alone, lambda: fresh_states(alone)).states.params
        left = untrained_parameters(alone.directory, alone.learner, params, (0,))
        between = [name for name in left if "a2a" in name]
        assert len(between) == 8  # weights and attention of both layers
        # One sender a relation: its attention is 1, whatever the parameters.
        assert {name.rsplit("_")[-1] for name in set(left) - set(between)} == {"src", "dst"}


# --- Another grid: the position table is resized -----------------------------------------------

NATIVE_SOURCE = PredatorPrey(size=3, num_predators=2, max_steps=10)


def states_from(native, tmp_path, encoder, resize, **size):
    trained = stage(native, tmp_path / "small", encoder=encoder)
    before = fresh_states(trained)
    checkpoint.save(
        trained.directory,
        before,
        checkpoint.describe(native, trained.learner.policy, seeds=[0, 1], epoch=1),
    )
    target = stage(replace(TARGET, **size), tmp_path / "large", encoder=encoder)
    return before, transferred_states(target, trained.directory, resize=resize)


@pytest.mark.parametrize("encoder", ["linear", "flat"])
def test_a_policy_of_a_small_grid_goes_on_with_a_resized_position_table(tmp_path, encoder):
    before, after = states_from(NATIVE_SOURCE, tmp_path, encoder, "nearest")
    small, large = (s.params["params"].pop("observation") for s in (before, after))
    assert equal(before.params, after.params)
    kernels = [part["state_encoder"].pop("dense") for part in (small, large)]
    assert equal(small, large)
    before, after = (np.asarray(part["kernel"]) for part in kernels)
    side, channels = (3, 1) if encoder == "linear" else (2, 16)
    # Of 2 places of the convolutions on 3x3 there are 3 on 6x6, whose middle one is in the second.
    nearest = [0, 0, 1, 1, 2, 2] if encoder == "linear" else [0, 1, 1]
    table = before.reshape(2, side, side, channels, -1)[:, nearest][:, :, nearest]
    np.testing.assert_array_equal(after, table.reshape(after.shape))
    assert equal(kernels[0]["bias"], kernels[1]["bias"])


def test_only_a_resized_table_takes_a_policy_to_another_grid(tmp_path):
    with pytest.raises(CheckpointError, match="the policy's grid differs: 3x3"):
        states_from(NATIVE_SOURCE, tmp_path, "linear", None)
    with pytest.raises(ValueError, match="encoder 'coordinates' has no position table"):
        states_from(NATIVE_SOURCE, tmp_path / "other", "coordinates", "nearest")


def test_coordinates_go_to_any_grid_as_they_are(tmp_path):
    before, after = states_from(NATIVE_SOURCE, tmp_path, "coordinates", None, size=(5, 7))
    assert equal(before.params, after.params)
