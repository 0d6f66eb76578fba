"""How fast an accelerator trains, and how long it takes to the figures of the main job.

Method. Everything happens in one process, in the order of what matters most, and every result is in
the files of `--output` before the next is begun: at the end of `--seconds` the program stops
wherever it is.

* `table`: a row is a policy, a task, a number of seeds and of environments of each. A call trains
  one epoch of 20,000 environment steps of every seed; after one call that does not count, calls are
  timed until there are five or two seconds are over; median, least and most. Programs of several
  rows are compiled at once and then timed one after the other, so only the first row's compile time
  is that of a program alone. `launches` are the operations that a step of the rollout and its way
  back start, and all of an update over its steps, read off the compiled program; `share` is the
  rate at which training does its program's multiply-adds over that of one large float32 product of
  the same precision. Memory is what the compiler planned for the program.
* The first row is tried in other ways too: turns of the rollout's loop, XLA's options, TF32. The
  rest is done in the fastest way that keeps the precision.
* `main`: IC3Net, preset fast, source stage on 5x5 at 10x10, transfer and scratch on 10x10, 32
  seeds; wall time from the first trace to the last held-out figure, compiling included.
* `chain`: stages of growing tasks, each from the parameters of the one before.

Needs jax, flax, optax, chex and numpy alone, since such machines are often bare.

    python benchmarks/accelerator.py --output accelerator
    python benchmarks/accelerator.py --output chain --job chain --policy ic3net --seeds 32 \
        --sizes 5 10 20 --predators 3 5 10 --max-steps 80 200 400 --epochs 40 80 100 \
        --settings learning_rate=1e-3
"""

import argparse
import csv
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from compiled_loops import Loop, loops_of
from jax.sharding import Mesh
from matrix_products import multiply_adds, products

from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.environments.types import Environment
from sumajax.evaluation import EPISODES, evaluate
from sumajax.learning import EPOCH_STEPS, Learner, make_learner, parallel, preset
from sumajax.learning.learner import Metrics, TrainState
from sumajax.learning.parallel import Execution
from sumajax.learning.scaling import for_stage
from sumajax.policies import POLICIES, make_policy
from sumajax.precision import MATRIX_PRECISION
from sumajax.upsampling import Scale, StateUpsampled

JOBS = ("all", "table", "main", "chain")
SECONDS = 420.0
TIMED_CALLS, TIMED_SECONDS = 5, 2.0
CHUNK = 10
"""Epochs of a compiled call in a job: the longest that divides a stage and is no longer."""
MARGIN = 5.0
"""Seconds before the end at which nothing new is begun."""
COMPILING = 6
"""Programs compiled at once: their tracing takes turns, XLA's part does not."""
FIGURES = (
    "env_steps",
    "episodes",
    "steps_taken",
    "success",
    "episode_return",
    "entropy",
    "policy_loss",
    "value_loss",
    "gradient_norm",
    "communication",
    "fault",
)
"""Of an epoch, in a job's `.csv`."""
MATRIX_SIDE = {"cpu": 1024}
LARGE_MATRIX_SIDE = 8192
"""Side of the product that gives the device's rate; by platform, and on an accelerator."""


@dataclass(frozen=True)
class Case:
    """What a row measures."""

    policy: str = "ic3net"
    task: str = "pp-10x10-5p"
    seeds: int = 32
    envs: int = 50
    rollout: int = 10


@dataclass(frozen=True)
class Trial:
    """A way to compile the same training."""

    name: str
    execution: Execution
    options: dict[str, Any] = field(default_factory=dict)  # XLA's, of this program alone
    precision: str | None = None  # None: the package's


TASKS: dict[str, Environment] = {
    "pp-4x4-2p": PredatorPrey(4, 2, vision=1, max_steps=10),
    "pp-10x10-5p": PredatorPrey(10, 5, vision=1, max_steps=200),
    "pp-20x20-10p": PredatorPrey(20, 10, vision=1, max_steps=400),
}
SMALL_CASE = Case(task="pp-4x4-2p", seeds=2, envs=1000, rollout=20)
SMALL_POLICY: dict[str, Any] = {"hidden": 8, "encoder": "linear"}
"""Settings of the policy with `--small`: it compiles in seconds."""

WIDE = [
    Case(seeds=1),
    Case(seeds=8),
    Case(seeds=128),
    Case(envs=500),
    Case(envs=4000, rollout=5),
    Case(seeds=1, envs=500),
    Case(seeds=1, envs=4000, rollout=5),
    Case(seeds=8, envs=500),
    Case(seeds=8, envs=4000, rollout=5),
]
"""Of IC3Net on 10x10. Environments x steps must divide an epoch of 20,000: 4,000 x 5 is the most
that an update can have side by side."""
OTHERS = [name for name in ("magic", "hetnet", "tarmac") if name in POLICIES]
ROWS = [
    *(Case(policy) for policy in OTHERS),
    Case(task="pp-20x20-10p"),
    *WIDE[:5],
    *(Case(policy, "pp-20x20-10p") for policy in OTHERS),
    *WIDE[5:],
    *(Case(policy, seeds=seeds) for policy in OTHERS for seeds in (1, 8)),
    *(Case(policy, envs=500) for policy in OTHERS),
    Case(task="pp-20x20-10p", envs=500),
    *(Case(policy, "pp-20x20-10p", seeds=1) for policy in ("ic3net", *OTHERS)),
]
"""After the first, the most wanted first: what there is no time for is left out."""

_GRAPHS = "FUSION,CUBLAS,CUBLASLT,CUDNN,CUSTOM_CALL,DYNAMIC_SLICE_FUSION"
LOOP_GRAPHS = {"xla_gpu_enable_command_buffer": f"{_GRAPHS},CONDITIONAL,WHILE"}
"""Whole loops as one CUDA graph; XLA alone makes graphs of what is inside a turn."""
NO_GRAPHS = {"xla_gpu_enable_command_buffer": ""}


def trials(plain: Execution) -> list[Trial]:
    """Other ways for the first row, before the job."""
    return [
        Trial("5 steps a turn", replace(plain, unroll=5)),
        Trial("2 steps a turn", replace(plain, unroll=2)),
        Trial("no CUDA graphs", plain, NO_GRAPHS),
        Trial("TF32", plain, precision="tensorfloat32"),
        Trial("seeds the other way", replace(plain, together=not plain.together)),
    ]


def later_trials(plain: Execution) -> list[Trial]:
    """Those that take long to compile, or that a driver may not stand."""
    five = replace(plain, unroll=5)
    return [
        Trial("no loop over steps", replace(plain, unroll=10)),
        Trial("loops in CUDA graphs", plain, LOOP_GRAPHS),
        Trial("5 steps a turn, loops in CUDA graphs", five, LOOP_GRAPHS),
        Trial("5 steps a turn, TF32", five, precision="tensorfloat32"),
    ]


@dataclass(frozen=True)
class Row:
    """A case, measured in one way."""

    case: Case
    trial: str
    env_steps_per_second: float
    least: float
    most: float
    compile_seconds: float
    compiled_beside: int  # other programs at the same time
    launches_per_step: float | None  # rollout and way back; None where no loop is left
    launches_per_update_step: float  # all of an update over its steps, all seeds
    unknown_loops: int  # loops whose turns the host has to count
    multiply_adds_per_step: float
    matrix_share: float
    memory_gb: float


@dataclass
class Report:
    """What there is so far, in files at every moment."""

    output: Path
    seconds: float
    began: float = field(default_factory=time.perf_counter)
    content: dict[str, Any] = field(default_factory=dict)

    @property
    def left(self) -> float:
        """Seconds in which something new may be begun."""
        return self.seconds - MARGIN - (time.perf_counter() - self.began)

    def note(self, key: str, value: Any) -> None:
        """Sets `key`, writes the files and says it."""
        self.content[key] = value
        self._write()
        print(f"[{time.perf_counter() - self.began:.0f} s] {key}: {json.dumps(value)}", flush=True)

    def add(self, key: str, value: dict[str, Any], line: dict[str, str]) -> None:
        """Adds to the list `key`, and a line of its table."""
        self.content.setdefault(key, []).append(value)
        self.content.setdefault("tables", {}).setdefault(key, []).append(line)
        self._write()
        told = ", ".join(f"{name} {cell}" for name, cell in line.items())
        print(f"[{time.perf_counter() - self.began:.0f} s] {told}", flush=True)

    def _write(self) -> None:
        (self.output / "accelerator.json").write_text(json.dumps(self.content, indent=2) + "\n")
        plain = {k: v for k, v in self.content.items() if not isinstance(v, list | dict)}
        parts = [", ".join(f"{name} {value}" for name, value in plain.items())]
        parts += [markdown(lines) for lines in self.content.get("tables", {}).values()]
        (self.output / "accelerator.md").write_text("\n\n".join(parts) + "\n")


def markdown(lines: list[dict[str, str]]) -> str:
    """A table of lines with the same keys."""
    head = list(lines[0])
    body = [[line[name] for name in head] for line in lines]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in [head, ["---"] * len(head), *body])


def platform() -> str:
    return jax.devices()[0].platform


def workers() -> int:
    return 1 if platform() == "cpu" else COMPILING


def matrix_rate(precision: str) -> float:
    """Floating-point operations per second of one large float32 product in `precision`."""
    side, times = MATRIX_SIDE.get(platform(), LARGE_MATRIX_SIDE), 10
    x = jax.random.normal(jax.random.key(0), (side, side)) / side**0.5
    with jax.default_matmul_precision(precision):
        many = jax.jit(lambda x: jax.lax.fori_loop(0, times, lambda _, y: y @ x, x))
        rates = []
        for _ in range(1 + TIMED_CALLS):
            began = time.perf_counter()
            jax.block_until_ready(many(x))
            rates.append(times * 2 * side**3 / (time.perf_counter() - began))
    return median(rates[1:])


@dataclass(frozen=True)
class Compiled:
    """A case ready to be timed."""

    case: Case
    trial: Trial
    train: parallel.Train
    states: TrainState
    seconds: float
    multiply_adds_per_step: float


def learner_of(case: Case) -> Learner:
    env = TASKS[case.task]
    config = preset("fast", case.policy, num_envs=case.envs, rollout_length=case.rollout)
    small = SMALL_POLICY if case.task == SMALL_CASE.task else {}
    return make_learner(env, make_policy(case.policy, env, **small), config)


def one_device(learner: Learner, seeds: int) -> Mesh:
    return parallel.make_mesh(seeds, learner.config.num_envs, 1)


def compiled(case: Case, trial: Trial) -> Compiled:
    learner = learner_of(case)
    mesh = one_device(learner, case.seeds)
    states = parallel.place(parallel.init_seeds(learner, list(range(case.seeds))), mesh)
    with jax.default_matmul_precision(trial.precision):
        began = time.perf_counter()
        options = trial.options or None
        train = parallel.compile_train(learner, mesh, 1, states, trial.execution, options)
        seconds = time.perf_counter() - began
    one = jax.eval_shape(learner.init, jax.random.key(0))
    adds = multiply_adds(products(learner.update, one)) / (case.envs * case.rollout)
    return Compiled(case, trial, train, states, seconds, adds)


def timed(ready: Compiled) -> list[float]:
    """Environment steps/s of each call, all seeds together."""
    states, _ = jax.block_until_ready(ready.train(ready.states))
    rates: list[float] = []
    began = time.perf_counter()
    while len(rates) < TIMED_CALLS and time.perf_counter() - began < TIMED_SECONDS:
        call = time.perf_counter()
        states, _ = jax.block_until_ready(ready.train(states))
        rates.append(ready.case.seeds * EPOCH_STEPS / (time.perf_counter() - call))
    return rates


def launches(program: Loop, case: Case) -> tuple[float | None, float]:
    """Per step of the rollout: of both scans' bodies, and of the whole update."""
    scans = [
        loop
        for loop in program.all_loops()
        if loop.products and not loop.inner and 1 < (loop.turns or 1) <= case.rollout
    ]
    both = sum((loop.turns or 1) * loop.launches for loop in scans) / case.rollout
    updates = EPOCH_STEPS / (case.envs * case.rollout)
    return both or None, program.launches / updates / case.rollout


def measured(ready: Compiled, matrix_rates: dict[str, float], beside: int) -> Row:
    rates = timed(ready)
    program = loops_of(ready.train.as_text())  # type: ignore[attr-defined]
    memory = ready.train.memory_analysis()  # type: ignore[attr-defined]
    per_step, per_update = launches(program, ready.case)
    precision = ready.trial.precision or MATRIX_PRECISION
    flops = 2 * ready.multiply_adds_per_step * median(rates)
    return Row(
        case=ready.case,
        trial=ready.trial.name,
        env_steps_per_second=median(rates),
        least=min(rates),
        most=max(rates),
        compile_seconds=ready.seconds,
        compiled_beside=beside,
        launches_per_step=per_step,
        launches_per_update_step=per_update,
        unknown_loops=sum(loop.turns is None for loop in program.all_loops()),
        multiply_adds_per_step=ready.multiply_adds_per_step,
        matrix_share=flops / matrix_rates[precision],
        memory_gb=(memory.temp_size_in_bytes + memory.argument_size_in_bytes) / 2**30,
    )


def shown(row: Row) -> dict[str, str]:
    """A line of the table."""
    case = row.case
    return {
        "policy": case.policy,
        "task": case.task,
        "seeds": str(case.seeds),
        "environments x steps": f"{case.envs} x {case.rollout}",
        "how": row.trial,
        "steps/s (least-most)": f"{row.env_steps_per_second:,.0f} "
        f"({row.least:,.0f}-{row.most:,.0f})",
        "share": f"{row.matrix_share:.1%}",
        "launches a step, of all": f"{row.launches_per_step or float('nan'):.0f}, "
        f"{row.launches_per_update_step:.0f}",
        "compile s (beside)": f"{row.compile_seconds:.1f} ({row.compiled_beside})",
        "GB": f"{row.memory_gb:.2f}",
    }


def in_batches(
    report: Report, wanted: list[tuple[Case, Trial]]
) -> Iterator[tuple[Compiled | BaseException, int]]:
    """Each of `wanted` compiled, some at a time; ends when there is no time for more."""
    longest, size = 0.0, workers()
    for first in range(0, len(wanted), size):
        batch = wanted[first : first + size]
        if report.left < longest:
            report.note("left_out", [asdict(case) for case, _ in wanted[first:]])
            return
        began = time.perf_counter()
        pool = ThreadPoolExecutor(size)
        futures: list[Future[Compiled]] = [pool.submit(compiled, *what) for what in batch]
        wait(futures, timeout=max(report.left, 0))
        pool.shutdown(wait=False, cancel_futures=True)
        longest = max(longest, time.perf_counter() - began)
        for future in futures:
            if not future.done() or future.cancelled():
                yield TimeoutError("not compiled in time"), len(batch) - 1
                continue
            error = future.exception()
            yield (error if error is not None else future.result()), len(batch) - 1


def measure(
    report: Report, key: str, wanted: list[tuple[Case, Trial]], rates: dict[str, float]
) -> list[tuple[Row, Trial]]:
    """Rows of `wanted`, each in the files as soon as it is there."""
    rows = []
    for (case, trial), (ready, beside) in zip(wanted, in_batches(report, wanted), strict=False):
        try:
            if isinstance(ready, BaseException):
                raise ready
            row = measured(ready, rates, beside)
        except Exception as error:  # out of memory, or an option XLA does not know: the next row
            failed = report.content.get("failed", [])
            told = f"{trial.name}: {type(error).__name__}: {error}"
            report.note("failed", [*failed, {**asdict(case), "why": told[:300]}])
            continue
        rows.append((row, ready.trial))
        report.add(key, asdict(row), shown(row))
    return rows


def fastest(rows: list[tuple[Row, Trial]], plain: Trial) -> Trial:
    """The trial to go on with: of those that keep the precision."""
    kept = [(row, trial) for row, trial in rows if trial.precision is None]
    return max(kept, key=lambda pair: pair[0].env_steps_per_second, default=(None, plain))[1]


@dataclass(frozen=True)
class Leg:
    """A stage of a job."""

    name: str
    learner: Learner
    epochs: int
    follows: str | None = None  # the leg whose parameters it starts from; None: fresh ones


@dataclass(frozen=True)
class ReadyLeg:
    """A leg, compiled."""

    leg: Leg
    chunk: int
    states: TrainState  # fresh
    train: parallel.Train
    evaluate: Callable[[Any, jax.Array], Any]


def prepared(leg: Leg, seeds: list[int], trial: Trial, episodes: int) -> ReadyLeg:
    """Fresh states of all seeds, and the two programs of a leg."""
    mesh = one_device(leg.learner, len(seeds))
    states = parallel.place(parallel.init_seeds(leg.learner, seeds), mesh)
    chunk = max(n for n in range(1, CHUNK + 1) if leg.epochs % n == 0)
    options = trial.options or None
    train = parallel.compile_train(leg.learner, mesh, chunk, states, trial.execution, options)
    greedy = jnp.zeros(len(seeds), bool)
    evaluate_all = jax.jit(held_out(leg.learner, trial.execution, episodes))
    return ReadyLeg(leg, chunk, states, train, evaluate_all.lower(states.params, greedy).compile())


def held_out(
    learner: Learner, execution: Execution, episodes: int
) -> Callable[[Any, jax.Array], Any]:
    """Parameters stacked over seeds and (S,) greedy -> `Evaluation` with leaves (S, episodes)."""
    env, policy, key = learner.env, learner.policy, jax.random.key(0)

    def of_one(given: tuple[Any, jax.Array]) -> Any:
        params, greedy = given
        return evaluate(env, policy, params, key, episodes=episodes, greedy=greedy)

    all_seeds = parallel.over_seeds(of_one, execution)
    return lambda params, greedy: all_seeds((params, greedy))


def held_out_figures(ready: ReadyLeg, params: Any) -> dict[str, dict[str, Any]]:
    """Held-out figures of every seed, sampled and greedy."""
    num_seeds, figures = jax.tree.leaves(params)[0].shape[0], {}
    for name, greedy in (("sampled", False), ("greedy", True)):
        result = jax.device_get(ready.evaluate(params, jnp.full(num_seeds, greedy)))
        steps, success = result.steps_taken.mean(1), result.success.mean(1)
        figures[name] = {
            "steps_taken": float(steps.mean()),
            "least": float(steps.min()),
            "most": float(steps.max()),
            "success": float(success.mean()),
            "steps_taken_by_seed": [round(float(x), 3) for x in steps],
            "success_by_seed": [round(float(x), 4) for x in success],
        }
    return figures


def run_legs(report: Report, legs: list[Leg], options: "Options", trial: Trial) -> None:
    """Trains the legs one after the other; everything they leave goes into the output."""
    began, seeds = time.perf_counter(), list(range(options.seeds))
    with ThreadPoolExecutor(workers()) as pool:
        make = partial(prepared, seeds=seeds, trial=trial, episodes=options.episodes)
        ready = list(pool.map(make, legs))
    report.note("job_compile_seconds", time.perf_counter() - began)
    params: dict[str, Any] = {}
    for each in ready:
        leg, states = each.leg, each.states
        if leg.follows is not None:
            states = replace(states, params=jax.tree.map(jnp.copy, params[leg.follows]))
        before = held_out_figures(each, states.params)
        states, epochs, seconds = train_leg(report, each, states, seeds)
        params[leg.name] = states.params
        save_params(report.output / f"{leg.name}.npz", states.params)
        after = held_out_figures(each, states.params)
        steps = epochs * len(seeds) * EPOCH_STEPS
        told = {
            "leg": leg.name,
            "epochs": epochs,
            "asked": leg.epochs,
            "train_seconds": seconds,
            "env_steps_per_second": steps / seconds if seconds else None,
            "wall_seconds": time.perf_counter() - began,
            "before": before,
            "after": after,
        }
        report.add("legs", told, shown_leg(told))
    report.note("job_wall_seconds", time.perf_counter() - began)


def shown_leg(told: dict[str, Any]) -> dict[str, str]:
    """A line of the job's table."""

    def figure(when: str, how: str) -> str:
        it = told[when][how]
        return f"{it['steps_taken']:.2f} ({it['least']:.2f}-{it['most']:.2f})"

    return {
        "stage": told["leg"],
        "epochs": f"{told['epochs']} of {told['asked']}",
        "train s": f"{told['train_seconds']:.1f}",
        "steps/s": f"{told['env_steps_per_second'] or 0:,.0f}",
        "wall s since the first trace": f"{told['wall_seconds']:.1f}",
        "held-out steps before, sampled": figure("before", "sampled"),
        "after, sampled (least-most)": figure("after", "sampled"),
        "after, greedy (least-most)": figure("after", "greedy"),
    }


def train_leg(
    report: Report, ready: ReadyLeg, states: TrainState, seeds: list[int]
) -> tuple[TrainState, int, float]:
    """States after the epochs that there was time for, how many, and the seconds of training."""
    seconds = last = 0.0
    for epoch in range(0, ready.leg.epochs, ready.chunk):
        if report.left < last:
            return states, epoch, seconds
        began = time.perf_counter()
        states, metrics = jax.block_until_ready(ready.train(states))
        last = time.perf_counter() - began
        seconds += last
        write_metrics(report.output / f"{ready.leg.name}.csv", metrics, epoch, seeds)
    return states, ready.leg.epochs, seconds


def write_metrics(file: Path, metrics: Metrics, first_epoch: int, seeds: list[int]) -> None:
    """Adds a line per seed and epoch."""
    known = jax.device_get(metrics)
    columns = {name: np.asarray(getattr(known, name)) for name in FIGURES}
    with file.open("a", newline="") as out:
        writer = csv.writer(out)
        if not out.tell():
            writer.writerow(["epoch", "seed", *columns])
        for epoch in range(columns[FIGURES[0]].shape[1]):
            for i, seed in enumerate(seeds):
                cells = [column[i, epoch] for column in columns.values()]
                writer.writerow([first_epoch + epoch + 1, seed, *cells])


def save_params(file: Path, params: Any) -> None:
    """Leaves (seeds, ...) by their path."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    arrays = {"/".join(str(key.key) for key in path): np.asarray(leaf) for path, leaf in leaves}
    np.savez(file, **arrays)  # type: ignore[arg-type]


def main_job(options: "Options") -> list[Leg]:
    """Source on 5x5 at 10x10, transfer and scratch on 10x10; with `--small` on 2x2 and 4x4."""
    if options.small:
        small, large = PredatorPrey(2, 2, vision=1, max_steps=10), TASKS["pp-4x4-2p"]
        config, shape = {"num_envs": 1000, "rollout_length": 20}, SMALL_POLICY
    else:
        small, large = PredatorPrey(5, 3, vision=1, max_steps=80), TASKS["pp-10x10-5p"]
        config, shape = {}, {}
    first, then = options.epochs[:2] if options.epochs else ((1, 1) if options.small else (40, 80))
    source, target = StateUpsampled(small, large.state_shape[1:]), large
    settings = preset("fast", "ic3net", **config)

    def leg(name: str, env: Environment, epochs: int, follows: str | None = None) -> Leg:
        trained_with = for_stage(settings, env, epochs, transferred=follows is not None)
        learner = make_learner(env, make_policy("ic3net", env, **shape), trained_with)
        return Leg(name, learner, epochs, follows)

    return [
        leg("source", source, first),
        leg("transfer", target, then, "source"),
        leg("scratch", target, then),
    ]


def chain_job(options: "Options") -> list[Leg]:
    """A stage per size, all states upsampled to the last one's."""
    legs: list[Leg] = []
    settings = preset("fast", options.policy, **options.settings)
    for i, size in enumerate(options.sizes):
        numbers = (options.predators[i], options.capturers[i] if options.capturers else 0)
        limit = options.max_steps[i]
        if any(options.capturers):
            task: Environment = PredatorCapturePrey(size, *numbers, vision=1, max_steps=limit)
        else:
            task = PredatorPrey(size, numbers[0], vision=1, max_steps=limit)
        if size != options.sizes[-1]:
            task = StateUpsampled(task, options.sizes[-1], options.scale)
        policy = make_policy(options.policy, task, **options.policy_settings)
        trained_with = for_stage(settings, task, options.epochs[i], transferred=i > 0)
        learner = make_learner(task, policy, trained_with)
        follows = legs[-1].name if legs else None
        legs.append(Leg(f"stage{i + 1}-{size}x{size}", learner, options.epochs[i], follows))
    return legs


@dataclass(frozen=True)
class Options:
    """What is asked; `parsed` explains each."""

    output: Path
    job: str = "all"
    seconds: float = SECONDS
    small: bool = False
    seeds: int = 32
    policy: str = "ic3net"
    sizes: tuple[int, ...] = ()
    predators: tuple[int, ...] = ()
    capturers: tuple[int, ...] = ()
    max_steps: tuple[int, ...] = ()
    epochs: tuple[int, ...] = ()
    episodes: int = EPISODES
    settings: dict[str, Any] = field(default_factory=dict)
    policy_settings: dict[str, Any] = field(default_factory=dict)
    scale: Scale = "none"
    unroll: int | None = None
    xla: dict[str, Any] = field(default_factory=dict)
    cache: Path | None = None

    def __post_init__(self) -> None:
        if (self.output / "accelerator.json").exists():
            raise ValueError(f"{self.output} holds results; choose another --output.")
        if self.job == "chain":
            lengths = {len(getattr(self, name)) for name in ("predators", "max_steps", "epochs")}
            lengths |= {len(self.sizes)} | ({len(self.capturers)} if self.capturers else set())
            if len(lengths) != 1 or not self.sizes:
                raise ValueError(
                    "--job chain needs as many --predators, --max-steps, --epochs (and "
                    "--capturers, if any) as --sizes, and at least one."
                )


def setting(text: str) -> tuple[str, Any]:
    """NAME=VALUE, the value a number, true, false, null or a word."""
    name, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE.")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def parsed(arguments: list[str] | None = None) -> Options:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--output", type=Path, required=True, help="directory of the results and of JAX's cache")
    add("--job", choices=JOBS, default="all", help="all: table and main")
    add("--seconds", type=float, default=SECONDS, help="the program ends after so many")
    add("--small", action="store_true", help="tiny tasks: whether it runs, on any device")
    add("--seeds", type=int, help="of a job; 32, with --small 2")
    add("--policy", choices=tuple(POLICIES), default="ic3net", help="of a chain")
    for name, words in (
        ("sizes", "sides of a chain's grids, each dividing the last"),
        ("predators", "of each stage"),
        ("capturers", "of each stage, for Predator-Capture-Prey"),
        ("max-steps", "of each stage"),
        ("epochs", "of each stage; of the main job: source and target"),
    ):
        add(f"--{name}", type=int, nargs="+", default=[], help=words)
    add("--episodes", type=int, default=EPISODES, help="held-out episodes of each seed")
    add("--settings", type=setting, nargs="+", default=[], help="of a chain's learner, NAME=VALUE")
    add("--policy-settings", type=setting, nargs="+", default=[], help="of a chain, NAME=VALUE")
    add("--scale", choices=get_args(Scale), default="none", help="of a chain's upsampled states")
    add("--unroll", type=int, help="steps in a turn of the rollout's loop; the backend's own")
    add("--xla", type=setting, nargs="+", default=[], help="options of XLA's, NAME=VALUE")
    add("--cache", type=Path, help="directory of compiled programs; compiled in the output")
    given = parser.parse_args(arguments)
    lists = {
        name: tuple(getattr(given, name))
        for name in ("sizes", "predators", "capturers", "max_steps", "epochs")
    }
    return Options(
        output=given.output,
        job=given.job,
        seconds=given.seconds,
        small=given.small,
        seeds=given.seeds or (2 if given.small else 32),
        policy=given.policy,
        episodes=given.episodes,
        settings=dict(given.settings),
        policy_settings=dict(given.policy_settings),
        scale=given.scale,
        unroll=given.unroll,
        xla=dict(given.xla),
        cache=given.cache,
        **lists,
    )


def table(report: Report, options: Options, plain: Trial) -> Trial:
    """The first row in several ways; returns the fastest. The other rows come after the job."""
    names = (MATRIX_PRECISION, "tensorfloat32")
    rates = {precision: matrix_rate(precision) for precision in names}
    report.note("matrix_rate", rates)
    first = SMALL_CASE if options.small else Case()
    others = trials(plain.execution)
    others = others[-1:] if options.small else others
    rows = measure(report, "rows", [(first, plain)], rates)
    rows += measure(report, "rows", [(first, trial) for trial in others], rates)
    best = fastest(rows, plain)
    report.note("way", best.name)
    return best


def main(options: Options) -> dict[str, Any]:
    """Runs what is asked; what was written, as a dictionary."""
    options.output.mkdir(parents=True, exist_ok=True)
    report = Report(options.output, options.seconds)
    execution = parallel.execution_on(platform())
    if options.unroll is not None:
        execution = replace(execution, unroll=options.unroll)
    plain = Trial("as the package does", execution, options.xla)
    report.note("device", jax.devices()[0].device_kind)
    report.note("platform", platform())
    report.note("jax", jax.__version__)
    report.note("matrix_precision", MATRIX_PRECISION)
    report.note("execution", asdict(execution))
    best = plain
    if options.job in ("all", "table"):
        best = table(report, options, plain)
    if options.job in ("all", "main"):
        run_legs(report, main_job(options), options, best)
    if options.job == "chain":
        run_legs(report, chain_job(options), options, plain)
    if options.job in ("all", "table"):
        rest = [
            (case, best) for case in ([replace(SMALL_CASE, seeds=1)] if options.small else ROWS)
        ]
        if not options.small:
            rest[COMPILING:COMPILING] = [(Case(), trial) for trial in later_trials(execution)]
        measure(report, "rows", rest, report.content["matrix_rate"])
    stats = jax.devices()[0].memory_stats() or {}
    report.note("peak_memory_gb", stats.get("peak_bytes_in_use", 0) / 2**30)
    return report.content


def keep_compiled(directory: Path) -> None:
    """Compiled programs stay there: a second try begins sooner."""
    jax.config.update("jax_compilation_cache_dir", str(directory.resolve()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def end_after(seconds: float) -> None:
    """Ends this process then, whatever it waits for: what there is, is in the files."""

    def end() -> None:
        print(f"{seconds:.0f} seconds are over; the files hold what there is.", flush=True)
        os._exit(0)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()


if __name__ == "__main__":
    asked = parsed()
    end_after(asked.seconds)
    keep_compiled(asked.cache or asked.output / "compiled")
    main(asked)
    sys.stdout.flush()
    os._exit(0)  # a program may still be compiling, beyond the last row there was time for
