"""The arms that are trained: those of the paper, and those that the ablations change.

An arm is one stretch of training, the same for every experiment it is run in. Its name is what its
rows are called in the kept files, and nothing is read out of it.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

from experiments.paper.published import TableArm
from sumajax.policies.encoder import EncoderKind
from sumajax.upsampling import Scale

Task = Literal["source", "target"]
"""The small task of an experiment, or the large one."""


@dataclass(frozen=True)
class Arm:
    """One stretch of training.

    Attributes:
      name: of its rows.
      task: of the experiment's two.
      like: the arm of Table II that it costs as much as and is trained as long as.
      start: arm of the source experiment whose checkpoints it goes on from; None: fresh.
      zero_shot: name of the rows of its evaluation before any training.
      upsampling: how the source's state comes to the target's size; none: it stays as it is.
      scale: what upsampling does to the state's mass.
      encoder: how the policy reads the state.
      carry_optimiser: take the optimiser's memory over.
      leave_out: modules whose parameters are not taken over.
      share: of its budget that it is trained.
      brief: its budget is the ablations'.
    """

    name: str
    task: Task
    like: TableArm
    start: "Arm | None" = None
    zero_shot: str | None = None
    upsampling: Literal["blocks", "corner", "none"] = "blocks"
    scale: Scale = "none"
    encoder: EncoderKind = "flat"
    carry_optimiser: bool = False
    leave_out: tuple[str, ...] = ()
    share: float = 1.0
    brief: bool = False


SOURCE = Arm("source", "source", like="source")
SOURCE_PLAIN = Arm("source-plain", "source", like="source-plain", upsampling="none")
TRANSFER = Arm("transfer", "target", like="transfer", start=SOURCE, zero_shot="zero-shot")
SCRATCH = Arm("scratch", "target", like="scratch")
TABLE_2 = (SOURCE_PLAIN, SOURCE, SCRATCH, TRANSFER)
"""The arms of the paper, in the order of Table II; the other arms change one thing in them."""

TRANSFER_BRIEF = replace(TRANSFER, name="transfer-brief", zero_shot="zero-shot-brief", brief=True)
SCRATCH_BRIEF = replace(SCRATCH, name="scratch-brief", brief=True)


@dataclass(frozen=True)
class Ablation:
    """One thing changed, or one thing in several ways.

    Attributes:
      variants: the changed arms on the target, by what the table calls them.
      beside_unchanged: it is compared with the unchanged arms; else with arms of its own.
    """

    variants: dict[str, Arm]
    beside_unchanged: bool = True


def _of_unchanged_source(variant: str, **changes: Any) -> Arm:
    """What is transferred from the paper's own source."""
    name, zero_shot = f"transfer-{variant}", f"zero-shot-{variant}"
    return replace(TRANSFER, name=name, zero_shot=zero_shot, brief=True, **changes)


def _of_own_source(variant: str, share: float = 1.0, **changes: Any) -> Arm:
    """A source of its own, and what is transferred from it."""
    source = replace(SOURCE, name=f"source-{variant}", share=share, **changes)
    return _of_unchanged_source(variant, start=source, **changes)


def _started_as_published(variant: str = "", **changes: Any) -> Arm:
    """The same, with the originals' initial weights of both encoders in all stages."""
    return _of_own_source(f"published-start{variant}", encoder="flat_published", **changes)


AblationName = Literal[
    "corner", "mass", "encoder", "optimiser", "short-source", "lab-gap", "published-start"
]
ABLATIONS: dict[str, Ablation] = {
    "corner": Ablation(
        {
            "(a) no upsampling: small state in a corner": _of_own_source(
                "corner", upsampling="corner"
            )
        }
    ),
    "mass": Ablation({"(b) state scale `mass`": _of_own_source("mass", scale="mass")}),
    "encoder": Ablation(
        {
            "(c) all but the state encoder": _of_unchanged_source(
                "encoder", leave_out=("state_encoder",)
            )
        }
    ),
    "optimiser": Ablation(
        {"(d) optimiser state carried": _of_unchanged_source("optimiser", carry_optimiser=True)}
    ),
    "short-source": Ablation(
        {
            "(e) source trained 25%": _of_own_source("25", share=0.25),
            "(e) source trained 50%": _of_own_source("50", share=0.5),
        }
    ),
    "lab-gap": Ablation(
        {
            "(f) encoder `lab_gap`, upsampled": _of_own_source("lab-gap", encoder="lab_gap"),
            "(f) encoder `lab_gap`, not upsampled": _of_own_source(
                "lab-gap-native", encoder="lab_gap", upsampling="none"
            ),
            "(f) from scratch, encoder `lab_gap`": replace(
                SCRATCH, name="scratch-lab-gap", encoder="lab_gap", brief=True
            ),
        },
        beside_unchanged=False,
    ),
    "published-start": Ablation(
        {
            "(g) encoders started as published, upsampled": _started_as_published(),
            "(g) the same, not upsampled: small state in a corner": _started_as_published(
                "-corner", upsampling="corner"
            ),
            "(g) the same, upsampled, all but the state encoder": replace(
                _started_as_published(),
                name="transfer-published-start-encoder",
                zero_shot="zero-shot-published-start-encoder",
                leave_out=("state_encoder",),
            ),
            "(g) from scratch, encoders started as published": replace(
                SCRATCH, name="scratch-published-start", encoder="flat_published", brief=True
            ),
        },
    ),
}
"""By `AblationName`, in the order of the table."""


def with_start(arm: Arm) -> tuple[Arm, ...]:
    """An arm behind the one it goes on from."""
    return (arm,) if arm.start is None else (*with_start(arm.start), arm)
