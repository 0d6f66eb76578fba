"""A task with automatic reset, in the form of gymnax 1.0: six values from a step.

gymnax is no dependency; where it is installed, its own spaces describe observations and actions.
Source of the form: gymnax's docs/api_rfc.md, section "1.0 contract".
"""

import importlib.util
from dataclasses import dataclass
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct

from sumajax.environments.types import Environment, Observation, agents_leave
from sumajax.environments.wrapper import unwrapped

if importlib.util.find_spec("gymnax") is not None:
    from gymnax.environments import spaces
else:
    from sumajax.compat import spaces


@struct.dataclass
class EnvParams:
    """What gymnax's programs ask of a task's parameters; the rest is in the task itself."""

    max_steps_in_episode: int = struct.field(pytree_node=False, default=0)


@dataclass(frozen=True)
class AutoReset:
    """`env` with a fresh episode after every end, for programs written for gymnax 1.0.

        task = AutoReset(PredatorPrey(size=5))
        obs, state = task.reset(key)
        obs, state, reward, terminated, truncated, info = task.step(key, state, actions)

    Observations are `Observation` records, actions (N,) int32 and rewards (N,) float32: one
    environment of a whole team. All functions can be traced and vmapped.

    Attributes:
      team_reward: one reward () for the team, the mean over its agents, as programs and wrappers
        for a single agent add up (gymnax's `LogWrapper`).
    """

    env: Environment
    team_reward: bool = False

    @property
    def name(self) -> str:
        """The task's class."""
        return type(unwrapped(self.env)).__name__

    @property
    def num_agents(self) -> int:
        """N."""
        return self.env.num_agents

    @property
    def num_actions(self) -> int:
        """Actions of one agent."""
        return self.env.num_actions

    @property
    def default_params(self) -> EnvParams:
        """The step limit; a task has no parameters beside its own fields."""
        return EnvParams(max_steps_in_episode=self.env.max_steps)

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: chex.PRNGKey, params: EnvParams | None = None) -> tuple[Observation, Any]:
        """A fresh episode: (observation, state). `params` is there for the form and not read."""
        state = self.env.reset(key)
        return self.env.observe(state), state

    @partial(jax.jit, static_argnums=0)
    def step(
        self, key: chex.PRNGKey, state: Any, action: Any, params: EnvParams | None = None
    ) -> tuple[Observation, Any, chex.Array, chex.Array, chex.Array, dict[str, Any]]:
        """One step of the team, and a reset where it ended the episode.

        Args:
          action: (N,) int32, or N numbers.

        Returns:
          observation and state (those of the next episode after an end), reward (N,), or () with
          `team_reward`, terminated () bool, truncated () bool, and info: `final_observation`, what
          the team saw before any reset (meant for the value after an end), `terminated`,
          `truncated`, `success`, `steps_taken`. The two flags are never both true: a team that is
          done with its last step has terminated.
        """
        # As gymnax splits it: a step's half, unused since domains keep a key of their own in their
        # state, and the next episode's.
        _, reset_key = jax.random.split(key)
        stepped, transition = self.env.step(state, jnp.asarray(action))
        seen = self.env.observe(stepped)
        fresh_seen, fresh = self.reset(reset_key)
        reward = transition.reward.mean() if self.team_reward else transition.reward
        done = transition.terminated | transition.truncated
        obs, state = jax.tree.map(
            lambda a, b: jnp.where(done, a, b), (fresh_seen, fresh), (seen, stepped)
        )
        info = {
            "final_observation": seen,
            "terminated": transition.terminated,
            "truncated": transition.truncated,
            "success": transition.success,
            "steps_taken": transition.steps_taken,
        }
        return obs, state, reward, transition.terminated, transition.truncated, info

    def observe(
        self,
        key: chex.PRNGKey | None,
        state: Any,
        action: Any = None,
        params: EnvParams | None = None,
    ) -> Observation:
        """What the team sees; needs neither a key nor the action that led there."""
        return self.env.observe(state)

    def observation_space(self, params: EnvParams | None = None) -> Any:
        """A space for each field of `Observation`."""
        shapes = {"state": self.env.state_shape, "view": self.env.view_shape}
        bounds = {"state": (0.0, 1.0), "view": (-1.0, float(self.env.num_agents + 1))}
        boxes = {
            name: spaces.Box(*bounds[name], (self.env.num_agents, *shape), jnp.float32)
            for name, shape in shapes.items()
        }
        if agents_leave(self.env):
            flags = spaces.Box(0, 1, (self.env.num_agents,), jnp.bool_)
            boxes |= {"alive": flags, "entered": flags}
        return spaces.Dict(boxes)

    def action_space(self, params: EnvParams | None = None) -> Any:
        """One choice per agent; `env.action_mask` tells the ones that mean something."""
        return spaces.Tuple([spaces.Discrete(self.env.num_actions) for _ in range(self.num_agents)])
