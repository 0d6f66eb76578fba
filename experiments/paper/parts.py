"""What the reproduction is made of: parts, each one arm of one experiment, with seeds of its own.

A part is an experiment of one stage: it trains from fresh parameters, or goes on from the
checkpoints of another part.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from experiments.paper.arms import (
    ABLATIONS,
    SCRATCH,
    SCRATCH_BRIEF,
    SOURCE,
    SOURCE_PLAIN,
    TRANSFER,
    TRANSFER_BRIEF,
    AblationName,
    Arm,
    with_start,
)
from experiments.paper.published import EXPERIMENTS, SOURCES, PaperExperiment
from sumajax.environments.types import Environment
from sumajax.experiment import Experiment, Stage
from sumajax.learning import preset
from sumajax.upsampling import StateUpsampled

PresetName = Literal["fast", "paper"]
PRESETS: tuple[PresetName, ...] = get_args(PresetName)
Table1Name = Literal["pp-ic3net", "pp-magic", "pp-hetnet", "pcp-hetnet-2p1c", "pcp-hetnet-3p2c"]
Selection = Literal[Table1Name, "q1", AblationName]
TABLE_1: tuple[Selection, ...] = (*get_args(Table1Name), "q1")
"""What runs when nothing is chosen: Table I, and question Q1."""
SELECTIONS: tuple[Selection, ...] = (*TABLE_1, *get_args(AblationName))

FAST_SOURCE_EPOCHS = 50
FAST_TARGET_EPOCHS = {"pp-ic3net": 125, "pp-magic": 60}
FAST_TARGET_EPOCHS_OTHERS = 150
FAST_BRIEF_EPOCHS = {"pp-hetnet": 60}
"""Of preset `fast`: 1.0 M source steps; on the target 3.0 M for HetNet, 2.5 M for IC3Net and 1.2 M
for MAGIC, by when all of their seeds but one have come to 20 steps. HetNet's many ablations are
brief: 1.2 M."""

ABLATED = ("pp-ic3net", "pp-hetnet")
"""Experiments that the ablations change."""


@dataclass(frozen=True)
class Part:
    """An arm of an experiment, by the experiment's name."""

    experiment: str
    arm: Arm

    def __str__(self) -> str:
        return f"{self.experiment} {self.arm.name}"

    @property
    def row(self) -> PaperExperiment:
        return EXPERIMENTS[self.experiment]

    @property
    def source(self) -> "Part | None":
        """The part whose checkpoints it goes on from."""
        return None if self.arm.start is None else Part(self.row.source_of, self.arm.start)

    @property
    def env(self) -> Environment:
        """The task as the policy sees it."""
        if self.arm.task == "target":
            return self.row.target
        if self.arm.upsampling == "none":
            return self.row.source
        size = self.row.target.size
        return StateUpsampled(self.row.source, size, self.arm.scale, self.arm.upsampling)


def parts_of(selections: Iterable[Selection], preset_name: PresetName) -> list[Part]:
    """The parts of what was chosen, in order, each after the one it goes on from, none twice."""
    parts = (part for name in selections for part in _selected(name, preset_name))
    return list(dict.fromkeys(parts))


def _selected(selection: Selection, preset_name: PresetName) -> list[Part]:
    if selection in EXPERIMENTS:
        source = EXPERIMENTS[selection].source_of
        return [Part(source, SOURCE), Part(selection, TRANSFER), Part(selection, SCRATCH)]
    if selection == "q1":
        return [Part(name, arm) for name in SOURCES for arm in (SOURCE, SOURCE_PLAIN)]
    ablation = ABLATIONS[selection]
    return [
        Part(name, arm)
        for name in ABLATED
        for compared in (
            *(unchanged_arms(name, preset_name) if ablation.beside_unchanged else ()),
            *ablation.variants.values(),
        )
        for arm in with_start(compared)
    ]


def unchanged_arms(name: str, preset_name: PresetName) -> tuple[Arm, Arm]:
    """Transfer and scratch that an experiment's ablations are compared with.

    They have the ablations' own budget, as the learning rate may anneal to its end.
    """
    if preset_name == "fast" and name in FAST_BRIEF_EPOCHS:
        return TRANSFER_BRIEF, SCRATCH_BRIEF
    return TRANSFER, SCRATCH


@dataclass(frozen=True)
class Budget:
    """How long to train: a preset's own epochs, scaled or replaced.

    Attributes:
      scale: factor on the preset's epochs.
      source, target: epochs instead of the preset's.
    """

    preset: PresetName
    scale: float = 1.0
    source: int | None = None
    target: int | None = None

    def epochs(self, part: Part) -> int:
        """Of a part; at least one."""
        given = self.source if part.arm.task == "source" else self.target
        if given is None:
            given = max(1, round(self.scale * self._own(part)))
        return max(1, round(part.arm.share * given))

    def _own(self, part: Part) -> int:
        if self.preset == "paper":
            return part.row.epochs[part.arm.like]
        if part.arm.task == "source":
            return FAST_SOURCE_EPOCHS
        own = FAST_TARGET_EPOCHS.get(part.experiment, FAST_TARGET_EPOCHS_OTHERS)
        return FAST_BRIEF_EPOCHS.get(part.experiment, own) if part.arm.brief else own


def experiment_of(
    part: Part, budget: Budget, seeds: tuple[int, ...], source: Path | None
) -> Experiment:
    """The experiment of a part: its one stage has the name of its arm.

    Args:
      source: checkpoints it goes on from, of all these seeds; None for a part that does not.
    """
    arm, row = part.arm, part.row
    stage = Stage(
        arm.name,
        part.env,
        budget.epochs(part),
        source,
        preset(budget.preset, row.policy),
        carry_optimiser=arm.carry_optimiser,
        leave_out=arm.leave_out,
    )
    return Experiment(
        (stage,),
        policy=row.policy,
        seeds=seeds,
        policy_settings={} if arm.encoder == "flat" else {"encoder": arm.encoder},
        name=str(part),
        preset=budget.preset,
        evaluate_every=0,
    )


def part_directory(part: Part, preset_name: PresetName, runs: Path) -> Path:
    """Where the runs of a part are, each with seeds of its own."""
    return runs / preset_name / part.experiment / part.arm.name


def run_directory(part: Part, preset_name: PresetName, seeds: Iterable[int], runs: Path) -> Path:
    """Of a part's run with these seeds."""
    return part_directory(part, preset_name, runs) / f"seeds-{'-'.join(map(str, seeds))}"


def checkpoints_in(run: Path, part: Part) -> Path:
    """Where a run keeps the checkpoints of a part."""
    return run / "checkpoints" / part.arm.name
