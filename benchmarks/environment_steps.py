"""How many environment steps per CPU second the domains make on their own, without a policy.

Method. E environments run side by side for T steps in one compiled rollout: `vmap` of the plain
per-environment functions inside one `lax.scan`. Actions are uniform and drawn for the whole rollout
before the scan, and so are the fresh starts that replace ended episodes: T x E calls of
`env.reset`, one for each step with which an episode could end. Each step calls `step`, then `view`
and `state_index` of what follows (with `--state-tensor` the whole of `observe`), and adds up all
that they return, so that nothing is dead code. The draws are part of the time.

Compile time is apart. A figure is the median over the repeats, with the extremes beside it; CPU
seconds are user + system time of all threads of the process. To measure on one core:

    taskset -c 0 python benchmarks/environment_steps.py --json steps.json
"""

import json
import math
import os
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import chex
import jax
import jax.numpy as jnp
import tyro

from sumajax.environments import PredatorCapturePrey, PredatorPrey, TrafficJunction
from sumajax.environments.roads import Difficulty
from sumajax.environments.types import Environment

Rollout = Callable[[Any, chex.PRNGKey], tuple[Any, chex.Array]]


@dataclass(frozen=True)
class Options:
    """Which tasks to step, and for how long."""

    sizes: tuple[int, ...] = (5, 10, 20)
    """Sides of the grids."""
    predators: tuple[int, ...] = (3, 5, 10)
    """Predators, one number per size."""
    capturers: int = 0
    """Capture agents beside them; 0 is Predator-Prey."""
    junctions: tuple[Difficulty, ...] = ()
    """Traffic Junctions at their published sizes, to be stepped instead of these grids."""
    vision: int = 1
    """How many cells an agent sees in each direction."""
    max_steps: int = 200
    """Step limit of an episode on the grids."""
    environments: tuple[int, ...] = (64, 256, 1024)
    """Numbers of environments side by side."""
    steps: int = 64
    """Steps of a rollout, which is one compiled call."""
    resets: bool = True
    """Replace ended episodes by fresh starts; without, they run on past their end."""
    state_tensor: bool = False
    """Build every agent's one-hot state tensor too, where learning gathers by cell instead."""
    repeats: int = 15
    """Timed repeats of each configuration."""
    seconds: float = 0.2
    """CPU seconds of a repeat, at least one rollout."""
    json: Path | None = None
    """Write the figures to this file as well."""

    def __post_init__(self) -> None:
        if len(self.sizes) != len(self.predators):
            raise ValueError(
                f"give one number of predators per size, got {len(self.predators)} "
                f"for {len(self.sizes)} sizes."
            )


@dataclass(frozen=True)
class Rates:
    """Environment steps per second over the repeats."""

    median: float
    least: float
    most: float


@dataclass(frozen=True)
class Result:
    """One configuration, measured."""

    task: str
    environments: int
    compile_seconds: float
    steps_per_cpu_second: Rates
    steps_per_second: Rates


def make_envs(options: Options) -> list[Environment]:
    """The junctions asked for, or else the grids."""
    vision, max_steps = options.vision, options.max_steps
    if options.junctions:
        return [TrafficJunction(difficulty, vision=vision) for difficulty in options.junctions]
    teams = list(zip(options.sizes, options.predators, strict=True))
    if options.capturers == 0:
        return [
            PredatorPrey(size, count, vision=vision, max_steps=max_steps) for size, count in teams
        ]
    return [
        PredatorCapturePrey(size, count, options.capturers, vision=vision, max_steps=max_steps)
        for size, count in teams
    ]


def make_rollout(env: Environment, options: Options, num_envs: int) -> Rollout:
    """(states, key) -> (states, checksum): `options.steps` steps of all environments."""
    length = options.steps

    def one_step(states: Any, inputs: tuple[chex.Array, Any]) -> tuple[Any, chex.Array]:
        actions, fresh = inputs
        states, transition = jax.vmap(env.step)(states, actions)
        if options.resets:
            done = transition.terminated | transition.truncated
            states = jax.tree.map(partial(choose, done), fresh, states)
        seen = jax.vmap(env.observe if options.state_tensor else env.view)(states)
        everything = (transition, seen, jax.vmap(env.state_index)(states))
        return states, sum(leaf.sum(dtype=jnp.float32) for leaf in jax.tree.leaves(everything))

    def rollout(states: Any, key: chex.PRNGKey) -> tuple[Any, chex.Array]:
        action_key, reset_key = jax.random.split(key)
        actions = draw_actions(action_key, (length, num_envs, env.num_agents), env.num_actions)
        fresh = draw_starts(reset_key, (length, num_envs), env) if options.resets else None
        states, checksums = jax.lax.scan(one_step, states, (actions, fresh))
        return states, checksums.sum()

    return rollout


def draw_actions(key: chex.PRNGKey, shape: tuple[int, ...], num_actions: int) -> chex.Array:
    """Uniform actions: 16 random bits scaled to the range are even enough to time with."""
    bits = jax.random.bits(key, (math.prod(shape),), jnp.uint16).astype(jnp.uint32)
    return ((bits * num_actions) >> 16).astype(jnp.int32).reshape(shape)


def draw_starts(key: chex.PRNGKey, shape: tuple[int, int], env: Environment) -> Any:
    """Fresh states, leaves (T, E, ...); drawn along one axis, which vectorises better than two."""
    states = jax.vmap(env.reset)(jax.random.split(key, math.prod(shape)))
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), states)


def choose(done: chex.Array, fresh: chex.Array, going_on: chex.Array) -> chex.Array:
    """(E, ...) of `fresh` where an episode is done, of `going_on` elsewhere."""
    return jnp.where(done.reshape(-1, *[1] * (going_on.ndim - 1)), fresh, going_on)


def measure(env: Environment, options: Options, num_envs: int) -> Result:
    """Compile, run once, then time `options.repeats` repeats."""
    key = jax.random.key(0)
    states = jax.vmap(env.reset)(jax.random.split(key, num_envs))
    started = time.perf_counter()
    rollout = jax.jit(make_rollout(env, options, num_envs)).lower(states, key).compile()
    compile_seconds = time.perf_counter() - started
    states, _ = jax.block_until_ready(rollout(states, key))
    steps = num_envs * options.steps
    per_cpu_second, per_second = [], []
    for repeat_key in list(jax.random.split(key, options.repeats)):
        cpu, wall, calls = time.process_time(), time.perf_counter(), 0
        while calls == 0 or time.process_time() - cpu < options.seconds:
            states, _ = jax.block_until_ready(rollout(states, repeat_key))
            calls += 1
        per_cpu_second.append(calls * steps / (time.process_time() - cpu))
        per_second.append(calls * steps / (time.perf_counter() - wall))
    return Result(str(env), num_envs, compile_seconds, spread(per_cpu_second), spread(per_second))


def spread(rates: list[float]) -> Rates:
    return Rates(median(rates), min(rates), max(rates))


def main(options: Options) -> None:
    print("million environment steps per second: median (least .. most) of the repeats")
    results = []
    for env in make_envs(options):
        print(env)
        for num_envs in options.environments:
            result = measure(env, options, num_envs)
            results.append(result)
            print(
                f"  {num_envs:6d} environments  CPU {shown(result.steps_per_cpu_second)}  "
                f"wall {shown(result.steps_per_second)}  compiled in {result.compile_seconds:.1f} s"
            )
    if options.json is not None:
        report = {
            "options": asdict(options) | {"json": str(options.json)},
            "machine": machine(),
            "results": [asdict(result) for result in results],
        }
        options.json.write_text(json.dumps(report, indent=2) + "\n")


def machine() -> dict[str, Any]:
    """What the figures depend on beside the code."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    allowed = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else ()
    return {
        "processor": names[0] if names else platform.processor(),
        "cores_allowed": len(allowed) or os.cpu_count(),
        "jax": jax.__version__,
    }


def shown(rates: Rates) -> str:
    return f"{rates.median / 1e6:5.2f} ({rates.least / 1e6:5.2f} .. {rates.most / 1e6:5.2f})"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
