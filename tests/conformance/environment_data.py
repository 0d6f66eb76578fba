"""Recorded episodes of the original Predator-Prey programs, and the same episodes replayed by ours.

A recording is one `.npz` file; tests/data/environments/README.md defines its fields. `replay` gives
our own answer to every one of them, in the same layout, so that a test only compares two arrays.
Set SUMAJAX_CONFORMANCE_DATA to a directory with an `environments/` folder to replay other files.

Symbols of that README: E episodes, S steps, K = S + E states, n agents, w window side, d grid side;
here also T = max_steps, to which every episode is padded so that all of them run side by side.
"""

import json
import os
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sumajax.environments import Observation, PredatorCapturePrey, PredatorPrey, Transition
from sumajax.environments.grid import OUTSIDE, STAY, window_offsets
from sumajax.environments.predator_capture_prey import CAPTURER, State

Arrays = dict[str, np.ndarray]

FLAT_CLASSES = ("capturers", "outside", "prey", "predators")
"""Order of the four class entries of a flat window cell."""
NO_LOCATION, HIDDEN_LOCATION = -1, -2
"""`obs_loc` of a cell outside the grid, and of one whose location entries are masked."""
MASKED = -1
"""Class and location entries of a cell that an agent is not allowed to see."""


def directory() -> Path:
    default = Path(__file__).parents[1] / "data"
    return Path(os.environ.get("SUMAJAX_CONFORMANCE_DATA", default)) / "environments"


def recordings() -> list[Path]:
    return sorted(directory().glob("*.npz"))


@lru_cache(maxsize=64)
def load(path: Path) -> tuple[dict[str, Any], Arrays]:
    """The configuration and the arrays of one recording."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    return json.loads(str(arrays.pop("meta_json"))), arrays


def recorded_domain(meta: dict[str, Any]) -> type[PredatorCapturePrey]:
    return PredatorCapturePrey if meta["env"].startswith("PCP") else PredatorPrey


def configure(meta: dict[str, Any], domain: type[PredatorCapturePrey]) -> PredatorCapturePrey:
    """The recorded configuration in our words."""
    common = {
        "size": meta["dim"],
        "num_predators": meta["nP"],
        "vision": meta["vision"],
        "max_steps": meta["max_steps"],
        "reward_mode": meta["mode"],
    }
    if domain is PredatorPrey:
        return PredatorPrey(**common)
    return PredatorCapturePrey(
        **common,
        num_capturers=meta["nA"],
        capture_reward="second" if meta["second_reward_scheme"] else "default",
        capture_vision=meta["A_vision"] if meta["A_vision"] >= 0 else None,
    )


@lru_cache(maxsize=64)
def replay(path: Path, domain: type[PredatorCapturePrey]) -> Arrays:
    """Our answer to every field of the recording, and some that only ours has."""
    meta, recorded = load(path)
    env = configure(meta, domain)
    states, seen, index, transition = run(env, *padded_inputs(env, recorded))
    ended = transition.terminated | transition.truncated  # (E, T)
    length = ended.argmax(1) + 1
    in_step = np.arange(env.max_steps) < length[:, None]  # (E, T)
    in_state = np.arange(env.max_steps + 1) <= length[:, None]  # (E, T + 1)
    last = (np.arange(len(length)), length - 1)
    classes = flat_classes(env, states.agents[in_state], seen.view[in_state])
    location = flat_location(env, seen.state[in_state])
    return {
        "reward": transition.reward[in_step],
        "done_env": transition.terminated[in_step],
        "success": transition.success[in_step],
        "pos": states.agents[in_state],
        "prey_pos": states.prey[in_state][:, None],
        "reached": states.reached[in_state],
        "captured": states.captured[in_state][:, env.agent_class == CAPTURER],
        "ep_len": transition.steps_taken[last],
        "ep_terminated": transition.terminated[last],
        "ep_truncated": transition.truncated[last],
        "ep_success": transition.success[last],
        "ep_return": (transition.reward * in_step[..., None]).sum(1, dtype=np.float64),
        # A transition has no other reward than that of its step.
        "ep_reward_terminal": np.zeros((len(length), env.num_agents)),
        "obs_loc": location,
        "obs_cls": classes,
        "obs_raw_ep0": flat_entries(env, location, classes)[: length[0] + 1],
        "obs_tensor": three_channels(env, seen.view[in_state]),
        "state_index": index[in_state],
        "state_tensor": seen.state[in_state],
        "state_tensor_from_table": np.asarray(env.state_table())[index[in_state]],
    }


def padded_inputs(
    env: PredatorCapturePrey, recorded: Arrays
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Starts (E, n, 2) and (E, 2), actions (E, T, n): after the recorded ones all agents stay."""
    lengths = np.diff(recorded["step_ptr"])
    actions = np.full((len(lengths), env.max_steps, env.num_agents), STAY, np.int32)
    actions[np.arange(env.max_steps) < lengths[:, None]] = recorded["action"]
    starts = recorded["state_ptr"][:-1]
    return recorded["pos"][starts], recorded["prey_pos"][starts][:, 0], actions


def run(
    env: PredatorCapturePrey, agents: np.ndarray, prey: np.ndarray, actions: np.ndarray
) -> tuple[State, Observation, np.ndarray, Transition]:
    """States, observations and state indices (E, T + 1, ...) and transitions (E, T, ...)."""

    def one_step(state, action):
        following, transition = env.step(state, action)
        return following, (following, transition)

    def one_episode(agents, prey, actions):
        start = env.state_at(agents, prey)
        _, (rest, transition) = jax.lax.scan(one_step, start, actions)
        states = jax.tree.map(lambda s, r: jnp.concatenate([s[None], r]), start, rest)
        return states, jax.vmap(env.observe)(states), jax.vmap(env.state_index)(states), transition

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one_episode))(agents, prey, actions))


def window_cells(env: PredatorCapturePrey, agents: np.ndarray) -> np.ndarray:
    """(K, n, w, w, 2): the cell, inside the grid or not, that each window cell shows."""
    return agents[:, :, None, None] + window_offsets(env.vision)


def flat_location(env: PredatorCapturePrey, state: np.ndarray) -> np.ndarray:
    """(K, n, w, w) flat index of each window cell, from the (K, n, 1, d, d) state tensors alone."""
    rows, columns = env.shape
    own = state.reshape(*state.shape[:2], -1).argmax(-1)
    cell = window_cells(env, np.stack([own // columns, own % columns], axis=-1))
    outside = (cell < 0).any(-1) | (cell >= (rows, columns)).any(-1)
    location = np.where(outside, NO_LOCATION, cell[..., 0] * columns + cell[..., 1])
    return np.where(beyond_sight(env), HIDDEN_LOCATION, location)


def flat_classes(env: PredatorCapturePrey, agents: np.ndarray, view: np.ndarray) -> np.ndarray:
    """(K, n, w, w, 4) class entries as the originals give them, from the (K, n, c, w, w) views.

    Ours tells a blind agent zeros where the original tells it -1, and only the original, whose
    windows are views of one shared array, masks those cells in everybody else's window too.
    """
    outside = (view == OUTSIDE).all(2)
    channels = {"capturers": np.zeros_like(outside), "outside": outside}
    channels |= {name: np.where(outside, 0, view[:, :, i]) for i, name in enumerate(env.entities)}
    classes = np.stack([channels[name] for name in FLAT_CLASSES], axis=-1)
    masked = beyond_sight(env) | blind(env)[:, None, None] | leaked(env, agents)
    return np.where(masked[..., None], MASKED, classes)


def flat_entries(env: PredatorCapturePrey, location: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """(K, n, w * w * (d * d + 4)): the flat observation of the originals."""
    bits = location[..., None] == np.arange(env.shape[0] * env.shape[1])
    bits = np.where((location == HIDDEN_LOCATION)[..., None], MASKED, bits)
    return np.concatenate([bits, classes], axis=-1).reshape(*location.shape[:2], -1)


def three_channels(env: PredatorCapturePrey, view: np.ndarray) -> np.ndarray:
    """(K, n, 3, w, w): a PP view with the channel of its zero capture agents put back in."""
    if "capturers" in env.entities:
        return view
    no_capturers = np.where(view[:, :, :1] == OUTSIDE, OUTSIDE, 0)
    return np.concatenate([view[:, :, :1], no_capturers, view[:, :, 1:]], axis=2)


def blind(env: PredatorCapturePrey) -> np.ndarray:
    """(n,) bool."""
    return (env.agent_class == CAPTURER) & (env.capture_vision is None)


def beyond_sight(env: PredatorCapturePrey) -> np.ndarray:
    """(n, w, w) bool: window cells farther away than a capture agent with some vision sees."""
    if env.capture_vision is None:
        return np.zeros((env.num_agents, *env.view_shape[1:]), bool)
    far = np.abs(window_offsets(env.vision)).max(-1) > env.capture_vision
    return (env.agent_class == CAPTURER)[:, None, None] & far


def leaked(env: PredatorCapturePrey, agents: np.ndarray) -> np.ndarray:
    """(K, n, w, w) bool: window cells that also lie in the window of some blind agent."""
    blind_cells = agents[:, blind(env)][:, None, None, None]  # (K, 1, 1, 1, blind, 2)
    distance = np.abs(window_cells(env, agents)[..., None, :] - blind_cells).max(-1)
    return (distance <= env.vision).any(-1)


def complete(recorded: Arrays) -> np.ndarray:
    """(K,) bool: everybody is on the prey and every capture agent has captured."""
    on_prey = (recorded["pos"] == recorded["prey_pos"]).all(-1)
    return on_prey.all(-1) & recorded["captured"].all(-1)
