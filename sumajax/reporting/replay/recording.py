"""One episode as numpy arrays: everything a replay shows of it."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from sumajax.environments.traffic_junction import TrafficJunction
from sumajax.environments.types import Environment
from sumajax.environments.wrapper import unwrapped
from sumajax.policies.types import Policy
from sumajax.reporting.replay.traffic_episode import TrafficEpisode

PREDATOR, CAPTURER = 0, 1


@dataclass(frozen=True)
class Episode:
    """Everything a replay shows of T steps of N agents, as numpy arrays.

    Frame t of T + 1 is the team before step t with what it says and does in that step; the last
    frame is the outcome.
    """

    agents: np.ndarray  # (T+1, N, 2) int cells (row, column)
    prey: np.ndarray  # (T+1, 2) int cells; given as (2,), one that stands still
    reached: np.ndarray  # (T+1, N) bool: has stood on the prey
    captured: np.ndarray  # (T+1, N) bool: nothing left to capture; true for predators throughout
    actions: np.ndarray  # (T, N) int: 0 up, 1 right, 2 down, 3 left, 4 stay, 5 capture
    attention: np.ndarray  # (T, N, N) weight of sender j (column) at receiver i (row)
    communication: np.ndarray  # (T, N) in [0, 1]: share of its means an agent used to talk
    reward: np.ndarray  # (T, N) of each step
    agent_class: np.ndarray  # (N,) 0 predator, 1 capture agent
    size: tuple[int, int]  # (rows, columns) of the task's grid
    vision: int  # of the predators, in cells
    capture_vision: int | None = None  # of the capture agents; None: blind
    success: bool = False  # the team was done at the end

    def __post_init__(self) -> None:
        steps, agents = self.actions.shape
        if np.shape(self.prey) == (2,):
            object.__setattr__(self, "prey", np.broadcast_to(self.prey, (steps + 1, 2)))
        expected = {
            "agents": (steps + 1, agents, 2),
            "prey": (steps + 1, 2),
            "reached": (steps + 1, agents),
            "captured": (steps + 1, agents),
            "attention": (steps, agents, agents),
            "communication": (steps, agents),
            "reward": (steps, agents),
            "agent_class": (agents,),
        }
        for name, shape in expected.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(
                    f"{name} of an episode of {steps} steps and {agents} agents must have shape "
                    f"{shape}, got {np.shape(getattr(self, name))}."
                )

    @property
    def num_steps(self) -> int:
        """T."""
        return len(self.actions)

    @property
    def num_agents(self) -> int:
        """N."""
        return len(self.agent_class)

    def sight(self, agent: int) -> int | None:
        """How far an agent sees, in cells; None for a blind one."""
        return self.vision if self.agent_class[agent] == PREDATOR else self.capture_vision


def record_episode(
    env: Environment, policy: Policy, params: Any, key: chex.PRNGKey, greedy: bool = False
) -> Episode | TrafficEpisode:
    """Runs one episode to its end and keeps what a replay needs.

    Args:
      env: Predator-Prey, Predator-Capture-Prey, Traffic Junction, or one of them upsampled.
      greedy: take the likeliest choice everywhere instead of sampling.

    Raises:
      ValueError: for a task whose state has no agents and prey on a grid, or a policy that was
        shaped for another task.
    """
    task = unwrapped(env)  # a wrapper changes what is observed, not the grid
    if isinstance(task, TrafficJunction):
        seen = record(env, policy, params, key, greedy)
        said = (seen.actions, seen.attention, seen.communication)
        return TrafficEpisode.of(task, seen.states, *said, seen.success)
    state = jax.eval_shape(task.reset, key)
    if not all(hasattr(state, name) for name in ("agents", "prey", "reached", "captured")):
        raise ValueError(
            f"a replay needs agents and prey on a grid; {type(task).__name__} has not."
        )
    recording = record(env, policy, params, key, greedy)
    states = recording.states
    return Episode(
        agents=np.asarray(states.agents),
        prey=np.asarray(states.prey),
        reached=np.asarray(states.reached),
        captured=np.asarray(states.captured),
        actions=recording.actions,
        attention=recording.attention,
        communication=recording.communication,
        reward=recording.reward,
        agent_class=np.asarray(env.agent_class),
        size=(task.state_shape[1], task.state_shape[2]),
        vision=(env.view_shape[-1] - 1) // 2,
        capture_vision=getattr(task, "capture_vision", None),
        success=recording.success,
    )


@dataclass(frozen=True)
class Recording:
    """T steps of N agents of any task, for whoever draws it."""

    states: Any  # leaves (T+1, ...): the task's own states, before each step and after the last
    actions: np.ndarray  # (T, N) int
    attention: np.ndarray  # (T, N, N) weight of sender j (column) at receiver i (row)
    communication: np.ndarray  # (T, N) in [0, 1]: share of its means an agent used to talk
    reward: np.ndarray  # (T, N) of each step
    success: bool  # the team was done at the end


def record(
    env: Environment, policy: Policy, params: Any, key: chex.PRNGKey, greedy: bool = False
) -> Recording:
    """Runs one episode of any task to its end.

    Args:
      greedy: take the likeliest choice everywhere instead of sampling.

    Raises:
      ValueError: when the policy was shaped for another task.
    """
    policy.check_fits(env)
    states, steps, ended, success = _run(env, policy, params, key, greedy)
    ended = np.asarray(ended)
    length = int(ended.argmax()) + 1 if ended.any() else len(ended)
    return Recording(
        states=jax.tree.map(lambda x: x[: length + 1], states),
        success=bool(success[length - 1]),
        **{name: np.asarray(of_steps[:length]) for name, of_steps in steps.items()},
    )


@partial(jax.jit, static_argnames=("env", "policy"))
def _run(
    env: Environment, policy: Policy, params: Any, key: chex.PRNGKey, greedy: chex.Array
) -> tuple[Any, dict[str, chex.Array], chex.Array, chex.Array]:
    """`max_steps` steps; what follows the end is cut off later.

    Returns:
      states, leaves (max_steps + 1, ...); what `Recording` has of each step; and whether it ended
      the episode, and whether with success (max_steps,).
    """
    reset_key, noise_key = jax.random.split(key)
    noise = policy.sample_noise(noise_key, (env.max_steps,), greedy)

    def step(loop: tuple[Any, Any], noise_t: Any) -> tuple[tuple[Any, Any], Any]:
        state, carry = loop
        carry, output = policy.apply_with(params, carry, env.observe(state), noise_t)
        following, transition = env.step(state, output.action)
        said = {
            "actions": output.action,
            "attention": output.attention,
            "communication": output.communication,
            "reward": transition.reward,
        }
        ended = transition.terminated | transition.truncated
        return (following, carry), (state, said, ended, transition.success)

    start = env.reset(reset_key), policy.initial_carry()
    (last, _), (before, *steps) = jax.lax.scan(step, start, noise)
    states = jax.tree.map(lambda x, end: jnp.concatenate([x, end[None]]), before, last)
    return states, *steps
