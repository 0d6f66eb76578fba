"""Our environments against recorded episodes of the original programs, every field at every step.

What is left out on purpose, and nothing else:
* files with two prey: the domains have one, as every published setting does;
* the value that the originals hide from sighted agents where a blind agent's window covers theirs
  (their windows share memory). Those cells are not skipped: the helper masks ours in the same
  places and the recorded -1 must be exactly there. `obs_tensor` holds the unhidden values.

`success` is the completion condition in every mode here. The originals define none in competitive
mode (-1) and give 0 in cooperative Predator-Capture-Prey even when all is done; both are compared
with the completion condition computed from the recorded positions and captures.
"""

from pathlib import Path

import environment_data as data
import numpy as np
import pytest

from sumajax.environments import PredatorCapturePrey, PredatorPrey

FIELDS = {
    *("pos", "prey_pos", "reached", "captured"),
    *("reward", "done_env", "ep_len", "ep_terminated", "ep_return", "ep_reward_terminal"),
    *("obs_loc", "obs_cls", "obs_raw_ep0", "obs_tensor", "state_index"),
}
SUCCESS_FIELDS = {"success", "ep_success"}
LAYOUT_FIELDS = {"step_ptr", "state_ptr", "ep_seed", "ep_policy", "action"}
REWARD_TOLERANCE = 1e-6


def replays() -> list[tuple[Path, type[PredatorCapturePrey]]]:
    """Every recording in its own domain; one without capture agents as Predator-Prey as well."""
    cases = []
    for path in data.recordings():
        meta, _ = data.load(path)
        domains = [data.recorded_domain(meta)] + [PredatorPrey] * (meta["nA"] == 0)
        cases += [(path, domain) for domain in dict.fromkeys(domains)]
    return cases


def case(path: Path, domain: type[PredatorCapturePrey], *more: str):
    meta, _ = data.load(path)
    two_prey = pytest.mark.skipif(
        meta["nprey"] != 1, reason="several prey: left out on purpose, the domains have one"
    )
    return pytest.param(
        path, domain, *more, id="-".join((path.stem, domain.__name__, *more)), marks=two_prey
    )


each_replay = pytest.mark.parametrize(("path", "domain"), [case(*replay) for replay in replays()])
each_recorded_field = pytest.mark.parametrize(
    ("path", "domain", "field"),
    [
        case(*replay, field)
        for replay in replays()
        for field in sorted(FIELDS.intersection(data.load(replay[0])[1]))
    ],
)


def test_there_are_recordings():
    assert data.recordings(), f"no .npz file in {data.directory()}"


@each_recorded_field
def test_field_is_as_recorded(path: Path, domain: type[PredatorCapturePrey], field: str):
    _, recorded = data.load(path)
    ours = data.replay(path, domain)[field]
    if np.issubdtype(recorded[field].dtype, np.floating):
        steps = recorded["ep_len"].max() if field.startswith("ep_") else 1
        np.testing.assert_allclose(ours, recorded[field], rtol=0, atol=REWARD_TOLERANCE * steps)
    else:
        np.testing.assert_array_equal(ours, recorded[field])


@each_replay
def test_success_is_the_completion_condition(path: Path, domain: type[PredatorCapturePrey]):
    meta, recorded = data.load(path)
    ours = data.replay(path, domain)
    complete = data.complete(recorded)
    last_state = recorded["state_ptr"][1:] - 1
    after_a_step = np.delete(complete, recorded["state_ptr"][:-1])
    np.testing.assert_array_equal(ours["success"], after_a_step)
    np.testing.assert_array_equal(ours["ep_success"], complete[last_state])
    always_zero = meta["mode"] == "cooperative" and meta["env"].startswith("PCP")
    for field in SUCCESS_FIELDS:
        undefined = recorded[field] == -1
        assert undefined.all() if meta["mode"] == "competitive" else not undefined.any()
        if always_zero:
            assert not recorded[field].any()
        elif not undefined.any():
            np.testing.assert_array_equal(ours[field], recorded[field])


@each_replay
def test_whoever_did_not_terminate_was_cut(path: Path, domain: type[PredatorCapturePrey]):
    _, recorded = data.load(path)
    ours = data.replay(path, domain)
    np.testing.assert_array_equal(ours["ep_truncated"], ~recorded["ep_terminated"])


@each_replay
def test_state_tensor_is_the_one_hot_of_the_own_cell(path: Path, domain: type[PredatorCapturePrey]):
    _, recorded = data.load(path)
    ours = data.replay(path, domain)
    rows = np.eye(ours["state_tensor"].shape[-1])
    by_hand = rows[recorded["pos"][..., 0], :, None] * rows[recorded["pos"][..., 1], None, :]
    np.testing.assert_array_equal(ours["state_tensor"][:, :, 0], by_hand)
    np.testing.assert_array_equal(ours["state_tensor_from_table"], ours["state_tensor"])


@each_replay
def test_every_field_of_the_file_is_compared(path: Path, domain: type[PredatorCapturePrey]):
    _, recorded = data.load(path)
    tensor_fields = {"obs_tensor", "state_index"}
    assert set(recorded) <= FIELDS | SUCCESS_FIELDS | LAYOUT_FIELDS
    assert set(recorded) >= (FIELDS | SUCCESS_FIELDS | LAYOUT_FIELDS) - tensor_fields
    np.testing.assert_array_equal(np.diff(recorded["step_ptr"]), recorded["ep_len"])
    np.testing.assert_array_equal(np.diff(recorded["state_ptr"]), recorded["ep_len"] + 1)
