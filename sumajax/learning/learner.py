"""TrainState, update, epoch: rollout and optimisation as one compiled loop."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax.flatten_util import ravel_pytree

from sumajax.environments.types import Environment
from sumajax.learning import critic, guard
from sumajax.learning.config import LearnerConfig
from sumajax.learning.critic import CriticState
from sumajax.learning.hetnet_loss import hetnet
from sumajax.learning.losses import LossFunction, LossParts, actor_critic
from sumajax.learning.optimiser import annealed, learning_rate, make_optimiser
from sumajax.learning.rewards import reward_scale
from sumajax.learning.rollout import (
    Actors,
    Draws,
    Trajectory,
    draw,
    last_value,
    rollout,
    stagger,
    start,
)
from sumajax.policies.types import Policy
from sumajax.precision import stated_precision

LOSSES: dict[str, LossFunction] = {"actor_critic": actor_critic, "hetnet": hetnet}
"""By `LearnerConfig.loss`."""

START = -1
"""Update number folded into the keys of the first episodes, before update 0."""


CRITIC = 2**32 - 1
"""Folded into the key of a critic's first parameters; no update has this number."""


@struct.dataclass
class TrainState:
    """Everything training needs to go on; saved and restored as it is."""

    params: Any
    opt_state: Any
    actors: Actors  # leaves (E, ...)
    key: chex.PRNGKey  # (): never changes; each update folds its number in
    updates: chex.Array  # () int32 updates done
    critic: CriticState | None = None  # where it is not a part of the policy


@struct.dataclass
class Tally:
    """Sums over updates; `Metrics` are made of them."""

    env_steps: chex.Array  # () int32
    episodes: chex.Array  # () int32 episodes that ended, either way
    steps_taken: chex.Array  # () int32 over those episodes
    success: chex.Array  # () int32 of those episodes
    episode_return: chex.Array  # () float32 over those episodes, mean over agents
    communication: chex.Array  # () float32 over environment steps, mean over agents
    agent_steps: chex.Array  # () int32
    loss: LossParts
    gradient_norm: chex.Array  # () float32 over updates
    updates: chex.Array  # () int32 taken
    faults: chex.Array  # (FAULTS,) int32 updates refused, by reason; see `guard`


@struct.dataclass
class Metrics:
    """Figures of an epoch; those of episodes are of the ones that ended in it, NaN if none did.

    What crosses the border of a compiled program are the sums; a mean is made of them when it is
    asked for. A program that handed out NaN for an epoch without an end would be stopped by
    `jax_debug_nans`. The figures have the leading axes of the sums: (epochs,) or (seeds, epochs).
    """

    sums: Tally
    fault: chex.Array  # () int32: 0, or what stopped the seed, 1 + its place in `guard.FAULTS`

    @property
    def env_steps(self) -> chex.Array:
        """() int32."""
        return self.sums.env_steps

    @property
    def episodes(self) -> chex.Array:
        """() int32."""
        return self.sums.episodes

    @property
    def steps_taken(self) -> chex.Array:
        """() float32: mean length of an episode."""
        return mean_of(self.sums.steps_taken, self.sums.episodes)

    @property
    def success(self) -> chex.Array:
        """() float32 in [0, 1]."""
        return mean_of(self.sums.success, self.sums.episodes)

    @property
    def episode_return(self) -> chex.Array:
        """() float32: undiscounted, mean over agents."""
        return mean_of(self.sums.episode_return, self.sums.episodes)

    @property
    def entropy(self) -> chex.Array:
        """() float32 nats: of the action, per agent that is trained."""
        return mean_of(self.sums.loss.entropy, self.sums.loss.acting)

    @property
    def policy_loss(self) -> chex.Array:
        """() float32: per agent that is trained."""
        return mean_of(self.sums.loss.policy, self.sums.loss.acting)

    @property
    def value_loss(self) -> chex.Array:
        """() float32: squared error per agent and step, of rewards as they are learnt from."""
        return mean_of(self.sums.loss.value, self.sums.agent_steps)

    @property
    def gradient_norm(self) -> chex.Array:
        """() float32: before clipping, mean over updates."""
        return mean_of(self.sums.gradient_norm, self.sums.updates)

    @property
    def communication(self) -> chex.Array:
        """() float32 in [0, 1]."""
        return mean_of(self.sums.communication, self.sums.env_steps)


def mean_of(total: chex.Array, count: chex.Array) -> chex.Array:
    """(...,) float32: total / count, NaN where there is nothing to take the mean of.

    By NumPy where the numbers are known; traced, it is part of its caller's program.
    """
    if isinstance(total, jax.core.Tracer) or isinstance(count, jax.core.Tracer):
        mean = total.astype(jnp.float32) / jnp.maximum(count, 1).astype(jnp.float32)
        return jnp.where(count > 0, mean, jnp.nan)
    total, count = np.asarray(total, np.float32), np.asarray(count, np.float32)
    return np.divide(total, count, out=np.full(total.shape, np.nan, np.float32), where=count > 0)


@dataclass(frozen=True)
class Learner:
    """A policy, its task and how it learns; the methods are pure and can be traced and vmapped.

    Attributes:
      axis, shards: name and size of the device axis that the environments are spread over, inside
        `shard_map`; None and 1 when one device has them all.
      unroll: steps of the rollout that one turn of its compiled loop takes.
    """

    env: Environment
    policy: Policy
    config: LearnerConfig
    axis: str | None = None
    shards: int = 1
    unroll: int = 1

    @partial(jax.jit, static_argnums=0)
    def init(self, key: chex.PRNGKey) -> TrainState:
        """Fresh parameters, optimiser and environments."""
        params_key, train_key = jax.random.split(key)
        return self.init_from(self.policy.init(params_key), train_key)

    def init_from(self, params: Any, key: chex.PRNGKey, opt_state: Any = None) -> TrainState:
        """The start of training from given parameters, and from optimiser memory if given.

        The environments are at staggered ages, unless every update starts them afresh.
        """
        fresh = make_optimiser(self.config).init(params)
        keys = self._keys(key, jnp.int32(START))
        actors = start(self.env, self.policy, keys)
        if not self.config.whole_episodes:
            ahead = jax.vmap(partial(jax.random.fold_in, data=0))(keys)
            actors = stagger(self.env, self.policy, params, actors, ahead)
        own_critic = self.config.critic == "state"
        critic_key = jax.random.fold_in(key, CRITIC)
        return TrainState(
            params=params,
            opt_state=fresh if opt_state is None else opt_state,
            actors=actors,
            key=key,
            updates=jnp.int32(0),
            critic=critic.init_critic(self.env, self.policy, actors, critic_key)
            if own_critic
            else None,
        )

    @partial(jax.jit, static_argnums=(0, 2))
    def train(self, state: TrainState, epochs: int) -> tuple[TrainState, Metrics]:
        """`epochs` epochs in one compiled call; the metrics' leaves are (epochs,)."""
        return jax.lax.scan(lambda s, _: self.epoch(s), state, length=epochs)

    def epoch(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """20,000 environment steps, or more with `whole_episodes`, which run to their end."""
        updates = self.config.updates_per_epoch
        state, tallies = jax.lax.scan(lambda s, _: self.update(s), state, length=updates)
        return state, summarise(_added(tallies))

    @stated_precision
    def update(self, state: TrainState) -> tuple[TrainState, Tally]:
        """One rollout and one optimiser step.

        The gradient is that of the loss summed over agents and steps, divided by the number of
        environment steps (docs/reference/learning.md, Gradients). An update that is not finite is
        refused: the state stays as it is, and of the tally only the fault is left.
        """
        weights = self._weights(state)
        grads, (actors, tally) = self._gradient(weights, *self._inputs(state), state.updates)
        grads, tally = self._over_devices((grads, tally))
        grads = jax.tree.map(lambda g: g / tally.env_steps.astype(g.dtype), grads)
        norm = optax.tree.norm(grads["policy"])
        tally = replace(tally, gradient_norm=norm, updates=jnp.int32(1))
        following = replace(
            self._policy_step(state, grads["policy"]),
            actors=actors,
            critic=self._critic_step(state.critic, grads["critic"]),
        )
        loss = tally.loss.policy + tally.loss.value + tally.loss.entropy
        faults = guard.faults_of(loss, norm, self._weights(following))
        nothing = jax.tree.map(jnp.zeros_like, tally)
        # The key stays as it is; chosen between it and itself, it would be used twice.
        new, old = (replace(s, key=None) for s in (following, state))
        kept, tally = guard.unless(faults, (new, tally), (old, nothing))
        updates = state.updates + tally.updates
        return replace(kept, key=state.key, updates=updates), replace(tally, faults=faults)

    def _weights(self, state: TrainState) -> dict[str, Any]:
        """All that gradients are taken of: the policy's parameters, and a critic's of its own."""
        return {"policy": state.params, "critic": state.critic and state.critic.params}

    def _policy_step(self, state: TrainState, grads: Any) -> TrainState:
        grads, opt_state = self._critic_alone(grads, state)
        optimiser = make_optimiser(self.config)
        rate = learning_rate(self.config, state.updates)
        params, opt_state = stepped(optimiser, rate, state.params, grads, opt_state)
        return replace(state, params=params, opt_state=opt_state)

    def _critic_step(self, state: CriticState | None, grads: Any) -> CriticState | None:
        if state is None:
            return None
        rate = self.config.critic_rate
        return CriticState(*stepped(critic.optimiser(), rate, state.params, grads, state.opt_state))

    def _inputs(self, state: TrainState) -> tuple[Actors, Draws]:
        """Where an update's rollout starts, and all its random numbers."""
        config = self.config
        keys = self._keys(state.key, state.updates)
        epoch = state.updates // config.updates_per_epoch
        actors, length = state.actors, config.rollout_length
        if config.whole_episodes:
            starts = jax.vmap(partial(jax.random.fold_in, data=0))(keys)
            actors = start(self.env, self.policy, starts, epoch)
            length += self.env.max_steps - 1
        return actors, draw(self.env, self.policy, keys, length, epoch)

    def _gradient(
        self, weights: dict[str, Any], actors: Actors, draws: Draws, updates: chex.Array
    ) -> tuple[Any, tuple[Actors, Tally]]:
        """Gradient of the summed loss, and what the rollout left."""
        gradient, limit = jax.grad(self._objective, has_aux=True), self.config.max_grad_norm
        if limit is None or not self.config.clip_per_env:
            return gradient(weights, actors, draws, updates)
        lanes = one_environment_each(actors, draws)
        grads, (actors, tallies) = jax.vmap(gradient, (None, 0, 0, None))(weights, *lanes, updates)
        grads = jax.vmap(partial(clip_by_global_norm, limit=limit))(grads)
        grads, tally = _added((grads, tallies))
        return grads, (jax.tree.map(lambda x: x[:, 0], actors), tally)

    def _objective(
        self, weights: dict[str, Any], actors: Actors, draws: Draws, updates: chex.Array
    ) -> tuple[chex.Array, tuple[Actors, Tally]]:
        config, params = self.config, weights["policy"]
        actors, trajectory = rollout(
            self.env, self.policy, params, actors, draws, config.detach_gap, self.unroll
        )
        scale = reward_scale(self.env, config)
        if scale != 1.0:
            trajectory = replace(trajectory, reward=scale * trajectory.reward)
        last = last_value(self.env, self.policy, params, actors)
        if weights["critic"] is not None:
            trajectory, last = self._valued(weights["critic"], trajectory, actors)
        if config.whole_episodes:
            valid = until_episode_end(trajectory, config.rollout_length)
        else:
            valid = jnp.ones(trajectory.last.shape, bool)
        loss, parts = LOSSES[config.loss](
            trajectory,
            valid,
            last,
            config,
            annealed(config, updates),
            self.axis,
        )
        return loss, (jax.lax.stop_gradient(actors), tally_of(trajectory, valid, parts))

    def _valued(
        self, params: Any, trajectory: Trajectory, actors: Actors
    ) -> tuple[Trajectory, chex.Array]:
        """The trajectory with the values of a critic of its own, and that of the steps' end."""
        shape = trajectory.value.shape
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), trajectory.before)
        value = critic.values(self.env, self.policy, params, flat).reshape(shape)
        last = critic.values(self.env, self.policy, params, actors)
        return replace(trajectory, value=value), jax.lax.stop_gradient(last)

    def _critic_alone(self, grads: Any, state: TrainState) -> tuple[Any, Any]:
        """Gradient and optimiser memory of an update: in the first `critic_epochs` nothing for what
        the policy depends on, and after them no memory of that time.
        """
        if not self.config.critic_epochs:
            return grads, state.opt_state
        alone = self.config.critic_epochs * self.config.updates_per_epoch
        grads = jax.tree.map(
            lambda g, critic: g if critic else jnp.where(state.updates < alone, 0.0, g),
            grads,
            self.policy.only_critic(grads),
        )
        fresh = make_optimiser(self.config).init(state.params)
        first = state.updates == alone
        return grads, jax.tree.map(lambda a, b: jnp.where(first, a, b), fresh, state.opt_state)

    def _over_devices(self, sums: Any) -> Any:
        """`sums` added up over devices, in one exchange: at each they wait for the slowest.

        Counts travel as floats, exact up to 2**24 for an update.
        """
        if self.axis is None:
            return sums
        vector, restore = ravel_pytree(jax.tree.map(lambda x: x.astype(jnp.float32), sums))
        added = restore(jax.lax.psum(vector, self.axis))
        return jax.tree.map(lambda x, y: y.astype(x.dtype), sums, added)

    def _keys(self, key: chex.PRNGKey, update: chex.Array) -> chex.PRNGKey:
        """(E,) keys of one update; each belongs to an environment, whatever device that is on."""
        key = jax.random.fold_in(key, update - START)
        num_envs = self.config.num_envs // self.shards
        number = jnp.arange(num_envs, dtype=jnp.int32)
        if self.axis is not None:
            number = number + jax.lax.axis_index(self.axis) * num_envs
        return jax.vmap(partial(jax.random.fold_in, key))(number)


def stepped(
    optimiser: optax.GradientTransformation,
    rate: chex.Numeric,
    params: Any,
    grads: Any,
    opt_state: Any,
) -> tuple[Any, Any]:
    """Parameters and optimiser memory after a step of `rate`."""
    # Its own arithmetic mixes whole numbers and floats, which a program may have forbidden.
    with jax.numpy_dtype_promotion("standard"):
        direction, opt_state = optimiser.update(grads, opt_state, params)
    return jax.tree.map(lambda p, d: p - rate * d, params, direction), opt_state


def one_environment_each(actors: Actors, draws: Draws) -> tuple[Actors, Draws]:
    """Leaves (E, ...), (T, E, ...) -> (E, 1, ...), (E, T, 1, ...): a batch of one, E times."""
    return (
        jax.tree.map(lambda x: x[:, None], actors),
        jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1)[:, :, None], draws),
    )


def clip_by_global_norm(grads: Any, limit: float) -> Any:
    """`grads`, made shorter where their norm over all leaves is above `limit`."""
    scale = jnp.minimum(1.0, limit / optax.tree.norm(grads))
    return jax.tree.map(lambda g: g * scale, grads)


def until_episode_end(trajectory: Trajectory, least: int) -> chex.Array:
    """(T, E) bool: the steps up to the first episode end at or after step `least`.

    The originals' collection rule: episodes are never cut, and a process stops at the first end
    after its share of steps (docs/reference/learning.md, Two ways to collect).
    """
    step = jnp.arange(trajectory.last.shape[0], dtype=jnp.int32)[:, None]
    enough = (trajectory.last & (step + 1 >= least)).astype(jnp.int32)
    return jnp.cumsum(enough, axis=0, dtype=jnp.int32) - enough == 0


def tally_of(trajectory: Trajectory, valid: chex.Array, parts: LossParts) -> Tally:
    """Counts what `valid` (T, E) steps hold; an agent that is not there has no step."""
    ended, num_agents = trajectory.last & valid, trajectory.value.shape[-1]
    env_steps = valid.sum(dtype=jnp.int32)
    tally = Tally(
        env_steps=env_steps,
        episodes=ended.sum(dtype=jnp.int32),
        steps_taken=jnp.where(ended, trajectory.steps_taken, 0).sum(dtype=jnp.int32),
        success=(trajectory.success & ended).sum(dtype=jnp.int32),
        episode_return=jnp.where(ended, trajectory.episode_return.mean(-1), 0).sum(),
        communication=jnp.where(valid, trajectory.communication.mean(-1), 0).sum(),
        agent_steps=env_steps * num_agents,
        loss=jax.lax.stop_gradient(parts),
        gradient_norm=jnp.float32(0),
        updates=jnp.int32(1),
        faults=jnp.zeros(len(guard.FAULTS), jnp.int32),
    )
    if trajectory.presence is None:
        return tally
    acted = trajectory.presence.before & valid[..., None]
    agent_steps = acted.sum(dtype=jnp.int32)
    used = jnp.where(acted, trajectory.communication, 0.0).sum()
    share = used / jnp.maximum(agent_steps, 1).astype(used.dtype)
    communication = share * tally.env_steps.astype(used.dtype)
    return replace(tally, communication=communication, agent_steps=agent_steps)


def summarise(tally: Tally) -> Metrics:
    """What an epoch's sums say."""
    return Metrics(sums=tally, fault=guard.first_fault(tally.faults))


def _added(tree: Any) -> Any:
    """Leaves summed over their first axis, each in its own dtype."""
    return jax.tree.map(lambda x: x.sum(0, dtype=x.dtype), tree)


def make_learner(env: Environment, policy: Policy, config: LearnerConfig | None = None) -> Learner:
    """The learner of `policy` on `env`; `config` defaults to the preset `fast`.

    Raises:
      ValueError: when the policy was shaped for another task, or the loss does not fit the task.
    """
    policy.check_fits(env)
    config = config or LearnerConfig()
    if config.loss == "hetnet" and policy.team.agents_leave:
        raise ValueError(
            "loss 'hetnet' has no place for agents that come and go; use loss 'actor_critic'."
        )
    if config.critic == "state":
        critic.check_has_features(env)
    elif not policy.module.critic_parameters:  # a policy that does not say what its critic's is
        config = replace(config, critic_epochs=0)
    return Learner(env, policy, config)
