"""Recorded episodes of the original Traffic Junction, and the same episodes replayed by ours.

A recording is one `tj_*.npz` file; tests/data/traffic_junction/README.md defines its fields. As in
`environment_data`, `replay` gives our own answer to every one of them. Set
SUMAJAX_CONFORMANCE_DATA to a directory with a `traffic_junction/` folder to replay other files.

Symbols of that README: E episodes, S steps, K = S + E states, N slots, G entries, w window side, d
grid side; here also T = max_steps, the length of every episode.
"""

import json
import os
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sumajax.environments import TrafficJunction
from sumajax.environments.traffic_junction import (
    Arrivals,
    collided,
    exact_rates,
    flat_observation,
    rates,
)

Arrays = dict[str, np.ndarray]


def directory() -> Path:
    default = Path(__file__).parents[1] / "data"
    return Path(os.environ.get("SUMAJAX_CONFORMANCE_DATA", default)) / "traffic_junction"


def recordings() -> list[Path]:
    return sorted(directory().glob("tj_*.npz"))


@lru_cache(maxsize=64)
def load(path: Path) -> tuple[dict[str, Any], Arrays]:
    """The configuration and the arrays of one recording."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    return json.loads(str(arrays.pop("meta_json"))), arrays


def configure(meta: dict[str, Any]) -> TrafficJunction:
    """The recorded configuration in our words."""
    return TrafficJunction(
        meta["difficulty"],
        meta["dim"],
        meta["nagents"],
        meta["vision"],
        meta["max_steps"],
        meta["add_rate_min"],
        meta["add_rate_max"],
        (meta["curr_start"], meta["curr_end"]),
    )


@lru_cache(maxsize=64)
def replay(path: Path) -> Arrays:
    """Our answer to every field of the recording, and some that only ours has."""
    meta, recorded = load(path)
    env = configure(meta)
    states, transition, flat, seen, index = run(env, meta["vocab_type"], recorded)
    alive, roads, steps = states.alive, env.roads, env.max_steps
    cell = np.where(alive[..., None], roads.cell[states.place], 0)
    after = jax.tree.map(lambda leaf: leaf[:, 1:], states)
    collisions = jax.jit(jax.vmap(jax.vmap(lambda state: collided(env, state))))(after)
    parts = {
        "reward": transition.reward,
        "collided": np.asarray(collisions),
        "completed": transition.left,
        "done_env": transition.terminated,
        "success": transition.success,
        "arrival_route": entered_routes(env, after, recorded),
        "alive": alive,
        "cell": cell,
        "route_id": roads.route[states.place],
        "route_pos": roads.position[states.place],
        "wait": states.wait,
        "last_act": states.last_action,
        "cars_in_sys": alive.sum(-1),
        **flat_parts(env, meta["vocab_type"], flat),
        "state_tensor": seen.state,
        "view": seen.view,
        "state_tensor_from_table": env.state_table()[index],
    }
    fields = {name: array.reshape(-1, *array.shape[2:]) for name, array in parts.items()}
    epochs = recorded["ep_epoch"]
    value_loss, action_loss = losses(transition.reward, transition.left, alive[:, 1:])
    return fields | {
        "grid_class": roads.classes if meta["vocab_type"] == "bool" else roads.road,
        "route_len": np.array([len(route) for route in roads.routes]),
        "route_cells": np.where(roads.padded_routes < 0, -1, roads.padded_routes),
        "ep_add_rate": rates(env, epochs),
        "ep_exact_rate": exact_rates(env, epochs),
        "ep_len": transition.truncated.argmax(1) + 1,
        "ep_success": transition.success[:, -1],
        "ep_return": transition.reward.sum(1, dtype=np.float64),
        # A transition has no other reward than that of its step.
        "ep_reward_terminal": np.zeros((len(epochs), env.num_agents)),
        "ep_value_loss": value_loss,
        "ep_action_loss": action_loss,
        "obs_raw_ep0": flat[0],
        "truncated_once_at_the_end": transition.truncated.sum(1) == transition.truncated[:, -1],
        "steps_taken": transition.steps_taken == 1 + np.arange(steps),
    }


def run(env: TrafficJunction, vocabulary: str, recorded: Arrays):
    """States (E, T + 1, ...), transitions (E, T, ...); flat and tensor observations, state rows."""

    def one_step(state, given):
        following, transition = env.step_with(state, *given)
        return following, (following, transition)

    def one_episode(*given):
        start = env.reset(jax.random.key(0))
        _, (rest, transition) = jax.lax.scan(one_step, start, given)
        states = jax.tree.map(lambda s, r: jnp.concatenate([s[None], r]), start, rest)
        flat = jax.vmap(lambda state: flat_observation(env, state, vocabulary))(states)
        seen, index = jax.vmap(env.observe)(states), jax.vmap(env.state_index)(states)
        return states.replace(key=None), transition, flat, seen, index

    def by_episode(name: str) -> np.ndarray:
        rows = recorded[name].astype(np.int32)
        return rows.reshape(-1, env.max_steps, *rows.shape[1:])

    slot, choice = by_episode("arrival_slot"), by_episode("arrival_choice")
    arrivals = Arrivals(happens=by_episode("arrival") == 1, slot=slot, choice=choice)
    result = jax.jit(jax.vmap(one_episode))(by_episode("action"), arrivals)
    return jax.tree.map(np.asarray, result)


def entered_routes(env: TrafficJunction, after, recorded: Arrays) -> np.ndarray:
    """(E, T, G) route ids of the cars that stand at their entry where one was let in, else -1."""
    slot = recorded["arrival_slot"].astype(int).reshape(*after.time.shape, -1)
    place = np.take_along_axis(after.place, np.maximum(slot, 0), axis=-1)
    new = (slot >= 0) & (env.roads.position[place] == 0)
    return np.where(new, env.roads.route[place], -1)


def flat_parts(env: TrafficJunction, vocabulary: str, flat: np.ndarray) -> Arrays:
    """The parts of flat observations (..., N, length) that the recording has apart."""
    own = 4 if vocabulary == "scalar" else 2
    window = flat[..., own:].reshape(*flat.shape[:-1], *env.view_shape[1:], -1)
    parts = {"obs_act": flat[..., 0], "obs_route": flat[..., 1], "obs_cars": window[..., -1]}
    if vocabulary == "scalar":
        return parts | {"obs_loc": flat[..., 2:4], "obs_class": window[..., 0]}
    classes = window[..., :-1]
    return parts | {"obs_class": np.where(classes.any(-1), classes.argmax(-1), -1)}


def losses(
    reward: np.ndarray, left: np.ndarray, alive_after: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(E, 2) value and policy losses of the recorded trainer, by their definition, from (E, T, N).

    Values are 0, every log-probability is log(1/2), nothing is discounted. An agent's own return
    is cut where its car completes, the team's is not; column 0 is the own, column 1 the team's.
    """
    own, team = np.zeros_like(reward, float), np.zeros_like(reward, float)
    next_own = next_team = np.zeros_like(own[:, 0])
    for t in reversed(range(reward.shape[1])):
        own[:, t] = next_own = reward[:, t] + ~left[:, t] * next_own
        team[:, t] = next_team = reward[:, t] + next_team
    targets = [own, np.broadcast_to(team.mean(-1, keepdims=True), own.shape)]
    value = [(alive_after * target**2).sum((1, 2)) for target in targets]
    action = [-(alive_after * target * np.log(0.5)).sum((1, 2)) for target in targets]
    return np.stack(value, axis=-1), np.stack(action, axis=-1)


def without_ghosts(env: TrafficJunction, recorded: Arrays) -> np.ndarray:
    """(K, N, w, w) recorded car counts less the empty slots, which the original has at (0, 0)."""
    reach = np.arange(-env.vision, env.vision + 1)
    at_corner = [recorded["cell"][..., axis, None] + reach == 0 for axis in (0, 1)]
    shows_corner = at_corner[0][..., None] & at_corner[1][..., None, :]
    empty = env.num_agents - recorded["cars_in_sys"][:, None, None, None]
    seen = shows_corner & (recorded["alive"] == 1)[..., None, None]
    return recorded["obs_cars"] - seen * empty
