"""HetNet's published loss (Seraj et al. 2022; docs/reference/learning.md, HetNet's loss).

A critic per class instead of per agent, advantages normalised per class, means over episodes where
the other loss has sums. An environment here is a process of the original: it shares nothing.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from sumajax.learning import returns
from sumajax.learning.config import LearnerConfig
from sumajax.learning.losses import LossParts, estimate_advantages, policy_gradient
from sumajax.learning.rollout import Trajectory

STD_EPS = float(np.finfo(np.float32).eps)


def hetnet(
    trajectory: Trajectory,
    valid: chex.Array,
    last_value: chex.Array,
    config: LearnerConfig,
    entropy_scale: chex.Numeric,
    axis: str | None = None,
) -> tuple[chex.Array, LossParts]:
    """Sum over environments of policy_weight * policy + value_weight * critic.

    policy: mean over episodes of the sum over agents and steps of -advantage * log pi.
    critic: mean over episodes of the sum over classes of the mean over steps of (V - target)^2,
    with the class's value V and the mean of its agents' targets.

    The steps of `valid` (T, E) make up whole episodes. No environment looks at another one, so
    `axis` has no part in it.
    """
    peers = same_class(trajectory.agent_class)
    dtype = trajectory.value.dtype
    size = peers.sum(0)[None, None]  # (1, 1, N)
    episodes = (trajectory.last & valid).sum(0, dtype=dtype)[:, None]  # (E, 1)
    weight = jnp.broadcast_to(valid[..., None], trajectory.value.shape).astype(dtype)
    raw = estimate_advantages(trajectory, last_value, config)
    advantages = normalise_by_class(raw, valid, episodes * trajectory.max_steps, peers)
    policy, entropy = policy_gradient(trajectory.decisions, advantages, weight / episodes[None])
    target = jax.lax.stop_gradient(trajectory.value) + raw
    mean = jnp.asarray(peers / size[0], dtype)
    error = ((trajectory.value - target) @ mean) ** 2  # each agent has its class's
    length = episode_length(trajectory)[..., None].astype(dtype)
    critic = (weight * error / size.astype(dtype) / length / episodes[None]).sum()
    loss = (
        config.policy_weight * policy
        + config.value_weight * critic
        - config.entropy_weight * entropy_scale * entropy
    )
    summed, action_entropy = policy_gradient(trajectory.decisions, advantages, weight)
    return loss, LossParts(summed, (weight * error).sum(), action_entropy, weight.sum())


def normalise_by_class(
    x: chex.Array, valid: chex.Array, padded: chex.Array, peers: np.ndarray
) -> chex.Array:
    """(T, E, N) x less its mean, over its standard deviation, per environment and class.

    Both are those of the original's array [episodes, agents of the class, `max_steps`], zero after
    the end of an episode: its zeros count too.

    Args:
      x: (T, E, N).
      valid: (T, E), of the steps that are no padding.
      padded: (E, 1) steps with the padding, episodes x `max_steps`.
      peers: (N, N) 1 where two agents are of one class.
    """
    same = jnp.asarray(peers, x.dtype)
    size, weight = same.sum(0)[None], valid[..., None].astype(x.dtype)  # (1, N), (T, E, 1)
    entries, steps = padded.astype(x.dtype) * size, weight.sum(0) * size  # (E, N)
    mean = (weight * x).sum(0) @ same / entries
    centred = x - mean[None]
    squares = (weight * centred**2).sum(0) @ same + (entries - steps) * mean**2
    return centred / (jnp.sqrt(squares / (entries - 1)) + STD_EPS)[None]


def same_class(agent_class: tuple[int, ...]) -> np.ndarray:
    """(N, N) 1 where two agents are of one class."""
    classes = np.array(agent_class)
    return (classes[:, None] == classes).astype(float)


def episode_length(trajectory: Trajectory) -> chex.Array:
    """(T, E): steps of the episode each step belongs to; 1 where the trajectory has not its end."""
    last, steps_taken = trajectory.last, trajectory.steps_taken
    ends = last.astype(steps_taken.dtype)
    return returns.discounted_returns(steps_taken * ends, 1 - ends, jnp.ones_like(steps_taken[0]))
