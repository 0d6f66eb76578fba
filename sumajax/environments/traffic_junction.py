"""Traffic Junction (TJ): cars enter at random, follow their routes, and must not collide.

A car can only go on (gas) or stay (brake), and sees the cells around it. Who gives way to whom has
to be agreed, so cars that talk do better. Cars share a fixed number of slots: the agents. A slot
is alive while a car is in it, and one that a car left may be given to the next car at once.

Source: Sukhbaatar et al. 2016 (CommNet), Singh et al. 2019 (IC3Net) section 4 and IC3Net's
published program, whose rules these are, step by step (docs/traffic_junction.md). MAGIC's program
has the same.

`reset`, `step`, `observe` and the rest are plain functions of a frozen configuration; the methods
of `TrafficJunction` only call them.
"""

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar, Literal, get_args

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike

from sumajax.environments import grid
from sumajax.environments.actions import checked_actions
from sumajax.environments.roads import Difficulty, Roads, roads
from sumajax.environments.states import SparseStates
from sumajax.environments.types import Observation, Transition
from sumajax.plain import plain_fields
from sumajax.records import exportable

WAIT_REWARD = -0.01
"""Per car and step, times the steps since it entered (the original's TIMESTEP_PENALTY)."""
COLLISION_REWARD = -10.0
"""Per car and step in which it shares its cell (CRASH_PENALTY)."""

GAS, BRAKE = 0, 1

RATE_STEP = 0.01
"""A rate that rises is rounded down to a multiple of this."""

MAX_TABLE = 10_000_000
"""Numbers in a table of state tensors: beyond a hard junction of side 54 they are listed sparsely
alone."""

CRITIC_AHEAD, CRITIC_BEHIND = 8, 3
"""Cells of its own way, before and behind a car, of which `critic_features` tells who is there. A
collision further off is a matter of cars that have yet to brake or to come."""
CRITIC_TIME = 10.0
"""Unit of steps in `critic_features`."""

MAX_STEPS = 2**31 - 1
"""Steps are counted in int32."""

MAX_RATE_EPOCHS = 1_000_000
"""Rates are listed epoch by epoch, up to the last in which they change."""

Vocabulary = Literal["bool", "scalar"]
"""How the originals' flat observation names a cell: by one entry of many, or by its two numbers."""


@exportable
@struct.dataclass
class State:
    """One episode in progress. N slots; G entries."""

    place: chex.Array  # (N,) int32: row of `Roads.cell`; of an empty slot: where its last car left
    alive: chex.Array  # (N,) bool: a car is in the slot
    wait: chex.Array  # (N,) int32 steps since the car entered; 0 in empty slots
    last_action: chex.Array  # (N,) int32 of the slot's last car that stayed in, 0 gas or 1 brake
    failed: chex.Array  # () bool: cars have collided in this episode
    time: chex.Array  # () int32 steps taken so far
    arrival_rate: chex.Array  # () float32: chance of a car per entry and step
    hold_up: chex.Array  # () float32: chance that a car before a crossing is held up
    key: chex.PRNGKey  # () the arrivals still to be drawn


@exportable
@struct.dataclass
class Arrivals:
    """The cars that want to enter in one step, by entry, in the order in which they are let in."""

    happens: chex.Array  # (G,) bool
    slot: chex.Array  # (G,) int32 in 0..N-1; nothing happens where a car is in it
    choice: chex.Array  # (G,) int32: which of the entry's routes


@dataclass(frozen=True)
class TrafficJunction:
    """Configuration of the task, and its functions as methods.

    Fields that are None take the published value of their difficulty.

    Attributes:
      difficulty: `easy` (two one-way roads), `medium` (two two-way roads) or `hard` (four).
      size: of the grid: 6, 14, 18. Easy's grid has one row and one column more.
      num_cars: N, how many cars there can be at once: 5, 10, 20.
      vision: how many cells a car sees in each direction.
      max_steps: step limit, with which every episode ends: 20, 40, 80.
      arrival_rate: chance that a car enters, per entry and step: 0.3, 0.2, 0.05.
      final_arrival_rate: what the rate rises to in the course of training, and what the task is
        once that is over: an episode that is not of some epoch has it. None: it stays.
      rate_epochs: the first epoch in which it rises, and the first in which it no longer does.
      hold_up: chance, while it is learnt, that a car that is about to enter a crossing stays where
        it is, whatever it does. After `rate_epochs` it falls to 0, in as many epochs as these are,
        and it is 0 in episodes that are not of some epoch.
      reset_last_action: a new car has not braked. In the original it has if the last car that
        stayed in its slot did.

    Raises:
      ValueError: for a value out of range; the sentence names it and the mend.
    """

    difficulty: Difficulty = "easy"
    size: int = None  # type: ignore[assignment]
    num_cars: int = None  # type: ignore[assignment]
    vision: int = 1
    max_steps: int = None  # type: ignore[assignment]
    arrival_rate: float = None  # type: ignore[assignment]
    final_arrival_rate: float | None = None
    rate_epochs: tuple[int, int] = (250, 1250)
    hold_up: float = 0.0
    reset_last_action: bool = False

    class_names: ClassVar[tuple[str, ...]] = ("cars",)
    channels: ClassVar[tuple[str, ...]] = ("road", "cars", "outside", "last action")
    num_actions: ClassVar[int] = 2
    agents_leave: ClassVar[bool] = True
    largest_reward: ClassVar[float] = -COLLISION_REWARD
    merit: ClassVar[str] = "success"
    figure_names: ClassVar[tuple[str, ...]] = ("collisions_per_car", "mean_delay", "cars_through")

    def __post_init__(self) -> None:
        plain_fields(self)
        _one_of("difficulty", self.difficulty, get_args(Difficulty))
        for name, value in PUBLISHED[self.difficulty].items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        if isinstance(self.rate_epochs, list):  # as JSON has it
            object.__setattr__(self, "rate_epochs", tuple(self.rate_epochs))
        _validate(self)

    @property
    def roads(self) -> Roads:
        """Lanes, entries and routes."""
        return roads(self.difficulty, self.size)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the grid."""
        return self.roads.shape

    @property
    def num_agents(self) -> int:
        return self.num_cars

    @property
    def agent_class(self) -> np.ndarray:
        return np.zeros(self.num_cars, np.int32)

    @property
    def action_mask(self) -> np.ndarray:
        return np.ones((self.num_cars, self.num_actions), bool)

    @property
    def state_shape(self) -> tuple[int, int, int]:
        return (2, *self.shape)

    @property
    def view_shape(self) -> tuple[int, int, int]:
        side = 2 * self.vision + 1
        return (len(self.channels), side, side)

    @property
    def sighted_classes(self) -> tuple[bool, ...]:
        return (True,)

    @property
    def rises(self) -> bool:
        """Whether the rate changes while training goes on; in epoch 0 it never does."""
        last, (first_epoch, end) = self.final_arrival_rate, self.rate_epochs
        return last is not None and last > self.arrival_rate and end > max(first_epoch, 1)

    @property
    def last_arrival_rate(self) -> float:
        """The rate of the task that training leads to."""
        return self.final_arrival_rate if self.rises else self.arrival_rate  # type: ignore[return-value]

    def reset(self, key: chex.PRNGKey) -> State:
        return reset(self, key)

    def reset_in_epoch(self, key: chex.PRNGKey, epoch: chex.Numeric) -> State:
        return reset_in_epoch(self, key, epoch)

    def step(self, state: State, actions: chex.Array) -> tuple[State, Transition]:
        return step(self, state, actions)

    def step_with(
        self, state: State, actions: chex.Array, arrivals: Arrivals
    ) -> tuple[State, Transition]:
        return step_with(self, state, actions, arrivals)

    def observe(self, state: State) -> Observation:
        return observe(self, state)

    def view(self, state: State) -> chex.Array:
        return view(self, state)

    def state_index(self, state: State) -> chex.Array:
        return state_index(self, state)

    def state_table(self) -> np.ndarray | None:
        states = self.roads.states
        fits = len(states) * math.prod(self.state_shape) <= MAX_TABLE
        return states.dense() if fits else None

    def sparse_states(self) -> SparseStates:
        return self.roads.states

    def active(self, state: State) -> chex.Array:
        return state.alive

    def alive(self, state: State) -> chex.Array:
        return state.alive

    def collided(self, state: State) -> chex.Array:
        return collided(self, state)

    def measure(self, state: State, transition: Transition, following: State) -> chex.Array:
        return measure(self, state, transition, following)

    def critic_features(self, state: State) -> chex.Array:
        return critic_features(self, state)

    def rates(self, epochs: ArrayLike) -> np.ndarray:
        return rates(self, epochs)


PUBLISHED: dict[Difficulty, dict[str, Any]] = {
    "easy": {"size": 6, "num_cars": 5, "max_steps": 20, "arrival_rate": 0.3},
    "medium": {"size": 14, "num_cars": 10, "max_steps": 40, "arrival_rate": 0.2},
    "hard": {"size": 18, "num_cars": 20, "max_steps": 80, "arrival_rate": 0.05},
}
"""Sizes and step limits of IC3Net's commands, and the constant rates of MAGIC's."""

FIRST_RATES: dict[Difficulty, float] = {"easy": 0.1, "medium": 0.05, "hard": 0.02}
"""Where the rates of IC3Net's commands begin; they rise to those above."""
RISE = (1 / 8, 5 / 8)
"""The part of a training in which they rise: epochs 250 to 1250 of 2000."""
HELD = 2**32 - 1
"""Folded into an episode's key for who is held up; splitting it has no such number."""


def reset(
    env: TrafficJunction, key: chex.PRNGKey, arrival_rate: chex.Numeric | None = None
) -> State:
    """An episode's start: an empty junction. The first cars come with the first step.

    Args:
      key: from which the arrivals of this episode are drawn.
      arrival_rate: another rate than `env.last_arrival_rate`; may be traced.
    """
    rate = env.last_arrival_rate if arrival_rate is None else arrival_rate
    return State(
        place=jnp.full(env.num_cars, env.roads.nowhere, jnp.int32),
        alive=jnp.zeros(env.num_cars, bool),
        wait=jnp.zeros(env.num_cars, jnp.int32),
        last_action=jnp.zeros(env.num_cars, jnp.int32),
        failed=jnp.zeros((), bool),
        time=jnp.zeros((), jnp.int32),
        arrival_rate=jnp.asarray(rate, jnp.float32),
        hold_up=jnp.float32(0),
        key=key,
    )


def reset_in_epoch(env: TrafficJunction, key: chex.PRNGKey, epoch: chex.Numeric) -> State:
    """`reset` as it is while training goes on, at the rate of an epoch.

    Args:
      epoch: () int32, counted from 0; may be traced.

    Source: the curriculum of IC3Net's published program.
    """
    rate = None
    if env.rises:
        table = rate_table(env)
        rate = jnp.asarray(table)[jnp.clip(epoch, 0, len(table) - 1)]
    state = reset(env, key, rate)
    if not env.hold_up:
        return state
    first_epoch, end = env.rate_epochs
    left = jnp.clip(1 - (jnp.float32(epoch) - end) / max(end - first_epoch, 1), 0, 1)
    return state.replace(hold_up=env.hold_up * left)  # type: ignore[attr-defined]


def with_curriculum(env: TrafficJunction, epochs: int) -> TrafficJunction:
    """`env` with a rate that rises over a training of so many epochs as IC3Net's do.

    A task whose rate rises already, or begins no higher than the published rate does, stays as it
    is.
    """
    first = FIRST_RATES[env.difficulty]
    if env.final_arrival_rate is not None or env.arrival_rate <= first:
        return env
    return replace(
        env,
        arrival_rate=first,
        final_arrival_rate=env.arrival_rate,
        rate_epochs=(int(RISE[0] * epochs), int(RISE[1] * epochs)),
    )


@cache
def rate_table(env: TrafficJunction) -> np.ndarray:
    """(epochs,) float32: `rates` up to the first epoch after the last rise."""
    return rates(env, np.arange(env.rate_epochs[1] + 1)).astype(np.float32)


def step(env: TrafficJunction, state: State, actions: chex.Array) -> tuple[State, Transition]:
    """One step of all cars, and the arrivals after it, drawn with the key in the state.

    Args:
      actions: (N,) int32: 0 gas, 1 brake; those of empty slots mean nothing. Concrete values are
        checked; a traced value out of range is a brake.

    Raises:
      ValueError: for a concrete action out of range, a wrong shape or no whole numbers.
    """
    actions = checked_actions(env, actions)
    if env.hold_up:
        actions = _hold_up(env, state, actions)
    moved, left = _move(env, state, actions)
    key, draw_key = jax.random.split(state.key)
    arrivals = draw_arrivals(env, draw_key, moved.alive, moved.arrival_rate)
    return _arrive(env, moved.replace(key=key), left, arrivals)  # type: ignore[attr-defined]


def step_with(
    env: TrafficJunction, state: State, actions: chex.Array, arrivals: Arrivals
) -> tuple[State, Transition]:
    """`step` with given arrivals instead of drawn ones; the key stays as it is."""
    moved, left = _move(env, state, checked_actions(env, actions))
    return _arrive(env, moved, left, arrivals)


def draw_arrivals(
    env: TrafficJunction, key: chex.PRNGKey, alive: chex.Array, rate: chex.Numeric
) -> Arrivals:
    """The cars of one step: each entry has one with chance `rate`, while there is an empty slot.

    A car's slot is any of the empty ones and its route any of its entry's, all equally likely.

    Args:
      alive: (N,) bool: slots that hold a car before any of these enters.
    """
    num_entries, num_routes = env.roads.first_places.shape
    bits = jax.random.bits(key, (2, num_entries), jnp.uint32)
    wanted = bits[0].astype(jnp.float32) * np.float32(2.0**-32) <= rate
    earlier = jnp.stack([wanted[:g].sum(dtype=jnp.uint32) for g in range(num_entries)])
    empty = (~alive).sum(dtype=jnp.uint32)
    happens = wanted & (earlier < empty)
    # How many are left for this one; and one draw of which of them it takes, and of its route.
    left = jnp.where(happens, empty - earlier, 1)
    pair = grid.scale_to_range(bits[1], left * np.uint32(num_routes))
    draw, choice = pair // num_routes, pair % num_routes
    # Whoever takes an empty slot leaves the last of those left in its place (Fisher and Yates).
    # Nothing is swapped here: walking back over the earlier draws finds the slot.
    which, order = draw, np.arange(num_entries)
    for g in reversed(range(num_entries - 1)):
        swapped = (which == draw[g]) & (order > g) & happens[g]
        which = jnp.where(swapped, left[g] - 1, which)
    # The slot with `which` empty ones before it.
    up_to = jnp.cumsum(~alive, dtype=jnp.uint32)
    slot = (up_to <= which[:, None]).sum(-1, dtype=jnp.int32)
    return Arrivals(happens=happens, slot=slot, choice=choice.astype(jnp.int32))


def observe(env: TrafficJunction, state: State) -> Observation:
    """Own cell and the way ahead (N, 2, rows, columns), and the view (N, 4, m, m)."""
    route = jnp.asarray(env.roads.padded_routes)[jnp.asarray(env.roads.route)[state.place]]
    position = jnp.asarray(env.roads.position)[state.place][:, None]
    along = np.arange(route.shape[1])
    lit = jnp.stack([along == position, along > position], axis=1) & state.alive[:, None, None]
    # Whatever is not lit is put where no cell is.
    cells = jnp.where(lit[..., None], route[:, None], np.array(env.shape))
    row, column = jnp.moveaxis(cells, -1, 0)
    slots, channels = np.arange(env.num_cars)[:, None, None], np.arange(2)[:, None]
    tensor = jnp.zeros((env.num_cars, *env.state_shape))
    tensor = tensor.at[slots, channels, row, column].set(1, mode="drop")
    entered = state.alive & (state.wait == 0)
    return Observation(state=tensor, view=view(env, state), alive=state.alive, entered=entered)


def view(env: TrafficJunction, state: State) -> chex.Array:
    """(N, 4, m, m) float32: roads, cars, what is no road, and the own last action everywhere.

    Cars are counted, the own one included. What is no road and what is no grid look alike, as in
    the original. An empty slot reads zeros.
    """
    alive = state.alive[:, None, None]
    lines = jnp.asarray(env.roads.lines(env.vision))[state.place]
    road = lines[:, 0, :, None] * lines[:, 1, None] > 1
    cell = jnp.asarray(env.roads.cell)[state.place]
    cars = grid.window_count(cell, cell[None], env.vision)[:, 0]
    last_action = jnp.broadcast_to(state.last_action[:, None, None], road.shape)
    channels = [road, jnp.where(alive, cars, 0), ~road & alive, jnp.where(alive, last_action, 0)]
    # Of one type before they are put together: XLA's CPU code then copies whole windows.
    return jnp.stack([channel.astype(jnp.float32) for channel in channels], axis=1)


def state_index(env: TrafficJunction, state: State) -> chex.Array:
    """(N,) int32: the row of `state_table()`; places with the same cells ahead share one."""
    return jnp.asarray(env.roads.state_row)[state.place]


def collided(env: TrafficJunction, state: State) -> chex.Array:
    """(N,) bool: cars that share their cell."""
    cell = grid.cell_index(jnp.asarray(env.roads.cell)[state.place], env.shape)
    return ((cell[:, None] == cell).sum(-1) > 1) & state.alive


def critic_features(env: TrafficJunction, state: State) -> chex.Array:
    """(N, F) float32: what each car's future depends on, the routes of the others included.

    Of the cells of its own way from `CRITIC_BEHIND` behind it to `CRITIC_AHEAD` before it, as far
    as the way goes: whether it is one, how many others are there, and how many will be one step
    before it, at the same time and one step after it, if nobody brakes. Of itself: whether it has
    just entered or braked, steps since it entered. Of the junction: share of slots that are empty,
    arrival rate, steps left. Empty slots read zeros.
    """
    offsets = np.arange(-CRITIC_BEHIND, CRITIC_AHEAD + 1)
    cells = _along(env, state, np.arange(-CRITIC_BEHIND - 1, CRITIC_AHEAD + 2))  # (N, K + 2)
    own, now = cells[:, None, 1:-1], cells[None, :, CRITIC_BEHIND + 1, None]
    # Who gets where: another is on its own k-th cell when this car is on its k-th, or a step apart.
    at_times = [cells[None, :, 1 + lag : len(offsets) + 1 + lag] for lag in (-1, 0, 1)]
    others = ~np.eye(env.num_cars, dtype=bool)[..., None] & (own >= 0)
    counts = [((own == there) & others).sum(1) for there in (now, *at_times)]
    shared = [
        (~state.alive).mean(dtype=jnp.float32),
        state.arrival_rate,
        jnp.minimum((env.max_steps - state.time) / CRITIC_TIME, 1),
    ]
    itself = [state.wait == 0, state.last_action, state.wait / CRITIC_TIME]
    figures = [*itself, *(jnp.broadcast_to(x, env.num_cars) for x in shared)]
    of_cells = [x.astype(jnp.float32) for x in (own[:, 0] >= 0, *counts)]
    rest = jnp.stack([x.astype(jnp.float32) for x in figures], axis=-1)
    features = jnp.concatenate([*of_cells, rest], axis=-1)
    return jnp.where(state.alive[:, None], features, 0)


def measure(
    env: TrafficJunction, state: State, transition: Transition, following: State
) -> chex.Array:
    """(3, 2) float32: amount and count of what success alone does not tell.

    * Collisions per car: steps in which a car shares its cell, of all that came.
    * Mean delay: steps that a car was in the junction beyond its route's length, of all that came.
      Nothing but its own brake holds a car up, so these are the steps it braked in.
    * Cars through: cars that left, per episode.
    """
    left = transition.left
    assert left is not None
    stays = state.alive & ~left
    came = (following.alive & ~stays).sum()
    waits = (stays & (following.place == state.place)).sum()
    collisions = collided(env, following).sum()
    pairs = [(collisions, came), (waits, came), (left.sum(), transition.truncated)]
    return jnp.stack([jnp.stack(pair).astype(jnp.float32) for pair in pairs])


def rates(env: TrafficJunction, epochs: ArrayLike) -> np.ndarray:
    """(E,) float64 arrival rate of training epochs, in the order in which they are trained.

    A rate that rises is rounded down to hundredths by float division, as in the original: 0.3
    becomes 0.29.

    Args:
      epochs: (E,) int, counted from 0; `np.arange(E)` for a whole run.
    """
    exact = exact_rates(env, epochs)
    return np.where(exact > env.arrival_rate, RATE_STEP * (exact // RATE_STEP), exact)


def exact_rates(env: TrafficJunction, epochs: ArrayLike) -> np.ndarray:
    """(E,) float64: `rates` before rounding.

    Each epoch of `rate_epochs` adds an equal part when it is first reached; epoch 0 adds none. The
    parts are added one after another, as in the original.
    """
    (start, end), first = env.rate_epochs, env.arrival_rate
    last = first if env.final_arrival_rate is None else env.final_arrival_rate
    epochs = np.asarray(epochs)
    reached = np.maximum.accumulate(np.concatenate([[0], epochs]))[:-1]
    rises = (epochs > reached) & (start <= epochs) & (epochs < end) & (last > first)
    parts = np.where(rises, (last - first) / max(end - start, 1), 0.0)
    return np.cumsum(np.concatenate([[first], parts]))[1:]


def flat_observation(
    env: TrafficJunction, state: State, vocabulary: Vocabulary = "bool"
) -> chex.Array:
    """(N, length) float32: the original's observation, for comparison with it; zeros when empty.

    Last action, route id over the largest, then with `scalar` the own row and column over the
    largest, then the window's cells, each as a one-hot of its class and a count of cars (`bool`) or
    as a road flag and the count (`scalar`). Two faults of the original are kept: empty slots are
    counted as cars at (0, 0), and the last cells of easy's column have the entry that stands for no
    road and the one after it.

    Raises:
      ValueError: for an unknown vocabulary.
    """
    _one_of("vocabulary", vocabulary, get_args(Vocabulary))
    where = env.roads
    cell = jnp.where(state.alive[:, None], jnp.asarray(where.cell)[state.place], 0)
    window = cell[:, None, None] + grid.window_offsets(env.vision)
    outside = grid.window_outside(cell, env.vision, env.shape)
    inside = jnp.clip(window, 0, np.array(env.shape) - 1)
    cars = grid.window_count(cell, cell[None], env.vision)[:, 0]

    def around(table: np.ndarray, beyond: int) -> chex.Array:
        there = jnp.asarray(table)[inside[..., 0], inside[..., 1]]
        return jnp.where(outside, beyond, there)

    own = [
        state.last_action[:, None],
        jnp.asarray(where.route)[state.place][:, None] / (len(where.routes) - 1),
    ]
    if vocabulary == "scalar":
        own.append(cell / (np.array(env.shape) - 1))
        cells = jnp.stack([around(where.road, 0), cars], axis=-1)
    else:
        classes = around(where.classes, where.outside_class)
        classes = jax.nn.one_hot(classes, where.outside_class + 2)
        cells = jnp.concatenate([classes, cars[..., None]], axis=-1)
    flat = jnp.concatenate([*own, cells.reshape(env.num_cars, -1)], axis=-1)
    return jnp.where(state.alive[:, None], flat, 0).astype(jnp.float32)


def _hold_up(env: TrafficJunction, state: State, actions: chex.Array) -> chex.Array:
    """(N,) what the cars do where some of those before a crossing have to brake.

    Arrivals are the same with and without, so evaluations are of the same episodes.
    """
    key = jax.random.fold_in(state.key, HELD)
    held = jax.random.bernoulli(key, state.hold_up, actions.shape)
    return jnp.where(held & jnp.asarray(env.roads.gives_way)[state.place], BRAKE, actions)


def _along(env: TrafficJunction, state: State, steps: np.ndarray) -> chex.Array:
    """(N, K) int32 numbers of the cells so many `steps` (K,) on along each car's way; negative
    where it does not go, and for empty slots.
    """
    numbers = grid.cell_index(env.roads.padded_routes, env.shape)
    ways = np.pad(numbers, ((0, 0), (1, 1)), constant_values=grid.NOWHERE)
    position = jnp.asarray(env.roads.position)[state.place][:, None] + steps
    position = jnp.clip(position + 1, 0, ways.shape[1] - 1)  # the first and last are no cells
    cells = jnp.asarray(ways)[jnp.asarray(env.roads.route)[state.place][:, None], position]
    return jnp.where(state.alive[:, None], cells, grid.NOWHERE)


def _move(env: TrafficJunction, state: State, actions: chex.Array) -> tuple[State, chex.Array]:
    """Every car goes on or stays; and (N,) bool: the cars that left the junction."""
    goes = state.alive & (actions == GAS)
    place = state.place + goes
    left = goes & jnp.asarray(env.roads.ended)[place]
    alive = state.alive & ~left
    moved = state.replace(  # type: ignore[attr-defined]
        place=place,
        alive=alive,
        wait=jnp.where(alive, state.wait + 1, 0),
        last_action=jnp.where(alive, (~goes).astype(jnp.int32), state.last_action),
    )
    return moved, left


def _arrive(
    env: TrafficJunction, state: State, left: chex.Array, arrivals: Arrivals
) -> tuple[State, Transition]:
    """New cars enter, then everybody is paid."""
    slots, place, alive = np.arange(env.num_cars), state.place, state.alive
    for g, first_places in enumerate(env.roads.first_places):
        enters = arrivals.happens[g] & (arrivals.slot[g] == slots) & ~alive
        place = jnp.where(enters, jnp.asarray(first_places)[arrivals.choice[g]], place)
        alive = alive | enters
    last_action = state.last_action
    if env.reset_last_action:
        last_action = jnp.where(alive & ~state.alive, GAS, last_action)
    following = state.replace(  # type: ignore[attr-defined]
        place=place, alive=alive, last_action=last_action, time=state.time + 1
    )
    collision = collided(env, following)
    failed = state.failed | collision.any()
    reward = WAIT_REWARD * following.wait + COLLISION_REWARD * collision
    transition = Transition(
        reward=jnp.where(alive, reward, 0).astype(jnp.float32),
        terminated=jnp.zeros((), bool),
        truncated=following.time >= env.max_steps,
        success=~failed,
        steps_taken=following.time,
        left=left,
    )
    return following.replace(failed=failed), transition


def _one_of(name: str, value: Any, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} {value!r} is unknown; choose one of {', '.join(choices)}.")


def _validate(env: TrafficJunction) -> None:
    least_values = {"size": 1, "num_cars": 2, "vision": 0, "max_steps": 1}
    for name, least in least_values.items():
        value = getattr(env, name)
        if isinstance(value, bool) or not isinstance(value, int):
            raise ValueError(f"{name} must be a whole number, got {value!r}.")
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}.")
    if env.max_steps > MAX_STEPS:
        raise ValueError(f"max_steps must be at most {MAX_STEPS}, got {env.max_steps}.")
    if env.size > grid.MAX_SIDE - 1:
        raise ValueError(f"size must be at most {grid.MAX_SIDE - 1}, got {env.size}.")
    if env.difficulty == "hard":
        if env.size % 3 or env.size < 9:
            raise ValueError(
                f"size {env.size} of the hard junction must be a multiple of 3, at least 9."
            )
    elif env.size % 2 or env.size < 4 + env.vision:
        raise ValueError(
            f"size {env.size} of the {env.difficulty} junction must be even and at least "
            f"{4 + env.vision}, which is 4 and the vision."
        )
    for name in ("arrival_rate", "final_arrival_rate", "hold_up"):
        rate = getattr(env, name)
        if name == "final_arrival_rate" and rate is None:
            continue
        number = isinstance(rate, (int, float)) and not isinstance(rate, bool)
        if not number or not 0 <= rate <= 1:
            raise ValueError(f"{name} is a chance between 0 and 1, got {rate!r}.")
    epochs = env.rate_epochs
    pair = isinstance(epochs, tuple) and len(epochs) == 2
    if not pair or not all(isinstance(epoch, int) for epoch in epochs):
        raise ValueError(f"rate_epochs are two whole numbers, first and end, got {epochs!r}.")
    if epochs[1] > MAX_RATE_EPOCHS:
        raise ValueError(f"rate_epochs must end by {MAX_RATE_EPOCHS}, got {epochs!r}.")
