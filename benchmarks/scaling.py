"""How the cost of a training step grows, beside what counting its matrix products gives.

Method. From one base, IC3Net on Predator-Prey 10x10 with 5 predators, one thing is changed at a
time. Each point is compiled, run once, then timed `--repeats` times for one epoch; the figure is
the median of CPU microseconds per environment step, and of wall time for the devices. Points of one
line are timed in turns, so that a slow spell of the machine falls on all of them. Growth is the
cost over that of the base. Theory is the growth of the multiply-adds in the compiled update,
counted in its program; over devices it is 1 / devices of wall time.

    python benchmarks/scaling.py --output scaling
"""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import jax
import matplotlib.pyplot as plt
import tyro
from epochs_per_second import PolicyName, machine
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter, ScalarFormatter
from matrix_products import multiply_adds, products

from sumajax.environments import PredatorPrey
from sumajax.learning import EPOCH_STEPS, Learner, make_learner, parallel, preset
from sumajax.policies import make_policy
from sumajax.reporting import print_table


@dataclass(frozen=True)
class Point:
    """One configuration."""

    policy: PolicyName = "ic3net"
    envs: int = 50
    agents: int = 5
    side: int = 10
    hidden: int = 128
    seeds: int = 1
    devices: int = 1


@dataclass(frozen=True)
class Options:
    """What to vary, and how far."""

    policy: PolicyName = "ic3net"
    """The base's policy."""
    envs: tuple[int, ...] = (25, 50, 100, 200, 500, 1000)
    """Environments side by side."""
    agents: tuple[int, ...] = (2, 5, 10, 20)
    """Predators."""
    side: tuple[int, ...] = (5, 10, 20)
    """Sides of the grid."""
    hidden: tuple[int, ...] = (64, 128, 256)
    """Hidden width."""
    seeds: tuple[int, ...] = (1, 2, 4)
    """Seeds trained in one program."""
    devices: tuple[int, ...] = (1, 2)
    """Devices the environments are spread over."""
    repeats: int = 5
    """Timed repeats of each point."""
    output: Path | None = None
    """Write scaling.json and scaling.png into this directory, which must not hold them."""

    def __post_init__(self) -> None:
        for name in VARIED:
            least = min(getattr(self, name), default=0)
            if least < 1:
                raise ValueError(
                    f"{name} must be numbers of at least 1, got {getattr(self, name)}."
                )
        for file in self.files:
            if file.exists():
                raise ValueError(f"{file} exists; choose another --output.")

    @property
    def files(self) -> list[Path]:
        names = ("scaling.json", "scaling.png")
        return [] if self.output is None else [self.output / name for name in names]


VARIED = ("envs", "agents", "side", "hidden", "seeds", "devices")


@dataclass(frozen=True)
class Cost:
    """A point, measured."""

    varied: str
    point: Point
    cpu_microseconds_per_step: float
    wall_microseconds_per_step: float
    spread: tuple[float, float]  # least and most CPU microseconds
    multiply_adds_per_step: float
    growth: float = 1.0
    theory: float = 1.0


def make(point: Point) -> Learner:
    env = PredatorPrey(point.side, point.agents, vision=1, max_steps=200)
    policy = make_policy(point.policy, env, hidden=point.hidden)
    return make_learner(env, policy, preset("fast", point.policy, num_envs=point.envs))


def counted(learner: Learner) -> float:
    """Multiply-adds of one update, per environment step."""
    state = jax.eval_shape(learner.init, jax.random.key(0))
    config = learner.config
    return multiply_adds(products(learner.update, state)) / (
        config.num_envs * config.rollout_length
    )


def prepared(point: Point) -> Callable[[], tuple[float, float]]:
    """A call trains one epoch and returns CPU and wall microseconds per environment step."""
    learner = make(point)
    mesh = parallel.make_mesh(point.seeds, point.envs, point.devices)
    states = parallel.place(parallel.init_seeds(learner, list(range(point.seeds))), mesh)
    train = parallel.compile_train(learner, mesh, 1, states)
    held: list[Any] = [jax.block_until_ready(train(states))[0]]

    def once() -> tuple[float, float]:
        cpu, wall = time.process_time(), time.perf_counter()
        held[0] = jax.block_until_ready(train(held[0]))[0]
        steps = point.seeds * EPOCH_STEPS / 1e6
        return (time.process_time() - cpu) / steps, (time.perf_counter() - wall) / steps

    return once


def measure(varied: str, options: Options) -> list[Cost]:
    """The points of one line."""
    base = Point(options.policy)
    values = sorted({*getattr(options, varied), getattr(base, varied)})
    points = [replace(base, **{varied: value}) for value in values]
    calls = [prepared(point) for point in points]
    turns = [[call() for call in calls] for _ in range(options.repeats)]
    costs = []
    for index, point in enumerate(points):
        cpu, wall = zip(*(turn[index] for turn in turns), strict=True)
        adds = counted(make(point))
        costs.append(Cost(varied, point, median(cpu), median(wall), (min(cpu), max(cpu)), adds))
    return with_growth(costs, points.index(base))


def with_growth(costs: list[Cost], base: int) -> list[Cost]:
    """`costs` of one line with growth and theory relative to its base."""
    over_devices = costs[base].varied == "devices"

    def of(cost: Cost) -> tuple[float, float]:
        if over_devices:
            return cost.wall_microseconds_per_step, 1 / cost.point.devices
        return cost.cpu_microseconds_per_step, cost.multiply_adds_per_step

    measured, expected = of(costs[base])
    return [
        replace(cost, growth=of(cost)[0] / measured, theory=of(cost)[1] / expected)
        for cost in costs
    ]


def shown(cost: Cost) -> dict[str, str]:
    """A line of the printed table."""
    least, most = cost.spread
    return {
        "varied": cost.varied,
        "value": str(getattr(cost.point, cost.varied)),
        "CPU us/step": f"{cost.cpu_microseconds_per_step:.1f} ({least:.1f}-{most:.1f})",
        "wall us/step": f"{cost.wall_microseconds_per_step:.1f}",
        "growth": f"{cost.growth:.2f}",
        "theory": f"{cost.theory:.2f}",
    }


MEASURED, THEORY = "#0072b2", "#d55e00"
"""Blue and vermilion of Okabe and Ito, told apart by most of the colour-blind."""
HEADROOM = 1.1
"""Top of a panel over its highest point."""


def draw(costs: list[Cost], file: Path) -> None:
    """A panel for each thing varied: growth measured and counted."""
    figure, panels = plt.subplots(2, 3, figsize=(10, 6), layout="constrained")
    for varied, panel in zip(VARIED, panels.flat, strict=True):
        _panel(panel, varied, [cost for cost in costs if cost.varied == varied])
    panels.flat[0].legend(frameon=False)
    figure.savefig(file, dpi=150)
    plt.close(figure)


def _panel(panel: Axes, varied: str, costs: list[Cost]) -> None:
    values = [getattr(cost.point, varied) for cost in costs]
    panel.plot(values, [c.theory for c in costs], "--", color=THEORY, label="multiply-adds")
    panel.plot(values, [c.growth for c in costs], "o-", color=MEASURED, label="measured")
    panel.set(xlabel=varied, ylabel="cost per step / base", xscale="log")
    panel.set_xticks(values, map(str, values))
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.yaxis.set_major_formatter(ScalarFormatter())
    panel.set_ylim(0, HEADROOM * max(max(c.growth, c.theory) for c in costs))
    panel.spines[["top", "right"]].set_visible(False)


def main(options: Options) -> None:
    parallel.use_cpu_devices(max(options.devices))
    header = machine()
    print(", ".join(f"{name} {value}" for name, value in header.items()), flush=True)
    costs: list[Cost] = []
    for varied in VARIED:
        costs += measure(varied, options)
        print_table([shown(cost) for cost in costs if cost.varied == varied], title=varied)
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        report = {"machine": header, "rows": [asdict(cost) for cost in costs]}
        (options.output / "scaling.json").write_text(json.dumps(report, indent=2) + "\n")
        draw(costs, options.output / "scaling.png")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
