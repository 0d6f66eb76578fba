"""One scan over environment and policy, differentiable with respect to the policy's parameters."""

from dataclasses import replace
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct

from sumajax.environments.states import listed_states
from sumajax.environments.types import Environment, Transition, agents_leave, resets
from sumajax.learning.windows import windows
from sumajax.policies.types import Decision, Policy
from sumajax.records import exportable


@exportable
@struct.dataclass
class Actors:
    """E environments with the teams that live in them."""

    env_state: Any  # leaves (E, ...)
    carry: Any  # leaves (E, N, ...): what the agents remember
    episode_return: chex.Array  # (E, N) float32: undiscounted, of the episode in progress


@struct.dataclass
class Draws:
    """All the random numbers of a rollout, drawn in one go outside the scan."""

    noise: Any  # leaves (T, E, ...): the policy's
    fresh: Any  # leaves (T, E, ...): the environment state that follows if an episode ends


@struct.dataclass
class Presence:
    """Who was there in a step, in a task whose agents come and go within an episode."""

    before: chex.Array  # (..., N) bool: when it acted
    after: chex.Array  # (..., N) bool: after the step; where `left` it is another agent
    left: chex.Array  # (..., N) bool: went for good with this step

    @property
    def entered(self) -> chex.Array:
        """(..., N) bool: has come with this step, into a place that was empty or was left."""
        return self.after & (~self.before | self.left)


@struct.dataclass
class Trajectory:
    """What T steps of E environments left behind."""

    decisions: dict[str, Decision]  # leaves (T, E, N, ...)
    value: chex.Array  # (T, E, N) float32
    communication: chex.Array  # (T, E, N) float32
    active: chex.Array  # (T, E, N) bool: the action could still change something
    reward: chex.Array  # (T, E, N) float32
    terminated: chex.Array  # (T, E) bool
    truncated: chex.Array  # (T, E) bool
    success: chex.Array  # (T, E) bool
    steps_taken: chex.Array  # (T, E) int32
    episode_return: chex.Array  # (T, E, N) float32: up to and including this step
    agent_class: tuple[int, ...] = struct.field(pytree_node=False)  # per agent
    max_steps: int = struct.field(pytree_node=False)  # the task's step limit
    presence: Presence | None = None  # leaves (T, E, N); None where nobody ever leaves
    before: Actors | None = None  # leaves (T, E, ...): what each step began with

    @property
    def last(self) -> chex.Array:
        """(T, E) bool: the episode ended with this step, either way."""
        return self.terminated | self.truncated


def start(env: Environment, policy: Policy, keys: chex.PRNGKey, epoch: chex.Numeric = 0) -> Actors:
    """Fresh episodes of an epoch of training, one per key of `keys` (E,)."""
    num_envs = keys.shape[0]
    return Actors(
        env_state=jax.vmap(resets(env, epoch))(keys),
        carry=policy.initial_carry((num_envs,)),
        episode_return=jnp.zeros((num_envs, env.num_agents), jnp.float32),
    )


def draw(
    env: Environment, policy: Policy, keys: chex.PRNGKey, length: int, epoch: chex.Numeric = 0
) -> Draws:
    """The random numbers of `length` steps; each environment's come from its own key (E,).

    Args:
      epoch: () int32 of training, from 0: the episodes that begin in these steps are of it.
    """
    fresh = resets(env, epoch)

    def of_one(key: chex.PRNGKey) -> Draws:
        noise_key, reset_key = jax.random.split(key)
        return Draws(
            noise=policy.sample_noise(noise_key, (length,)),
            fresh=jax.vmap(fresh)(jax.random.split(reset_key, length)),
        )

    return jax.vmap(of_one, out_axes=1)(keys)


def select(condition: chex.Array, if_true: Any, if_false: Any) -> Any:
    """Leaf by leaf, along the leading axes that `condition` has, (E,) or (E, N)."""

    def leaf(a: chex.Array, b: chex.Array) -> chex.Array:
        missing = (1,) * (b.ndim - condition.ndim)
        return jnp.where(condition.reshape(condition.shape + missing), a, b)

    return jax.tree.map(leaf, if_true, if_false)


def state_features(env: Environment, policy: Policy, params: Any) -> chex.Array | None:
    """(S, F) features of every state tensor the task has, or None where it has too many to list."""
    with jax.ensure_compile_time_eval():  # an encoder can make use of what is in them
        states = listed_states(env)
    return None if states is None else policy.encode_listed(params, states)


def act(
    env: Environment,
    policy: Policy,
    params: Any,
    features: chex.Array | None,
    actors: Actors,
    noise: Any,
) -> tuple[Any, Any]:
    """The policy's step in all environments: (carry, PolicyOutput)."""
    own = own_features(env, policy, params, features, actors.env_state)
    view = jax.vmap(env.view)(actors.env_state)
    alive = who_is_alive(env, actors.env_state)
    return policy.step(params, actors.carry, own, view, noise, alive)


def own_features(
    env: Environment, policy: Policy, params: Any, features: chex.Array | None, env_state: Any
) -> chex.Array:
    """(E, N, F) features of what each agent is shown: from `state_features`, or encoded here."""
    if features is not None:
        return features[jax.vmap(env.state_index)(env_state)]
    states = jax.vmap(env.observe)(env_state).state
    flat = states.reshape(-1, *states.shape[-3:])
    return policy.encode_states(params, flat).reshape(*states.shape[:-3], -1)


def who_is_alive(env: Environment, env_state: Any) -> chex.Array | None:
    """(E, N) bool: who is there; None where nobody ever leaves."""
    return jax.vmap(env.alive)(env_state) if agents_leave(env) else None


def presence_in(
    env: Environment, env_state: Any, transition: Transition, following: Any
) -> Presence | None:
    """Who was there in the step from states `env_state` (E,) to `following`; None: always all."""
    if not agents_leave(env):
        return None
    alive = jax.vmap(env.alive)
    return Presence(before=alive(env_state), after=alive(following), left=transition.left)


def hand_on(policy: Policy, carry: Any, presence: Presence | None) -> Any:
    """What the agents remember after a step; nothing, for who is new, if the policy says so."""
    return carry if presence is None else policy.handed_on(carry, presence.entered)


def rollout(
    env: Environment,
    policy: Policy,
    params: Any,
    actors: Actors,
    draws: Draws,
    detach_gap: int | None = None,
    unroll: int = 1,
) -> tuple[Actors, Trajectory]:
    """T steps of E environments; ended episodes are followed by `draws.fresh` ones.

    Gradients reach `params` through the trajectory's logits and values, back through the agents'
    memory and messages to the start of the episode or of the segment, or over `detach_gap` steps.

    Args:
      unroll: steps that one turn of the compiled loop takes; changes no result.
    """
    if detach_gap is None:
        actors, (before, trajectory) = unroll_steps(env, policy, params, actors, draws, unroll)
        return actors, replace(trajectory, before=before)
    constant = jax.lax.stop_gradient(params)
    actors, (before, trajectory) = unroll_steps(env, policy, constant, actors, draws, unroll)
    trajectory = recompute_in_windows(
        env, policy, params, before, draws.noise, trajectory, detach_gap, unroll
    )
    return actors, replace(trajectory, before=before)


def unroll_steps(
    env: Environment, policy: Policy, params: Any, actors: Actors, draws: Draws, unroll: int = 1
) -> tuple[Actors, tuple[Actors, Trajectory]]:
    """`rollout` without a gap; and the actors before each step, leaves (T, E, ...).

    The state tensors are encoded once, before the scan, and gathered by cell.
    """
    features, params = state_features(env, policy, params), policy.prepare(params)

    def body(actors: Actors, draws: Draws) -> tuple[Actors, tuple[Actors, Trajectory]]:
        following, step = advance(env, policy, params, features, actors, draws)
        return following, (actors, step)

    return jax.lax.scan(body, actors, draws, unroll=unroll)


def advance(
    env: Environment,
    policy: Policy,
    params: Any,
    features: chex.Array | None,
    actors: Actors,
    draws: Draws,
) -> tuple[Actors, Trajectory]:
    """One step of all environments, and its record; leaves (E, ...), of `draws` too."""
    beginning = policy.initial_carry((actors.episode_return.shape[0],))
    active = jax.vmap(env.active)(actors.env_state)
    carry, output = act(env, policy, params, features, actors, draws.noise)
    env_state, transition = jax.vmap(env.step)(actors.env_state, output.action)
    episode_return = actors.episode_return + transition.reward
    done = transition.terminated | transition.truncated
    presence = presence_in(env, actors.env_state, transition, env_state)
    carry = hand_on(policy, carry, presence)
    following = Actors(
        env_state=select(done, draws.fresh, env_state),
        carry=select(done, beginning, carry),
        episode_return=select(done, jnp.zeros_like(episode_return), episode_return),
    )
    step = Trajectory(
        decisions=output.decisions,
        value=output.value,
        communication=output.communication,
        active=active,
        episode_return=episode_return,
        reward=transition.reward,
        terminated=transition.terminated,
        truncated=transition.truncated,
        success=transition.success,
        steps_taken=transition.steps_taken,
        agent_class=tuple(env.agent_class.tolist()),
        max_steps=env.max_steps,
        presence=presence,
    )
    return following, step


def stagger(
    env: Environment, policy: Policy, params: Any, actors: Actors, keys: chex.PRNGKey
) -> Actors:
    """`actors` at staggered ages: each environment has been played for a number of steps of its
    own, evenly drawn from 0 to the step limit.

    Environments that all start at once stay in step: the first updates see beginnings of episodes
    only, later ones ends only, and the first episodes to end are the quick ones, which makes the
    first figures too good. Played ahead, they are as those of a training that has long been going.

    Args:
      keys: (E,) of the steps played here.
    """
    features, params = state_features(env, policy, params), policy.prepare(params)
    most = env.max_steps + 1
    waits = jax.vmap(lambda key: jax.random.randint(key, (), 0, most, jnp.int32))(keys)

    def body(actors: Actors, time: chex.Array) -> tuple[Actors, None]:
        step_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, time)
        draws = jax.tree.map(lambda x: x[0], draw(env, policy, step_keys, 1))
        following, _ = advance(env, policy, params, features, actors, draws)
        return select(time >= waits, following, actors), None

    return jax.lax.scan(body, actors, jnp.arange(env.max_steps, dtype=jnp.int32))[0]


def recompute_in_windows(
    env: Environment,
    policy: Policy,
    params: Any,
    before: Actors,
    noise: Any,
    trajectory: Trajectory,
    gap: int,
    unroll: int = 1,
) -> Trajectory:
    """`trajectory` with logits and values that gradients reach `params` through.

    The same as a scan that cuts memory off, in fewer and wider steps: the derivative with respect
    to a weight is added up once for many steps, and not at every single one. Choices stay those
    that were made, whatever rounding makes of the logits.

    Args:
      before, noise: leaves (T, E, ...): the actors and the policy's random numbers of each step.
    """
    features, params = state_features(env, policy, params), policy.prepare(params)
    cut = trajectory.last | (trajectory.steps_taken % gap == 0)  # (T, E): after the step
    begins = jnp.roll(cut, 1, axis=0).at[0].set(True)
    pieces = windows(begins, gap)
    if trajectory.presence is not None and policy.fresh_memory:
        begins = begins[..., None] | jnp.roll(trajectory.presence.entered, 1, axis=0)

    # States too many to list are encoded step by step here as well: as one batch of all that were
    # met they took a quarter longer, as they no longer fit a core's cache.
    def body(carry: Any, now: tuple[chex.Array, Actors, Any]) -> tuple[Any, Any]:
        begins, actors, noise = now
        actors = replace(actors, carry=select(begins, actors.carry, carry))
        carry, output = act(env, policy, params, features, actors, noise)
        logits = {name: decision.logits for name, decision in output.decisions.items()}
        return carry, (logits, output.value)

    steps = pieces.split((begins, before, noise))
    # Each window begins with what was remembered then: this is for its shapes and types alone.
    beginning = jax.tree.map(lambda x: x[0], steps[1].carry)
    _, again = jax.lax.scan(body, beginning, steps, unroll=unroll)
    logits, value = pieces.join(again)
    decisions = {
        name: replace(decision, logits=logits[name])
        for name, decision in trajectory.decisions.items()
    }
    return replace(trajectory, decisions=decisions, value=value)


def last_value(env: Environment, policy: Policy, params: Any, actors: Actors) -> chex.Array:
    """(E, N) value of what the agents see now: the bootstrap after a rollout. No gradient."""
    params, actors = jax.lax.stop_gradient((params, actors))
    num_envs = actors.episode_return.shape[0]
    # Where messages depend on a draw (edges, bits), those of the likeliest draw.
    noise = policy.greedy_noise((num_envs,))
    features = state_features(env, policy, params)
    return act(env, policy, params, features, actors, noise)[1].value
