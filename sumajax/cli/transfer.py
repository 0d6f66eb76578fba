"""`sumajax transfer DOMAIN`: its options, the plan that they say, and its run."""

import sys
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

from sumajax import hosts, store
from sumajax.cli.config_file import NOTE, with_config_file
from sumajax.cli.domains import (
    DOMAINS,
    Domain,
    domain_of,
    grid_label,
    grid_of,
    parse_size,
    parse_team,
    step_limit,
    team_label,
    with_size,
)
from sumajax.cli.options import chosen_preset, keep_compiled, parse, plain_errors
from sumajax.environments import PredatorCapturePrey, PredatorPrey, TrafficJunction
from sumajax.environments.roads import Difficulty
from sumajax.environments.traffic_junction import with_curriculum
from sumajax.environments.types import Environment
from sumajax.evaluation import EPISODES
from sumajax.experiment.directory import plain
from sumajax.experiment.plan import MAX_EPOCHS, Experiment, chain, check_seeds
from sumajax.experiment.run import Where, run_experiment
from sumajax.experiment.stillness import Still
from sumajax.learning import LearnerConfig, parallel, preset
from sumajax.policies import POLICIES
from sumajax.policies.encoder import EncoderKind
from sumajax.reporting.loggers import LoggerName
from sumajax.transfer import CHUNK
from sumajax.upsampling import Fill, Scale, StateUpsampled

Upsampling = Literal["blocks", "corner", "none"]
MAX_DEVICES = 256
MAX_HOSTS = 256
STOPPED = 3
"""Exit status of a run that ended, but in which a seed stopped on the way."""


@dataclass(frozen=True)
class TransferOptions:
    """Pre-train on a small grid with upsampled state, transfer to a large one, directly or by
    stages between, and compare with training there from scratch.
    """

    domain: ClassVar[str]

    source: PredatorCapturePrey
    """The small task, whose state is upsampled to the target's size."""
    target: PredatorCapturePrey
    """The large task."""
    sizes: tuple[str, ...] = ()
    """Grids of all stages, as 5 10 20, or 10x20 for unequal sides; the last is the target. The
    tasks' other settings are the target's."""
    teams: tuple[str, ...] = ()
    """Team of each of --sizes, as 3 5 10, or 2+1 3+2 for two classes."""
    epochs: tuple[int, ...] = ()
    """Epochs of each of --sizes; source-epochs and target-epochs if not given."""
    max_steps: tuple[int, ...] = ()
    """Step limit of each of --sizes; if not given 80 up to 5x5, 200 up to 20x20, and ten times the
    longer side beyond."""
    policy: str = "ic3net"
    """ic3net, commnet, iric, ic, magic, hetnet, hetnet-binary, ..."""
    policy_settings: dict[str, Any] = field(default_factory=dict)
    """The policy's own settings."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: this package's learner. paper: the originals' procedure."""
    seeds: tuple[int, ...] = (0,)
    """Each trains its own policy; all are reported."""
    source_epochs: int = 40
    """Epochs of 20,000 environment steps on the source task."""
    target_epochs: int = 80
    """Epochs on the target task; 0 stops after the source."""
    scratch: bool = True
    """Also train on the target from scratch."""
    scratch_epochs: int | None = None
    """Epochs from scratch; the target's if not given."""
    until_still: bool = False
    """End a stage, but not the one from scratch, when it has stopped improving; its epochs are then
    the most it may have."""
    source_checkpoint: Path | None = None
    """Checkpoints, or a run, to transfer from, made elsewhere, or the name of a trained policy of
    the package, as pp-5x5-at-10x10-ic3net; the source stage is then left out."""
    output: Path | None = None
    """Directory of the run; runs/<experiment>-<policy>-<preset> if not given."""
    scale: Scale = "none"
    """What upsampling does to the state's mass: none (the paper), or mass (blocks sum to one)."""
    upsampling: Upsampling = "blocks"
    """blocks: the paper's. corner: the small state as it is, zeros around it. none: the small state
    alone, which only the encoders lab_gap and coordinates can take to another grid."""
    encoder: EncoderKind = "flat"
    """How the policy reads the state: flat, flat_published (started as the originals start their
    layers), lab_gap (pools over the grid), linear or coordinates (shares of the grid's sides)."""
    carry_optimiser: bool = False
    """Carry the optimiser's memory over with the parameters."""
    leave_out: tuple[str, ...] = ()
    """Modules of the policy whose parameters are not carried over, as state_encoder."""
    evaluate_every: int = 15
    """Epochs between held-out evaluations while a stage trains on the target; 0 for none."""
    episodes: int = EPISODES
    """Held-out episodes of each evaluation."""
    threshold: float = 20.0
    """Steps taken that count as solved in the comparison."""
    checkpoint_every: int = CHUNK
    """Epochs between two checkpoints at most."""
    devices: int | None = None
    """Devices to spread seeds and environments over, of each host; None: all there are that can
    share them, of CPUs one per core."""
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
            ("checkpoint_every", 1, MAX_EPOCHS),
            ("hosts", 1, MAX_HOSTS),
            ("host", 0, self.hosts - 1),
            ("devices", 1, MAX_DEVICES),
        ):
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise ValueError(
                    f"{name.replace('_', '-')} must lie between {least} and {most}, got {value}."
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
        if self.devices is not None:
            parallel.spread(len(self.seeds), self.learner.num_envs, self.hosts * self.devices)

    @property
    def directory(self) -> Path:
        name = DOMAINS[self.domain].experiment
        return self.output or Path("runs") / f"{name}-{self.policy}-{self.preset}"

    @cached_property
    def tasks(self) -> tuple[Any, ...]:
        """Of every stage on the way to the target, the target last, by its own grid."""
        if self.sizes:
            return tuple(_sized(self))
        return (self.source, self.target)

    def like(self, place: int) -> Any:
        """The task whose settings that stage of --sizes has, but for grid, team and step limit."""
        return self.target

    def limit(self, place: int, size: tuple[int, int]) -> int:
        """Step limit of that stage of --sizes if none is given."""
        own = {task.shape: task.max_steps for task in (self.source, self.target)}
        return own.get(size, step_limit(size))

    def taught(self, task: Any, epochs: int) -> Any:
        """A stage's task as it is in a training of so many epochs."""
        return task

    def experiment(self) -> Experiment:
        """The plan that these options say.

        Raises:
          ValueError: for options that do not go together.
        """
        names, epochs = _names(self), _epochs(self)
        lengths = [*epochs, *epochs[-1:] * (len(self.tasks) - len(epochs))]
        taught = map(self.taught, self.tasks, lengths)
        envs = [_seen(self, task, place) for place, task in enumerate(taught)]
        scratch = self.scratch and len(epochs) == len(envs) and len(envs) > 1
        scratch_epochs = epochs[-1] if self.scratch_epochs is None else self.scratch_epochs
        first = 0 if self.source_checkpoint is None else 1
        stages = chain(
            envs[first : len(epochs)],
            names[first : len(epochs)],
            epochs[first:],
            self.learner,
            start=self.source_checkpoint,
            scratch_epochs=scratch_epochs if scratch else 0,
            until=Still() if self.until_still else None,
            carry_optimiser=self.carry_optimiser,
            leave_out=self.leave_out,
        )
        settings = dict(self.policy_settings)
        if self.encoder != "flat":
            settings["encoder"] = self.encoder
        return Experiment(
            stages,
            policy=self.policy,
            seeds=self.seeds,
            policy_settings=settings,
            name=DOMAINS[self.domain].experiment,
            preset=self.preset,
            threshold=self.threshold,
            evaluate_every=self.evaluate_every,
            episodes=self.episodes,
        )

    def where(self) -> Where:
        return Where(
            devices=self.devices,
            num_hosts=self.hosts,
            log=self.log,
            chunk=self.checkpoint_every,
            options=described(self),
        )


@dataclass(frozen=True)
class PPTransfer(TransferOptions):
    """Predator-Prey: pre-train on a small grid with upsampled state, transfer to a large one,
    directly or by stages between, and compare with training there from scratch.
    """

    domain: ClassVar[str] = "pp"

    source: PredatorPrey = DOMAINS["pp"].source
    """The small task, whose state is upsampled to the target's size."""
    target: PredatorPrey = DOMAINS["pp"].target
    """The large task."""


@dataclass(frozen=True)
class PCPTransfer(TransferOptions):
    """Predator-Capture-Prey: pre-train on a small grid with upsampled state, transfer to a large
    one, directly or by stages between, and compare with training there from scratch.
    """

    domain: ClassVar[str] = "pcp"

    source: PredatorCapturePrey = DOMAINS["pcp"].source
    """The small task, whose state is upsampled to the target's size."""
    target: PredatorCapturePrey = DOMAINS["pcp"].target
    """The large task."""
    policy: str = DOMAINS["pcp"].policy


@dataclass(frozen=True)
class TJTransfer(TransferOptions):
    """Traffic Junction: pre-train on a small junction with upsampled state, transfer to a large
    one, directly or by stages between, and compare with training there from scratch.
    """

    domain: ClassVar[str] = "tj"

    source: TrafficJunction = DOMAINS["tj"].source  # type: ignore[assignment]
    """The small task, whose state is upsampled to the target's size."""
    target: TrafficJunction = DOMAINS["tj"].target  # type: ignore[assignment]
    """The large task."""
    difficulties: tuple[Difficulty, ...] = ()
    """Of all stages, as easy medium, the last is the target; what is not said by --sizes, --teams
    and --max-steps, and the arrival rates, is published for each. With --sizes alone all stages
    are of the target's."""
    sizes: tuple[str, ...] = ()
    """Sides of the grids of all stages, as 7 14 for easy medium, or 9 18 for hard hard."""
    teams: tuple[str, ...] = ()
    """Cars of each stage, how many there can be at once; those of its difficulty if not given."""
    max_steps: tuple[int, ...] = ()
    """Step limit of each stage; that of its difficulty if not given."""
    curriculum: bool = True
    """Let each stage's arrival rate rise as in IC3Net's runs, to that of the task, between an
    eighth and five eighths of its epochs. What is evaluated has the task's rate throughout."""
    source_epochs: int = 60
    """Epochs of 20,000 environment steps on the source task."""
    threshold: float = 0.8
    """Success that counts as solved in the comparison."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.difficulties and not self.sizes:
            shapes = [TrafficJunction(difficulty).shape for difficulty in self.difficulties]
            object.__setattr__(self, "sizes", tuple(grid_label(shape) for shape in shapes))
        if len(self.difficulties) not in (0, len(self.sizes)):
            raise ValueError(
                f"difficulties has {len(self.difficulties)} values and sizes {len(self.sizes)}; "
                "give as many of each."
            )
        if self.sizes and not self.teams:
            cars = [team_label(self.like(place)) for place in range(len(self.sizes))]
            object.__setattr__(self, "teams", tuple(cars))

    def like(self, place: int) -> TrafficJunction:
        """The source's settings or the target's, of whichever has the difficulty; or published."""
        if not self.difficulties:
            return self.target
        difficulty = self.difficulties[place]
        for task in (self.target, self.source):
            if task.difficulty == difficulty:
                return task
        of_all = {name: getattr(self.target, name) for name in ("vision", "reset_last_action")}
        return TrafficJunction(difficulty, **of_all)

    def limit(self, place: int, size: tuple[int, int]) -> int:
        return self.like(place).max_steps

    def taught(self, task: TrafficJunction, epochs: int) -> TrafficJunction:
        """At rates that rise, with --curriculum."""
        return with_curriculum(task, epochs) if self.curriculum else task


OPTIONS: dict[str, type[TransferOptions]] = {
    options.domain: options for options in (PPTransfer, PCPTransfer, TJTransfer)
}
"""Of `sumajax transfer DOMAIN`."""


def main(domain: str, arguments: list[str] | None = None) -> None:
    """Reads the options of a transfer and runs it; without `arguments` those of the program."""
    options = OPTIONS[domain]
    with plain_errors():
        given = with_config_file(options, sys.argv[1:] if arguments is None else arguments)
        chosen, policy = chosen_preset(given, options.policy)
        # The subclass gives both tasks a default.
        default = options(  # type: ignore[call-arg]
            learner=preset(chosen, policy), policy_settings=settings_of(policy, DOMAINS[domain])
        )
        prog = None if arguments is None else f"sumajax transfer {domain}"
        config = parse(options, default, given, NOTE, prog=prog)
        keep_compiled()
        if config.coordinator is not None:
            hosts.connect(config.hosts, config.host, config.coordinator)
        summary = run_experiment(config.experiment(), config.directory, config.where())
        if summary.get("stops"):
            raise SystemExit(STOPPED)


def settings_of(policy: str, domain: Domain) -> dict[str, Any]:
    """Every setting of a policy of the package that has a default, with what it is in a domain."""
    if policy not in POLICIES:
        return {}
    module, variant = POLICIES[policy]
    fixed = {"team", "parent", "name", "encoder", *variant}
    settings = {f.name: f.default for f in fields(module) if f.init and f.name not in fixed}
    return settings | {k: v for k, v in domain.policy_settings if k in settings}


def described(options: TransferOptions) -> dict[str, Any]:
    """The options as config.json keeps them, without those of one host's place in the run."""
    values = asdict(options)
    if options.source_checkpoint is not None:
        place = options.source_checkpoint
        values["source_checkpoint"] = place if store.is_named(place) else place.absolute()
    return plain({k: v for k, v in values.items() if k not in ("hosts", "host", "coordinator")})


def _sized(options: TransferOptions) -> list[Environment]:
    """The tasks of --sizes and --teams."""
    sizes = [parse_size(text) for text in options.sizes]
    domain: Domain = domain_of(options.target)
    for name in ("teams", "epochs", "max_steps"):
        given = getattr(options, name)
        if given and len(given) != len(sizes):
            raise ValueError(
                f"{name.replace('_', '-')} has {len(given)} values and sizes {len(sizes)}; give "
                "as many of each."
            )
    if not options.teams:
        raise ValueError(f"sizes {' '.join(options.sizes)} need --teams, as many.")
    limits = options.max_steps or [options.limit(*stage) for stage in enumerate(sizes)]
    teams = [parse_team(text, domain) for text in options.teams]
    return [
        with_size(options.like(place), size, team, limit)
        for place, (size, team, limit) in enumerate(zip(sizes, teams, limits, strict=True))
    ]


def _names(options: TransferOptions) -> list[str]:
    """Source and transfer where there are two, else each by its grid and team.

    Raises:
      ValueError: for two stages of the same task.
    """
    if len(options.tasks) == 2:
        return ["source", "transfer"]
    names = [f"{grid_label(task.shape)}-{team_label(task)}" for task in options.tasks]
    if len(set(names)) != len(names):
        raise ValueError(f"sizes and teams say one stage twice: {', '.join(names)}; leave one out.")
    return names


def _epochs(options: TransferOptions) -> list[int]:
    """Of each stage; without the target's where there is none."""
    if options.epochs:
        if not options.sizes:
            raise ValueError("epochs goes with sizes; give source-epochs and target-epochs.")
        return list(options.epochs)
    later = len(options.tasks) - 1
    return [
        options.source_epochs,
        *([options.target_epochs] * later if options.target_epochs else []),
    ]


def _seen(options: TransferOptions, task: Any, place: int) -> Environment:
    """A task as the policy sees it: at the target's size, the target itself as it is."""
    if place == len(options.tasks) - 1 and place > 0:
        return task
    at = task if options.upsampling == "none" else options.tasks[-1]
    fill: Fill = "corner" if options.upsampling == "corner" else "blocks"
    return StateUpsampled(task, grid_of(at, at.shape), options.scale, fill)
