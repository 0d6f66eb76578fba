"""How a stage's settings follow from its task, for a policy that was brought from a smaller one.

An update moves the policy a little in every decision, and a team that looks for something on a
large grid takes many decisions, each agent one a step: what is a small change on 10x10 undoes the
search on 40x40. Measured for each update at one learning rate: 0.010, 0.004 and 0.004 nats per
decision on 10x10, 20x20 and 40x40, which are 1, 2 and 6 nats for the decisions that a team takes
while it crosses its grid. See docs/settings.md for the trials.
"""

import math
from dataclasses import replace

import jax

from sumajax.environments.types import Environment
from sumajax.learning.config import EPOCH_STEPS, LearnerConfig

REFERENCE_DECISIONS = 100.0
"""Of 5 agents on 10x10, the task on which `fast` was found."""
OWN_CRITIC_SHARE = 3 / 16
"""Of the reference: the size up to which a policy's own critic keeps what a transfer brought. Tried
on both sides: with 1/4 (10 agents on 20x20) it learns as fast as one that is shown the state, with
1/8 (14 on 20x40) and 1/16 (20 on 40x40) its policy is lost."""
CRITIC_LIMITS = 5
"""Step limits that the critic learns alone for: it has to see whole episodes, and more than one."""


def crossing(env: Environment) -> float:
    """Steps from one corner of the grid to the other, rows + columns, of a square of as many cells.

    The cells are those an agent can tell apart, the rows of `state_table`, whatever size the state
    tensors were brought to; without a table those of the tensor.
    """
    table = jax.eval_shape(env.state_table)
    cells = math.prod(env.state_shape) if table is None else table.shape[0]
    return 2 * math.sqrt(cells)


def share_of_reference(env: Environment) -> float:
    """(0, 1]: `REFERENCE_DECISIONS` as a share of a team's decisions in a crossing of its grid."""
    return min(1.0, REFERENCE_DECISIONS / (env.num_agents * crossing(env)))


def for_stage(
    config: LearnerConfig, env: Environment, epochs: int, *, transferred: bool = False
) -> LearnerConfig:
    """What is trained in a stage of so many epochs on `env`, ready for `make_learner`.

    Args:
      transferred: it starts from parameters that were trained on another task.
    """
    config = with_horizon(config.for_stage(epochs, transferred=transferred), env)
    return after_transfer(config, env) if transferred else config


def with_horizon(config: LearnerConfig, env: Environment) -> LearnerConfig:
    """`config` with a discount that sees as far as a crossing of the grid of `env`.

    At 0.95 an agent 60 steps from the prey expects the same wherever it goes. Only for critic
    `state`: the policy's own does not learn the longer returns of a new task fast enough, and its
    policy is lost meanwhile. Twice is the same as once; with `scale_by_size` off nothing changes.
    """
    if config.critic != "state" or not config.scale_by_size:
        return config
    return replace(config, gamma=max(config.gamma, 1 - 1 / crossing(env)))


def after_transfer(config: LearnerConfig, env: Environment) -> LearnerConfig:
    """The settings of a stage on `env` that starts from a trained policy, of `for_stage`'s.

    * `learning_rate`: with the root of the share that the reference has in the team's decisions,
      since what an update changes grows with the square of the rate.
    * `entropy_weight`, `value_weight`: with that share itself. What there is to gain by one
      decision shrinks with the way; the bonus has to as well, or the policy stays near uniform.
      So has the critic's pull on what it shares with the policy. Its own parameters learn as fast
      as before, since Adam takes no notice of a gradient's scale.
    * `critic`: below `OWN_CRITIC_SHARE`, one that is shown the true state, where the task says what
      that is.
    * `critic_epochs`: `CRITIC_LIMITS` step limits of every environment.

    With `scale_by_size` off nothing changes. Twice is the same as once.
    """
    if not config.scale_by_size:
        return config
    share = share_of_reference(env)
    steps = CRITIC_LIMITS * env.max_steps * config.num_envs
    if share < OWN_CRITIC_SHARE and hasattr(env, "critic_features"):
        config = with_horizon(replace(config, critic="state"), env)
    return replace(
        config,
        learning_rate=config.learning_rate * math.sqrt(share),
        entropy_weight=config.entropy_weight * share,
        value_weight=config.value_weight * share,
        critic_epochs=math.ceil(steps / EPOCH_STEPS),
        scale_by_size=False,
    )
