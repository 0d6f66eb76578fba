"""Held-out episodes, sampled and greedy; a random policy and the shortest paths beside them."""

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sumajax import checkpoint, store
from sumajax.checkpoint import CheckpointError
from sumajax.description import rebuild_policy, rebuild_task
from sumajax.environments.types import Environment, Observation, figure_names, measured
from sumajax.export import PLATFORMS, export_policy
from sumajax.keys import key_of
from sumajax.learning.rollout import Actors, act, hand_on, presence_in, select, state_features
from sumajax.policies.types import Policy
from sumajax.records import exportable
from sumajax.sources import source_of

HELD_OUT_SEED = 20_240_229
"""Of the held-out starts; training keys are folded from small seeds, never from this."""
EPISODES = 1024
LANES = 128
"""Held-out episodes in progress at a time."""


@exportable
@struct.dataclass
class Evaluation:
    """One row per episode."""

    steps_taken: chex.Array  # (episodes,) int32; the step limit where the team never finished
    success: chex.Array  # (episodes,) bool
    episode_return: chex.Array  # (episodes,) float32: undiscounted, mean over agents
    measured: chex.Array  # (episodes, F, 2) float32 of the domain's own figures: amount and count

    def figures(self, env: Environment) -> dict[str, float]:
        """The domain's own figures over all these episodes; NaN where there was nothing to count.

        Args:
          env: the task that was played, which names them.
        """
        amount, count = np.asarray(self.measured, np.float64).sum(0).T
        values = np.divide(amount, count, out=np.full(len(count), np.nan), where=count > 0)
        return dict(zip(figure_names(env), values.tolist(), strict=True))


def held_out_keys(episodes: int = EPISODES) -> chex.PRNGKey:
    """(episodes,) reset keys of the fixed held-out starts; the same for every policy and seed."""
    return jax.random.split(key_of(HELD_OUT_SEED), episodes)


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
    logits = jnp.where(jnp.asarray(env.action_mask), jnp.float32(0.0), -jnp.inf)

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
    measured: chex.Array  # (L, F, 2) float32 so far, of the episodes in progress
    result: Evaluation
    time: chex.Array  # () int32 steps so far, of all lanes


def _play(
    env: Environment, policy: Policy, choose: Any, key: chex.PRNGKey, episodes: int
) -> Evaluation:
    """Every held-out start, played to its end.

    A team that gets stuck plays on to the step limit. Were all starts played side by side, it would
    hold up everybody, so a lane whose episode ends takes the next start that is left.
    """
    keys, number = held_out_keys(episodes), len(figure_names(env))
    starts, lanes = jax.vmap(env.reset)(keys), min(LANES, episodes)
    first = Actors(
        env_state=jax.tree.map(lambda x: x[:lanes], starts),
        carry=policy.initial_carry((lanes,)),
        episode_return=jnp.zeros((lanes, env.num_agents), jnp.float32),
    )

    def unfinished(queue: _Queue) -> chex.Array:
        return (queue.episode < episodes).any()

    def body(queue: _Queue) -> _Queue:
        actors = queue.actors
        carry, actions = choose(actors, jax.random.fold_in(key, queue.time))
        env_state, transition = jax.vmap(env.step)(actors.env_state, actions)
        episode_return = actors.episode_return + transition.reward
        carry = hand_on(policy, carry, presence_in(env, actors.env_state, transition, env_state))
        done = transition.terminated | transition.truncated
        own = jax.vmap(partial(measured, env))(actors.env_state, transition, env_state)
        own = queue.measured + own
        now = Evaluation(transition.steps_taken, transition.success, episode_return.mean(-1), own)
        # A row past the end is dropped.
        row = jnp.where(done, queue.episode, episodes)
        result = jax.tree.map(lambda x, y: x.at[row].set(y, mode="drop"), queue.result, now)
        ended = jnp.cumsum(done, dtype=jnp.int32)
        episode = jnp.where(done, queue.following + ended - 1, queue.episode)
        fresh = jax.tree.map(lambda x: x[jnp.minimum(episode, episodes - 1)], starts)
        actors = Actors(
            env_state=select(done, fresh, env_state),
            carry=select(done, policy.initial_carry((lanes,)), carry),
            episode_return=jnp.where(done[:, None], 0.0, episode_return),
        )
        own = jnp.where(done[:, None, None], 0.0, own)
        return _Queue(actors, episode, queue.following + ended[-1], own, result, queue.time + 1)

    result = Evaluation(
        steps_taken=jnp.zeros(episodes, jnp.int32),
        success=jnp.zeros(episodes, bool),
        episode_return=jnp.zeros(episodes, jnp.float32),
        measured=jnp.zeros((episodes, number, 2), jnp.float32),
    )
    episode = jnp.arange(lanes, dtype=jnp.int32)
    own = jnp.zeros((lanes, number, 2), jnp.float32)
    queue = _Queue(first, episode, jnp.int32(lanes), own, result, jnp.int32(0))
    return jax.lax.while_loop(unfinished, body, queue).result


@struct.dataclass
class Agent:
    """A trained policy to act with: pure, batched over any leading axes, traceable.

    A pytree whose leaves are the parameters: it can be an argument of a compiled function.
    """

    env: Environment = struct.field(pytree_node=False)
    policy: Policy = struct.field(pytree_node=False)
    params: Any

    def __eq__(self, other: object) -> bool:
        """The same policy for the same task, with the same numbers."""
        if not isinstance(other, Agent) or (self.env, self.policy) != (other.env, other.policy):
            return False
        flatten: Any = jax.tree.flatten
        (mine, structure), (theirs, of_theirs) = flatten(self.params), flatten(other.params)
        return structure == of_theirs and all(map(np.array_equal, mine, theirs))

    def __hash__(self) -> int:
        return hash((self.env, self.policy))

    def initial_carry(self, batch_shape: tuple[int, ...] = ()) -> Any:
        """What the team remembers at the start of an episode."""
        return self.policy.initial_carry(batch_shape)

    def act(
        self, carry: Any, obs: Observation, key: chex.PRNGKey, *, greedy: chex.Numeric = False
    ) -> tuple[Any, chex.Array]:
        """(next carry, actions (..., N) int32) for obs.state (..., N, C, rows, columns).

        Args:
          key: ignored when greedy.
          greedy: take the likeliest choice everywhere; may be traced.

        Raises:
          ValueError: for the observation, or the carry, of another team or grid.
        """
        self.policy.check_step(carry, obs)
        noise = self.policy.sample_noise(key, obs.view.shape[:-4], greedy)
        carry, output = self.policy.apply_with(self.params, carry, obs, noise)
        return carry, output.action

    def export(
        self, directory: str | os.PathLike[str], *, platforms: Sequence[str] = PLATFORMS
    ) -> Path:
        """Writes the step, with the parameters in it, for programs that have JAX alone.

        Arguments, errors and the files as for `sumajax.export.export_policy`.
        """
        return export_policy(self.env, self.policy, self.params, directory, platforms=platforms)


def load_agent(
    directory: str | os.PathLike[str],
    *,
    seed: int | None = None,
    env: Environment | None = None,
    policy: Policy | None = None,
) -> Agent:
    """The policy that a run, or one stage of it, ended with.

    Args:
      directory: of a run (the policy of its last stage is taken), of one of its
        checkpoints/<stage>, or of one checkpoint; or the name of a policy of the package, as for
        `pretrained`.
      seed: which of the seeds that were trained side by side; None: the first.
      env, policy: what it was trained on and as, where the package does not know them.

    Raises:
      CheckpointError: when there is no good checkpoint, it has not that seed, or it is of a task or
        policy that the package does not know, or of another than was given.
    """
    found = source_of(directory)
    meta = found.meta
    if env is None and policy is None:
        env, policy = checkpoint.rebuild(meta)
    else:
        env, policy = _given(meta, env, policy)
        checkpoint.check_compatible(meta, env, policy, found.name)
    like = jax.eval_shape(policy.init, key_of(0))
    seeds = meta.get("seeds", [])
    if seed is not None and seed not in (seeds or [0]):
        known = ", ".join(map(str, seeds or [0]))
        raise CheckpointError(f"{found.name} has no seed {seed}; its seeds are {known}.")
    if seeds:
        place = 0 if seed is None else seeds.index(seed)
        stacked = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((len(seeds), *x.shape), x.dtype), like
        )
        params = jax.tree.map(lambda x: x[place], found.load(stacked))
    else:
        params = found.load(like)
    return Agent(env, policy, jax.tree.map(jnp.asarray, params))


def pretrained(name: str) -> Agent:
    """A trained policy of the package, as `pretrained("pp-10x10-ic3net")`.

    `sumajax.store.names()` lists them; `sumajax.store.card(name)` says how one was made and what
    it reaches.

    Raises:
      ValueError: for an unknown name; lists the known.
    """
    store.entry(name)
    return load_agent(name)


def _given(
    meta: dict[str, Any], env: Environment | None, policy: Policy | None
) -> tuple[Environment, Policy]:
    """The task and policy that were given, and of what was not, the checkpoint's."""
    env = rebuild_task(meta) if env is None else env
    policy = rebuild_policy(meta, env) if policy is None else policy.shaped_for(env)
    return env, policy
