"""One episode as numpy arrays: everything a replay shows of it."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from sumajax.environments.types import Environment
from sumajax.policies.types import Policy

PREDATOR, CAPTURER = 0, 1


@dataclass(frozen=True)
class Episode:
    """Everything a replay shows of T steps of N agents, as numpy arrays.

    Frame t of T + 1 is the team before step t with what it says and does in that step; the last
    frame is the outcome.
    """

    agents: np.ndarray  # (T+1, N, 2) int cells (row, column)
    prey: np.ndarray  # (2,) int cell
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
        expected = {
            "agents": (steps + 1, agents, 2),
            "prey": (2,),
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
) -> Episode:
    """Runs one episode to its end and keeps what a replay needs.

    Args:
      env: Predator-Prey, Predator-Capture-Prey, or one of them upsampled.
      greedy: take the likeliest choice everywhere instead of sampling.

    Raises:
      ValueError: for a task whose state has no agents and prey on a grid.
    """
    task = getattr(env, "env", env)  # StateUpsampled changes what is observed, not the grid
    state = jax.eval_shape(task.reset, key)
    if not all(hasattr(state, name) for name in ("agents", "prey", "reached", "captured")):
        raise ValueError(
            f"a replay needs agents and prey on a grid; {type(task).__name__} has not."
        )
    first, steps = _run(env, policy, params, key, greedy)
    steps = jax.device_get(steps)
    length = int(np.argmax(steps["ended"])) + 1 if steps["ended"].any() else len(steps["ended"])

    def whole(name: str) -> np.ndarray:
        return np.concatenate([np.asarray(getattr(first, name))[None], steps[name][:length]])

    return Episode(
        agents=whole("agents"),
        prey=np.asarray(first.prey),
        reached=whole("reached"),
        captured=whole("captured"),
        actions=steps["actions"][:length],
        attention=steps["attention"][:length],
        communication=steps["communication"][:length],
        reward=steps["reward"][:length],
        agent_class=np.asarray(env.agent_class),
        size=(task.state_shape[1], task.state_shape[2]),
        vision=(env.view_shape[-1] - 1) // 2,
        capture_vision=getattr(task, "capture_vision", None),
        success=bool(steps["success"][length - 1]),
    )


@partial(jax.jit, static_argnames=("env", "policy"))
def _run(
    env: Environment, policy: Policy, params: Any, key: chex.PRNGKey, greedy: chex.Array
) -> tuple[Any, dict[str, chex.Array]]:
    """The first state, and `max_steps` steps from it; what follows the end is cut off later."""
    reset_key, noise_key = jax.random.split(key)
    first = env.reset(reset_key)
    noise = policy.sample_noise(noise_key, (env.max_steps,))
    noise = jax.tree.map(lambda numbers: jnp.where(greedy, 0, numbers), noise)

    def step(loop: tuple[Any, Any], noise_t: Any) -> tuple[tuple[Any, Any], dict[str, chex.Array]]:
        state, carry = loop
        # IC3Net's gate of this step was chosen one step ahead, and its output holds the next one.
        gate = getattr(carry, "gate", None)
        team_step: Any = policy.module.apply(
            params, carry, env.observe(state), noise_t, method=policy.module.encode_and_step
        )
        carry, output = team_step
        state, transition = env.step(state, output.action)
        record = {
            "agents": state.agents,
            "reached": state.reached,
            "captured": state.captured,
            "actions": output.action,
            "attention": output.attention,
            "communication": output.communication if gate is None else gate,
            "reward": transition.reward,
            "ended": transition.terminated | transition.truncated,
            "success": transition.success,
        }
        return (state, carry), record

    _, steps = jax.lax.scan(step, (first, policy.initial_carry()), noise)
    return first, steps
