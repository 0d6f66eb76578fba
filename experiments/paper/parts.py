"""What `reproduce_paper.py` is made of: parts, each one arm of one experiment in its own run.

A part trains from fresh parameters or goes on from the checkpoints of another part. Both are runs
of `transfer_run.py`: an arm from scratch is the source stage of a run whose two tasks are the same.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from pcp_transfer import PCPTransfer
from pp_transfer import PPTransfer
from sumajax.cli.transfer_config import SOURCE, TRANSFER, TransferConfig

from experiments.paper.published import EXPERIMENTS, SOURCES, Experiment
from sumajax.environments import PredatorPrey
from sumajax.learning import parallel, preset

PresetName = Literal["fast", "paper"]
Selection = Literal[
    "pp-ic3net",
    "pp-magic",
    "pp-hetnet",
    "pcp-hetnet-2p1c",
    "pcp-hetnet-3p2c",
    "q1",
    "corner",
    "mass",
    "encoder",
    "optimiser",
    "short-source",
    "lab-gap",
]
SELECTIONS: tuple[Selection, ...] = get_args(Selection)
TABLE_1 = SELECTIONS[:6]
"""What runs when nothing is chosen: Table I, and question Q1."""

FAST_SOURCE_EPOCHS = 50
FAST_TARGET_EPOCHS = {"pp-ic3net": 125, "pp-magic": 60}
FAST_TARGET_EPOCHS_OTHERS = 150
FAST_BRIEF_EPOCHS = {"pp-hetnet": 60}
"""Of preset `fast`: 1.0 M source steps; on the target 3.0 M for HetNet, 2.5 M for IC3Net and 1.2 M
for MAGIC, by when all of their seeds have come to 20 steps. HetNet's many ablations are brief:
1.2 M."""

ABLATED = ("pp-ic3net", "pp-hetnet")
"""Experiments that the ablations change."""

Changes = tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class Part:
    """One arm to train.

    Attributes:
      arm: `source`, `source-plain` (the source task without upsampling), `transfer` or `scratch`;
        of an ablation with its name behind.
      start: arm of the source experiment whose checkpoints it goes on from; None: fresh.
      changes: options of the run that are not the experiment's own.
      share: of the arm's budget.
    """

    experiment: str
    arm: str
    start: str | None = None
    changes: Changes = ()
    share: float = 1.0

    @property
    def row(self) -> Experiment:
        return EXPERIMENTS[self.experiment]

    @property
    def stage(self) -> str:
        """The arm that the run itself calls it."""
        return SOURCE if self.start is None else TRANSFER

    @property
    def source(self) -> tuple[str, str] | None:
        """(experiment, arm) whose checkpoints it needs."""
        return None if self.start is None else (self.row.source_of, self.start)


def parts_of(selections: Iterable[str], preset_name: PresetName) -> list[Part]:
    """The parts of what was chosen, in order, each after the one it goes on from, none twice."""
    found: dict[tuple[str, str], Part] = {}
    for selection in selections:
        for part in _selected(selection, preset_name):
            found.setdefault((part.experiment, part.arm), part)
    return list(found.values())


def _selected(selection: str, preset_name: PresetName) -> list[Part]:
    if selection in EXPERIMENTS:
        source = EXPERIMENTS[selection].source_of
        return [
            Part(source, "source"),
            Part(selection, "transfer", "source"),
            Part(selection, "scratch"),
        ]
    if selection == "q1":
        return [Part(name, arm) for name in SOURCES for arm in ("source", "source-plain")]
    return [part for name in ABLATED for part in ablation(selection, name, preset_name)]


def unchanged_arms(name: str, preset_name: PresetName) -> tuple[Part, Part]:
    """Transfer and scratch that an experiment's ablations are compared with.

    They have the ablations' own budget, as the learning rate may anneal to its end.
    """
    brief = "-brief" if preset_name == "fast" and name in FAST_BRIEF_EPOCHS else ""
    return Part(name, f"transfer{brief}", "source"), Part(name, f"scratch{brief}")


def ablation(selection: str, name: str, preset_name: PresetName) -> list[Part]:
    """The parts of one ablation of an experiment; the arms it is compared with included.

    `lab-gap`, another encoder, is compared with arms of its own.
    """
    unchanged = (Part(name, "source"), *unchanged_arms(name, preset_name))
    on_target: dict[str, Changes] = {
        "encoder": (("leave_out", ("state_encoder",)),),
        "optimiser": (("carry_optimiser", True),),
    }
    in_source: dict[str, Changes] = {
        "corner": (("upsampling", "corner"),),
        "mass": (("scale", "mass"),),
    }
    if selection in on_target:
        changed = Part(name, f"transfer-{selection}", "source", on_target[selection])
        return [*unchanged, changed]
    if selection in in_source:
        return [*unchanged, *_pair(name, selection, in_source[selection])]
    if selection == "short-source":
        short = [_pair(name, f"{share}", (), share / 100) for share in (25, 50)]
        return [*unchanged, *short[0], *short[1]]
    gap: Changes = (("encoder", "lab_gap"),)
    native: Changes = (*gap, ("upsampling", "none"))
    return [
        *_pair(name, "lab-gap", gap),
        *_pair(name, "lab-gap-native", native),
        Part(name, "scratch-lab-gap", None, gap),
    ]


def _pair(name: str, variant: str, changes: Changes, share: float = 1.0) -> list[Part]:
    """A source of its own and what is transferred from it."""
    return [
        Part(name, f"source-{variant}", None, changes, share),
        Part(name, f"transfer-{variant}", f"source-{variant}", changes),
    ]


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
        on_source = part.arm.startswith("source")
        given = self.source if on_source else self.target
        if given is None:
            given = max(1, round(self.scale * self._own(part, on_source)))
        return max(1, round(part.share * given))

    def _own(self, part: Part, on_source: bool) -> int:
        if self.preset == "paper":
            arm = "source" if on_source else part.arm.split("-")[0]
            return part.row.epochs[arm]
        if on_source:
            return FAST_SOURCE_EPOCHS
        own = FAST_TARGET_EPOCHS.get(part.experiment, FAST_TARGET_EPOCHS_OTHERS)
        return FAST_BRIEF_EPOCHS.get(part.experiment, own) if "-" in part.arm else own


def directory_of(part: Part, preset_name: str, seeds: tuple[int, ...], runs: Path) -> Path:
    """Of a part's run with these seeds."""
    group = "-".join(map(str, seeds))
    return runs / preset_name / part.experiment / part.arm / f"seeds-{group}"


def seeds_of(directory: Path) -> tuple[int, ...]:
    """What `directory_of` put into the name; nothing for any other."""
    numbers = directory.name.removeprefix("seeds-").split("-")
    return tuple(map(int, numbers)) if all(number.isdigit() for number in numbers) else ()


def config_of(
    part: Part,
    budget: Budget,
    seeds: tuple[int, ...],
    directory: Path,
    source: Path | None,
    devices: int | None,
) -> TransferConfig:
    """The run of a part.

    Args:
      source: checkpoints it goes on from, of all these seeds.
      devices: at most so many; None: as many as the machine's cores.
    """
    row, epochs = part.row, budget.epochs(part)
    learner = preset(budget.preset, row.policy)
    most = devices or os.cpu_count() or 1
    options: dict[str, Any] = {
        "policy": row.policy,
        "preset": budget.preset,
        "seeds": seeds,
        "learner": learner,
        "devices": parallel.most_devices(len(seeds), learner.num_envs, most),
        "output": directory,
        "scratch": False,
        "evaluate_every": 0,
        **dict(part.changes),
    }
    if part.start is not None:
        options |= {"source": row.source, "target": row.target, "target_epochs": epochs}
        options |= {"source_checkpoint": source}
    else:
        options |= {"source_epochs": epochs, "target_epochs": 0, **_fresh_tasks(part)}
    return (PPTransfer if isinstance(row.target, PredatorPrey) else PCPTransfer)(**options)


def _fresh_tasks(part: Part) -> dict[str, Any]:
    """Tasks of a run that trains from fresh parameters; two that are the same upsample nothing."""
    row = part.row
    if part.arm == "source-plain":
        return {"source": row.source, "target": row.source}
    if part.arm.startswith("scratch"):
        return {"source": row.target, "target": row.target}
    return {"source": row.source, "target": row.target}
