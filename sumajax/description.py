"""Tasks and policies in words: what a checkpoint is of, for whoever reads it next.

`describe` says it as JSON, `rebuild` makes task and policy of that again, from known names alone,
and `check_compatible` says whether the parameters fit another stage.
"""

import contextlib
import dataclasses
import importlib.metadata
import math
import os
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.environments.types import Environment
from sumajax.policies import POLICIES, Policy, make_policy
from sumajax.upsampling import StateUpsampled

MAX_SETTING, MAX_CELLS = 10_000, 10_000_000
"""Whole numbers, and cells of the grid, of a task or policy that is built from a file."""

POOLED_ENCODERS = ("lab_gap",)
"""Encoders that pool over the grid: their parameters fit any."""

TASKS: dict[str, type] = {
    cls.__name__: cls for cls in (PredatorPrey, PredatorCapturePrey, StateUpsampled)
}
"""Every task `rebuild` may make, by the name a description calls it."""


class CheckpointError(ValueError):
    """A checkpoint cannot be written, read or used; the sentence says where, why and the mend."""


def describe(env: Environment, policy: Policy, **more: Any) -> dict[str, Any]:
    """The `meta` of a policy on a task, for `save`, `rebuild` and `check_compatible`.

    Args:
      more: preset, seed, epoch and whatever else belongs to the run, as JSON.
    """
    cls = type(policy.module)
    return {
        "task": describe_task(env),
        "policy": {
            "name": policy.name,
            "module": _class_name(
                cls, {module.__name__: module for module, _ in POLICIES.values()}
            ),
            "settings": _settings(policy),
        },
        "num_agents": env.num_agents,
        "num_actions": env.num_actions,
        "state_shape": list(env.state_shape),
        "view_shape": list(env.view_shape),
        "versions": {name: _version(name) for name in ("sumajax", "jax", "flax", "optax")},
        **more,
    }


def rebuild(meta: dict[str, Any]) -> tuple[Environment, Policy]:
    """The task and the policy of `meta`, made from the names in `TASKS` and `POLICIES` alone.

    Raises:
      CheckpointError: for a task or policy that is not one of those, or a value it refuses.
    """
    env = rebuild_task(meta)
    return env, rebuild_policy(meta, env)


def rebuild_task(meta: dict[str, Any]) -> Environment:
    """The task of `meta`; errors as for `rebuild`."""
    with _unusable():
        return _rebuild_task(meta["task"])


def rebuild_policy(meta: dict[str, Any], env: Environment) -> Policy:
    """The policy of `meta`, shaped for `env`; errors as for `rebuild`."""
    with _unusable():
        name, settings = meta["policy"]["name"], meta["policy"]["settings"]
        if name not in POLICIES or POLICIES[name][0].__name__ != meta["policy"]["module"]:
            raise CheckpointError(
                f"policy {name!r} is not one of {', '.join(POLICIES)}; build it in your program "
                "and give it to load_agent as policy=..., or take its parameters with load_params."
            )
        settings = _bounded(settings)
        policy = make_policy(name, env, **settings)
        for field in dataclasses.fields(policy.module):
            if field.name in settings and not _fits(settings[field.name], field.default):
                raise ValueError(f"policy setting {field.name} is {settings[field.name]!r}")
        return policy


@contextlib.contextmanager
def _unusable() -> Iterator[None]:
    """Whatever a description that is not ours makes go wrong, in one sentence."""
    try:
        yield
    except CheckpointError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise CheckpointError(
            f"the checkpoint's description of task and policy is not usable ({reason(error)}); "
            "save it with meta from describe(env, policy)."
        ) from error


def check_compatible(
    meta: dict[str, Any],
    env: Environment,
    policy: Policy,
    directory: str | os.PathLike[str] = "the checkpoint",
) -> None:
    """Whether the parameters of a checkpoint fit `policy` on `env`; team sizes may differ.

    Args:
      meta: of the checkpoint, from `describe`.
      directory: of the checkpoint, for the sentence.

    Raises:
      CheckpointError: for the first of policy, its settings, vision, observation channels, number
        of actions, policy grid that differs; names both values and the mend.
    """
    try:
        saved, settings = dict(meta), dict(meta["policy"]["settings"])
        pairs = list(_compared(saved, settings, env, policy))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise CheckpointError(
            f"{directory} does not say which task and policy it is of; save it with meta from "
            "describe(env, policy)."
        ) from error
    for what, theirs, ours, mend in pairs:
        if theirs != ours:
            raise CheckpointError(
                f"{what} differs: {theirs} in {directory}, {ours} in this stage; {mend}."
            )


def _compared(
    saved: dict[str, Any], settings: dict[str, Any], env: Environment, policy: Policy
) -> Iterator[tuple[str, Any, Any, str]]:
    """(what, saved value, value here, mend) in the order in which they are worth knowing."""
    yield "policy", saved["policy"]["name"], policy.name, "use one policy in both stages"
    for name, here in _settings(policy).items():
        # A setting younger than the checkpoint was its default then.
        yield (
            f"policy setting {name}",
            settings.pop(name, here),
            here,
            "use one value in both stages",
        )
    for name, value in settings.items():
        yield f"policy setting {name}", value, "unknown", "use the policy it was saved with"
    view, here = saved["view_shape"], list(env.view_shape)
    yield "vision", (view[1] - 1) // 2, (here[1] - 1) // 2, "give both stages the same vision"
    yield (
        "number of observation channels",
        view[0],
        here[0],
        "use tasks with the same entities (Predator-Prey or Predator-Capture-Prey) in both stages",
    )
    yield (
        "number of actions",
        saved["num_actions"],
        env.num_actions,
        "use tasks with the same actions in both stages",
    )
    if _settings(policy).get("encoder") in POOLED_ENCODERS:
        return
    yield (
        "the policy's grid",
        _sides(saved["state_shape"]),
        _sides(env.state_shape),
        "upsample the smaller task with StateUpsampled(env, size) to the size of the larger",
    )


def _sides(state_shape: Any) -> str:
    return f"{state_shape[1]}x{state_shape[2]}"


def describe_task(env: Any) -> dict[str, Any]:
    """A task as JSON: its class, and the fields of its configuration."""
    fields = dataclasses.fields(env) if dataclasses.is_dataclass(env) else ()
    return {
        "class": _class_name(type(env), TASKS),
        "fields": {field.name: _plain(getattr(env, field.name)) for field in fields if field.init},
    }


def _class_name(cls: Any, known: dict[str, Any]) -> str:
    """Its bare name only if that means this very class, else the name of where it is from."""
    bare = cls.__name__
    return bare if known.get(bare) is cls else f"{cls.__module__}.{cls.__qualname__}"


def _plain(value: Any) -> Any:
    """`value` as JSON; of what JSON cannot say only the name is kept."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value)
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if type(value) in TASKS.values():
        return describe_task(value)
    return _class_name(value if hasattr(value, "__qualname__") else type(value), {})


def _settings(policy: Policy) -> dict[str, Any]:
    """Every field of the policy's module that a user may set."""
    variant = POLICIES[policy.name][1] if policy.name in POLICIES else {}
    fixed = {"team", "parent", "name", *variant}
    names = [f.name for f in dataclasses.fields(policy.module) if f.init and f.name not in fixed]
    return {name: _plain(getattr(policy.module, name)) for name in names}


def _rebuild_task(task: dict[str, Any], depth: int = 0) -> Environment:
    name, fields = task["class"], _bounded(task["fields"])
    if not isinstance(name, str) or name not in TASKS or depth > 4:
        raise CheckpointError(
            f"task {name!r} is not one of {', '.join(TASKS)}; build it in your program and give it "
            "to load_agent as env=..., or take the policy's parameters with load_params."
        )
    if "env" in fields:
        fields["env"] = _rebuild_task(fields["env"], depth + 1)
    env = TASKS[name](**fields)
    if math.prod(env.state_shape) > MAX_CELLS:
        raise CheckpointError(
            f"the described task has a {_sides(env.state_shape)} grid, more than the {MAX_CELLS} "
            "cells that are read from a file; build it in your program."
        )
    return env


def _bounded(fields: dict[str, Any]) -> dict[str, Any]:
    """Fields read from a file, whole numbers limited (`max_steps` is free), lists hashable."""
    for name, value in fields.items():
        if isinstance(value, int) and abs(value) > MAX_SETTING and name != "max_steps":
            raise CheckpointError(
                f"the described {name} {value} is more than the {MAX_SETTING} that is read from a "
                "file; build task and policy in your program."
            )
    return {k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()}


def _fits(value: Any, default: Any) -> bool:
    """Whether a setting has the type of its default, as far as that tells."""
    if default is None or default is dataclasses.MISSING:
        return True
    return type(value) is type(default) or (type(value), type(default)) == (int, float)


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def reason(error: BaseException) -> str:
    """The first line of an error, or what the system said at its root, without a full stop."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    if said := re.search(r"([^:]+) \[os_error_code=", text):  # of TensorStore
        return said[1].strip()
    lines = text.strip().splitlines() or [type(error).__name__]
    return lines[0][:200].rstrip(". ")
