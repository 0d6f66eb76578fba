"""Traffic Junction as published, and from easy to medium: what each seed comes to.

python experiments/traffic_junction.py --parts easy medium hard --seeds 0 1 2
python experiments/traffic_junction.py --rebuild            # tables alone

Stop it when you like; the same command goes on, and what is finished is not run again. Every part
is one or two experiments (`experiments`), whose seeds are trained side by side; all are played in
the held-out episodes at the task's own rate, sampled and greedy.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # the clone: `experiments` is a package of it

from experiments.paper.results import write_csv
from experiments.studies import (
    KEY,
    Row,
    StudyRun,
    curves_of,
    keep_plan,
    locked,
    note_session,
    read_csv,
    replaced,
    study_runs,
)
from sumajax.cli.options import keep_compiled, parse, plain_errors
from sumajax.environments.roads import Difficulty
from sumajax.environments.traffic_junction import TrafficJunction, with_curriculum
from sumajax.environments.types import Environment
from sumajax.evaluation import EPISODES
from sumajax.experiment import Experiment, Stage
from sumajax.experiment.plan import check_seeds
from sumajax.experiment.records import MODES, StageRecords
from sumajax.learning import LearnerConfig, preset
from sumajax.learning.config import Critic
from sumajax.reporting import write_text
from sumajax.upsampling import Fill, StateUpsampled

RESULTS = Path(__file__).parent / "results" / "traffic_junction"

# --- What is run --------------------------------------------------------------------------------

LESSON_EPOCHS, SHARP_EPOCHS = 120, 30
"""Of 20,000 environment steps: with rates that rise, then at the task's own rate."""
TARGET_EPOCHS = LESSON_EPOCHS // 5
"""Of a task after a smaller one: a fifth of its lessons from scratch, and what scratch has beside
it."""
SOLVED = 0.8
"""Success, in the run's own comparison."""
POLICY = "ic3net"
SETTINGS: dict[str, Any] = {"talk_always": True}
"""As the published program has it in this domain."""
HOLD_UP = 0.3
"""Drivers learn to keep their distance from who may stop before anybody can gain by stopping."""
CRITIC: Critic = "state"
LESSON_ENTROPY, SHARP_ENTROPY = 0.01, 0.001
"""Weights of the bonus. These two and the critic are all that is not preset `fast`;
docs/settings.md, Traffic Junction."""

Part = Literal["easy", "medium", "hard", "transfer", "transfer-hard", "memory"]
PARTS: tuple[Part, ...] = get_args(Part)
SMALLER = {
    "transfer": (TrafficJunction("easy"), TrafficJunction("medium")),
    "transfer-hard": (TrafficJunction("hard", size=9), TrafficJunction("hard")),
}
"""Of a part: the task that is seen at the size of the one after it."""


@dataclass(frozen=True)
class Study:
    """An experiment without its seeds; its name is that of its directory and rows."""

    name: str
    stages: tuple[Stage, ...]
    settings: Mapping[str, Any] = field(default_factory=lambda: SETTINGS)

    def experiment(self, seeds: Sequence[int]) -> Experiment:
        return Experiment(
            self.stages,
            policy=POLICY,
            seeds=tuple(seeds),
            policy_settings=self.settings,
            name=self.name,
            threshold=SOLVED,
            evaluate_every=0,
            episodes=EPISODES,
        )


def lessons(
    name: str, task: TrafficJunction, epochs: int, start: str | None = None, **seen: Any
) -> Stage:
    """A task at rates that rise from an eighth to three eighths of its epochs, with hold-ups that
    end two eighths later; seen at another size if `seen` says at which and how.
    """
    rise = (epochs // 8, 3 * epochs // 8)
    rising = with_curriculum(task, epochs)
    env: Environment = replace(rising, rate_epochs=rise, hold_up=HOLD_UP)
    if seen:
        env = StateUpsampled(env, **seen)
    return Stage(name, env, epochs, start, learner(LESSON_ENTROPY))


def learner(entropy_weight: float) -> LearnerConfig:
    return preset("fast", POLICY, critic=CRITIC, entropy_weight=entropy_weight)


def taught(difficulty: Difficulty) -> tuple[Stage, ...]:
    """Lessons, then the task itself with next to no bonus for choices that are not sharp."""
    task, name = TrafficJunction(difficulty), f"{difficulty}-sharp"
    return (
        lessons(difficulty, task, LESSON_EPOCHS),
        Stage(name, task, SHARP_EPOCHS, difficulty, learner(SHARP_ENTROPY)),
    )


def transfer(small: TrafficJunction, large: TrafficJunction, fill: Fill) -> tuple[Stage, ...]:
    """The small task seen at the size of the large one, then that."""
    source = lessons(_name(small), small, LESSON_EPOCHS, size=large.shape[0], fill=fill)
    return source, lessons(_name(large), large, TARGET_EPOCHS, source.name)


def _name(task: TrafficJunction) -> str:
    """Its difficulty, with its size where that is another than published."""
    published = task == TrafficJunction(task.difficulty)
    return task.difficulty if published else f"{task.difficulty}-{task.size}"


def studies(part: Part) -> list[Study]:
    """The experiments of a part."""
    if part == "transfer" or part == "transfer-hard":
        small, large = SMALLER[part]
        scratch = lessons("scratch", large, TARGET_EPOCHS)
        return [
            Study(f"{part}-blocks", (*transfer(small, large, "blocks"), scratch)),
            Study(f"{part}-corner", transfer(small, large, "corner")),
        ]
    if part == "memory":
        settings = {**SETTINGS, "fresh_memory": True}
        return [Study("easy-fresh-memory", taught("easy"), settings)]
    return [Study(part, taught(part))]


# --- What is kept -------------------------------------------------------------------------------

FIGURES = ("success", "return", *TrafficJunction.figure_names)
COLUMNS = {
    "held_out": (*KEY, "when", "env_steps", "mode", "episodes", *FIGURES),
    "curves": (*KEY, "epoch", "env_steps", "cpu_seconds", "success"),
}
"""The kept files. `held_out`: episodes at the task's rate, before a stage (`zero shot`) and after
it (`end`). `curves`: training's own figures, at the rate of the epoch."""


def rows_of(found: StudyRun[Study]) -> dict[str, list[Row]]:
    """The rows of a finished run, by kept file."""
    records = StageRecords(found.directory / "stages.json")
    held_out = [
        {"experiment": found.study.name, "stage": stage.name, **row}
        for stage in found.experiment.stages
        for row in played(records[stage.name], found.seeds)
    ]
    return {"held_out": held_out, "curves": curves_of(found, ("success",))}


def played(record: Mapping[str, Any], seeds: Sequence[int]) -> Iterator[Row]:
    """What is known of a stage, by time, way of choosing and seed."""
    end = record["result"]
    times = [("end", end["env_steps"], end["evaluation"])]
    if record.get("zero_shot"):
        times.insert(0, ("zero shot", 0, record["zero_shot"]))
    for when, env_steps, evaluation in times:
        for mode in MODES:
            for place, seed in enumerate(seeds):
                figures = {name: evaluation[mode][name][place] for name in FIGURES}
                about = {"seed": seed, "when": when, "env_steps": env_steps, "mode": mode}
                yield {**about, "episodes": evaluation[mode]["episodes"], **figures}


def keep(found: StudyRun[Study], output: Path) -> None:
    """Puts the rows of a finished run in the place of all of its experiment and seeds."""
    for name, new in rows_of(found).items():
        file = output / f"{name}.csv"
        rows = replaced(read_csv(file), found.study.name, found.seeds, new)
        write_csv(file, COLUMNS[name], rows)


# --- Tables -------------------------------------------------------------------------------------

WORDS = ("success", "success (greedy)", "collisions per car", "mean delay", "cars through")


def tables(held_out: Sequence[Row]) -> str:
    """A row per experiment, stage and time: mean and range over the seeds."""
    head = ["experiment", "stage", "when", "M steps", "seeds", *WORDS]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for place in dict.fromkeys((r["experiment"], r["stage"], r["when"]) for r in held_out):
        rows = [r for r in held_out if (r["experiment"], r["stage"], r["when"]) == place]
        sampled, greedy = ([r for r in rows if r["mode"] == mode] for mode in MODES)
        cells = [spread(sampled, "success"), spread(greedy, "success")]
        cells += [spread(sampled, name) for name in TrafficJunction.figure_names]
        seeds = " ".join(str(row["seed"]) for row in sampled)
        steps = f"{sampled[0]['env_steps'] / 1e6:.1f}"
        lines.append("| " + " | ".join([*place, steps, seeds, *cells]) + " |")
    return "\n".join([TITLE, *lines, ""])


TITLE = """# Traffic Junction: tables

Made by `python experiments/traffic_junction.py --rebuild` of the CSV files beside it. Held-out
episodes at the task's rate; mean over the seeds, least and greatest in brackets; sampled choices
where it does not say greedy.
"""


def spread(rows: Sequence[Row], name: str) -> str:
    """Mean over the seeds, with the least and the greatest."""
    values = np.array([row[name] for row in rows])
    one = f"{values.mean():.3f}"
    return one if len(values) == 1 else f"{one} ({values.min():.3f}-{values.max():.3f})"


# --- The program --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Options:
    """Trains policies of Traffic Junction and writes what they came to."""

    parts: tuple[Part, ...] = PARTS
    """easy, medium, hard: as published. transfer: easy seen at 14x14, then medium, by blocks and by
    padding, and medium from scratch beside it. transfer-hard: the same from hard 9x9 to 18x18.
    memory: easy, newcomers without their slot's
    memory."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Trained side by side in one run; seeds that are added later have a run of their own."""
    output: Path = RESULTS
    """Where CSV files and tables are kept."""
    runs: Path = Path("runs/traffic_junction")
    """Where the run directories with their checkpoints are."""
    rebuild: bool = False
    """Train nothing; make the tables again from the CSV files in output."""

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        for part in self.parts:
            if part not in PARTS:
                raise ValueError(f"part {part!r} is unknown; choose one of {', '.join(PARTS)}.")


def run(options: Options) -> None:
    """Does what the options ask for, and writes the tables.

    Raises:
      ValueError, OSError: one sentence each.
    """
    for study in [] if options.rebuild else [s for part in options.parts for s in studies(part)]:
        for found in study_runs(study, options.seeds, options.runs, devices=1):
            note_session(found, options.output)
            found.train()
            with locked(options.output):
                keep(found, options.output)
            keep_plan(found, options.output)
    held_out = read_csv(options.output / "held_out.csv")
    if not held_out:
        raise ValueError(f"{options.output} holds no results; run a part first.")
    write_text(options.output / "tables.md", tables(held_out))


def main() -> None:
    """Reads the options and runs."""
    with plain_errors():
        options = parse(Options, Options(), prog="python experiments/traffic_junction.py")
        if not options.rebuild:
            keep_compiled()
        run(options)


if __name__ == "__main__":
    main()
