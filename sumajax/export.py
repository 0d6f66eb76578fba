"""A policy step out of the package: compiled code with the parameters in it, called with JAX alone.

A directory of three files:

    step.bin     the step as `jax.export` writes it; `jax.export.deserialize` reads it
    carry.npz    what one team remembers at the start of an episode, an array per name
    card.json    every input and output with its shape, dtype and meaning; task, policy and versions

The step takes dictionaries, arrays and nothing else, of any number of teams b side by side:

    step(carry, {"state": ..., "view": ...}, key, greedy) -> (carry, {"action": ..., "value": ...})
"""

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import chex
import jax
import jax.export
import jax.numpy as jnp

from sumajax.checkpoint import save_npz
from sumajax.checkpoint.leaves import named_leaves
from sumajax.description import CheckpointError, describe, reason
from sumajax.environments.types import Environment, Observation
from sumajax.keys import IMPLEMENTATION, key_of
from sumajax.policies.types import Policy
from sumajax.reporting.metrics import write_bytes, write_json

PLATFORMS = ("cpu", "cuda")
"""What the step is compiled for, wherever it is exported."""
KNOWN_PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
"""What JAX compiles for; a name that it does not know it takes without a word."""
STEP, CARRY, CARD = "step.bin", "carry.npz", "card.json"
BATCH = "b"
"""The axis of teams side by side, in the card's shapes."""

_MEANING = {
    "state": "each agent's own cell on the grid that the policy reads: 1 there (where the task is "
    "seen upsampled, on its whole block), 0 elsewhere",
    "view": "counts of the entities in the cells around each agent, a channel for each kind; -1 "
    "outside the grid",
    "alive": "which agents are in the task now",
    "entered": "which agents have come with the last step: they start without memory",
    "key": f"two words of a {IMPLEMENTATION} key, as jax.random.key_data(jax.random.key(0)); a new "
    "one for every step; not used where greedy",
    "greedy": "true: every choice is the likeliest; false: drawn from the policy's probabilities",
    "action": "what each agent does",
    "value": "the return that the critic expects for each agent",
}


def export_policy(
    env: Environment,
    policy: Policy,
    params: Any,
    directory: str | os.PathLike[str],
    *,
    platforms: Sequence[str] = PLATFORMS,
) -> Path:
    """Writes a policy's step to `directory`, which must not be there yet, and returns it.

    Args:
      platforms: of `KNOWN_PLATFORMS`; none of them need be at hand.

    Raises:
      CheckpointError: where `directory` is there or cannot be written, flatbuffers is missing, a
        platform is unknown, or JAX cannot compile for it.
    """
    directory = Path(directory)
    if os.path.lexists(directory):
        raise CheckpointError(f"{directory} exists; choose another directory, nothing is replaced.")
    if not platforms or not set(platforms) <= set(KNOWN_PLATFORMS):
        raise CheckpointError(
            f"platforms must be some of {', '.join(KNOWN_PLATFORMS)}, got {list(platforms)}."
        )
    first = named_leaves(policy.initial_carry())
    written = _serialized(policy, params, tuple(platforms))
    try:
        directory.mkdir(parents=True)
        try:
            write_bytes(directory / STEP, written)
            save_npz(directory / CARRY, first)
            write_json(directory / CARD, _card(env, policy, platforms))
        except BaseException:
            shutil.rmtree(directory, ignore_errors=True)
            raise
    except OSError as error:
        raise CheckpointError(
            f"{directory} cannot be written: {reason(error)}; choose a directory that can."
        ) from error
    return directory


def plain_step(policy: Policy, params: Any) -> Callable[..., tuple[Any, Any]]:
    """The step over dictionaries of arrays, b teams side by side."""
    structure, names = jax.tree.structure(policy.initial_carry()), tuple(_carried(policy))

    def step(
        carry: dict[str, chex.Array],
        observation: dict[str, chex.Array],
        key: chex.Array,
        greedy: chex.Array,
    ) -> tuple[dict[str, chex.Array], dict[str, chex.Array]]:
        record = jax.tree.unflatten(structure, [carry[name] for name in names])
        obs = Observation(**observation)
        typed = jax.random.wrap_key_data(key, impl=IMPLEMENTATION)
        noise = policy.sample_noise(typed, obs.view.shape[:1], greedy)
        record, output = policy.apply_with(params, record, obs, noise)
        return named_leaves(record), {"action": output.action, "value": output.value}

    return step


def _serialized(policy: Policy, params: Any, platforms: tuple[str, ...]) -> bytes:
    """The exported step, for any number of teams."""
    (batch,) = jax.export.symbolic_shape(BATCH)
    carry, observation, key, greedy = _inputs(policy)

    def batched(x: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((batch, *x.shape), x.dtype)

    of_teams = jax.tree.map(batched, (carry, observation))
    step = jax.jit(plain_step(policy, params))
    try:
        exported = jax.export.export(step, platforms=platforms)(*of_teams, key, greedy)
        return bytes(exported.serialize())
    except ModuleNotFoundError as error:
        raise CheckpointError(
            f"{error.name} is not installed, with which JAX writes compiled code; pip install "
            "'sumajax[export]'."
        ) from error
    except (NotImplementedError, ValueError) as error:
        raise CheckpointError(
            f"JAX does not compile this policy for platforms {', '.join(platforms)}: "
            f"{reason(error)}; choose of {', '.join(PLATFORMS)}."
        ) from error


def _inputs(policy: Policy) -> tuple[Any, ...]:
    """Carry, observation, key and greedy of one team, in the abstract."""
    team = policy.team
    shapes: dict[str, Any] = {
        "state": jax.ShapeDtypeStruct((team.num_agents, *team.state_shape), jnp.float32),
        "view": jax.ShapeDtypeStruct((team.num_agents, *team.view_shape), jnp.float32),
    }
    if team.agents_leave:
        shapes["alive"] = jax.ShapeDtypeStruct((team.num_agents,), jnp.bool_)
    if team.agents_leave and policy.fresh_memory:
        shapes["entered"] = shapes["alive"]
    key = jax.eval_shape(lambda: jax.random.key_data(key_of(0)))
    return _carried(policy), shapes, key, jax.ShapeDtypeStruct((), jnp.bool_)


def _carried(policy: Policy) -> dict[str, Any]:
    """What one team remembers, by name in the order of its leaves, in the abstract."""
    return named_leaves(jax.eval_shape(policy.initial_carry))


def _card(env: Environment, policy: Policy, platforms: Sequence[str]) -> dict[str, Any]:
    """What a caller without the package has to know."""
    carry, observation, key, greedy = _inputs(policy)
    agents = (policy.team.num_agents,)
    action = jax.ShapeDtypeStruct(agents, jnp.int32)
    value = jax.ShapeDtypeStruct(agents, jnp.float32)
    memory = {name: _array(x, BATCH) for name, x in carry.items()}
    return {
        "format": "sumajax policy step",
        "call": "jax.export.deserialize(step.bin).call(carry, observation, key, greedy) -> "
        "(carry, output)",
        "platforms": list(platforms),
        "inputs": {
            "carry": memory,
            "observation": {name: _array(x, BATCH, name) for name, x in observation.items()},
            "key": _array(key, None, "key"),
            "greedy": _array(greedy, None, "greedy"),
        },
        "outputs": {
            "carry": memory,
            "output": {
                "action": _array(action, BATCH, "action"),
                "value": _array(value, BATCH, "value"),
            },
        },
        "first_carry": f"{CARRY}: of one team, without the axis {BATCH}; at the start of every "
        "episode",
        "action_mask": [list(row) for row in policy.team.action_mask],
        "agent_class": list(policy.team.agent_class),
        **describe(env, policy),
    }


def _array(x: jax.ShapeDtypeStruct, batch: str | None, name: str = "") -> dict[str, Any]:
    """An input or output as the card lists it."""
    shape = [*([batch] if batch else []), *x.shape]
    meaning = {"meaning": _MEANING[name]} if name in _MEANING else {}
    return {"shape": shape, "dtype": str(x.dtype), **meaning}
