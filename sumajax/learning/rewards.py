"""Rewards in one unit, whatever a task pays in.

An entropy bonus, a critic's weight and a clip are numbers beside rewards: what keeps a policy open
where a step costs 0.05 is nothing where a collision costs 10, and there the policy settles on the
first thing that collides less, long before it has seen what giving way would do. So a task says
what its largest reward is, and the learner measures all of them by it (docs/settings.md, Traffic
Junction).
"""

from sumajax.environments.types import Environment
from sumajax.learning.config import LearnerConfig

REFERENCE_REWARD = 0.05
"""What a step of Predator-Prey costs, the task on which `fast` was found."""


def reward_scale(env: Environment, config: LearnerConfig) -> float:
    """What rewards are multiplied by before they are learnt from.

    1 with `scale_rewards` off, and for a task that does not say what its largest reward is.
    """
    largest = getattr(env, "largest_reward", None)
    return REFERENCE_REWARD / largest if largest and config.scale_rewards else 1.0
