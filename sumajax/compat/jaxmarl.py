"""The tasks as JaxMARL environments, and JaxMARL's own training scripts on them.

    env = JaxMARLEnv(PredatorPrey(size=5))           # dictionaries of agents, automatic reset
    python -m sumajax.compat.jaxmarl baselines/IPPO/ippo_rnn_mpe.py ENV_NAME=sumajax_predator_prey

JaxMARL is no dependency. Where it is installed the environment is a `MultiAgentEnv` of its own and
its spaces are used; where it is not, everything but `register` and the command works as well.
Source of the conventions: JaxMARL's environments/multi_agent_env.py and wrappers/baselines.py.
"""

import importlib.util
import runpy
import sys
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sumajax.environments import PredatorCapturePrey, PredatorPrey, TrafficJunction
from sumajax.environments.types import Environment
from sumajax.environments.wrapper import unwrapped
from sumajax.records import exportable
from sumajax.upsampling import StateUpsampled

if importlib.util.find_spec("jaxmarl") is not None:
    from jaxmarl.environments import multi_agent_env, spaces

    Base: Any = multi_agent_env.MultiAgentEnv
else:
    from sumajax.compat import spaces

    Base = object

TASKS: dict[str, type[Any]] = {
    "sumajax_predator_prey": PredatorPrey,
    "sumajax_predator_capture_prey": PredatorCapturePrey,
    "sumajax_traffic_junction": TrafficJunction,
}
"""Names for `make`."""


@exportable
@struct.dataclass
class State:
    """An episode in progress, with the two fields that JaxMARL's states have."""

    env_state: Any  # the task's own state
    done: chex.Array  # () bool: the step that led here ended the episode
    step: chex.Array  # () int32 steps taken so far


class JaxMARLEnv(Base):
    """A task behind JaxMARL's `MultiAgentEnv` interface.

    Agents are `agent_0` and so on, predators first. An observation is one flat float32 vector, as
    long for every agent: the own cell one-hot, the view, and, with several classes, the class
    one-hot. All agents have the same number of actions; `get_avail_actions` tells those that mean
    something, the others are a stay. All agents of a team end together.

    Args:
      task: Predator-Prey, Predator-Capture-Prey, one of them upsampled, or any other task.
    """

    def __init__(self, task: Environment) -> None:
        self.task = task
        self.num_agents = task.num_agents
        self.max_steps = task.max_steps
        self.agents = [f"agent_{index}" for index in range(task.num_agents)]
        length = sum(int(np.prod(shape)) for shape in (task.state_shape, task.view_shape))
        length += self._classes.shape[1]
        self.observation_spaces = {
            agent: spaces.Box(-1.0, float(task.num_agents + 1), (length,), jnp.float32)
            for agent in self.agents
        }
        self.action_spaces = {agent: spaces.Discrete(task.num_actions) for agent in self.agents}

    @property
    def name(self) -> str:
        """The task's class."""
        return type(unwrapped(self.task)).__name__

    def __eq__(self, other: object) -> bool:
        """Of the same task: two such share what is compiled."""
        return isinstance(other, JaxMARLEnv) and (type(self), self.task) == (
            type(other),
            other.task,
        )

    def __hash__(self) -> int:
        return hash((type(self), self.task))

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """The names of each class's agents."""
        names = getattr(self.task, "class_names", ())
        groups: dict[str, list[str]] = {}
        for agent, kind in zip(self.agents, self.task.agent_class, strict=True):
            name = names[kind] if kind < len(names) else f"class_{kind}"
            groups.setdefault(name, []).append(agent)
        return groups

    @property
    def _classes(self) -> np.ndarray:
        """(N, number of classes) one-hot, or no columns where all are of one class."""
        kinds = self.task.agent_class
        present = np.unique(kinds)
        return kinds[:, None] == present[None] if len(present) > 1 else np.zeros((len(kinds), 0))

    def observation_space(self, agent: str) -> Any:
        """Of one agent."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """Of one agent."""
        return self.action_spaces[agent]

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: chex.PRNGKey) -> tuple[dict[str, chex.Array], State]:
        """A fresh episode: observations by agent, and the state."""
        env_state = self.task.reset(key)
        state = State(env_state, jnp.zeros((), bool), jnp.zeros((), jnp.int32))
        return self.get_obs(state), state

    @partial(jax.jit, static_argnums=0)
    def step(
        self,
        key: chex.PRNGKey,
        state: State,
        actions: dict[str, chex.Array],
        reset_state: State | None = None,
    ) -> tuple[Any, State, dict[str, chex.Array], dict[str, chex.Array], dict[str, chex.Array]]:
        """One step, and a new episode where it ended the old one.

        Args:
          actions: by agent, shape () or (1,).
          reset_state: the start of the episode that follows; None draws one.

        Returns:
          observations, state, rewards () and dones () by agent, `__all__` among the dones, and
          info, whose leaves are (num_agents,): `success`, `terminated`, `truncated`, `steps_taken`.
        """
        # As JaxMARL splits it: the step's half, and the next episode's.
        step_key, reset_key = jax.random.split(key)
        obs, stepped, rewards, dones, info = self.step_env(step_key, state, actions)
        if reset_state is None:
            fresh_obs, fresh = self.reset(reset_key)
        else:
            fresh_obs, fresh = self.get_obs(reset_state), reset_state
        obs, stepped = jax.tree.map(
            lambda a, b: jnp.where(dones["__all__"], a, b), (fresh_obs, fresh), (obs, stepped)
        )
        return obs, stepped, rewards, dones, info

    def step_env(
        self, key: chex.PRNGKey, state: State, actions: dict[str, chex.Array]
    ) -> tuple[Any, State, dict[str, chex.Array], dict[str, chex.Array], dict[str, chex.Array]]:
        """`step` without the reset; the key is not used, as a domain whose steps need one keeps it
        in its state."""
        joint = jnp.stack([jnp.reshape(actions[agent], ()) for agent in self.agents])
        env_state, transition = self.task.step(state.env_state, joint.astype(jnp.int32))
        done = transition.terminated | transition.truncated
        stepped = State(env_state, done, transition.steps_taken)
        rewards = dict(zip(self.agents, transition.reward, strict=True))
        dones = dict.fromkeys([*self.agents, "__all__"], done)
        names = ("success", "terminated", "truncated", "steps_taken")
        info = {name: jnp.full(self.num_agents, getattr(transition, name)) for name in names}
        return self.get_obs(stepped), stepped, rewards, dones, info

    def get_obs(self, state: State) -> dict[str, chex.Array]:
        """What every agent sees, as flat vectors by agent."""
        seen = self.task.observe(state.env_state)
        rows = [seen.state, seen.view, jnp.asarray(self._classes, jnp.float32)]
        flat = jnp.concatenate([row.reshape(self.num_agents, -1) for row in rows], axis=-1)
        return dict(zip(self.agents, flat, strict=True))

    def get_avail_actions(self, state: State) -> dict[str, chex.Array]:
        """(num_actions,) bool by agent; the same in every state."""
        return dict(zip(self.agents, jnp.asarray(self.task.action_mask), strict=True))


def make(env_id: str, upsample_to: int | None = None, **settings: Any) -> JaxMARLEnv:
    """The task called `env_id` in `TASKS`, with its fields as settings.

    Args:
      upsample_to: side of a larger grid at whose size the state is seen; None leaves it.

    Raises:
      ValueError: for an unknown name or setting, or a value the task refuses.
    """
    if env_id not in TASKS:
        raise ValueError(f"task {env_id!r} is unknown; choose one of {', '.join(TASKS)}.")
    try:
        task: Any = TASKS[env_id](**settings)
    except TypeError as error:
        fields = [name for name, f in TASKS[env_id].__dataclass_fields__.items() if f.init]
        raise ValueError(f"{env_id}: {error}; its settings are {', '.join(fields)}.") from None
    return JaxMARLEnv(task if upsample_to is None else StateUpsampled(task, upsample_to))


def register(**tasks: Environment) -> None:
    """Lets `jaxmarl.make` find the names in `TASKS`, and those of `tasks`.

    JaxMARL finds environments by a fixed list of names, so its `make` is replaced by one that knows
    ours as well; call this before a program imports `make` from it.

        register(pp10=PredatorPrey(size=10, num_predators=5, max_steps=200))
        jaxmarl.make("pp10"), jaxmarl.make("sumajax_predator_prey", size=5)

    Raises:
      ImportError: where JaxMARL is not installed.
    """
    import jaxmarl
    import jaxmarl.registration as theirs

    original = theirs.make

    def make_any(env_id: str, **settings: Any) -> Any:
        if env_id in tasks:
            return JaxMARLEnv(tasks[env_id])
        return make(env_id, **settings) if env_id in TASKS else original(env_id, **settings)

    jaxmarl.make = theirs.make = make_any
    known = theirs.registered_envs
    known.extend(name for name in [*TASKS, *tasks] if name not in known)


def main(arguments: list[str]) -> None:
    """Runs one of JaxMARL's scripts, unchanged, with the tasks registered."""
    if not arguments:
        raise SystemExit("usage: python -m sumajax.compat.jaxmarl SCRIPT [its options]")
    register()
    sys.argv = arguments
    runpy.run_path(arguments[0], run_name="__main__")


if __name__ == "__main__":
    # The script becomes `__main__` in this module's place, so the importable one must run it.
    from sumajax.compat import jaxmarl as importable

    importable.main(sys.argv[1:])
