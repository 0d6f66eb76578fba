"""The options of a transfer experiment, checked as they are made."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

from sumajax import hosts
from sumajax.environments import PredatorCapturePrey
from sumajax.learning import LearnerConfig, parallel
from sumajax.policies.encoder import EncoderKind
from sumajax.reporting.loggers import LoggerName
from sumajax.upsampling import Scale

Upsampling = Literal["blocks", "corner", "none"]
SOURCE, TRANSFER, SCRATCH = "source", "transfer", "scratch"
MAX_EPOCHS = 100_000
"""Updates are counted in 32 bits, and an epoch has at most 20,000."""
MAX_DEVICES = 256
MAX_HOSTS = 256
WHERE = ("devices", "hosts", "host", "coordinator")
"""Options that say where a run is computed: they change no result, and may change between runs."""


@dataclass(frozen=True)
class TransferConfig:
    """Options of a transfer experiment; an experiment adds its name and default tasks."""

    experiment: ClassVar[str]

    source: PredatorCapturePrey
    """The small task, whose state is upsampled to the target's size."""
    target: PredatorCapturePrey
    """The large task."""
    policy: str = "ic3net"
    """ic3net, commnet, iric, ic, magic, hetnet or hetnet-binary."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: this package's learner. paper: the originals' procedure."""
    seeds: tuple[int, ...] = (0,)
    """Each trains its own policy; all are reported."""
    source_epochs: int = 40
    """Epochs of 20,000 environment steps on the source task."""
    target_epochs: int = 80
    """Epochs on the target task, for each of the two arms; 0 stops after the source."""
    scratch: bool = True
    """Also train on the target from scratch, with the same budget."""
    source_checkpoint: Path | None = None
    """Checkpoints to transfer from, made elsewhere; the source stage is then left out."""
    output: Path | None = None
    """Directory of the run; runs/<experiment>-<policy>-<preset> if not given."""
    scale: Scale = "none"
    """What upsampling does to the state's mass: none (the paper), or mass (blocks sum to one)."""
    upsampling: Upsampling = "blocks"
    """blocks: the paper's. corner: the small state as it is, zeros around it. none: the small state
    alone, which only the encoder lab_gap can take to another grid."""
    encoder: EncoderKind = "flat"
    """How the policy reads the state: flat, lab_gap (pools over the grid) or linear."""
    carry_optimiser: bool = False
    """Carry the optimiser's memory over with the parameters."""
    leave_out: tuple[str, ...] = ()
    """Modules of the policy whose parameters are not carried over, as state_encoder."""
    evaluate_every: int = 15
    """Epochs between held-out evaluations while a target arm trains; 0 for none."""
    threshold: float = 20.0
    """Steps taken that count as solved in the comparison."""
    devices: int | None = None
    """CPU devices to spread seeds and environments over, of each host; None: all that they spread
    over."""
    hosts: int = 1
    """How many machines (or processes) train together, each started with the same command and its
    own --host."""
    host: int = 0
    """Which of them this one is; 0 has the files and the screen."""
    coordinator: str | None = None
    """HOST:PORT of host 0, with several hosts."""
    log: tuple[LoggerName, ...] = ()
    """Where to show the metrics beside metrics.csv: tensorboard, wandb."""
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    """The learner's settings; what is not given comes from the preset."""

    def __post_init__(self) -> None:
        for name, least, most in (
            ("source_epochs", 1, MAX_EPOCHS),
            ("target_epochs", 0, MAX_EPOCHS),
            ("evaluate_every", 0, MAX_EPOCHS),
            ("hosts", 1, MAX_HOSTS),
            ("host", 0, self.hosts - 1),
            ("num_devices", 1, MAX_DEVICES),
        ):
            if not least <= getattr(self, name) <= most:
                raise ValueError(
                    f"{name.removeprefix('num_').replace('_', '-')} must lie between {least} and "
                    f"{most}, got {getattr(self, name)}."
                )
        check_seeds(self.seeds)
        if not 0 < self.threshold < float("inf"):
            raise ValueError(f"threshold must be a number greater than 0, got {self.threshold}.")
        if self.source_checkpoint is not None and not self.target_epochs:
            raise ValueError(
                "source-checkpoint leaves the source stage out and target-epochs 0 the target; "
                "give target-epochs of at least 1."
            )
        if (self.coordinator is None) != (self.hosts == 1):
            raise ValueError(
                f"hosts {self.hosts} and coordinator {self.coordinator} do not go together; "
                "several hosts need the HOST:PORT of host 0, one needs none."
            )
        if self.coordinator is not None:
            hosts.address(self.coordinator)
        parallel.spread(len(self.seeds), self.learner.num_envs, self.hosts * self.num_devices)

    @property
    def num_devices(self) -> int:
        """Of this host: those asked for, or as many as seeds and environments spread over."""
        if self.devices is not None:
            return self.devices
        most = min(os.cpu_count() or 1, MAX_DEVICES)
        return parallel.most_devices(len(self.seeds), self.learner.num_envs, most, self.hosts)

    @property
    def directory(self) -> Path:
        return self.output or Path("runs") / f"{self.experiment}-{self.policy}-{self.preset}"


def check_seeds(seeds: tuple[int, ...]) -> None:
    """Refuses none, doubles and what does not fit into 31 bits."""
    if not seeds or len(set(seeds)) != len(seeds) or not all(0 <= s < 2**31 for s in seeds):
        raise ValueError(
            f"seeds must be distinct numbers from 0 to {2**31 - 1}, got {list(seeds)}."
        )
