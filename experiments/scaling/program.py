"""`python experiments/scale.py`: its options, and what it does with them."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from experiments.scaling.plans import PARTS, VARIANTS, Part, Study, studies
from experiments.scaling.report import write_report
from experiments.scaling.results import Results
from experiments.scaling.runs import finish
from experiments.studies import StudyRun, keep_plan, locked, note_session, study_runs
from sumajax.cli.options import keep_compiled, parse, plain_errors
from sumajax.cli.transfer import MAX_DEVICES
from sumajax.evaluation import EPISODES
from sumajax.experiment.plan import check_seeds
from sumajax.learning import parallel
from sumajax.transfer import StoppedError

RESULTS = Path(__file__).parents[1] / "results" / "scale"
REPLAYED = "pp40-hetnet"
"""The experiment of whose first seed an episode is kept, to look at."""


@dataclass(frozen=True)
class Options:
    """Trains chains to large grids, scratch and simpler rivals, and writes what they came to."""

    parts: tuple[Part, ...] = ("pp20",)
    """pp10, pp20, pp40: Predator-Prey by way of 5x5. pcp20: Predator-Capture-Prey. rect: 10x20 to
    20x40. rivals: what else makes a small task fit. dilution: policies on large teams. brief,
    short: sources of 0.3 and of 0.5 M steps each. still: stages that end themselves."""
    policies: tuple[str, ...] = ()
    """hetnet, ic3net, ic3net-talking, ic3net-max, tarmac-ic3net, tarmac-ic3net-twice (two rounds of
    messages), magic; each part's own if not given."""
    only: tuple[str, ...] = ()
    """Of these parts only the experiments called so, as rivals-blank-hetnet."""
    seeds: tuple[int, ...] = (0,)
    """Trained side by side in one run; seeds that are added later have a run of their own."""
    devices: int = 1
    """To spread seeds and environments over."""
    output: Path = RESULTS
    """Where CSV files, tables and figures are kept."""
    runs: Path = Path("runs/scale")
    """Where the run directories with their checkpoints are."""
    rebuild: bool = False
    """Train nothing; make tables and figures again from the CSV files in output."""

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        if not 1 <= self.devices <= MAX_DEVICES:
            raise ValueError(f"devices must lie between 1 and {MAX_DEVICES}, got {self.devices}.")
        for name, given, known in (
            ("part", self.parts, PARTS),
            ("policy", self.policies, tuple(VARIANTS)),
            ("experiment", self.only, tuple(s.name for s in self._of_parts)),
        ):
            for value in given:
                if value not in known:
                    raise ValueError(
                        f"{name} {value!r} is unknown; choose one of {', '.join(known)}."
                    )

    @property
    def _of_parts(self) -> list[Study]:
        known = [part for part in self.parts if part in PARTS]
        policies = [policy for policy in self.policies if policy in VARIANTS]
        return [study for part in known for study in studies(part, policies)]

    @property
    def studies(self) -> list[Study]:
        return [study for study in self._of_parts if not self.only or study.name in self.only]


def run(options: Options, episodes: int = EPISODES) -> None:
    """Does what the options ask for, and writes every table and figure.

    Args:
      episodes: held-out episodes of what a stage begins and ends with.

    Raises:
      ValueError, OSError: one sentence each.
    """
    if not options.rebuild:
        for study in options.studies:
            for found in study_runs(study, options.seeds, options.runs, options.devices):
                _finish(found, options, episodes)
    with locked(options.output):
        results = Results.read(options.output)
        if not results.rows["stages"]:
            raise ValueError(f"{options.output} holds no results; run a part first.")
        write_report(results)
    print(f"wrote {options.output / 'tables.md'}")


def _finish(found: StudyRun[Study], options: Options, episodes: int) -> None:
    """Runs what is missing of an experiment and keeps it."""
    name = f"{found.study.name}, seeds {' '.join(map(str, found.seeds))}"
    print(f"== {name}", flush=True)
    note_session(found, options.output)
    try:
        rows = finish(found, episodes)
    except StoppedError as error:  # no rows then; the others go on
        print(f"{name}: {error}", flush=True)
        return
    with locked(options.output):
        results = Results.read(options.output)
        results.add(found.study.name, found.seeds, rows)
        results.write()
        replay = found.directory / "replay.gif"
        if found.study.name == REPLAYED and 0 in found.seeds and replay.exists():
            shutil.copy(replay, options.output / f"replay-{found.study.name}.gif")
    keep_plan(found, options.output)


def main() -> None:
    """Reads the options and runs."""
    with plain_errors():
        options = parse(Options, Options(), prog="python experiments/scale.py")
        if not options.rebuild:
            keep_compiled()
            # All at once: the experiments share the devices of one program.
            parallel.choose_devices(options.devices, options.devices, options.devices)
        run(options)
