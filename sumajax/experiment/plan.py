"""What an experiment is, as data: stages, each a task, where it starts and how it learns there.

Source, transfer and scratch are one such plan; a chain of any length is another (paper section
IV-B). Names of stages are for people and files: nothing is read out of them.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from sumajax import checkpoint
from sumajax.description import describe_task
from sumajax.environments.types import Environment
from sumajax.evaluation import EPISODES
from sumajax.experiment.stillness import Still
from sumajax.learning import LearnerConfig
from sumajax.learning.scaling import for_stage
from sumajax.policies import Policy, make_policy
from sumajax.policies.encoder import Resize
from sumajax.sources import source_of

MAX_EPOCHS = 100_000
"""Updates are counted in 32 bits, and an epoch has at most 20,000."""

_NAME = re.compile(r"[A-Za-z0-9][\w.+-]{0,99}")
"""Of a stage: it is the name of a directory and of rows in metrics.csv."""


@dataclass(frozen=True)
class Stage:
    """One stretch of training.

    Attributes:
      name: in the files; letters, digits and . + - _.
      env: the task as the policy sees it: `StateUpsampled(task, size)` where it is seen at another
        task's size.
      epochs: of 20,000 environment steps each.
      start: name of an earlier stage whose parameters it goes on from; a `Path` of checkpoints made
        elsewhere, or of the name of a trained policy of the package; None: fresh parameters.
      learner: its settings; `for_stage` makes of them what is trained here.
      carry_optimiser: take the optimiser's memory over with the parameters.
      leave_out: modules of the policy whose parameters are not taken over, as `state_encoder`.
      resize: how the state encoder's position table comes from the grid of the stage before to this
        one's, where the policy sees each task at its own size: `nearest` or `bilinear`.
      beside: another task that the same policy trains on in the same updates, see `MixedLearner`.
      until: a rule by which it ends before it has had all its epochs; None: it has them all. What
        the learner anneals it anneals over all of them, so a stage that ends early ends at the
        learning rate it has come to.

    Raises:
      ValueError: for a name or number of epochs out of range.
    """

    name: str
    env: Environment
    epochs: int
    start: str | Path | None = None
    learner: LearnerConfig = LearnerConfig()
    carry_optimiser: bool = False
    leave_out: tuple[str, ...] = ()
    resize: Resize | None = None
    beside: Environment | None = None
    until: Still | None = None

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ValueError(
                f"stage name {self.name!r} must be of letters, digits and . + - _, at most 100."
            )
        if not 1 <= self.epochs <= MAX_EPOCHS:
            raise ValueError(
                f"epochs of stage {self.name} must lie between 1 and {MAX_EPOCHS}, "
                f"got {self.epochs}."
            )
        if self.resize and self.carry_optimiser:
            raise ValueError(
                f"stage {self.name} resizes the position table and carries the optimiser's memory, "
                "which has the old size; leave one of them out."
            )

    @property
    def trained_with(self) -> LearnerConfig:
        """The learner's settings with this stage's length, start and task worked in."""
        transferred = self.start is not None
        return for_stage(self.learner, self.env, self.epochs, transferred=transferred)


@dataclass(frozen=True)
class Experiment:
    """Stages that one policy is trained in, each for every seed.

    The last stage that starts from another is the target, the stages it comes from are its chain,
    and all others are there to compare with.

    Attributes:
      stages: in the order they are trained.
      policy: name of a policy of the package, or a `Policy`, which is shaped for each task.
      seeds: each trains its own policy in every stage.
      policy_settings: of a policy called by name, as {"hidden": 64}.
      name, preset: what the files call it.
      threshold: steps taken, or whatever the target names as its merit, that count as solved in the
        comparison.
      evaluate_every: epochs between held-out evaluations on the way, in every stage that starts
        from another or is of the target's task; 0 for none.
      episodes: held-out episodes of an evaluation.

    Raises:
      ValueError: for no stages, doubles, a start that is no earlier stage, seeds out of range.
    """

    stages: tuple[Stage, ...]
    policy: str | Policy = "ic3net"
    seeds: tuple[int, ...] = (0,)
    policy_settings: Mapping[str, Any] | None = None
    name: str = "experiment"
    preset: str = "fast"
    threshold: float = 20.0
    evaluate_every: int = 15
    episodes: int = EPISODES

    def __post_init__(self) -> None:
        object.__setattr__(self, "stages", tuple(self.stages))
        object.__setattr__(self, "seeds", tuple(int(seed) for seed in self.seeds))
        check_seeds(self.seeds)
        names = [stage.name for stage in self.stages]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"an experiment needs stages of distinct names, got {names}.")
        for place, stage in enumerate(self.stages):
            if isinstance(stage.start, str) and stage.start not in names[:place]:
                raise ValueError(
                    f"stage {stage.name} starts from {stage.start!r}, which is no earlier stage; "
                    f"there are {names[:place]} (a directory of checkpoints is given as a Path)."
                )
        if not 0 < self.threshold < float("inf"):
            raise ValueError(f"threshold must be a number greater than 0, got {self.threshold}.")
        if not 0 <= self.evaluate_every <= MAX_EPOCHS:
            raise ValueError(
                f"evaluate-every must lie between 0 and {MAX_EPOCHS}, got {self.evaluate_every}."
            )

    @cached_property
    def by_name(self) -> dict[str, Stage]:
        return {stage.name: stage for stage in self.stages}

    @property
    def target(self) -> Stage:
        """The last stage that starts from another; the last of all where none does."""
        started = [stage for stage in self.stages if stage.start is not None]
        return (started or self.stages)[-1]

    def ancestors(self, stage: Stage) -> tuple[Stage, ...]:
        """The stages that `stage` comes from, the first one first."""
        if not isinstance(stage.start, str):
            return ()
        before = self.by_name[stage.start]
        return (*self.ancestors(before), before)

    @property
    def chain(self) -> tuple[Stage, ...]:
        """The target with the stages it comes from, in order."""
        return (*self.ancestors(self.target), self.target)

    @property
    def scratch(self) -> Stage | None:
        """The stage that trains on the target's task from fresh parameters, if there is one."""
        fresh = [s for s in self.stages if s.start is None and s not in self.chain]
        return next((s for s in fresh if s.env == self.target.env), None)

    def evaluates_every(self, stage: Stage) -> int:
        """Epochs between held-out evaluations while `stage` trains; 0 for none."""
        begins = stage.start is None and stage.env != self.target.env
        return 0 if begins else self.evaluate_every

    def policy_on(self, env: Environment) -> Policy:
        """The policy, shaped for a task."""
        if isinstance(self.policy, str):
            return make_policy(self.policy, env, **(self.policy_settings or {}))
        return self.policy.shaped_for(env)

    @property
    def policy_name(self) -> str:
        return self.policy if isinstance(self.policy, str) else self.policy.name

    def check(self) -> None:
        """Refuses stages whose parameters do not fit the stage they start from.

        Raises:
          CheckpointError: names what differs, both values and the mend.
        """
        for stage in self.stages:
            policy = self.policy_on(stage.env)
            if isinstance(stage.start, str):
                before = self.by_name[stage.start]
                meta = checkpoint.describe(before.env, self.policy_on(before.env))
                named, any_grid = f"the {before.name} stage", stage.resize is not None
                checkpoint.check_compatible(meta, stage.env, policy, named, any_grid=any_grid)
            if stage.beside is not None:
                meta = checkpoint.describe(stage.beside, self.policy_on(stage.beside))
                named = f"the task beside stage {stage.name}"
                checkpoint.check_compatible(meta, stage.env, policy, named)


def check_seeds(seeds: Sequence[int]) -> None:
    """Refuses none, doubles and what does not fit into 31 bits."""
    if not seeds or len(set(seeds)) != len(seeds) or not all(0 <= s < 2**31 for s in seeds):
        raise ValueError(
            f"seeds must be distinct numbers from 0 to {2**31 - 1}, got {list(seeds)}."
        )


def described(experiment: Experiment) -> dict[str, Any]:
    """The plan as JSON, for config.json: what is trained, whichever way it was asked for.

    A place is no part of it: checkpoints made elsewhere are known by what is in them.
    """
    return {
        "name": experiment.name,
        "policy": checkpoint.describe(
            experiment.target.env, experiment.policy_on(experiment.target.env)
        )["policy"],
        "preset": experiment.preset,
        "seeds": list(experiment.seeds),
        "threshold": experiment.threshold,
        "evaluate_every": experiment.evaluate_every,
        "episodes": experiment.episodes,
        "target": experiment.target.name,
        "stages": [_described(stage) for stage in experiment.stages],
    }


def _described(stage: Stage) -> dict[str, Any]:
    start: Any = stage.start
    if isinstance(start, Path):
        start = {"checkpoint": _identity(start)}
    return {
        "name": stage.name,
        "task": describe_task(stage.env),
        "start": start,
        "epochs": stage.epochs,
        "learner": asdict(stage.trained_with),
        "carry_optimiser": stage.carry_optimiser,
        "leave_out": list(stage.leave_out),
        "resize": stage.resize,
        "beside": stage.beside and describe_task(stage.beside),
        "until": stage.until and asdict(stage.until),
    }


def _identity(start: Path) -> str | None:
    """None where nothing is there any more: a stage that has begun does not need it."""
    try:
        return source_of(start).identity()
    except checkpoint.CheckpointError:
        return None


# --- Plans that are asked for often ------------------------------------------------------------


def chain(
    envs: Sequence[Environment],
    names: Sequence[str],
    epochs: Sequence[int],
    learner: LearnerConfig,
    *,
    start: Path | None = None,
    scratch_epochs: int = 0,
    until: Still | None = None,
    **carried: Any,
) -> tuple[Stage, ...]:
    """Stages that start each from the one before, and a rival that learns the last from scratch.

    Args:
      envs: each task as the policy sees it, the last one is the target; names, epochs: as many.
      start: checkpoints that the first stage starts from; None: fresh parameters.
      scratch_epochs: of the rival; 0: none.
      until: the rule by which each of them but the rival may end early.
      carried: `carry_optimiser` and `leave_out` of every stage that starts from another.
    """
    stages: list[Stage] = []
    before: str | Path | None = start
    for env, name, length in zip(envs, names, epochs, strict=True):
        more = {} if before is None else carried
        stages.append(Stage(name, env, length, before, learner, until=until, **more))
        before = name
    if scratch_epochs:
        stages.append(Stage("scratch", envs[-1], scratch_epochs, None, learner))
    return tuple(stages)
