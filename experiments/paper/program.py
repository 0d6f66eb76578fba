"""The paper's evidence in one command: Tables I and II, Figure 2, ablations, claim by claim.

python -m experiments.paper                          # Table I and Q1, preset fast
python -m experiments.paper --experiments pp-hetnet --seeds 0 1 2 3 4
python -m experiments.paper --rebuild                # tables and figures alone

Stop it when you like; the same command goes on, and what is finished is not run again.
"""

import json
import os
import shlex
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from experiments.paper.arms import TABLE_2
from experiments.paper.parts import (
    SELECTIONS,
    TABLE_1,
    Budget,
    Part,
    PresetName,
    Selection,
    checkpoints_in,
    experiment_of,
    part_directory,
    parts_of,
    run_directory,
)
from experiments.paper.report import PROVENANCE, write_report
from experiments.paper.results import (
    FinishedRun,
    Results,
    changed_settings,
    commit,
    machine,
    recognised,
)
from experiments.paper.speed import PASSES, seconds_per_epoch, wait_until_quiet
from sumajax import checkpoint
from sumajax.cli.options import keep_compiled, parse, plain_errors
from sumajax.cli.transfer import MAX_DEVICES
from sumajax.description import versions
from sumajax.experiment import Experiment, run_experiment
from sumajax.experiment.plan import MAX_EPOCHS, check_seeds
from sumajax.experiment.run import Where
from sumajax.learning import parallel
from sumajax.reporting import write_json
from sumajax.transfer import StoppedError

RESULTS = Path(__file__).parents[1] / "results"
SPEED_SEED = 0
"""The one that Table II is measured with, where its arm has a fresh start."""


@dataclass(frozen=True)
class Options:
    """Reruns the paper's experiments and writes its tables and figures with ours beside them."""

    experiments: tuple[Selection, ...] = TABLE_1
    """Rows of Table I; q1: the source tasks without upsampling; and the ablations of PP with IC3Net
    and HetNet: corner, mass, encoder, optimiser, short-source, lab-gap, published-start."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Trained side by side; seeds that are added later are run alone."""
    preset: PresetName = "fast"
    """fast: this package's learner and 1.0 M source steps. paper: the originals' procedure and the
    paper's budgets."""
    epochs_scale: float = 1.0
    """Factor on the preset's epochs."""
    source_epochs: int | None = None
    """Epochs of every source instead of the preset's."""
    target_epochs: int | None = None
    """Epochs of every target arm instead of the preset's."""
    devices: int | None = None
    """Devices to use at most; None: all there are, of CPUs one per core."""
    output: Path = RESULTS
    """Where the CSV files, tables, figures and the report are kept."""
    runs: Path = Path("runs/paper")
    """Where the run directories with their checkpoints are."""
    rebuild: bool = False
    """Train nothing; make tables, figures and report again from the CSV files in output."""
    import_runs: tuple[Path, ...] = ()
    """Train nothing; keep the finished stages of these runs of `sumajax transfer`."""
    import_commit: str = "unknown"
    """The commit that the imported runs are of, which they do not say themselves."""
    measure_speed: bool = False
    """Train nothing; measure Table II for the chosen experiments, with nothing else running: two
    passes, each row once the machine is quiet."""
    speed_epochs: int = 100
    """Epochs that a row of Table II is measured over."""

    def __post_init__(self) -> None:
        if not self.experiments or len(set(self.experiments)) != len(self.experiments):
            raise ValueError(
                f"experiments must be distinct names of {', '.join(SELECTIONS)}, "
                f"got {list(self.experiments)}."
            )
        check_seeds(self.seeds)
        if not 0 < self.epochs_scale <= 100:
            raise ValueError(f"epochs-scale must lie between 0 and 100, got {self.epochs_scale}.")
        for name, most in (
            ("source_epochs", MAX_EPOCHS),
            ("target_epochs", MAX_EPOCHS),
            ("devices", MAX_DEVICES),
            ("speed_epochs", MAX_EPOCHS),
        ):
            value = getattr(self, name)
            if value is not None and not 1 <= value <= most:
                raise ValueError(
                    f"{name.replace('_', '-')} must lie between 1 and {most}, got {value}."
                )
        modes = [n for n in ("rebuild", "import_runs", "measure_speed") if getattr(self, n)]
        if len(modes) > 1:
            first, second = (mode.replace("_", "-") for mode in modes[:2])
            raise ValueError(f"{first} and {second} do different things; give one of them.")

    @property
    def budget(self) -> Budget:
        return Budget(self.preset, self.epochs_scale, self.source_epochs, self.target_epochs)


def run(options: Options) -> None:
    """Does what the options ask for, and writes every table and figure.

    Raises:
      ValueError, OSError: one sentence each.
    """
    results = Results.read(options.output)
    if options.rebuild and not any(results.rows.values()):
        raise ValueError(f"{options.output} holds no results; run experiments or import runs.")
    with locked(options.output):
        if options.import_runs:
            import_runs(options, results)
        elif options.measure_speed:
            measure(options, results)
        elif not options.rebuild:
            train(options, results)
        write_report(Results.read(options.output))  # of the numbers that are kept, no finer ones
    print(f"wrote {options.output / 'README.md'}")


@contextmanager
def locked(directory: Path) -> Any:
    """The results, for one program at a time.

    Raises:
      ValueError: when another one writes there.
      OSError: when nothing can be written there.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        lock = FileLock(directory / ".lock")
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(f"{directory} is in use by another run; wait for its end.") from None
    except OSError as error:
        raise OSError(f"cannot write to {directory} ({error.strerror}).") from None
    try:
        yield
    finally:
        lock.release()
        (directory / ".lock").unlink(missing_ok=True)


def train(options: Options, results: Results) -> None:
    """Runs what is missing of the chosen parts, and keeps each part when it ends."""
    parts = parts_of(options.experiments, options.preset)
    missing = {part: missing_seeds(part, options, results) for part in parts}
    for part in parts:
        needed = missing[part] | _needed_by(part, missing, options, results)
        found = groups(part, needed, options, results)
        for seeds, source in found:
            train_part(part, seeds, source, options, results)
        if lost := needed - {seed for seeds, _ in found for seed in seeds}:
            print(
                f"{part}: not run with seeds {' '.join(map(str, sorted(lost)))}, of which "
                f"{part.source} has no checkpoint.",
                flush=True,
            )


def missing_seeds(part: Part, options: Options, results: Results) -> set[int]:
    """Seeds of which no finished curve is kept.

    Raises:
      ValueError: when one of another length is: it is evidence that nothing may overwrite.
    """
    epochs = options.budget.epochs(part)
    kept = results.last_epochs(part, options.preset)
    for seed in options.seeds:
        if kept.get(seed, epochs) != epochs:
            raise ValueError(
                f"{results.directory} holds {kept[seed]} epochs of {part}, "
                f"preset {options.preset}, seed {seed}, not {epochs}; choose another --output or "
                "the same epochs."
            )
    return set(options.seeds) - set(kept)


def _needed_by(
    part: Part, missing: dict[Part, set[int]], options: Options, results: Results
) -> set[int]:
    """Seeds whose checkpoints other parts go on from, and that are nowhere to be found."""
    wanted: set[int] = set()
    for other, seeds in missing.items():
        if other.source == part:
            wanted |= seeds
    there = {seed for seeds, _ in checkpoints_of(part, options, results) for seed in seeds}
    return wanted - there


def groups(
    part: Part, seeds: set[int], options: Options, results: Results
) -> list[tuple[tuple[int, ...], Path | None]]:
    """Seeds to train side by side, with the checkpoints that they start from.

    A run that was begun goes on as it was; the others are grouped as their sources are.
    """
    found: list[tuple[tuple[int, ...], Path | None]] = []
    left = set(seeds)
    starts: list[tuple[tuple[int, ...], Path | None]] = [(tuple(sorted(left)), None)]
    if part.source is not None:
        starts = [*checkpoints_of(part.source, options, results)]
    for begun in _begun(part, options):
        if left & set(begun):
            found.append((begun, _start(begun, starts)))
            left -= set(begun)
    for there, path in starts:
        if together := tuple(sorted(left & set(there))):
            found.append((together, path))
            left -= set(together)
    return found


def _start(
    seeds: tuple[int, ...], starts: Iterable[tuple[tuple[int, ...], Path | None]]
) -> Path | None:
    return next((path for there, path in starts if set(seeds) <= set(there)), None)


def _begun(part: Part, options: Options) -> list[tuple[int, ...]]:
    """Seeds of the runs of a part, finished or not."""
    found = sorted(part_directory(part, options.preset, options.runs).glob("*/config.json"))
    plans = [json.loads(file.read_text()).get("experiment", {}) for file in found]
    return [tuple(plan["seeds"]) for plan in plans if plan]


def checkpoints_of(
    part: Part, options: Options, results: Results
) -> list[tuple[tuple[int, ...], Path]]:
    """(seeds, checkpoints) of a finished source: our own runs, then those that were imported."""
    found = []
    for seeds in _begun(part, options):
        run = finished_run(part, seeds, options)
        if run.has_ended:
            found.append((seeds, checkpoints_in(run.directory, part)))
    for file in sorted((results.directory / PROVENANCE).glob("*.json")):
        known = json.loads(file.read_text())
        path = checkpoints_in(Path(known["run"]), part)
        is_of_it = known["preset"] == options.preset and str(part) in known["parts"]
        if is_of_it and path.is_dir():
            found.append((tuple(known["seeds"]), path))
    return [pair for pair in found if checkpoint.latest(pair[1]) is not None]


def finished_run(part: Part, seeds: Sequence[int], options: Options) -> FinishedRun:
    """The run of a part with these seeds; it may not have ended, or begun."""
    directory = run_directory(part, options.preset, seeds, options.runs)
    return FinishedRun(directory, {part.arm.name: part})


def num_devices(experiment: Experiment, options: Options) -> int:
    """As many as are allowed and its seeds and environments spread over."""
    (stage,) = experiment.stages
    most = options.devices or len(parallel.available_devices())
    return parallel.most_devices(len(experiment.seeds), stage.learner.num_envs, most)


def train_part(
    part: Part, seeds: tuple[int, ...], source: Path | None, options: Options, results: Results
) -> None:
    """Runs a part, or goes on with it, unless it is finished; then keeps its rows."""
    print(f"== {part}, preset {options.preset}, seeds {' '.join(map(str, seeds))}", flush=True)
    finished = finished_run(part, seeds, options)
    note = Provenance.of([part], options.preset, seeds, finished.directory)
    if not finished.has_ended:
        experiment = experiment_of(part, options.budget, seeds, source)
        note.write(results.directory, {"command": command(), "commit": commit()})
        try:
            where = Where(devices=num_devices(experiment, options))
            run_experiment(experiment, finished.directory, where)
        except StoppedError as error:
            # A part without an end is no curve; its file says why, and the others go on.
            note.write(results.directory, {"stopped": str(error)})
            print(f"{part}: {error}", flush=True)
            return
    note.keep_plan(results.directory, finished.plan)
    results.add(finished)
    results.write()


def import_runs(options: Options, results: Results) -> None:
    """Keeps the finished stages of runs that were made without this program."""
    found = [recognised(directory) for directory in options.import_runs]
    for finished in found:
        results.add(finished)
        config, plan = finished.config, finished.plan
        parts = list(finished.parts.values())
        about = {
            "command": shlex.join(["python", *config["command"]]),
            "commit": options.import_commit,
            "versions": config["versions"],
        }
        note = Provenance.of(parts, plan["preset"], tuple(plan["seeds"]), finished.directory)
        note.write(results.directory, about)
        note.keep_plan(results.directory, plan)
        print(f"kept {', '.join(map(str, parts))} of {finished.directory}")
        if changed := changed_settings(plan):
            print(f"  with another {', '.join(changed)} than preset {plan['preset']}")
    results.write()


def measure(options: Options, results: Results) -> None:
    """Table II for the chosen experiments: all its rows, pass after pass."""
    parts = [p for p in parts_of(options.experiments, options.preset) if p.arm in TABLE_2]
    for number in range(1, PASSES + 1):
        for part in parts:
            measure_part(part, number, options, results)


def measure_part(part: Part, number: int, options: Options, results: Results) -> None:
    """One row in one pass; left out where there is no source to start from.

    An arm that goes on from a source has the first seed that one is found of.
    """
    seed, start = SPEED_SEED, None
    if part.source is not None:
        found = checkpoints_of(part.source, options, results)
        if not found:
            print(f"{part}: no source to start from, left out")
            return
        (seed, *_), start = found[0]
    experiment = experiment_of(part, options.budget, (seed,), start)
    devices = num_devices(experiment, options)
    if not wait_until_quiet():
        print(f"{part}: the machine is not quiet; the load is kept beside the row", flush=True)
    timed = seconds_per_epoch(experiment, options.runs, devices, options.speed_epochs)
    about = {
        "experiment": part.experiment,
        "arm": part.arm.name,
        "preset": options.preset,
        "pass": number,
    }
    known = machine()
    where = {"machine": f"{known['processor']}, {known['cores']} cores", "commit": commit()}
    results.replace("seconds_per_epoch", [{**about, **timed, **where}], tuple(about))
    results.write()
    print(f"{part}, pass {number}: {timed['seconds']:.3f} s per epoch", flush=True)


@dataclass(frozen=True)
class Provenance:
    """Where the rows of a run come from: its file is added to each time the run goes on."""

    parts: list[Part]
    preset: str
    seeds: tuple[int, ...]
    run: Path

    @classmethod
    def of(
        cls, parts: list[Part], preset: str, seeds: tuple[int, ...], directory: Path
    ) -> "Provenance":
        return cls(parts, preset, seeds, directory.resolve())

    def file(self, results: Path) -> Path:
        """Named after what the run trained: experiments with their arms, and seeds."""
        by_experiment: dict[str, list[str]] = {}
        for part in self.parts:
            by_experiment.setdefault(part.experiment, []).append(part.arm.name)
        names = "+".join(f"{name}-{'+'.join(arms)}" for name, arms in by_experiment.items())
        seeds = "-".join(map(str, self.seeds))
        return results / PROVENANCE / f"{self.preset}-{names}-seeds-{seeds}.json"

    def write(self, results: Path, session: dict[str, Any]) -> None:
        """Adds a session: its command and commit, versions, machine and time."""
        file = self.file(results)
        file.parent.mkdir(parents=True, exist_ok=True)
        before = json.loads(file.read_text()) if file.exists() else {}
        now = {
            "versions": versions(),
            "machine": machine(),
            "load_before": os.getloadavg()[0],
            "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            **session,
        }
        about = {
            "parts": [str(part) for part in self.parts],
            "preset": self.preset,
            "seeds": self.seeds,
            "run": self.run,
        }
        write_json(file, {**before, **about, "sessions": [*before.get("sessions", []), now]})

    def keep_plan(self, results: Path, plan: dict[str, Any]) -> None:
        """Adds what was trained, resolved: tasks, starts and every setting of the learner."""
        file = self.file(results)
        write_json(file, {**json.loads(file.read_text()), "experiment": plan})


def command() -> str:
    """As it can be typed again."""
    return shlex.join(["python", "-m", "experiments.paper", *sys.argv[1:]])


def main() -> None:
    """Reads the options and runs."""
    with plain_errors():
        options = parse(Options, Options(), prog="python -m experiments.paper")
        if not options.rebuild and not options.import_runs:
            keep_compiled()
            # All at once: parts of other seeds spread over other numbers of them.
            parallel.choose_devices(options.devices or parallel.usable_cores(), 1, options.devices)
        run(options)
