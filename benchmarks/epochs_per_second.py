"""How fast policies train here, and how far that is from the speed of their matrix products.

Method. A row is a policy and a task. It is measured by two processes of its own, so that nothing of
another row warms it or adds to its memory: the first starts with an empty compilation cache and
measures everything, the second finds the cache filled and only measures its compilation.

* Training: `--repeats` calls of `--epochs` epochs of 20,000 environment steps each, after one call
  that does not count; median of the repeats, with the least and the most. CPU microseconds are user
  and system time of all threads of the process per environment step. Compilation is apart.
* Matrix products: the products of one policy step, read off its program, at the shapes that one
  device has in training, together with the two products of each that its derivatives take, on
  random operands, on all devices at once; in the same process, right after the training.
* `matmul_fraction` is the rate at which training gets through the multiply-adds that the policy
  needs (the published architecture's count, benchmarks/multiply_adds.py; three times that of the
  forward pass) over the rate of those products alone.
* Peak memory is the largest resident size of the first process.

    python benchmarks/epochs_per_second.py --json speed.json
"""

import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any, Literal, get_args

import tyro

PolicyName = Literal[
    "ic3net",
    "commnet",
    "iric",
    "ic",
    "magic",
    "tarmac",
    "tarmac-ic3net",
    "hetnet",
    "hetnet-binary",
]
TaskName = Literal["pp-5x5-3p", "pp-10x10-5p", "pp-20x20-10p", "pcp-10x10-3p2c", "tj-medium-10c"]
POLICY_NAMES: tuple[PolicyName, ...] = get_args(PolicyName)
TASK_NAMES: tuple[TaskName, ...] = ("pp-5x5-3p", "pp-10x10-5p", "pp-20x20-10p", "pcp-10x10-3p2c")


@dataclass(frozen=True)
class Options:
    """What to measure."""

    policy: tuple[PolicyName, ...] = POLICY_NAMES
    """Policies, each on every task."""
    task: tuple[TaskName, ...] = TASK_NAMES
    """Tasks: domain, grid and team."""
    envs: int | None = None
    """Environments side by side; the preset's number if not given."""
    seeds: int = 1
    """Seeds trained in one program."""
    devices: int = field(default_factory=lambda: os.cpu_count() or 1)
    """CPU devices that share the environments."""
    epochs: int = 2
    """Epochs of a repeat."""
    repeats: int = 5
    """Timed repeats."""
    json: Path | None = None
    """Write machine and rows to this file as well; it must not exist."""

    def __post_init__(self) -> None:
        for name in ("seeds", "devices", "epochs", "repeats"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}.")


@dataclass(frozen=True)
class Row:
    """A policy on a task, measured; rates are medians, with extremes in `spread`."""

    policy: str
    task: str
    devices: int
    epochs_per_second: float
    env_steps_per_second: float
    cpu_microseconds_per_step: float
    compile_seconds_cold: float
    compile_seconds_warm: float
    peak_memory_mb: float
    matmul_fraction: float
    spread: dict[str, tuple[float, float]]  # least and most of the repeats, by key
    envs: int
    seeds: int
    matmul_gflops_per_second: float
    megaflops_per_step: float


@dataclass(frozen=True)
class Worker:
    """One process's share of a row, told on its command line."""

    policy: PolicyName
    task: TaskName
    envs: int | None
    seeds: int
    devices: int
    epochs: int
    repeats: int
    only_compile: bool


def measure(options: Options, policy: PolicyName, task: TaskName) -> Row:
    """Both processes of a row."""
    with tempfile.TemporaryDirectory() as cache:
        shared = (policy, task, options.envs, options.seeds, options.devices, options.epochs)
        full = _in_process(Worker(*shared, options.repeats, only_compile=False), cache)
        warm = _in_process(Worker(*shared, options.repeats, only_compile=True), cache)
    return Row(**full, compile_seconds_warm=warm["compile_seconds_cold"])


def _in_process(worker: Worker, cache: str) -> dict[str, Any]:
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "SUMAJAX_BENCHMARK_WORKER": json.dumps(asdict(worker)),
    }
    done = subprocess.run(
        [sys.executable, __file__], env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"measuring {worker} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def run_worker(worker: Worker) -> dict[str, Any]:
    """Compiles, trains and times; the fields of a `Row` it can know."""
    from sumajax.learning import parallel

    parallel.use_cpu_devices(worker.devices)
    from matrix_products import product_rate, step_products
    from multiply_adds import of_step

    from sumajax.learning import EPOCH_STEPS, make_learner, preset
    from sumajax.policies import make_policy

    env = make_task(worker.task)
    policy = make_policy(worker.policy, env)
    changes = {} if worker.envs is None else {"num_envs": worker.envs}
    learner = make_learner(env, policy, preset("fast", worker.policy, **changes))
    num_envs = learner.config.num_envs
    mesh = parallel.make_mesh(worker.seeds, num_envs, worker.devices)
    states = parallel.place(parallel.init_seeds(learner, list(range(worker.seeds))), mesh)
    began = time.perf_counter()
    train = parallel.compile_train(learner, mesh, worker.epochs, states)
    compiled = time.perf_counter() - began
    if worker.only_compile:
        return {"compile_seconds_cold": compiled}
    rates, costs = timed(train, states, worker)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    per_device = num_envs // mesh.shape[parallel.ENVS]
    rate = product_rate(step_products(env, policy, per_device), mesh)
    flops = 2 * 3 * of_step(worker.policy, env)
    return {
        "policy": worker.policy,
        "task": worker.task,
        "devices": worker.devices,
        "epochs_per_second": median(rates) / EPOCH_STEPS,
        "env_steps_per_second": median(rates),
        "cpu_microseconds_per_step": median(costs),
        "compile_seconds_cold": compiled,
        "peak_memory_mb": memory,
        "matmul_fraction": median(rates) * flops / rate.median,
        "spread": {
            "env_steps_per_second": (min(rates), max(rates)),
            "cpu_microseconds_per_step": (min(costs), max(costs)),
            "matmul_gflops_per_second": (rate.least / 1e9, rate.most / 1e9),
        },
        "envs": num_envs,
        "seeds": worker.seeds,
        "matmul_gflops_per_second": rate.median / 1e9,
        "megaflops_per_step": flops / 1e6,
    }


def timed(train: Any, states: Any, worker: Worker) -> tuple[list[float], list[float]]:
    """Environment steps/s and CPU microseconds per step of each repeat, after one warm-up call."""
    import jax

    from sumajax.learning import EPOCH_STEPS

    states, _ = jax.block_until_ready(train(states))
    steps = worker.seeds * worker.epochs * EPOCH_STEPS
    rates, costs = [], []
    for _ in range(worker.repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        states, _ = jax.block_until_ready(train(states))
        rates.append(steps / (time.perf_counter() - wall))
        costs.append((time.process_time() - cpu) / steps * 1e6)
    return rates, costs


def make_task(name: TaskName) -> Any:
    """The environment of a task's name."""
    from sumajax.environments import PredatorCapturePrey, PredatorPrey, TrafficJunction

    return {
        "pp-5x5-3p": lambda: PredatorPrey(5, 3, vision=1, max_steps=80),
        "pp-10x10-5p": lambda: PredatorPrey(10, 5, vision=1, max_steps=200),
        "pp-20x20-10p": lambda: PredatorPrey(20, 10, vision=1, max_steps=400),
        "pcp-10x10-3p2c": lambda: PredatorCapturePrey(10, 3, 2, vision=1, max_steps=200),
        "tj-medium-10c": lambda: TrafficJunction("medium"),
    }[name]()


def machine() -> dict[str, Any]:
    """What the figures depend on beside the code."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    packages = ("sumajax", "jax", "jaxlib", "flax", "optax", "numpy")
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "load_before": os.getloadavg()[0],
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
    }


def shown(row: Row) -> dict[str, str]:
    """A line of the printed table."""
    least, most = row.spread["env_steps_per_second"]
    return {
        "policy": row.policy,
        "task": row.task,
        "epochs/s": f"{row.epochs_per_second:.2f}",
        "steps/s (least-most)": f"{row.env_steps_per_second:,.0f} ({least:,.0f}-{most:,.0f})",
        "CPU us/step": f"{row.cpu_microseconds_per_step:.1f}",
        "compile s cold, warm": f"{row.compile_seconds_cold:.1f}, {row.compile_seconds_warm:.1f}",
        "MB": f"{row.peak_memory_mb:.0f}",
        "products GFLOP/s": f"{row.matmul_gflops_per_second:.0f}",
        "reached": f"{row.matmul_fraction:.0%}",
    }


def main(options: Options) -> None:
    from sumajax.reporting import print_table

    if options.json is not None and options.json.exists():
        raise ValueError(f"{options.json} exists; choose another --json.")
    header = machine()
    print(__doc__.strip().partition("\n\n    python")[0])
    print(", ".join(f"{name} {value}" for name, value in header.items()), flush=True)
    rows = []
    for task in options.task:
        for policy in options.policy:
            rows.append(measure(options, policy, task))
            print(", ".join(f"{k} {v}" for k, v in shown(rows[-1]).items()), flush=True)
            if options.json is not None:
                report = {"machine": header, "rows": [asdict(row) for row in rows]}
                options.json.write_text(json.dumps(report, indent=2) + "\n")
    print_table([shown(row) for row in rows], title=f"{options.devices} devices")


if __name__ == "__main__":
    told = os.environ.get("SUMAJAX_BENCHMARK_WORKER")
    if told:
        print(json.dumps(run_worker(Worker(**json.loads(told)))))
    else:
        main(tyro.cli(Options, description=__doc__))
