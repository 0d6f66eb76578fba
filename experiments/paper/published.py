"""What the paper says of its five experiments (Tables I and II), and the budgets that follow.

Every number here is the paper's own; none is ours. The rows of Table II's sources are taken in the
order in which they stand in the paper's text.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Literal

from sumajax.environments import PredatorCapturePrey, PredatorPrey

LARGEST_RATIO = 7.88
"""The abstract's and the conclusion's figure, of PCP 3P/2C."""


TableArm = Literal["source-plain", "source", "scratch", "transfer"]
"""What Table II has a row of, by our name; `source-plain` is the source without upsampling."""


@dataclass(frozen=True)
class SecondsPerEpoch:
    """Mean and standard error over 100 epochs (Table II)."""

    mean: float
    error: float


@dataclass(frozen=True)
class PaperExperiment:
    """A row of Table I: tasks and policy, and what the paper reports.

    Attributes:
      name: as the command line and every file call it.
      source_of: the experiment whose source policy it transfers.
      hours: T, the fixed hour at which Table I compares.
      scratch, transfer: steps taken in the hour before T.
      pretraining: epochs on the source task before the transfer.
      seconds: Table II.
    """

    name: str
    title: str
    policy: str
    source: PredatorCapturePrey
    target: PredatorCapturePrey
    hours: float
    scratch: float
    transfer: float
    pretraining: int
    seconds: dict[TableArm, SecondsPerEpoch]
    source_of: str

    @property
    def source_title(self) -> str:
        """What its source is called: its own title, without the target."""
        return self.title.rsplit(",", 1)[0]

    @property
    def ratio(self) -> float:
        """Steps taken from scratch over steps taken after transfer, cut off as the paper does."""
        return math.floor(100 * self.scratch / self.transfer) / 100

    def hours_of(self, arm: TableArm, epochs: float) -> float:
        """The paper's hours for so many epochs of an arm."""
        return epochs * self.seconds[arm].mean / 3600

    def epochs_at(self, arm: TableArm, hours: float) -> int:
        """The number of epochs that come nearest to so many of the paper's hours."""
        return round(hours * 3600 / self.seconds[arm].mean)

    @property
    def epochs(self) -> dict[TableArm, int]:
        """The paper's budgets: its pre-training, then until the hour T of Table I at the seconds
        per epoch of Table II.
        """
        left = self.hours - self.hours_of("source", self.pretraining)
        return {
            "source": self.pretraining,
            "source-plain": self.pretraining,
            "transfer": self.epochs_at("transfer", left),
            "scratch": self.epochs_at("scratch", self.hours),
        }


Seconds = tuple[float, float]


def _seconds(
    *, source_plain: Seconds, source: Seconds, scratch: Seconds, transfer: Seconds
) -> dict[TableArm, SecondsPerEpoch]:
    return {
        "source-plain": SecondsPerEpoch(*source_plain),
        "source": SecondsPerEpoch(*source),
        "scratch": SecondsPerEpoch(*scratch),
        "transfer": SecondsPerEpoch(*transfer),
    }


_PP_SOURCE = PredatorPrey(size=5, num_predators=3, vision=1, max_steps=80)
_PP_TARGET = PredatorPrey(size=10, num_predators=5, vision=1, max_steps=200)
_PCP_SOURCE = PredatorCapturePrey(size=5, num_predators=2, num_capturers=1, max_steps=80)
_PCP_SOURCE_SECONDS: dict[str, Seconds] = {"source_plain": (490.64, 2.46), "source": (315.05, 0.87)}

_predator_prey = partial(PaperExperiment, source=_PP_SOURCE, target=_PP_TARGET)
_capture = partial(
    PaperExperiment, policy="hetnet", source=_PCP_SOURCE, source_of="pcp-hetnet-2p1c"
)

_ROWS = (
    _predator_prey(
        name="pp-ic3net",
        title="PP, IC3Net, 10x10 5P",
        policy="ic3net",
        hours=10.0,
        scratch=55.59,
        transfer=20.72,
        pretraining=350,
        seconds=_seconds(
            source_plain=(47.72, 0.24),
            source=(50.03, 0.25),
            scratch=(143.13, 0.51),
            transfer=(132.62, 0.87),
        ),
        source_of="pp-ic3net",
    ),
    _predator_prey(
        name="pp-magic",
        title="PP, MAGIC, 10x10 5P",
        policy="magic",
        hours=30.0,
        scratch=192.61,
        transfer=69.67,
        pretraining=590,
        seconds=_seconds(
            source_plain=(98.69, 0.52),
            source=(105.89, 0.49),
            scratch=(313.80, 1.16),
            transfer=(256.24, 0.79),
        ),
        source_of="pp-magic",
    ),
    _predator_prey(
        name="pp-hetnet",
        title="PP, HetNet, 10x10 5P",
        policy="hetnet",
        hours=100.0,
        scratch=189.70,
        transfer=27.13,
        pretraining=500,
        seconds=_seconds(
            source_plain=(199.96, 0.73),
            source=(229.45, 0.66),
            scratch=(580.76, 2.44),
            transfer=(439.49, 4.93),
        ),
        source_of="pp-hetnet",
    ),
    _capture(
        name="pcp-hetnet-2p1c",
        title="PCP, HetNet, 10x10 2P/1C",
        target=PredatorCapturePrey(size=10, num_predators=2, num_capturers=1, max_steps=200),
        hours=200.0,
        scratch=184.62,
        transfer=30.19,
        pretraining=700,
        seconds=_seconds(**_PCP_SOURCE_SECONDS, scratch=(784.00, 5.45), transfer=(791.37, 5.05)),
    ),
    _capture(
        name="pcp-hetnet-3p2c",
        title="PCP, HetNet, 10x10 3P/2C",
        target=PredatorCapturePrey(size=10, num_predators=3, num_capturers=2, max_steps=200),
        hours=350.0,
        scratch=199.85,
        transfer=25.34,
        pretraining=700,
        seconds=_seconds(**_PCP_SOURCE_SECONDS, scratch=(835.35, 7.57), transfer=(846.94, 3.44)),
    ),
)

EXPERIMENTS = {row.name: row for row in _ROWS}
"""Table I, by name, in the order in which they are run: the cheapest first."""

SOURCES = tuple(dict.fromkeys(row.source_of for row in _ROWS))
"""Experiments with a source task of their own."""
