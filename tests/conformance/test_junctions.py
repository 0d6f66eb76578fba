"""Our Traffic Junction against recorded episodes of the original, every field at every step.

Policies with dead agents (`policy_*` files of the same folder) are compared elsewhere.
"""

from pathlib import Path

import jax
import numpy as np
import pytest
import traffic_data as data

from sumajax.environments import TrafficJunction

FIELDS = {
    *("grid_class", "route_len", "route_cells"),
    *("ep_add_rate", "ep_exact_rate", "ep_len", "ep_success", "ep_return", "ep_reward_terminal"),
    *("ep_value_loss", "ep_action_loss"),
    *("reward", "collided", "completed", "done_env", "success", "arrival_route"),
    *("alive", "cell", "route_id", "route_pos", "wait", "last_act", "cars_in_sys"),
    *("obs_act", "obs_route", "obs_class", "obs_cars", "obs_raw_ep0"),
}
SCALAR_FIELDS = {"obs_loc"}
GIVEN_FIELDS = {"action", "arrival", "arrival_slot", "arrival_choice", "draw_u"}
LAYOUT_FIELDS = {"step_ptr", "state_ptr", "ep_seed", "ep_policy", "ep_epoch"}
FLOAT32 = 1e-6
"""Of one reward or observation; sums over an episode have as many times that."""
EXACT = {"ep_add_rate", "ep_exact_rate"}
"""Numbers that the host computes in float64."""
RELATIVE = {"ep_value_loss", "ep_action_loss"}

each_recording = pytest.mark.parametrize("path", data.recordings(), ids=lambda path: path.stem)
each_field = pytest.mark.parametrize(
    ("path", "field"),
    [
        pytest.param(path, field, id=f"{path.stem}-{field}")
        for path in data.recordings()
        for field in sorted((FIELDS | SCALAR_FIELDS).intersection(data.load(path)[1]))
    ],
)


def test_every_file_is_of_a_known_kind():
    names = [path.stem for path in data.directory().glob("*.npz")]
    assert any(name.startswith("tj_") for name in names), f"no tj_*.npz in {data.directory()}"
    kinds = ("tj_", "curriculum", "policy_")
    assert [name for name in names if not name.startswith(kinds)] == []


@each_field
def test_field_is_as_recorded(path: Path, field: str):
    _, recorded = data.load(path)
    ours, theirs = data.replay(path)[field], recorded[field]
    if field in RELATIVE:
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    elif np.issubdtype(theirs.dtype, np.floating) and field not in EXACT:
        steps = recorded["ep_len"].max() if field.startswith("ep_") else 1
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=FLOAT32 * steps)
    else:
        np.testing.assert_array_equal(ours, theirs)


@each_recording
def test_every_field_of_the_file_is_compared(path: Path):
    meta, recorded = data.load(path)
    vocabulary = SCALAR_FIELDS if meta["vocab_type"] == "scalar" else set()
    assert set(recorded) == FIELDS | vocabulary | GIVEN_FIELDS | LAYOUT_FIELDS
    np.testing.assert_array_equal(np.diff(recorded["step_ptr"]), recorded["ep_len"])
    np.testing.assert_array_equal(np.diff(recorded["state_ptr"]), recorded["ep_len"] + 1)


@each_recording
def test_the_given_arrivals_are_those_of_the_recorded_draws(path: Path):
    """A car comes where the drawn number is not above the rate, and nothing is drawn when full."""
    _, recorded = data.load(path)
    rate = np.repeat(recorded["ep_add_rate"], recorded["ep_len"])[:, None]
    drawn = ~np.isnan(recorded["draw_u"])
    np.testing.assert_array_equal(
        recorded["arrival"][drawn] == 1, (recorded["draw_u"] <= rate)[drawn]
    )
    np.testing.assert_array_equal(recorded["arrival"] == -1, ~drawn)


@each_recording
def test_an_episode_is_cut_at_the_step_limit_and_nowhere_else(path: Path):
    ours = data.replay(path)
    assert ours["truncated_once_at_the_end"].all()
    assert ours["steps_taken"].all()


@each_recording
def test_state_tensor_is_the_own_cell_and_the_way_ahead(path: Path):
    meta, recorded = data.load(path)
    ours, side = data.replay(path), meta["side"]
    own = np.zeros((*recorded["alive"].shape, side, side))
    ahead = np.zeros_like(own)
    for k, i in np.argwhere(recorded["alive"]):
        own[k, i, *recorded["cell"][k, i]] = 1
        route = recorded["route_id"][k, i]
        to_come = slice(recorded["route_pos"][k, i] + 1, recorded["route_len"][route])
        ahead[k, i, *recorded["route_cells"][route, to_come].T] = 1
    np.testing.assert_array_equal(ours["state_tensor"], np.stack([own, ahead], axis=2))
    np.testing.assert_array_equal(ours["state_tensor_from_table"], ours["state_tensor"])


@each_recording
def test_view_has_what_the_recorded_window_has(path: Path):
    meta, recorded = data.load(path)
    road, cars, outside, last_action = np.moveaxis(data.replay(path)["view"], 2, 0)
    alive = (recorded["alive"] == 1)[..., None, None]
    grid = recorded["grid_class"]
    is_road = grid != meta["outside_class"]
    if meta["vocab_type"] == "bool":  # one cell of easy's road has the class of what is none
        route_cells = recorded["route_cells"].reshape(-1, 2)
        is_road = np.zeros(grid.shape, bool)
        is_road[tuple(route_cells[(route_cells >= 0).all(-1)].T)] = True
    around = np.pad(is_road, meta["vision"])
    reach = np.arange(2 * meta["vision"] + 1)
    rows, columns = (recorded["cell"][..., axis, None].astype(int) + reach for axis in (0, 1))
    in_window = around[rows[..., None], columns[..., None, :]]
    np.testing.assert_array_equal(road, alive & in_window)
    np.testing.assert_array_equal(outside, alive & ~in_window)
    np.testing.assert_array_equal(cars, data.without_ghosts(data.configure(meta), recorded))
    np.testing.assert_array_equal(
        last_action, alive * recorded["last_act"][..., None, None] + 0 * road
    )


def curricula() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    with np.load(data.directory() / "curriculum.npz") as file:
        names = sorted({name.split(".")[0] for name in file.files})
        return {name: (file[f"{name}.settings"], file[f"{name}.add_rate"]) for name in names}


@pytest.mark.parametrize("name", curricula())
def test_curriculum(name: str):
    (first, last, start, end), recorded = curricula()[name]
    env = TrafficJunction(
        arrival_rate=first, final_arrival_rate=last, rate_epochs=(int(start), int(end))
    )
    epochs = np.arange(len(recorded))
    np.testing.assert_array_equal(env.rates(epochs), recorded)
    begin = jax.jit(jax.vmap(lambda epoch: env.reset_in_epoch(jax.random.key(0), epoch)))
    np.testing.assert_array_equal(begin(epochs).arrival_rate, recorded.astype(np.float32))
