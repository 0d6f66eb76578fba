"""Tasks and policies in words: what a checkpoint is of, for whoever reads it next.

`describe` says it as JSON, `rebuild` makes task and policy of that again, from known names alone,
and `check_compatible` says whether the parameters fit another stage.
"""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import math
import os
import platform
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from flax import linen as nn

from sumajax.environments import PredatorCapturePrey, PredatorPrey, TrafficJunction
from sumajax.environments.types import Environment
from sumajax.plain import is_values, plain
from sumajax.policies import POLICIES, Policy, make_policy
from sumajax.upsampling import StateUpsampled

MAX_SETTING, MAX_CELLS = 10_000, 10_000_000
"""Whole numbers, and cells of the grid, of a task or policy that is built from a file."""

POOLED_ENCODERS = ("lab_gap", "coordinates")
"""Encoders that pool over the grid, or read shares of it: their parameters fit any."""

_LINEN_FIELDS = ("parent", "name")
"""Of every module; they say where it stands in another, not what it is."""

_BUILD_IT = (
    "build it in your program and pass env=... and policy=... to load_agent, or take the "
    "parameters alone with load_params"
)

TASKS: dict[str, type] = {
    cls.__name__: cls
    for cls in (PredatorPrey, PredatorCapturePrey, TrafficJunction, StateUpsampled)
}
"""Every task `rebuild` may make, by the name a description calls it."""


PACKAGES = ("jax", "flax", "optax", "orbax-checkpoint", "numpy")
"""Whose versions are worth knowing of a run."""

MAX_ITEMS = 4096
"""Values of an array that a description holds one by one; of a larger one it holds the digest."""


class CheckpointError(ValueError):
    """A checkpoint cannot be written, read or used; the sentence says where, why and the mend."""

    def __init__(self, sentence: str) -> None:
        super().__init__(_printable(sentence))


def describe(env: Environment, policy: Policy, **more: Any) -> dict[str, Any]:
    """The `meta` of a policy on a task, for `save`, `rebuild` and `check_compatible`.

    Args:
      more: preset, seed, epoch and whatever else belongs to the run, as JSON.
    """
    modules = {module.__name__: module for module, _ in POLICIES.values()}
    return {
        "task": describe_task(env),
        "policy": {
            "name": policy.name,
            "module": _class_name(type(policy.module), modules),
            "settings": _settings(policy),
        },
        "num_agents": plain(env.num_agents),
        "num_actions": plain(env.num_actions),
        "state_shape": list(plain(env.state_shape)),
        "view_shape": list(plain(env.view_shape)),
        "versions": versions(),
        **more,
    }


def versions() -> dict[str, str]:
    """Of Python, this package and those it rests on; `unknown` for one that is not installed."""
    from sumajax import __version__  # known also where the package is on the path alone

    others = {name: _version(name) for name in PACKAGES}
    return {"python": platform.python_version(), "sumajax": __version__, **others}


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
                f"policy {name!r} is not one of {', '.join(POLICIES)}; {_BUILD_IT}."
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
    *,
    here: str = "this stage",
    any_grid: bool = False,
) -> None:
    """Whether the parameters of a checkpoint fit `policy` on `env`; team sizes may differ.

    Args:
      meta: of the checkpoint, from `describe`.
      directory: of the checkpoint, for the sentence.
      here: what `env` and `policy` are of, for the sentence.
      any_grid: the position table is going to be resized, the grids may differ.

    Raises:
      CheckpointError: for the first of policy, its settings, vision, observation channels, number
        of actions, policy grid that differs; names both values and the mend.
    """
    try:
        saved, settings = dict(meta), dict(meta["policy"]["settings"])
        pairs = list(_compared(saved, settings, env, policy, any_grid))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise CheckpointError(
            f"{directory} does not say which task and policy it is of; save it with meta from "
            "describe(env, policy)."
        ) from error
    for what, theirs, ours, mend in pairs:
        if theirs != ours:
            raise CheckpointError(
                f"{what} differs: {theirs} in {directory}, {ours} in {here}; {mend}."
            )


def _compared(
    saved: dict[str, Any],
    settings: dict[str, Any],
    env: Environment,
    policy: Policy,
    any_grid: bool,
) -> Iterator[tuple[str, Any, Any, str]]:
    """(what, saved value, value here, mend) in the order in which they are worth knowing."""
    yield "policy", saved["policy"]["name"], policy.name, "use one policy in both"
    for name, here in _settings(policy).items():
        # A setting younger than the checkpoint was its default then.
        yield (
            f"policy setting {name}",
            settings.pop(name, here),
            here,
            "use one value in both",
        )
    for name, value in settings.items():
        yield f"policy setting {name}", value, "unknown", "use the policy it was saved with"
    view, here = saved["view_shape"], list(env.view_shape)
    yield "vision", (view[1] - 1) // 2, (here[1] - 1) // 2, "give both the same vision"
    yield (
        "number of observation channels",
        view[0],
        here[0],
        "use tasks with the same entities in both",
    )
    yield (
        "number of actions",
        saved["num_actions"],
        env.num_actions,
        "use tasks with the same actions in both",
    )
    if any_grid or _settings(policy).get("encoder") in POOLED_ENCODERS:
        return
    yield (
        "the policy's grid",
        _sides(saved["state_shape"]),
        _sides(env.state_shape),
        "upsample the smaller task with StateUpsampled(env, size) to the size of the larger",
    )


def _sides(state_shape: Any) -> str:
    return f"{state_shape[1]}x{state_shape[2]}"


def describe_task(value: Any) -> dict[str, Any]:
    """A task as JSON: its class and the fields of its configuration; so is a dataclass within."""
    fields = dataclasses.fields(value) if dataclasses.is_dataclass(value) else ()
    fixed = _LINEN_FIELDS if isinstance(value, nn.Module) else ()
    names = [field.name for field in fields if field.init and field.name not in fixed]
    return {
        "class": _class_name(type(value), TASKS),
        "fields": {name: _json(getattr(value, name)) for name in names},
    }


def _class_name(cls: Any, known: dict[str, Any]) -> str:
    """Its bare name only if that means this very class, else the name of where it is from."""
    bare = cls.__name__
    return bare if known.get(bare) is cls else f"{cls.__module__}.{cls.__qualname__}"


def _json(value: Any) -> Any:
    """`value` as JSON; of what JSON cannot say only a name that is the same in the next program."""
    value = plain(value)
    if is_values(value):
        return value.tolist() if value.size <= MAX_ITEMS else _described_array(np.asarray(value))
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (list, tuple)):
        return [_json(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _json(item) for key, item in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return describe_task(value)
    return _class_name(value if hasattr(value, "__qualname__") else type(value), {})


def _described_array(array: np.ndarray) -> dict[str, Any]:
    digest = hashlib.sha256(array.tobytes()).hexdigest()
    return {"shape": list(array.shape), "dtype": str(array.dtype), "sha256": digest}


def _settings(policy: Policy) -> dict[str, Any]:
    """Every field of the policy's module that a user may set."""
    variant = POLICIES[policy.name][1] if policy.name in POLICIES else {}
    fixed = {"team", *_LINEN_FIELDS, *variant}
    names = [f.name for f in dataclasses.fields(policy.module) if f.init and f.name not in fixed]
    return {name: _json(getattr(policy.module, name)) for name in names}


def _rebuild_task(task: dict[str, Any], depth: int = 0) -> Environment:
    name, fields = task["class"], _bounded(task["fields"])
    if not isinstance(name, str) or name not in TASKS or depth > 4:
        raise CheckpointError(f"task {name!r} is not one of {', '.join(TASKS)}; {_BUILD_IT}.")
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
    """`unknown` where only its files are there, as of a clone on the path."""
    try:
        return importlib.metadata.version(package) or "unknown"
    except (importlib.metadata.PackageNotFoundError, KeyError):
        return "unknown"


def _printable(sentence: str) -> str:
    """On one line and with nothing that steers a terminal: a path may hold any character."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in sentence)


def reason(error: BaseException) -> str:
    """The first line of an error, or what the system said at its root, without a full stop."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    if found := re.search(r"([^:]+) \[os_error_code=", text):  # of TensorStore
        return found[1].strip()
    lines = text.strip().splitlines() or [type(error).__name__]
    return lines[0][:200].rstrip(". ")
