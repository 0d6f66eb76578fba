"""Training several seeds, on several devices: the same numbers however they are spread.

Seeds share nothing, so they are spread over devices first; what devices are left over share the
environments of each seed, and add up their gradients.
"""

import contextlib
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from sumajax import hosts
from sumajax.keys import key_of
from sumajax.learning.learner import Learner, Metrics, TrainState

SEEDS, ENVS = "seeds", "envs"

Train = Callable[[TrainState], tuple[TrainState, Metrics]]

PROGRAMS_KEPT = 32
"""Of each kind in a process: a stage that goes on, or one like another, traces nothing again."""

MOST_PIECES = 40_000
"""Of memory, that may be mapped when a stage is compiled. Linux allows a process 65,530
(`vm.max_map_count`) and a compiled stage has some 5,000, its evaluations counted."""
_PIECES = Path("/proc/self/maps")  # one per line, on Linux


@dataclass(frozen=True)
class Execution:
    """How a kind of device trains: what is computed stays the same to rounding.

    Attributes:
      together: all seeds side by side, every matrix product one batch of all seeds' products;
        otherwise one seed after the other.
      unroll: steps of the rollout that one turn of its compiled loop takes.
    """

    together: bool
    unroll: int = 1


EXECUTIONS = {"cpu": Execution(together=False)}
"""By JAX's name of the platform, where it is not `ACCELERATOR`.

A CPU's core is full with one seed, whose arrays stay in its cache: four seeds of IC3Net side by
side took 64.8 CPU microseconds per environment step, one after the other 60.5
(benchmarks/README.md)."""
ACCELERATOR = Execution(together=True, unroll=5)
"""One seed's products are far too small to fill an accelerator: a step takes as long as starting
its operations does, whatever the number of seeds. Measured on an H100 with 32 seeds of IC3Net:
2.4 M steps/s side by side, 0.26 M one after the other, 2.8 M with five steps in a turn."""


def execution_on(platform: str) -> Execution:
    """How devices of `platform` train, as "cpu" or "gpu"."""
    return EXECUTIONS.get(platform, ACCELERATOR)


def over_seeds(function: Callable[..., Any], execution: Execution) -> Callable[[Any], Any]:
    """`function` of one seed's tree as a function of the trees stacked along a leading axis."""
    return jax.vmap(function) if execution.together else partial(jax.lax.map, function)


def use_cpu_devices(count: int) -> None:
    """Makes JAX see `count` CPU devices; only before JAX has been used (RuntimeError).

    One shard of the environments per core, without threads inside the small matrix products of a
    step, took 61 where threads took 76 microseconds per environment step (IC3Net, 5 agents, 100
    environments, two cores). The compiler's first level of effort halves the time to the first
    update and cost no speed after it. A flag that is set already stays as it is.
    """
    jax.config.update("jax_num_cpu_devices", count)  # first: it raises where JAX has been used
    flags = os.environ.get("XLA_FLAGS", "")
    wanted = {"xla_backend_optimization_level": "1"}
    if count > 1:
        wanted["xla_cpu_multi_thread_eigen"] = "false"
    missing = [f"--{name}={value}" for name, value in wanted.items() if name not in flags]
    os.environ["XLA_FLAGS"] = " ".join([flags, *missing]).strip()


def usable_cores(root: Path = Path("/")) -> int:
    """Cores that this process may keep busy: those of its affinity, within its container's share.

    Args:
      root: where the files of /proc and /sys are, for tests.
    """
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    return max(1, math.floor(min(cores, _container_share(root))))


def _container_share(root: Path) -> float:
    """Processor time per time that the control groups of this process have; inf without limit.

    Version 2 writes "QUOTA PERIOD" in cpu.max, version 1 a file for each. A group has no more than
    the groups it lies in. Seen from inside a container its own group may be the topmost.
    """
    shares = [math.inf]
    for line in _words(root / "proc/self/cgroup", "\n"):
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        group = Path(path.strip("/"))
        if not controllers:
            for place in (group, *group.parents):
                limit = _words(root / "sys/fs/cgroup" / place / "cpu.max")
                shares.append(_share(*limit) if len(limit) == 2 else math.inf)
        elif "cpu" in controllers.split(","):
            for place in (group, *group.parents):
                files = root / "sys/fs/cgroup/cpu" / place
                quota, period = (_words(files / f"cpu.cfs_{n}_us") for n in ("quota", "period"))
                shares.append(_share(quota[0], period[0]) if quota and period else math.inf)
    return min(shares)


def _words(file: Path, separator: str | None = None) -> list[str]:
    """What a file holds; nothing where it cannot be read."""
    try:
        return file.read_text().strip().split(separator)
    except (OSError, UnicodeDecodeError):
        return []


def _share(quota: str, period: str) -> float:
    """No quota is "max" in version 2 and -1 in version 1."""
    limited = quota.isdecimal() and period.isdecimal() and int(period) > 0
    return int(quota) / int(period) if limited else math.inf


def available_devices() -> list[jax.Device]:
    """This host's devices of the kind that computes.

    Raises:
      ValueError: where JAX was told to use what the machine has not.
    """
    try:
        return jax.local_devices()
    except (RuntimeError, AssertionError) as error:  # a bare assertion where no CUDA is found
        why = (str(error).splitlines() or ["none is there"])[0]
        raise ValueError(
            f"JAX finds no device of the kind that JAX_PLATFORMS={_platforms()!r} asks "
            f"for ({why}); unset JAX_PLATFORMS, or install what drives it."
        ) from None


def choose_devices(
    num_seeds: int, num_envs: int, asked: int | None = None, num_hosts: int = 1
) -> int:
    """How many devices of this host to train on: those asked for, or all that can share the work.

    Where the CPU computes and JAX has not been used yet, it is given a device for each core;
    otherwise JAX has the devices that it has. Several hosts must have met (`hosts.connect`).

    Raises:
      ValueError: when more are asked for than there are, or JAX finds none.
    """
    if _cpu_may_compute():
        with contextlib.suppress(RuntimeError):  # JAX has been used
            use_cpu_devices(asked or most_devices(num_seeds, num_envs, usable_cores(), num_hosts))
    there_are = len(available_devices())
    if asked is not None and asked > there_are:
        raise ValueError(
            f"{asked} devices asked for, but JAX sees {there_are}; ask for at most those."
        )
    return asked or most_devices(num_seeds, num_envs, there_are, num_hosts)


def _cpu_may_compute() -> bool:
    """Unless JAX was told to use something else. With an accelerator CPU devices lie idle."""
    return _platforms().split(",")[0] in ("", "cpu")


def _platforms() -> str:
    """What JAX was told to use, by the environment or by the program."""
    return jax.config.jax_platforms or ""  # type: ignore[attr-defined]


def spread(num_seeds: int, num_envs: int, devices: int) -> tuple[int, int]:
    """How many devices share the seeds, and how many the environments of each.

    Raises:
      ValueError: when seeds and environments do not spread over so many.
    """
    over_seeds = math.gcd(num_seeds, devices)
    over_envs = devices // over_seeds
    if num_envs % over_envs:
        raise ValueError(
            f"{num_envs} environments do not spread over {over_envs} devices; choose numbers that "
            "divide."
        )
    return over_seeds, over_envs


def most_devices(num_seeds: int, num_envs: int, most: int, num_hosts: int = 1) -> int:
    """The largest number of devices up to `most` that seeds and environments spread over.

    With several hosts: the number of each of them.
    """

    def fits(of_each: int) -> bool:
        devices = of_each * num_hosts
        return num_envs % (devices // math.gcd(num_seeds, devices)) == 0

    return next(filter(fits, range(most, 1, -1)), 1)


def make_mesh(num_seeds: int, num_envs: int, devices: int) -> Mesh:
    """`devices` devices as (seeds, envs).

    Raises:
      ValueError: when there are not so many devices, or seeds and environments do not spread.
    """
    shape = spread(num_seeds, num_envs, devices)
    if devices > jax.device_count():
        raise ValueError(
            f"{devices} devices asked for, but JAX sees {jax.device_count()}; ask for at most "
            "those."
        )
    return Mesh(np.array(jax.devices()[:devices]).reshape(shape), (SEEDS, ENVS))


def init_seeds(learner: Learner, seeds: list[int]) -> TrainState:
    """A fresh training state per seed, stacked along a leading axis."""
    return _init_all(learner)(seed_keys(seeds))


@lru_cache(PROGRAMS_KEPT)
def _init_all(learner: Learner) -> Callable[[chex.PRNGKey], TrainState]:
    return jax.jit(jax.vmap(learner.init))


def init_seeds_from(
    learner: Learner, seeds: list[int], params: Any, opt_state: Any = None
) -> TrainState:
    """The start of training from given parameters, leaves (S, ...), per seed."""
    return _init_all_from(learner)(params, opt_state, seed_keys(seeds))


@lru_cache(PROGRAMS_KEPT)
def _init_all_from(learner: Learner) -> Callable[[Any, Any, chex.PRNGKey], TrainState]:
    def of_one(params: Any, opt_state: Any, key: chex.PRNGKey) -> TrainState:
        return learner.init_from(params, jax.random.split(key)[1], opt_state)

    return jax.jit(jax.vmap(of_one))


def seed_keys(seeds: list[int]) -> chex.PRNGKey:
    """(S,) keys."""
    return jnp.stack([key_of(seed) for seed in seeds])


@lru_cache(PROGRAMS_KEPT)
def make_train(
    learner: Learner, mesh: Mesh, epochs: int, execution: Execution | None = None
) -> Train:
    """A jitted function from states stacked over seeds to the states `epochs` epochs later.

    The states given are used up. Metrics' leaves are (seeds, epochs).

    Args:
      execution: None: that of the mesh's kind of device.
    """
    execution = execution or execution_on(mesh.devices.flat[0].platform)
    over_envs = mesh.shape[ENVS]
    axis = ENVS if over_envs > 1 else None
    local = replace(learner, axis=axis, shards=over_envs, unroll=execution.unroll)
    train = over_seeds(lambda state: local.train(state, epochs), execution)
    specs = state_specs()
    spread = jax.shard_map(
        train, mesh=mesh, in_specs=(specs,), out_specs=(specs, P(SEEDS)), check_vma=False
    )
    return jax.jit(spread, donate_argnums=0)


def compile_train(
    learner: Learner,
    mesh: Mesh,
    epochs: int,
    states: TrainState,
    execution: Execution | None = None,
    compiler_options: dict[str, Any] | None = None,
) -> Train:
    """`make_train` compiled ahead for `states`, so that its cost can be told apart.

    Makes room for it first: a process may go through any number of stages.
    """
    make_room(MOST_PIECES)
    lowered = make_train(learner, mesh, epochs, execution).lower(states)  # type: ignore[attr-defined]
    return lowered.compile(compiler_options)


def make_room(most: int) -> None:
    """Frees what was compiled and nobody holds any more, if over `most` pieces are mapped."""
    if _PIECES.exists() and len(_PIECES.read_text().splitlines()) > most:
        jax.clear_caches()


def state_specs() -> Any:
    """How a stacked `TrainState` lies on the mesh: all by seed, actors by environment too."""
    by_seed = P(SEEDS)
    specs: Any = dict.fromkeys(TrainState.__dataclass_fields__, by_seed)
    return TrainState(**specs | {"actors": P(SEEDS, ENVS)})


def place(states: TrainState, mesh: Mesh) -> TrainState:
    """`states`, the same on every host, as arrays that lie on the mesh."""
    specs = state_specs()

    def placed(name: str) -> Any:
        return hosts.placed(getattr(states, name), NamedSharding(mesh, getattr(specs, name)))

    return TrainState(**{name: placed(name) for name in TrainState.__dataclass_fields__})
