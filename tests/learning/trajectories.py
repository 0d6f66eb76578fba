"""Made-up trajectories, and tiny tasks, policies and learners for real ones."""

from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from probes import Probe, ProbeState

from sumajax.environments import PredatorPrey
from sumajax.learning import Learner, make_learner, preset
from sumajax.learning.rollout import Trajectory
from sumajax.policies import Decision, Policy, PolicyModule, PolicyOutput, TeamSpec, make_policy

TINY_TASK = PredatorPrey(size=3, num_predators=2, max_steps=5)


def tiny_learner(
    env: Any = TINY_TASK, policy: str = "iric", settings: str = "fast", **changes: Any
) -> Learner:
    """A real learner that compiles in seconds."""
    small = {"hidden": 4} if policy in ("ic3net", "commnet", "iric", "ic") else {}
    made = make_policy(policy, env, encoder="linear", **small)
    return make_learner(env, made, preset(settings, policy, **changes))


def random_trajectory(
    rng: np.random.Generator,
    lengths: list[list[int]],
    agent_class: tuple[int, ...] = (0, 0),
    *,
    max_steps: int = 7,
    beyond: int = 2,
    decisions: dict[str, int] | None = None,
) -> tuple[Trajectory, np.ndarray]:
    """A trajectory of random figures and the steps (T, E) that belong to whole episodes.

    Args:
      lengths: of the episodes of each environment; those of `max_steps` hit the limit.
      beyond: steps of a further episode after them, which has no end.
      decisions: number of choices by name; {"action": 4} unless given.
    """
    num_steps, num_envs = max(map(sum, lengths)) + beyond, len(lengths)
    shape = (num_steps, num_envs, len(agent_class))
    steps_taken, last = np.ones(shape[:2], np.int32), np.zeros(shape[:2], bool)
    valid = np.zeros(shape[:2], bool)
    for env, of_env in enumerate(lengths):
        end = sum(of_env)
        counted = [np.arange(1, n + 1) for n in (*of_env, num_steps - end)]
        steps_taken[:, env] = np.concatenate(counted)
        last[np.cumsum(of_env, dtype=int) - 1, env] = True
        valid[:end, env] = True
    truncated = last & (steps_taken == max_steps)
    by_class = rng.normal(size=(*shape[:2], max(agent_class) + 1))
    trajectory = Trajectory(
        decisions={
            name: Decision(rng.normal(size=(*shape, k)), rng.integers(k, size=shape))
            for name, k in (decisions or {"action": 4}).items()
        },
        value=by_class[..., list(agent_class)],
        communication=rng.uniform(size=shape),
        active=rng.uniform(size=shape) < 0.7,
        reward=rng.normal(size=shape),
        terminated=last & ~truncated,
        truncated=truncated,
        success=last & ~truncated,
        steps_taken=steps_taken,
        episode_return=rng.normal(size=shape),
        agent_class=tuple(agent_class),
        max_steps=max_steps,
    )
    return jax.tree.map(jnp.asarray, trajectory), valid


@dataclass(frozen=True)
class Clock(Probe):
    """One agent, whose state tensor is the time."""

    max_steps: int = 7

    def state_index(self, state: ProbeState) -> chex.Array:
        return jnp.full((1,), state.time)

    def state_table(self) -> chex.Array:
        return jnp.arange(self.max_steps, dtype=jnp.float32)[:, None, None, None]


class Sum(PolicyModule):
    """Remembers the sum of what it saw, and says so as its value; a parameter per state."""

    states: int = 0

    def setup(self) -> None:
        self.x = self.param("x", nn.initializers.zeros, (self.states,))

    def encode_states(self, states: chex.Array) -> chex.Array:
        return self.x[:, None]

    def __call__(
        self, carry: chex.Array, features: chex.Array, view: chex.Array, noise: Any
    ) -> tuple[chex.Array, PolicyOutput]:
        carry = carry + features[..., 0]
        logits = jnp.zeros((*carry.shape, self.team.num_actions))
        decisions = {"action": Decision(logits, jnp.zeros(carry.shape, jnp.int32))}
        pairs = jnp.zeros((*carry.shape, self.team.num_agents))
        return carry, PolicyOutput(decisions, carry, jnp.ones(carry.shape), pairs)

    def initial_carry(self, batch_shape: tuple[int, ...]) -> chex.Array:
        return jnp.zeros((*batch_shape, self.team.num_agents))

    def sample_noise(self, key: chex.PRNGKey, batch_shape: tuple[int, ...]) -> chex.Array:
        return jnp.zeros(batch_shape)


def summing_policy(env: Clock) -> Policy:
    return Policy("sum", Sum(TeamSpec.of(env), states=env.max_steps))
