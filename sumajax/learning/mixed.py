"""One policy trained on two tasks at once: half of each update's environments are of either."""

from dataclasses import dataclass, field, fields, replace
from typing import Any

import chex
import jax
import jax.numpy as jnp

from sumajax.environments.types import Environment
from sumajax.learning.learner import Learner, Tally, TrainState
from sumajax.learning.rollout import Actors, Draws

OF_EPISODES = ("episodes", "steps_taken", "success", "episode_return")
"""Figures of a `Tally` that are of `env` alone: of two tasks together they would say nothing."""


@dataclass(frozen=True)
class MixedLearner(Learner):
    """A learner whose updates follow the sum of two gradients, each of a rollout in half of the
    environments: one on `env`, one on `beside`.

    An update has as many environment steps as any other, so at equal epochs it costs the same
    steps. Advantages are centred within each half. The metrics' figures of episodes are of `env`,
    all others of both; `TrainState.actors` is a pair.

    Attributes:
      beside: the other task; the parameters of the policy fit both.
    """

    beside: Environment = field(kw_only=True)

    @property
    def halves(self) -> tuple[Learner, Learner]:
        """A learner of each task, with half of the environments."""
        config = replace(self.config, num_envs=self.config.num_envs // 2)
        shared = {name: getattr(self, name) for name in ("axis", "shards", "unroll")}
        beside = self.policy.shaped_for(self.beside)
        return (
            Learner(self.env, self.policy, config, **shared),
            Learner(self.beside, beside, config, **shared),
        )

    def init_from(self, params: Any, key: chex.PRNGKey, opt_state: Any = None) -> TrainState:
        first, second = (
            half.init_from(params, jax.random.fold_in(key, place), opt_state)
            for place, half in enumerate(self.halves)
        )
        actors: Any = (first.actors, second.actors)
        return replace(first, actors=actors, key=key)

    def _inputs(self, state: TrainState) -> tuple[Any, Any]:
        pair: Any = state.actors
        # A half counts twice as many updates to an epoch as the whole does.
        inputs = [
            half._inputs(
                replace(
                    state,
                    actors=actors,
                    key=jax.random.fold_in(state.key, place),
                    updates=2 * state.updates,
                )
            )
            for place, (half, actors) in enumerate(zip(self.halves, pair, strict=True))
        ]
        actors, draws = zip(*inputs, strict=True)
        return actors, draws

    def _gradient(
        self, weights: Any, actors: Any, draws: Any, updates: chex.Array
    ) -> tuple[Any, tuple[Any, Tally]]:
        following: list[Actors] = []
        grads, tallies = [], []
        pairs: list[tuple[Actors, Draws]] = list(zip(actors, draws, strict=True))
        for half, pair in zip(self.halves, pairs, strict=True):
            gradient, (actors_after, tally) = half._gradient(weights, *pair, 2 * updates)
            grads.append(gradient)
            following.append(actors_after)
            tallies.append(tally)
        both = jax.tree.map(jnp.add, *tallies)
        tally = replace(both, **{name: getattr(tallies[0], name) for name in OF_EPISODES})
        return jax.tree.map(jnp.add, *grads), (tuple(following), tally)


def mixed_with(learner: Learner, beside: Environment) -> MixedLearner:
    """`learner`, but half of its environments are of the task `beside`.

    Raises:
      ValueError: for an odd number of environments.
    """
    if learner.config.num_envs % 2:
        raise ValueError(
            f"num_envs must be even to be of two tasks by halves, got {learner.config.num_envs}."
        )
    own = {f.name: getattr(learner, f.name) for f in fields(Learner)}
    return MixedLearner(**own, beside=beside)
