"""Actor-critic losses of a trajectory: sums over time, environments and agents.

A loss is a function of (trajectory, valid, last_value, config, entropy_scale, axis) that returns a
sum to differentiate and `LossParts` to report; `learner.LOSSES` names them.
"""

from collections.abc import Callable
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
from flax import struct

from sumajax.learning import returns
from sumajax.learning.config import LearnerConfig
from sumajax.learning.rollout import Trajectory
from sumajax.policies.types import MASKED_LOGIT, Decision


@struct.dataclass
class LossParts:
    """Sums over a batch, for reporting."""

    policy: chex.Array  # () float32
    value: chex.Array  # () float32 squared error
    entropy: chex.Array  # () float32 nats, of the action, where the policy is trained
    acting: chex.Array  # () float32 number of agent-steps where the policy is trained


LossFunction = Callable[
    [Trajectory, chex.Array, chex.Array, LearnerConfig, chex.Numeric, str | None],
    tuple[chex.Array, LossParts],
]


def log_prob_and_entropy(decision: Decision) -> tuple[chex.Array, chex.Array]:
    """(...,) log-probability of what was chosen, and entropy in nats, of one decision."""
    log_probs = jax.nn.log_softmax(decision.logits)
    # A product with the one-hot choice, not a gather: its gradient is no scatter.
    chosen = jax.nn.one_hot(decision.choice, log_probs.shape[-1], dtype=log_probs.dtype)
    taken = jnp.where(chosen > 0, log_probs, 0.0).sum(-1)
    possible = decision.logits > MASKED_LOGIT / 2
    entropy = -jnp.where(possible, jnp.exp(log_probs) * log_probs, 0.0).sum(-1)
    return taken, entropy


def centre(x: chex.Array, weight: chex.Array, axis: str | None = None) -> chex.Array:
    """x with mean 0 over the entries of weight 1, of all devices."""
    return x - _moments(x, weight, axis)[0]


def normalise(x: chex.Array, weight: chex.Array, axis: str | None = None) -> chex.Array:
    """x with mean 0 and standard deviation 1 over the entries of weight 1, of all devices."""
    mean, variance = _moments(x, weight, axis)
    return (x - mean) * jax.lax.rsqrt(variance + 1e-8)


def _moments(x: chex.Array, weight: chex.Array, axis: str | None) -> tuple[chex.Array, chex.Array]:
    """(), () mean and variance of the entries of weight 1."""
    sums = jnp.stack([weight.sum(), (weight * x).sum(), (weight * x**2).sum()])
    count, first, second = sums if axis is None else jax.lax.psum(sums, axis)
    count = jnp.maximum(count, 1.0)
    mean = first / count
    return mean, jnp.maximum(second / count - mean**2, 0.0)


ADVANTAGES: dict[str, Callable[[chex.Array, chex.Array, str | None], chex.Array]] = {
    "raw": lambda x, weight, axis: x,
    "centred": centre,
    "normalised": normalise,
}
"""By `LearnerConfig.advantages`."""


def policy_gradient(
    decisions: dict[str, Decision],
    advantages: chex.Array,
    weight: chex.Array,
    acting: chex.Array | None = None,
) -> tuple[chex.Array, chex.Array]:
    """() sum of -weight * advantage * log pi(choices), () sum of the action's entropy.

    Every decision of an agent (its action, its gate) shares the advantage, a constant here. Those
    beside the action still count where `acting` leaves the action out: an agent that has arrived
    can move no more, but what it says can send the others the right way.
    """
    acting = weight if acting is None else acting
    pairs = {name: log_prob_and_entropy(decision) for name, decision in decisions.items()}
    weighted = sum((acting if name == "action" else weight) * pairs[name][0] for name in pairs)
    loss = -(jax.lax.stop_gradient(advantages) * weighted).sum()
    return loss, (acting * pairs["action"][1]).sum()


def estimate_advantages(
    trajectory: Trajectory, last_value: chex.Array, config: LearnerConfig
) -> chex.Array:
    """(T, E, N) advantages under `config`, constants to every gradient.

    A step limit is no end of the task: with `bootstrap_timeouts` the value of the observation after
    it, which the rollout never encodes, is taken to be that of the observation before it.
    Where agents come and go, nothing is passed on from an agent to the one that takes its place;
    the reward of a newcomer's first step, in which it has not acted, is left out, or with
    `alive_mask` `after` added to who had the place before, as in the originals.
    """
    value, last_value = jax.lax.stop_gradient((trajectory.value, last_value))
    reward, presence = trajectory.reward, trajectory.presence
    if presence is not None and config.alive_mask == "before":
        reward = jnp.where(presence.entered, 0.0, reward)
    if config.bootstrap_timeouts:
        goes_on = trajectory.truncated[..., None]
        goes_on = goes_on if presence is None else goes_on & ~presence.left
        reward = reward + config.gamma * goes_on.astype(value.dtype) * value
    ongoing = jnp.broadcast_to(~trajectory.last[..., None], value.shape)
    ongoing = (ongoing if presence is None else ongoing & ~presence.left).astype(value.dtype)
    return returns.generalised_advantages(
        reward, config.gamma * ongoing, value, last_value, config.gae_lambda
    )


def estimate_returns(
    trajectory: Trajectory, last_value: chex.Array, config: LearnerConfig
) -> chex.Array:
    """(T, E, N) what the critic is to learn: advantage plus value, partly the team's mean of it.

    The team's part is the mean over its N places, whoever holds them: it goes on where a place is
    handed on, and an empty place is worth nothing (as in the originals' team mean).
    """
    value = jax.lax.stop_gradient(trajectory.value)
    own = estimate_advantages(trajectory, last_value, config) + value
    presence = trajectory.presence
    if presence is None or config.team_reward == 0.0:
        return returns.mix_team(own, config.team_reward)
    value = jnp.where(presence.before, value, 0.0)
    places = replace(trajectory, value=value, presence=None)
    beyond = jnp.where(presence.after[-1], last_value, 0.0)
    of_places = estimate_advantages(places, beyond, config) + value
    return returns.mix_team(own, config.team_reward, of_places)


def counted(trajectory: Trajectory, valid: chex.Array, config: LearnerConfig) -> chex.Array:
    """(T, E, N) float32, 1 for the agent-steps that are learnt from.

    Those of the `valid` (T, E) steps, and where agents come and go of who is there, before or after
    the step as `alive_mask` says.
    """
    weight = jnp.broadcast_to(valid[..., None], trajectory.value.shape).astype(jnp.float32)
    if trajectory.presence is None:
        return weight
    return jnp.where(getattr(trajectory.presence, config.alive_mask), weight, 0.0)


def actor_critic(
    trajectory: Trajectory,
    valid: chex.Array,
    last_value: chex.Array,
    config: LearnerConfig,
    entropy_scale: chex.Numeric,
    axis: str | None = None,
) -> tuple[chex.Array, LossParts]:
    """Policy gradient with a learnt baseline.

    sum of -advantage * log pi + value_weight (V - R)^2 - entropy_weight H, with R the advantage
    plus V, or with `team_reward` partly the team's mean of it, and H the entropy of the action.

    Args:
      valid: (T, E), 0 for steps that must not count.
      last_value: (E, N) of the observation after the last step.
      entropy_scale: what annealing leaves of the entropy weight.

    Source: Singh et al. 2019, section 3.2; Mnih et al. 2016 for the entropy.
    """
    chex.assert_equal_shape([trajectory.value, trajectory.reward])
    weight = counted(trajectory, valid, config)
    value = jax.lax.stop_gradient(trajectory.value)
    target = estimate_returns(trajectory, last_value, config)
    advantages = target - value
    acting = weight * trajectory.active.astype(weight.dtype) if config.mask_inactive else weight
    advantages = ADVANTAGES[config.advantages](advantages, acting, axis)
    policy, entropy = policy_gradient(trajectory.decisions, advantages, weight, acting)
    critic = (weight * (trajectory.value - target) ** 2).sum()
    loss = (
        config.policy_weight * policy
        + config.value_weight * critic
        - config.entropy_weight * entropy_scale * entropy
    )
    return loss, LossParts(policy, critic, entropy, acting.sum())
