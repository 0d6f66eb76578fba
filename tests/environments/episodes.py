"""What the tests of both domains share: compiled steps, whole episodes, a policy that knows all."""

from dataclasses import dataclass
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st

from sumajax.environments import PredatorCapturePrey
from sumajax.environments.grid import CAPTURE, DOWN, LEFT, RIGHT, STAY, UP
from sumajax.environments.predator_capture_prey import CAPTURER, State

EPISODES = 6000
"""Behind each of the published levels of policies that need no learning, and behind ours."""

reset = jax.jit(lambda env, key: env.reset(key), static_argnums=0)
step = jax.jit(lambda env, state, actions: env.step(state, actions), static_argnums=0)
view = jax.jit(lambda env, state: env.view(state), static_argnums=0)
reset_many = jax.jit(
    lambda env, key, count: jax.vmap(env.reset)(jax.random.split(key, count)),
    static_argnums=(0, 2),
)


def play(env: PredatorCapturePrey, state: State, plan: list):
    """The states and transitions of a plan: one list of the agents' actions per step."""
    states, transitions = [state], []
    for actions in plan:
        state, transition = step(env, state, jnp.asarray(actions))
        states.append(state)
        transitions.append(transition)
    return states, transitions


@partial(jax.jit, static_argnums=0)
def play_recorded(env: PredatorCapturePrey, state: State, actions):
    """States after each step and transitions (T, ...) of actions (T, N)."""

    def one_step(state, actions):
        state, transition = env.step(state, actions)
        return state, (state, transition)

    return jax.lax.scan(one_step, state, actions)[1]


def random_actions(env: PredatorCapturePrey, key, shape: tuple[int, ...]):
    """(*shape, N) uniform over what each agent's class can do: 5 actions, 6 for capture agents."""
    choices = env.action_mask.sum(-1)
    return jnp.floor(jax.random.uniform(key, (*shape, env.num_agents)) * choices).astype(jnp.int32)


def shortest_path_actions(env: PredatorCapturePrey, state: State):
    """(N,) the way to the prey along the rows, then along the columns, then capture."""
    down, right = jnp.moveaxis(state.prey - state.agents, -1, 0)
    arrived = jnp.where(env.agent_class == CAPTURER, CAPTURE, STAY)
    along_columns = jnp.where(right > 0, RIGHT, jnp.where(right < 0, LEFT, arrived))
    return jnp.where(down > 0, DOWN, jnp.where(down < 0, UP, along_columns))


@partial(jax.jit, static_argnums=(0, 1))
def episode_lengths(env: PredatorCapturePrey, choose, states: State, keys):
    """(E,) steps taken from `states` (E, ...) by `choose`(env, states, key), one key per step."""

    def one_step(carry, key):
        states, going, length = carry
        states, transition = jax.vmap(env.step)(states, choose(env, states, key))
        return (states, going & ~transition.terminated, length + going), None

    count = states.time.shape[0]
    start = (states, jnp.ones(count, bool), jnp.zeros(count, jnp.int32))
    (_, going, length), _ = jax.lax.scan(one_step, start, keys)
    return jnp.where(going, keys.shape[0] + 1, length)


@cache
def random_lengths(env: PredatorCapturePrey) -> np.ndarray:
    """(EPISODES,) steps taken by uniformly random agents; one more than the limit: never done."""
    states = reset_many(env, jax.random.key(0), EPISODES)
    keys = jax.random.split(jax.random.key(1), env.max_steps)
    choose = lambda env, states, key: random_actions(env, key, states.time.shape)  # noqa: E731
    return np.asarray(episode_lengths(env, choose, states, keys))


def assert_level(length: np.ndarray, limit: int, steps: float, error: float, success: float):
    """Steps taken and success under a step limit agree with published ones, within rounding."""
    taken, done = np.minimum(length, limit), length <= limit
    assert abs(taken.mean() - steps) < 4 * np.hypot(taken.std() / EPISODES**0.5, error) + 0.005
    success_error = (2 * success * (1 - success) / EPISODES) ** 0.5
    assert abs(done.mean() - success) < 4 * success_error + 0.001


def assert_shortest_paths(env: PredatorCapturePrey, steps: float) -> None:
    """The published mean of the shortest paths is ours, within the error of the published one."""
    bound = np.asarray(jax.vmap(env.shortest_steps)(reset_many(env, jax.random.key(0), 100_000)))
    assert abs(bound.mean() - steps) < 4 * bound.std() / EPISODES**0.5 + 0.005


def assert_bound_is_reached(env: PredatorCapturePrey) -> None:
    """Walking straight to the prey takes just as long as `shortest_steps` says."""
    states = reset_many(env, jax.random.key(0), 500)
    keys = jax.random.split(jax.random.key(1), env.max_steps)
    length = episode_lengths(env, walk_straight, states, keys)
    np.testing.assert_array_equal(length, jax.vmap(env.shortest_steps)(states))


def walk_straight(env: PredatorCapturePrey, states: State, key):
    return jax.vmap(partial(shortest_path_actions, env))(states)


@partial(jax.jit, static_argnums=0)
def random_moment(env: PredatorCapturePrey, seed):
    """A state in the middle of an episode, likely with some agents on the prey, and actions."""
    keys = jax.random.split(jax.random.key(seed), 3)
    states, _ = play_recorded(env, env.reset(keys[0]), random_actions(env, keys[1], (12,)))
    return jax.tree.map(lambda leaf: leaf[-1], states), random_actions(env, keys[2], ())


def take(tree, index: int):
    """Entry `index` of the leading axis of every leaf."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree)


def assert_same(ours, theirs) -> None:
    """Two trees of arrays are equal to the last bit, shapes and types included."""
    jax.tree.map(partial(np.testing.assert_array_equal, strict=True), ours, theirs)


def reorder(state: State, order) -> State:
    """The same state with its agents listed in another order."""
    agents, reached, captured = (
        np.asarray(leaf)[order] for leaf in (state.agents, state.reached, state.captured)
    )
    return state.replace(agents=agents, reached=reached, captured=captured)


@dataclass(frozen=True)
class Symmetry:
    """One of the eight ways to lay a square grid on itself: quarter turns, then a mirror image."""

    quarter_turns: int  # counterclockwise, as in numpy.rot90
    mirrored: bool  # left to right

    def cells(self, cells, side: int):
        row, column = np.moveaxis(np.asarray(cells), -1, 0)
        for _ in range(self.quarter_turns):
            row, column = side - 1 - column, row
        return np.stack([row, side - 1 - column if self.mirrored else column], axis=-1)

    def windows(self, windows):
        windows = np.rot90(windows, self.quarter_turns, axes=(-2, -1))
        return windows[..., ::-1] if self.mirrored else windows

    def actions(self, actions):
        actions = np.asarray(actions)
        turned = np.array([LEFT, UP, RIGHT, DOWN, STAY, CAPTURE], np.int32)
        mirrored = np.array([UP, LEFT, DOWN, RIGHT, STAY, CAPTURE], np.int32)
        for _ in range(self.quarter_turns):
            actions = turned[actions]
        return mirrored[actions] if self.mirrored else actions

    def state(self, state: State, side: int) -> State:
        return state.replace(
            agents=self.cells(state.agents, side), prey=self.cells(state.prey, side)
        )


symmetries = st.builds(Symmetry, st.integers(0, 3), st.booleans())
