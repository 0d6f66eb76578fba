"""Predator-Capture-Prey (PCP), and the engine of Predator-Prey, its case without capture agents.

Predators with limited sight and blind capture agents look for one stationary prey. Everybody must
reach it, and each capture agent must then also capture it. Source: Seraj et al. 2022 (HetNet) and
its published program; Singh et al. 2019 (IC3Net) for the predators' part.

`reset`, `step`, `observe` and the rest are plain functions of a frozen configuration; the methods
of `PredatorCapturePrey` only call them.
"""

from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal, get_args

import chex
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike

from sumajax.environments import grid
from sumajax.environments.actions import checked_actions, is_traced
from sumajax.environments.states import SparseStates, one_hot_states
from sumajax.environments.types import Observation, Transition
from sumajax.plain import plain_fields
from sumajax.records import exportable

STEP_REWARD = -0.05
"""Per agent and step while its work is not done (the originals' TIMESTEP_PENALTY)."""
PREY_REWARD = 0.05
"""Per agent on the prey in the cooperative and competitive modes (POS_PREY_REWARD)."""
NEAR_CAPTURE_REWARD = -0.025
"""Second reward scheme: a capture agent that stands on the prey but has not captured it."""

MAX_STEPS = 2**31 - 1
"""Steps are counted in int32."""

NEARNESS = (0.9, 0.97, 0.99)
"""Bases of `critic_features`: a power of the way that is left tells apart ways of up to some 10, 30
and 100 steps."""
OFFSET_UNIT = 10.0
"""Cells, of the offsets in `critic_features`: the side of a middling grid."""

PREDATOR, CAPTURER = 0, 1

RewardMode = Literal["mixed", "cooperative", "competitive"]
CaptureReward = Literal["default", "second"]


@exportable
@struct.dataclass
class State:
    """One episode in progress. N agents: predators first, then capture agents."""

    agents: chex.Array  # (N, 2) int32 cells
    prey: chex.Array  # (2,) int32 cell
    reached: chex.Array  # (N,) bool: has stood on the prey; such an agent never moves again
    captured: chex.Array  # (N,) bool: nothing left to capture; true for predators from the start
    time: chex.Array  # () int32 steps taken so far


@dataclass(frozen=True)
class PredatorCapturePrey:
    """Configuration of the task, and its functions as methods.

    Attributes:
      size: side of a square grid, or (rows, columns).
      num_predators, num_capturers: team sizes; either may be 0, not both.
      vision: how many cells a predator sees in each direction; smaller than the grid's sides.
      max_steps: step limit of an episode.
      reward_mode: `mixed` pays -0.05 until an agent is done and ends with the team; `cooperative`
        and `competitive` pay on the prey and always run to the step limit.
      capture_reward: `default`, or `second`: only half the penalty on the prey before capturing.
      capture_vision: how far capture agents see, at most `vision`; None: they are blind.

    Raises:
      ValueError: for a value out of range; the sentence names it and the mend.
    """

    size: int | tuple[int, int] = 5
    num_predators: int = 2
    num_capturers: int = 1
    vision: int = 1
    max_steps: int = 80
    reward_mode: RewardMode = "mixed"
    capture_reward: CaptureReward = "default"
    capture_vision: int | None = None

    class_names: ClassVar[tuple[str, ...]] = ("predators", "capturers")
    entities: ClassVar[tuple[str, ...]] = ("predators", "capturers", "prey")
    num_actions: ClassVar[int] = 6

    def __post_init__(self) -> None:
        plain_fields(self)
        object.__setattr__(self, "size", grid.plain_size(self.size))
        _validate(self)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return grid.grid_size(self.size)

    @property
    def num_agents(self) -> int:
        return self.num_predators + self.num_capturers

    @property
    def agent_class(self) -> np.ndarray:
        return np.repeat(
            np.array([PREDATOR, CAPTURER], np.int32), [self.num_predators, self.num_capturers]
        )

    @property
    def action_mask(self) -> np.ndarray:
        mask = np.ones((self.num_agents, self.num_actions), bool)
        mask[self.agent_class == PREDATOR, grid.CAPTURE :] = False
        return mask

    @property
    def state_shape(self) -> tuple[int, int, int]:
        return (1, *self.shape)

    @property
    def view_shape(self) -> tuple[int, int, int]:
        side = 2 * self.vision + 1
        return (len(self.entities), side, side)

    @property
    def sighted_classes(self) -> tuple[bool, ...]:
        return (True, self.capture_vision is not None)

    def reset(self, key: chex.PRNGKey) -> State:
        return reset(self, key)

    def state_at(self, agents: ArrayLike, prey: ArrayLike) -> State:
        return state_at(self, agents, prey)

    def step(self, state: State, actions: chex.Array) -> tuple[State, Transition]:
        return step(self, state, actions)

    def observe(self, state: State) -> Observation:
        return observe(self, state)

    def view(self, state: State) -> chex.Array:
        return view(self, state)

    def state_index(self, state: State) -> chex.Array:
        return grid.cell_index(state.agents, self.shape)

    def state_table(self) -> chex.Array:
        return grid.one_hot_cells(self.shape)

    def sparse_states(self) -> SparseStates:
        return one_hot_states(self.shape)

    def active(self, state: State) -> chex.Array:
        return active(self, state)

    def alive(self, state: State) -> chex.Array:
        return jnp.ones(self.num_agents, bool)

    def shortest_steps(self, state: State) -> chex.Array:
        return shortest_steps(self, state)

    def critic_features(self, state: State) -> chex.Array:
        return critic_features(self, state)


def reset(env: PredatorCapturePrey, key: chex.PRNGKey) -> State:
    """A fresh episode: agents and prey on distinct cells, every placement equally likely."""
    cells = grid.place_distinct(key, env.num_agents + 1, env.shape)
    return _start(env, cells[:-1], cells[-1])


def state_at(env: PredatorCapturePrey, agents: ArrayLike, prey: ArrayLike) -> State:
    """A chosen start, for tests and replays: agents (N, 2), prey (2,), distinct from every agent.

    Raises:
      ValueError: when a cell lies outside the grid or an agent starts on the prey; checked only
        for concrete values, since a traced value is not known yet.
    """
    agents, prey = jnp.asarray(agents, jnp.int32), jnp.asarray(prey, jnp.int32)
    if agents.shape != (env.num_agents, 2) or prey.shape != (2,):
        raise ValueError(
            f"state_at needs agents of shape ({env.num_agents}, 2) and prey of shape (2,), "
            f"got {agents.shape} and {prey.shape}."
        )
    if not is_traced(agents, prey):
        for name, cells in (("agent", np.asarray(agents)), ("prey", np.asarray(prey)[None])):
            outside = (cells < 0).any(-1) | (cells >= np.array(env.shape)).any(-1)
            if outside.any():
                raise ValueError(
                    f"{name} cell {tuple(cells[outside][0].tolist())} lies outside the "
                    f"{env.shape[0]}x{env.shape[1]} grid; rows and columns count from 0."
                )
        if (np.asarray(agents) == np.asarray(prey)).all(-1).any():
            raise ValueError(
                f"an agent starts on the prey at {tuple(np.asarray(prey).tolist())}; "
                "agents must start elsewhere."
            )
    return _start(env, agents, prey)


def step(env: PredatorCapturePrey, state: State, actions: chex.Array) -> tuple[State, Transition]:
    """One step of the whole team, without a reset at the end.

    Args:
      actions: (N,) int32: 0 up, 1 right, 2 down, 3 left, 4 stay, 5 capture (means something only to
        a capture agent that already stands on the prey). Concrete values are checked; a traced
        value out of range is a stay.

    Raises:
      ValueError: for a concrete action out of range, a wrong shape or no whole numbers.
    """
    actions = checked_actions(env, actions)
    was_on_prey = (state.agents == state.prey[None]).all(-1)
    captured = state.captured | (was_on_prey & (actions == grid.CAPTURE))
    moved = grid.move(state.agents, actions, env.shape)
    agents = jnp.where(state.reached[:, None], state.agents, moved)
    on_prey = (agents == state.prey[None]).all(-1)
    reached = state.reached | on_prey
    time = state.time + 1
    success = (on_prey & captured).all()
    terminated = success if env.reward_mode == "mixed" else jnp.zeros_like(success)
    transition = Transition(
        reward=_reward(env, on_prey, captured),
        terminated=terminated,
        truncated=(time >= env.max_steps) & ~terminated,
        success=success,
        steps_taken=time,
    )
    next_state = State(agents, state.prey, reached, captured, time)
    return next_state, transition


def observe(env: PredatorCapturePrey, state: State) -> Observation:
    """Own cell one-hot (N, 1, rows, columns) and entity counts around each agent (N, c, m, m)."""
    return Observation(state=grid.one_hot_position(state.agents, env.shape), view=view(env, state))


def view(env: PredatorCapturePrey, state: State) -> chex.Array:
    """(N, c, m, m) float32: counts of predators, (PCP: capture agents) and prey around each agent.

    Cells outside the grid are -1 in every channel. A blind agent reads zeros; one with less vision
    than the window reads -1 beyond it.
    """
    counts = grid.window_count(state.agents, _entities(env, state), env.vision)
    outside = grid.window_outside(state.agents, env.vision, env.shape)
    # Nobody stands outside, so the counts there are zero.
    seen = (counts + grid.OUTSIDE * outside[:, None].astype(counts.dtype)).astype(jnp.float32)
    if env.num_capturers == 0:
        return seen
    is_capturer = (env.agent_class == CAPTURER)[:, None, None, None]
    if env.capture_vision is None:
        return jnp.where(is_capturer, 0.0, seen)
    beyond = np.abs(grid.window_offsets(env.vision)).max(-1) > env.capture_vision
    return jnp.where(is_capturer & beyond, grid.OUTSIDE, seen)


def _entities(env: PredatorCapturePrey, state: State) -> chex.Array:
    """(c, M, 2) int32: the cells of each class, filled up to the largest class."""
    cells = {
        "predators": state.agents[: env.num_predators],
        "capturers": state.agents[env.num_predators :],
        "prey": state.prey[None],
    }
    most = max(env.num_predators, env.num_capturers, 1)
    fill_up = partial(jnp.pad, constant_values=grid.NOWHERE)
    classes = [cells[name] for name in env.entities]
    return jnp.stack([fill_up(c, ((0, most - c.shape[0]), (0, 0))) for c in classes])


def active(env: PredatorCapturePrey, state: State) -> chex.Array:
    """(N,) bool: not yet on the prey, or on it with the capture still to do."""
    return ~(state.reached & state.captured)


def shortest_steps(env: PredatorCapturePrey, state: State) -> chex.Array:
    """() int32: the fewest steps in which the team can be done if it knew where the prey is.

    The bound that no policy beats: the longest shortest path, one step more for a capture agent.
    """
    distance = jnp.abs(state.agents - state.prey[None]).sum(-1, dtype=jnp.int32)
    return (distance + (~state.captured).astype(jnp.int32)).max()


def critic_features(env: PredatorCapturePrey, state: State) -> chex.Array:
    """(N, 15) float32: what each agent's future depends on, prey and team-mates included.

    Of itself: offset to the prey (rows, columns, in units of `OFFSET_UNIT`), nearness to it at each
    scale of `NEARNESS`, whether it has reached and captured it, whether it sees it, whether it can
    capture. Of the team: mean and greatest nearness at each scale but the last, share of agents
    that are done, whether anybody sees the prey.
    """
    offset = (state.prey[None] - state.agents).astype(jnp.float32)
    way = jnp.abs(offset).sum(-1, keepdims=True)
    nearness = jnp.concatenate([base**way for base in NEARNESS], axis=-1)
    done = state.reached & state.captured
    sight = jnp.asarray([env.vision, -1 if env.capture_vision is None else env.capture_vision])
    sees = jnp.abs(offset).max(-1) <= sight[env.agent_class].astype(jnp.float32)
    flags = jnp.stack([state.reached, state.captured, sees, env.agent_class == CAPTURER], -1)
    of_team = jnp.concatenate(
        [
            nearness[:, :-1].mean(0),
            nearness[:, :-1].max(0),
            jnp.stack([done.astype(jnp.float32).mean(), sees.any().astype(jnp.float32)]),
        ]
    )
    of_team = jnp.broadcast_to(of_team[None], (env.num_agents, of_team.shape[0]))
    own = [offset / OFFSET_UNIT, nearness, flags.astype(jnp.float32)]
    return jnp.concatenate([*own, of_team], axis=-1).astype(jnp.float32)


def _start(env: PredatorCapturePrey, agents: chex.Array, prey: chex.Array) -> State:
    return State(
        agents=agents,
        prey=prey,
        reached=jnp.zeros(env.num_agents, bool),
        captured=jnp.asarray(env.agent_class != CAPTURER),
        time=jnp.zeros((), jnp.int32),
    )


def _reward(env: PredatorCapturePrey, on_prey: chex.Array, captured: chex.Array) -> chex.Array:
    """(N,) float32 from the flags after the step: the capturing step itself is paid as done."""
    team_on_prey = on_prey.sum(dtype=jnp.float32)
    paid_on_prey = {
        "mixed": jnp.float32(0.0),
        "cooperative": PREY_REWARD * team_on_prey,
        "competitive": PREY_REWARD / jnp.maximum(team_on_prey, 1),
    }[env.reward_mode]
    waiting = NEAR_CAPTURE_REWARD if env.capture_reward == "second" else STEP_REWARD
    reward = jnp.where(on_prey, jnp.where(captured, paid_on_prey, waiting), STEP_REWARD)
    return reward.astype(jnp.float32)


def _validate(env: PredatorCapturePrey) -> None:
    rows, columns = env.shape
    for name in ("num_predators", "num_capturers", "vision", "max_steps", "capture_vision"):
        value = getattr(env, name)
        if name == "capture_vision" and value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int):
            raise ValueError(f"{name} must be a whole number, got {value!r}.")
    least_values = {"num_predators": 0, "num_capturers": 0, "vision": 0, "max_steps": 1}
    for name, least in least_values.items():
        if getattr(env, name) < least:
            raise ValueError(f"{name} must be at least {least}, got {getattr(env, name)}.")
    if max(rows, columns) > grid.MAX_SIDE:
        raise ValueError(
            f"the {rows}x{columns} grid is too large; its sides have at most {grid.MAX_SIDE} cells."
        )
    if env.max_steps > MAX_STEPS:
        raise ValueError(f"max_steps must be at most {MAX_STEPS}, got {env.max_steps}.")
    if env.num_agents < 1:
        raise ValueError("the team is empty; give at least one predator or capture agent.")
    if env.num_agents + 1 > rows * columns:
        raise ValueError(
            f"{env.num_agents} agents and a prey need {env.num_agents + 1} distinct cells, but a "
            f"{rows}x{columns} grid has {rows * columns}; use fewer agents or a larger grid."
        )
    if env.vision >= min(rows, columns):
        raise ValueError(
            f"vision {env.vision} must be smaller than the sides of the {rows}x{columns} grid; "
            f"use at most {min(rows, columns) - 1}."
        )
    for name, choices in (("reward_mode", RewardMode), ("capture_reward", CaptureReward)):
        if getattr(env, name) not in get_args(choices):
            raise ValueError(
                f"{name} {getattr(env, name)!r} is unknown; choose one of "
                f"{', '.join(get_args(choices))}."
            )
    if env.capture_vision is not None and not 0 <= env.capture_vision <= env.vision:
        raise ValueError(
            f"capture_vision {env.capture_vision} must lie between 0 and vision {env.vision}, "
            "or be None for blind capture agents."
        )
