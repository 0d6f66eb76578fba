"""The learner's settings and their two presets. Sources of every number: docs/settings.md."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from math import inf
from numbers import Real
from typing import Any, Literal, get_args

from sumajax.plain import plain_fields

EPOCH_STEPS = 20_000
"""Environment steps of an epoch: 10 updates of 4 processes x 500 steps, as the paper's runs."""

Optimiser = Literal["adam", "rmsprop"]
Loss = Literal["actor_critic", "hetnet"]
Preset = Literal["fast", "paper"]
Advantages = Literal["raw", "centred", "normalised"]
AliveMask = Literal["before", "after"]
Critic = Literal["policy", "state"]


@dataclass(frozen=True)
class LearnerConfig:
    """How a policy is trained; the defaults are the preset `fast`.

    Attributes:
      num_envs: environments side by side (E).
      rollout_length: steps of each environment in an update (T); with `whole_episodes` the least
        number of steps after which an environment stops at the end of its episode.
      whole_episodes: start every update afresh and use finished episodes only, as the originals do,
        instead of going on from where the last segment ended.
      gamma, gae_lambda: discount and trace decay of the advantage estimates.
      bootstrap_timeouts: value an episode cut by the step limit as if it went on.
      team_reward: share of the team's mean in each agent's return, 0 to 1.
      scale_rewards: learn from rewards in units of the task's own, so that the largest that it says
        a step has is 0.05, as in Predator-Prey (`rewards.reward_scale`).
      advantages: `raw`, `centred` to mean 0 over the batch, or `normalised` to standard deviation 1
        as well.
      mask_inactive: no policy gradient for actions that no longer change anything; what an agent
        that has arrived says is still trained.
      alive_mask: where agents come and go, which of them count in a step: those there `before` it,
        or, as in the originals, `after` it. Then the last step of who leaves is not learnt from,
        that before a newcomer's first is, and the newcomer's reward is paid to who has left.
      loss: `actor_critic`, or `hetnet`, the per-class loss of HetNet's published program, which
        is of whole episodes only and normalises advantages in its own way.
      critic: `policy`: the policy's own, from what the agents know; or `state`: one that is shown
        the true state in training, and shares nothing with the policy (`learning.critic`).
      value_weight, policy_weight, entropy_weight: of the critic's squared error, of the policy
        gradient and of the entropy bonus.
      optimiser, learning_rate: Adam, or RMSprop as the originals set it.
      transfer_rate: the learning rate after a transfer, as a share of `learning_rate`: what the
        source has learnt is to be bent, not to be learnt anew.
      scale_by_size: after a transfer, rate and weights follow the size of the task, and the critic
        learns alone first (`scaling.after_transfer`).
      max_grad_norm: clip of the gradient's global norm; None is no clipping.
      clip_per_env: clip each environment's gradient alone before they are added, as processes do.
      critic_epochs: so long at the start the critic alone learns, at `critic_rate`: only parameters
        that no decision depends on change, so a policy brought from elsewhere stays as it is until
        its critic knows the task.
      critic_rate: the learning rate of that time, and always of critic `state`.
      warmup_epochs: the learning rate rises linearly from 0 over this many epochs.
      anneal_epochs: learning rate and entropy weight fall linearly to `anneal_to` of their start
        over this many epochs; 0 keeps them constant; None: over the whole stage, whose length
        `for_stage` tells, constant as long as it is not told.
      detach_gap: no gradient through the memory past every so many steps of an episode; None: none
        past the start of the segment.

    Raises:
      ValueError: for a value out of range or two that do not fit together.
    """

    num_envs: int = 50
    rollout_length: int = 10
    whole_episodes: bool = False
    gamma: float = 0.95
    gae_lambda: float = 0.95
    bootstrap_timeouts: bool = True
    team_reward: float = 0.2
    scale_rewards: bool = True
    advantages: Advantages = "centred"
    mask_inactive: bool = True
    alive_mask: AliveMask = "before"
    loss: Loss = "actor_critic"
    critic: Critic = "policy"
    value_weight: float = 0.5
    policy_weight: float = 1.0
    entropy_weight: float = 0.004
    optimiser: Optimiser = "adam"
    learning_rate: float = 1.5e-3
    transfer_rate: float = 0.5
    scale_by_size: bool = True
    max_grad_norm: float | None = 0.5
    clip_per_env: bool = False
    critic_epochs: int = 0
    critic_rate: float = 1.5e-3
    warmup_epochs: int = 0
    anneal_epochs: int | None = None
    anneal_to: float = 0.02
    detach_gap: int | None = None

    def __post_init__(self) -> None:
        plain_fields(self)
        _validate(self)

    def for_stage(self, epochs: int, *, transferred: bool = False) -> "LearnerConfig":
        """The settings of a stage of so many epochs, ready for `make_learner`.

        Args:
          transferred: it goes on from parameters that were trained on another task, at
            `transfer_rate` of the learning rate.

        Twice is the same as once.
        """
        return replace(
            self,
            anneal_epochs=epochs if self.anneal_epochs is None else self.anneal_epochs,
            learning_rate=self.learning_rate * (self.transfer_rate if transferred else 1.0),
            transfer_rate=1.0,
        )

    @property
    def updates_per_epoch(self) -> int:
        return EPOCH_STEPS // (self.num_envs * self.rollout_length)


_PUBLISHED: dict[str, Any] = {
    # Singh et al. 2019 and its published program; MAGIC, TarMAC and HetNet build on its trainer.
    "num_envs": 4,  # processes of the paper's runs (VII-C)
    "rollout_length": 500,  # batch_size per process
    "whole_episodes": True,
    "gamma": 1.0,
    "gae_lambda": 1.0,
    "bootstrap_timeouts": False,
    "team_reward": 0.0,
    "scale_rewards": False,
    "advantages": "raw",
    "mask_inactive": False,
    "alive_mask": "after",
    "value_weight": 0.01,
    "entropy_weight": 0.0,
    "optimiser": "rmsprop",
    "learning_rate": 1e-3,
    "transfer_rate": 1.0,
    "scale_by_size": False,
    "max_grad_norm": None,
    "anneal_epochs": 0,
    "detach_gap": 10,
}

_HETNET: dict[str, Any] = {
    # Seraj et al. 2022: the command of its program's README; docs/settings.md.
    **_PUBLISHED,
    "gae_lambda": 0.95,
    "loss": "hetnet",
    "value_weight": 1.0,
    "policy_weight": 50.0,
    "learning_rate": 1e-4,
    "max_grad_norm": 0.75,
    "clip_per_env": True,
    "detach_gap": 5,
}

_TEAM = {"team_reward": 1.0}

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "fast": {
        "commnet": _TEAM,
        "ic": _TEAM,
        "iric": {"team_reward": 0.0},
        "tarmac": _TEAM,
    },
    "paper": {
        "ic3net": _PUBLISHED,
        "commnet": {**_PUBLISHED, **_TEAM},
        "iric": _PUBLISHED,
        "ic": {**_PUBLISHED, **_TEAM},
        "magic": {**_PUBLISHED, "value_weight": 0.015},
        "tarmac": {**_PUBLISHED, **_TEAM},
        "tarmac-ic3net": _PUBLISHED,
        "hetnet": _HETNET,
        "hetnet-binary": _HETNET,
    },
}
"""Settings that differ from the defaults, by preset and policy."""


def preset(name: str, policy: str = "ic3net", **changes: Any) -> LearnerConfig:
    """The settings of preset `name` for a policy, with `changes`.

    Raises:
      ValueError: for an unknown preset or setting, or preset `paper` of an unpublished policy.
    """
    if name not in PRESETS:
        raise ValueError(f"preset {name!r} is unknown; choose one of {', '.join(PRESETS)}.")
    if name == "paper" and policy not in PRESETS[name]:
        raise ValueError(
            f"nothing was published about policy {policy!r}: use preset 'fast', "
            f"or 'paper' with one of {', '.join(PRESETS[name])}."
        )
    known = {field.name for field in fields(LearnerConfig)}
    unknown = sorted(set(changes) - known)
    if unknown:
        raise ValueError(f"the learner has no setting {unknown[0]!r}; it has {', '.join(known)}.")
    return LearnerConfig(**{**PRESETS[name].get(policy, {}), **changes})


_OPTIONAL = ("max_grad_norm", "anneal_epochs", "detach_gap")
"""Settings that None turns off."""

_LEAST: dict[str, int] = {
    "num_envs": 1,
    "rollout_length": 1,
    "critic_epochs": 0,
    "warmup_epochs": 0,
    "anneal_epochs": 0,
    "detach_gap": 1,
}

_UNIT = (lambda x: 0 <= x <= 1, "lie between 0 and 1")
_WEIGHT = (lambda x: 0 <= x < inf, "be a finite number of at least 0")
_POSITIVE = (lambda x: 0 < x < inf, "be a finite number greater than 0")

_NUMBERS: dict[str, tuple[Callable[[float], bool], str]] = {
    "gamma": _UNIT,
    "gae_lambda": _UNIT,
    "team_reward": _UNIT,
    "anneal_to": _UNIT,
    "transfer_rate": _POSITIVE,
    "value_weight": _WEIGHT,
    "policy_weight": _WEIGHT,
    "entropy_weight": _WEIGHT,
    "learning_rate": _POSITIVE,
    "critic_rate": _POSITIVE,
    "max_grad_norm": _POSITIVE,
}
"""What a number must be, as a test and in words."""

_SWITCHES = (
    "whole_episodes",
    "bootstrap_timeouts",
    "scale_rewards",
    "mask_inactive",
    "scale_by_size",
    "clip_per_env",
)


def _validate(config: LearnerConfig) -> None:
    given = {k: v for k, v in vars(config).items() if v is not None or k not in _OPTIONAL}
    for name, least in _LEAST.items():
        value = given.get(name, least)
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}.")
    for name in _SWITCHES:
        if not isinstance(given[name], bool):
            raise ValueError(f"{name} must be True or False, got {given[name]!r}.")
    for name, (fits, words) in _NUMBERS.items():
        value = given.get(name, 1.0)
        if isinstance(value, bool) or not isinstance(value, Real) or not fits(float(value)):
            raise ValueError(f"{name} must {words}, got {value!r}.")
    for name, choices in (
        ("optimiser", Optimiser),
        ("loss", Loss),
        ("critic", Critic),
        ("advantages", Advantages),
        ("alive_mask", AliveMask),
    ):
        if getattr(config, name) not in get_args(choices):
            raise ValueError(
                f"{name} {getattr(config, name)!r} is unknown; "
                f"choose one of {', '.join(get_args(choices))}."
            )
    if config.loss == "hetnet":
        _validate_hetnet(config)
    if config.clip_per_env and config.max_grad_norm is None:
        raise ValueError("clip_per_env needs max_grad_norm, got None; give the norm to clip at.")
    steps = config.num_envs * config.rollout_length
    if EPOCH_STEPS % steps:
        raise ValueError(
            f"{config.num_envs} environments x {config.rollout_length} steps = {steps} steps per "
            f"update do not divide an epoch of {EPOCH_STEPS}; {_nearest(config)} would."
        )


def _validate_hetnet(config: LearnerConfig) -> None:
    needed = {
        "whole_episodes": True,
        "bootstrap_timeouts": False,
        "mask_inactive": False,
        "team_reward": 0.0,
        "critic": "policy",
    }
    for name, value in needed.items():
        if getattr(config, name) != value:
            raise ValueError(
                f"loss 'hetnet' needs {name}={value}, got {getattr(config, name)!r}; "
                "preset 'paper' of policy 'hetnet' has all it needs."
            )


def _nearest(config: LearnerConfig) -> str:
    """The two numbers of environments nearest to the given one that divide an epoch."""
    fits = [n for n in range(1, EPOCH_STEPS + 1) if EPOCH_STEPS % (n * config.rollout_length) == 0]
    if not fits:
        return "a rollout_length of 20 with 50 environments"
    around = sorted(sorted(fits, key=lambda n: abs(n - config.num_envs))[:2])
    return " or ".join(f"{n} environments" for n in around)
