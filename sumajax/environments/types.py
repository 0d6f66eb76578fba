"""What every domain offers: the `Environment` contract and the two records that cross it."""

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, runtime_checkable

import chex
import jax.numpy as jnp
import numpy as np
from flax import struct

from sumajax.records import exportable


@exportable
@struct.dataclass
class Observation:
    """What the agents know before they act (paper section IV-A, IV-C).

    Axes: N agents, C state channels (1 where the state is the agent's cell), (rows, columns) of the
    policy's grid, c entity channels, m = 2 vision + 1.
    """

    state: chex.Array  # (N, C, rows, columns) float32: the agent's own cell, one-hot (or upsampled)
    view: chex.Array  # (N, c, m, m) float32: entity counts around the agent, -1 outside the grid
    alive: chex.Array | None = None  # (N,) bool, needed where agents leave; None: all are there
    entered: chex.Array | None = None  # (N,) bool: has come with the last step; None: not told


@exportable
@struct.dataclass
class Transition:
    """What one step did to the team. `terminated` and `truncated` are never both true."""

    reward: chex.Array  # (N,) float32: individual rewards of this step
    terminated: chex.Array  # () bool: the team is done
    truncated: chex.Array  # () bool: not done, and the step limit is reached or passed
    success: chex.Array  # () bool: the completion condition holds after this step, in every mode
    steps_taken: chex.Array  # () int32: steps of this episode so far, this one included
    left: chex.Array | None = None  # (N,) bool: went for good with this step; None: nobody does


@runtime_checkable
class Environment(Protocol):
    """A cooperative task on a grid, as frozen configuration plus pure functions.

    No function keeps state, resets on its own or needs a key after `reset`: all of them can be
    traced, vmapped and scanned. Policies read shapes and classes; the learner reads the rest.

    A domain with chance in its steps takes a part of the key of `reset` into its state and splits
    it anew in every `step`: environments side by side, steps and episodes then all draw apart.

    Optional, used where a domain has them: `shortest_steps(state)`, () int32, the fewest
    steps that the team could still need; `sparse_states()`, the `states.SparseStates` that
    `state_table` lists, for large grids, whose table grows with the square of the cells;
    `critic_features(state)`, (N, F) float32, what a critic of its own is shown in training: what
    tells how each agent will fare, seen by anybody or not, in numbers that mean the same on any
    grid and in any team;
    `largest_reward`, a constant, the size of the largest reward that a step has for an agent, where
    a task does not pay in Predator-Prey's hundredths (`learning.rewards`);
    `merit`, a constant, the figure that says how well a team does, "steps_taken" or "success" (see
    `merit_of`); `figure_names`, F of them, and `measure(state, transition, following)`, (F, 2)
    float32, figures of the domain's own (see `measured`);
    `reset_in_epoch(key, epoch)`, a fresh episode of an epoch of training, of a task that becomes
    harder while it is learnt (see `resets`).
    """

    @property
    def max_steps(self) -> int:
        """The step limit of an episode."""

    @property
    def num_agents(self) -> int:
        """N."""

    @property
    def num_actions(self) -> int:
        """Size of the action space shared by all agents; `action_mask` narrows it."""

    @property
    def agent_class(self) -> np.ndarray:
        """(N,) int32: class of each agent, 0 for the first class; classes are contiguous."""

    @property
    def action_mask(self) -> np.ndarray:
        """(N, num_actions) bool: the actions that mean something to an agent."""

    @property
    def state_shape(self) -> tuple[int, int, int]:
        """(C, rows, columns) of `Observation.state`."""

    @property
    def view_shape(self) -> tuple[int, int, int]:
        """(c, m, m) of `Observation.view`."""

    @property
    def sighted_classes(self) -> tuple[bool, ...]:
        """For each agent class, whether its `view` carries information (blind ones read zeros)."""

    def reset(self, key: chex.PRNGKey) -> Any:
        """A fresh episode."""

    def step(self, state: Any, actions: chex.Array) -> tuple[Any, Transition]:
        """One step of the whole team; `actions` is (N,) int32.

        `truncated` is true at the step limit and past it, while the team is not done: a caller that
        steps on, or comes with a state of a longer limit, is told at every step.
        """

    def observe(self, state: Any) -> Observation:
        """What the agents see now; equals `state_table()[state_index(state)]` and `view(state)`."""

    def view(self, state: Any) -> chex.Array:
        """(N, c, m, m): the `view` part of `observe` alone."""

    def state_index(self, state: Any) -> chex.Array:
        """(N,) int32: the row of `state_table()` that is each agent's state tensor."""

    def state_table(self) -> chex.Array | None:
        """(S, C, rows, columns): every state tensor that can occur, so each is encoded once; None
        where there are too many to list."""

    def active(self, state: Any) -> chex.Array:
        """(N,) bool: agents whose next action can still change anything."""

    def alive(self, state: Any) -> chex.Array:
        """(N,) bool: agents that are in the task now; who is not sees, does and says nothing.

        Read only where the task says that agents come and go, by a constant `agents_leave = True`.
        Such a task also fills in `Observation.alive` and `Transition.left`; an agent that is alive
        after a step in which its place was left is another one. `Observation.entered`, who has come
        with the last step, into an empty place or one that was left, is for those who act on
        observations alone with a policy whose newcomers have no memory (`fresh_memory`).
        """


def resets(env: Environment, epoch: chex.Numeric) -> Callable[[chex.PRNGKey], Any]:
    """How episodes begin in epoch `epoch` of training, () int32 from 0 and perhaps traced.

    By `env.reset_in_epoch` where the task has it, and as everywhere else, by `env.reset`, where it
    does not change. What changes has to be in the state: an episode that is under way when an epoch
    ends stays as it began, and the next one is of the new epoch. `reset` is the task that training
    leads to, which evaluation plays.
    """
    changing = getattr(env, "reset_in_epoch", None)
    return env.reset if changing is None else partial(changing, epoch=epoch)


def merit_of(env: Environment) -> str:
    """The figure that says how well a team does on `env`: "steps_taken" until it is done, fewer
    being better, or "success", where every episode lasts as long."""
    return str(getattr(env, "merit", "steps_taken"))


def figure_names(env: Environment) -> tuple[str, ...]:
    """The figures that a domain has beside steps, success and return; none if it names none."""
    return tuple(getattr(env, "figure_names", ()))


def measured(env: Environment, state: Any, transition: Transition, following: Any) -> chex.Array:
    """(F, 2) float32: what one step adds to each of `figure_names(env)`, an amount and a count.

    Over steps and episodes both are added up, and the figure is all amounts over all counts: of
    collisions per car, the cars that have collided in the step and those that came with it.
    """
    if not figure_names(env):
        return jnp.zeros((0, 2), jnp.float32)
    return jnp.asarray(env.measure(state, transition, following), jnp.float32)  # type: ignore[attr-defined]


def agents_leave(env: Environment) -> bool:
    """Whether agents come and go within an episode of `env`; a task that does not say: no."""
    return bool(getattr(env, "agents_leave", False))
