"""Held-out episodes, sampled and greedy; a random policy and the shortest paths beside them."""

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct

from sumajax import checkpoint
from sumajax.checkpoint import CheckpointError
from sumajax.environments.types import Environment, Observation
from sumajax.learning.rollout import Actors, act, select, start, state_features
from sumajax.policies.types import Policy

HELD_OUT_SEED = 20_240_229
"""Of the held-out starts; training keys are folded from small seeds, never from this."""
EPISODES = 1024
LANES = 128
"""Held-out episodes in progress at a time."""


@struct.dataclass
class Evaluation:
    """One row per episode."""

    steps_taken: chex.Array  # (episodes,) int32; the step limit where the team never finished
    success: chex.Array  # (episodes,) bool
    episode_return: chex.Array  # (episodes,) float32: undiscounted, mean over agents


def held_out_keys(episodes: int = EPISODES) -> chex.PRNGKey:
    """(episodes,) reset keys of the fixed held-out starts; the same for every policy and seed."""
    return jax.random.split(jax.random.key(HELD_OUT_SEED), episodes)


@partial(jax.jit, static_argnames=("env", "policy", "episodes"))
def evaluate(
    env: Environment,
    policy: Policy,
    params: Any,
    key: chex.PRNGKey,
    *,
    episodes: int = EPISODES,
    greedy: chex.Numeric = False,
) -> Evaluation:
    """Plays every held-out start once, to its end.

    Args:
      key: the policy's own randomness; ignored when greedy.
      greedy: every choice of the policy (action, gate, edge, bit) is its likeliest one; may be
        traced, so both kinds share one compiled program.

    Raises:
      ValueError: when the policy was shaped for another task.
    """
    policy.check_fits(env)
    features, params = state_features(env, policy, params), policy.prepare(params)

    def choose(actors: Actors, key: chex.PRNGKey) -> tuple[Any, chex.Array]:
        noise = policy.sample_noise(key, actors.episode_return.shape[:1], greedy)
        carry, output = act(env, policy, params, features, actors, noise)
        return carry, output.action

    return _play(env, policy, choose, key, episodes)


@partial(jax.jit, static_argnames=("env", "policy", "episodes"))
def evaluate_random(
    env: Environment, policy: Policy, key: chex.PRNGKey, *, episodes: int = EPISODES
) -> Evaluation:
    """The held-out starts under uniformly random actions, each class over the actions it has."""
    logits = jnp.where(jnp.asarray(env.action_mask), 0.0, -jnp.inf)

    def choose(actors: Actors, key: chex.PRNGKey) -> tuple[Any, chex.Array]:
        shape = actors.episode_return.shape
        return actors.carry, jax.random.categorical(key, logits, shape=shape).astype(jnp.int32)

    return _play(env, policy, choose, key, episodes)


def shortest_path_steps(env: Environment, episodes: int = EPISODES) -> chex.Array | None:
    """(episodes,) int32 bound on the held-out starts, for a task that offers `shortest_steps`."""
    bound = getattr(env, "shortest_steps", None)
    if bound is None:
        return None
    return jax.jit(jax.vmap(lambda key: bound(env.reset(key))))(held_out_keys(episodes))


@struct.dataclass
class _Queue:
    """Lanes that play one held-out episode after another. L lanes, 1 row per episode."""

    actors: Actors  # leaves (L, ...)
    episode: chex.Array  # (L,) int32 the episode a lane plays; past the last one: none
    following: chex.Array  # () int32 the next episode to start
    result: Evaluation
    time: chex.Array  # () int32 steps so far, of all lanes


def _play(
    env: Environment, policy: Policy, choose: Any, key: chex.PRNGKey, episodes: int
) -> Evaluation:
    """Every held-out start, played to its end.

    A team that gets stuck plays on to the step limit. Were all starts played side by side, it would
    hold up everybody, so a lane whose episode ends takes the next start that is left.
    """
    keys = held_out_keys(episodes)
    first = start(env, policy, keys[:LANES])
    starts, lanes = jax.vmap(env.reset)(keys), first.episode_return.shape[0]

    def unfinished(queue: _Queue) -> chex.Array:
        return (queue.episode < episodes).any()

    def body(queue: _Queue) -> _Queue:
        actors = queue.actors
        carry, actions = choose(actors, jax.random.fold_in(key, queue.time))
        env_state, transition = jax.vmap(env.step)(actors.env_state, actions)
        episode_return = actors.episode_return + transition.reward
        done = transition.terminated | transition.truncated
        now = Evaluation(transition.steps_taken, transition.success, episode_return.mean(-1))
        # A row past the end is dropped.
        row = jnp.where(done, queue.episode, episodes)
        result = jax.tree.map(lambda x, y: x.at[row].set(y, mode="drop"), queue.result, now)
        episode = jnp.where(done, queue.following + jnp.cumsum(done) - 1, queue.episode)
        fresh = jax.tree.map(lambda x: x[jnp.minimum(episode, episodes - 1)], starts)
        actors = Actors(
            env_state=select(done, fresh, env_state),
            carry=select(done, policy.initial_carry((lanes,)), carry),
            episode_return=jnp.where(done[:, None], 0.0, episode_return),
        )
        return _Queue(actors, episode, queue.following + done.sum(), result, queue.time + 1)

    result = Evaluation(
        steps_taken=jnp.zeros(episodes, jnp.int32),
        success=jnp.zeros(episodes, bool),
        episode_return=jnp.zeros(episodes),
    )
    queue = _Queue(first, jnp.arange(lanes), jnp.int32(lanes), result, jnp.int32(0))
    return jax.lax.while_loop(unfinished, body, queue).result


@dataclass(frozen=True)
class Agent:
    """A trained policy to act with: pure, batched over any leading axes, traceable."""

    env: Environment
    policy: Policy
    params: Any

    def initial_carry(self, batch_shape: tuple[int, ...] = ()) -> Any:
        """What the team remembers at the start of an episode."""
        return self.policy.initial_carry(batch_shape)

    def act(
        self, carry: Any, obs: Observation, key: chex.PRNGKey, *, greedy: bool = False
    ) -> tuple[Any, chex.Array]:
        """(next carry, actions (..., N) int32) for obs.state (..., N, C, rows, columns).

        Raises:
          ValueError: for the observation, or the carry, of another team or grid.
        """
        self.policy.check_step(carry, obs)
        noise = self.policy.sample_noise(key, obs.view.shape[:-4], greedy)
        carry, output = self.policy.apply_with(self.params, carry, obs, noise)
        return carry, output.action


ARMS = ("transfer", "scratch", "source")
"""Where a run's directory is given: the arm whose policy is meant, first found."""


def load_agent(directory: str | os.PathLike[str], *, seed: int = 0) -> Agent:
    """The policy that a run, or one arm's checkpoint directory, ended with.

    Args:
      directory: of a run (its transferred policy is taken), of its checkpoints/<arm>, or of one
        checkpoint.
      seed: which of the seeds trained side by side, by position.

    Raises:
      CheckpointError: when there is no good checkpoint, or it does not say what it is of.
    """
    root = Path(directory)
    arms = [root / "checkpoints" / arm for arm in ARMS if (root / "checkpoints" / arm).is_dir()]
    root = arms[0] if arms else root
    meta = checkpoint.read_meta(root)
    env, policy = checkpoint.rebuild(meta)
    num_seeds = len(meta.get("seeds", ()))
    like = jax.eval_shape(policy.init, jax.random.key(0))
    if num_seeds:
        if not 0 <= seed < num_seeds:
            raise CheckpointError(f"{root} holds {num_seeds} seeds; there is no seed {seed}.")
        stacked = jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_seeds, *x.shape), x.dtype), like)
        params = jax.tree.map(lambda x: x[seed], checkpoint.load_params(root, stacked))
    else:
        params = checkpoint.load_params(root, like)
    return Agent(env, policy, jax.tree.map(jnp.asarray, params))
