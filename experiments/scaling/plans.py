"""What is trained: tasks, budgets and the experiments of each part.

An experiment is one plan of stages of one policy; every seed of it is a run. In all of them the
stages of a chain and its rivals have the same learner, whose settings follow from the task by the
rules of `sumajax.learning.scaling`, and scratch has as many environment steps as the whole chain.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from experiments.scaling.rivals import BlankState
from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.environments.types import Environment
from sumajax.experiment import Experiment, Stage, Still
from sumajax.experiment.summary import grid_label
from sumajax.learning import LearnerConfig, preset
from sumajax.policies.encoder import Resize
from sumajax.upsampling import Fill, Scale, StateUpsampled

# --- Budgets, in epochs of 20,000 environment steps --------------------------------------------

PP10_EPOCHS = (40, 125)  # 5x5, 10x10
PP20_EPOCHS = (40, 40, 60)  # 5x5, 10x10, 20x20
PP40_EPOCHS = (40, 40, 60, 50)  # 5x5, 10x10, 20x20, 40x40
PCP20_EPOCHS = (50, 50, 75)  # 5x5, 10x10, 20x20
RECT_EPOCHS = (80, 80)  # 10x20, 20x40
CUT_EPOCHS = {"brief": (15, 15, 60), "short": (25, 25, 60)}  # 5x5, 10x10, 20x20: shorter sources
STILL_EPOCHS = (100, 100, 150)  # at most, where a stage ends by itself
EVALUATE_EVERY = 5
"""Epochs between held-out evaluations while a stage trains."""
EPISODES_ON_THE_WAY = 128
"""Of those evaluations; what a stage begins and ends with is played in all held-out episodes."""

# --- Settings of all of them -------------------------------------------------------------------

LEARNER: dict[str, Any] = {}
"""Settings of the learner other than those of preset `fast`."""
SCALE: Scale = "mass"
"""Of upsampling; rival `none` has the paper's."""
SHORT_LIMIT_PER_SIDE, SHORT_LIMIT_FROM = 4, 20
"""From 20x20 on teams are also reported at a limit of four steps for each cell of the longer side,
80 on 20x20 as was published (Singh et al. 2019)."""

# --- Tasks, smallest first ---------------------------------------------------------------------

PP = (
    PredatorPrey(size=5, num_predators=3, max_steps=80),
    PredatorPrey(size=10, num_predators=5, max_steps=200),
    PredatorPrey(size=20, num_predators=10, max_steps=200),
    PredatorPrey(size=40, num_predators=20, max_steps=400),
)
PCP = (
    PredatorCapturePrey(size=5, num_predators=2, num_capturers=1, max_steps=80),
    PredatorCapturePrey(size=10, num_predators=3, num_capturers=2, max_steps=200),
    PredatorCapturePrey(size=20, num_predators=6, num_capturers=4, max_steps=200),
)
RECT = (
    PredatorPrey(size=(10, 20), num_predators=7, max_steps=200),
    PredatorPrey(size=(20, 40), num_predators=14, max_steps=400),
)
TEAM = 10
"""Of 20x20; rival `grid-alone` has it on every grid."""


def limits(task: Any) -> tuple[int, ...]:
    """Step limits that a task is reported at; the longest is the one it is trained with."""
    side = max(task.state_shape[-2:])
    if side < SHORT_LIMIT_FROM:
        return (task.max_steps,)
    return (SHORT_LIMIT_PER_SIDE * side, task.max_steps)


# --- Policies ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Variant:
    """A policy of the package with settings of its own."""

    policy: str
    settings: dict[str, Any] = field(default_factory=dict)


VARIANTS = {
    # A value for each agent: classes' values tell the agents apart too late (docs/settings.md).
    "hetnet": Variant("hetnet", {"critic": "agent"}),
    "ic3net": Variant("ic3net"),
    "ic3net-talking": Variant("ic3net", {"message": "talking"}),
    "ic3net-max": Variant("ic3net", {"message": "max"}),
    "tarmac-ic3net": Variant("tarmac-ic3net"),
    "tarmac-ic3net-twice": Variant("tarmac-ic3net", {"comm_passes": 2}),
    "magic": Variant("magic"),
}

Part = Literal[
    "pp10", "pp20", "pp40", "pcp20", "rect", "rivals", "dilution", "brief", "short", "still"
]
PARTS: tuple[Part, ...] = get_args(Part)
OWN_POLICIES: dict[str, tuple[str, ...]] = {
    "pp10": ("hetnet", "ic3net"),
    "pp20": ("hetnet", "ic3net"),
    "pp40": ("hetnet", "ic3net"),
    "pcp20": ("hetnet",),
    "rect": ("hetnet",),
    "rivals": ("hetnet",),
    "dilution": tuple(VARIANTS),
    "brief": ("hetnet",),
    "short": ("hetnet",),
    "still": ("hetnet",),
}
"""What each part is run with where nothing is said."""


# --- Stages ------------------------------------------------------------------------------------

SCRATCH = "scratch"
"""The stage that is compared with a chain; those of a chain are called by their grids."""


def seen_at(task: Any, target: Any, scale: Scale = SCALE, fill: Fill = "blocks") -> Environment:
    """A task at the target's size, the target itself as it is."""
    if task.size == target.size:
        return task
    return StateUpsampled(task, target.size, scale, fill)


def chain_of(
    envs: Sequence[Environment], epochs: Sequence[int], learner: LearnerConfig, **later: Any
) -> tuple[Stage, ...]:
    """Stages called by their grids, each from the one before.

    Args:
      later: settings of every stage but the first.
    """
    stages: list[Stage] = []
    for env, length in zip(envs, epochs, strict=True):
        start = stages[-1].name if stages else None
        name = _name(env, [stage.name for stage in stages])
        stages.append(Stage(name, env, length, start, learner, **(later if start else {})))
    return tuple(stages)


def _name(env: Environment, taken: Sequence[str]) -> str:
    """By its grid, and its team where the grid alone does not tell it from another."""
    name = grid_label(env)
    return f"{name}-{env.num_agents}" if name in taken else name


def with_scratch(stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """A chain with the rival that has all its steps on its last task."""
    last = stages[-1]
    steps = sum(stage.epochs for stage in stages)
    return (*stages, Stage(SCRATCH, last.env, steps, None, last.learner))


def compared(tasks: Sequence[Any], epochs: Sequence[int], learner: LearnerConfig) -> Any:
    """A chain and scratch."""
    envs = [seen_at(task, tasks[-1]) for task in tasks]
    return with_scratch(chain_of(envs, epochs, learner))


# --- Rivals on 20x20, each with the steps of the chain ------------------------------------------


@dataclass(frozen=True)
class Rival:
    """What takes the place of state upsampling in the chain to 20x20.

    Attributes:
      words: for the tables.
      stages: of a learner.
      settings: of the policy.
    """

    words: str
    stages: Any
    settings: dict[str, Any] = field(default_factory=dict)


def _upsampled(scale: Scale, fill: Fill = "blocks", **later: Any) -> Any:
    def stages(learner: LearnerConfig) -> tuple[Stage, ...]:
        envs = [seen_at(task, PP[2], scale, fill) for task in PP[:3]]
        return chain_of(envs, PP20_EPOCHS, learner, **later)

    return stages


def _direct(learner: LearnerConfig) -> tuple[Stage, ...]:
    envs = [seen_at(task, PP[2]) for task in (PP[0], PP[2])]
    return chain_of(envs, (PP20_EPOCHS[0], sum(PP20_EPOCHS[1:])), learner)


def _native(resize: Resize | None = None) -> Any:
    def stages(learner: LearnerConfig) -> tuple[Stage, ...]:
        return chain_of(PP[:3], PP20_EPOCHS, learner, resize=resize)

    return stages


def _blank(learner: LearnerConfig) -> tuple[Stage, ...]:
    return chain_of([BlankState(task) for task in PP[:3]], PP20_EPOCHS, learner)


def _mixed(learner: LearnerConfig) -> tuple[Stage, ...]:
    beside = seen_at(PP[1], PP[2])
    return (Stage("mixed", PP[2], sum(PP20_EPOCHS), None, learner, beside=beside),)


def _team_alone(learner: LearnerConfig) -> tuple[Stage, ...]:
    small = replace(PP[2], num_predators=PP[1].num_predators)
    first, last = sum(PP20_EPOCHS[:-1]), PP20_EPOCHS[-1]
    return chain_of([small, PP[2]], (first, last), learner)


def _grid_alone(learner: LearnerConfig) -> tuple[Stage, ...]:
    envs = [seen_at(replace(task, num_predators=TEAM), PP[2]) for task in PP[:3]]
    return chain_of(envs, PP20_EPOCHS, learner)


RIVALS: dict[str, Rival] = {
    "direct": Rival("upsampled, from 5x5 to 20x20 at once", _direct),
    "none": Rival("upsampled, state scale `none` (the paper)", _upsampled("none")),
    "coordinates": Rival(
        "coordinates through Fourier features", _native(), {"encoder": "coordinates"}
    ),
    "nearest": Rival("position table resized, nearest", _native("nearest")),
    "bilinear": Rival("position table resized, bilinear", _native("bilinear")),
    "corner": Rival("padding: the small state in a corner", _upsampled("none", "corner")),
    "fresh-encoder": Rival("fresh state encoder", _upsampled(SCALE, leave_out=("state_encoder",))),
    "blank": Rival("no position at all", _blank),
    "mixed": Rival("10x10 and 20x20 in every update", _mixed),
    "team-alone": Rival("20x20 with 5 predators, then with 10", _team_alone),
    "grid-alone": Rival("10 predators on every grid", _grid_alone),
}


# --- Experiments -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Study:
    """An experiment without its seeds.

    Attributes:
      name: of its directory and rows.
      variant: name of its policy in `VARIANTS`.
      words: what the tables call its chain.
    """

    name: str
    part: Part
    variant: str
    words: str
    stages: tuple[Stage, ...]
    settings: dict[str, Any]

    def experiment(self, seeds: Sequence[int]) -> Experiment:
        return Experiment(
            self.stages,
            policy=VARIANTS[self.variant].policy,
            seeds=tuple(seeds),
            policy_settings=self.settings,
            name=self.name,
            evaluate_every=EVALUATE_EVERY,
            episodes=EPISODES_ON_THE_WAY,
        )


def studies(part: Part, policies: Sequence[str] = ()) -> list[Study]:
    """The experiments of a part, with its own policies unless others are given."""
    return [study for name in policies or OWN_POLICIES[part] for study in _studies(part, name)]


def _studies(part: Part, name: str) -> list[Study]:
    variant = VARIANTS[name]
    learner = preset("fast", variant.policy, **LEARNER)
    if part == "rivals":
        return [
            Study(
                f"rivals-{rival}-{name}",
                part,
                name,
                kind.words,
                kind.stages(learner),
                {**variant.settings, **kind.settings},
            )
            for rival, kind in RIVALS.items()
        ]
    words, stages = _stages(part, learner)
    # Scratch takes longer than all else and shares nothing with it: it can be run on its own.
    alone = {SCRATCH: [stage for stage in stages if stage.name == SCRATCH]}
    runs = {"": [stage for stage in stages if stage.name != SCRATCH], **alone}
    return [
        Study(f"{part}-{name}-{run}".strip("-"), part, name, words, tuple(own), variant.settings)
        for run, own in runs.items()
        if own
    ]


def _stages(part: Part, learner: LearnerConfig) -> tuple[str, tuple[Stage, ...]]:
    """What the chain is called, and all stages."""
    if part == "pp10":
        return "chain", compared(PP[:2], PP10_EPOCHS, learner)
    if part == "pp20":
        return "chain", compared(PP[:3], PP20_EPOCHS, learner)
    if part == "pp40":
        return "chain", compared(PP, PP40_EPOCHS, learner)
    if part == "pcp20":
        return "chain", compared(PCP, PCP20_EPOCHS, learner)
    if part == "rect":
        return "chain", compared(RECT, RECT_EPOCHS, learner)
    envs = [seen_at(task, PP[2]) for task in PP[:3]]
    if part == "dilution":
        return "chain", chain_of(envs, PP20_EPOCHS, learner)
    if part in CUT_EPOCHS:
        return f"chain of {part} sources", chain_of(envs, CUT_EPOCHS[part], learner)
    stages = chain_of(envs, STILL_EPOCHS, learner)
    return "chain that ends its stages itself", tuple(
        replace(stage, until=Still()) for stage in stages
    )
