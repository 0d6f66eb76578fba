"""Small teams, their policies and what they see, shared by the tests of this folder.

What is compiled is kept: a test that asks for the same policy and batch shape again pays nothing.
"""

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from drawn import drawn_parameters

from sumajax.environments import Observation, PredatorCapturePrey, PredatorPrey
from sumajax.policies import Policy, make_policy

PREY_THREE = PredatorPrey(size=4, num_predators=3)
PREY_FIVE = PredatorPrey(size=4, num_predators=5)
CAPTURE_THREE = PredatorCapturePrey(size=4, num_predators=2, num_capturers=1)
CAPTURE_FIVE = PredatorCapturePrey(size=4, num_predators=3, num_capturers=2)


class ComeAndGo(PredatorPrey):
    """Predator-Prey for policies to act in while some of the agents are not there."""

    agents_leave = True


NAMES = ("ic3net", "magic", "tarmac-ic3net", "hetnet", "hetnet-binary")
"""The policies that differ in more than what their team says to each other."""


@lru_cache
def small(name: str, env: Any = PREY_THREE, **settings: Any) -> Policy:
    """A policy of few features (HetNet's are fixed)."""
    if not name.startswith("hetnet"):
        settings.setdefault("hidden", 16)
    return make_policy(name, env, **settings)


@lru_cache
def parameters(policy: Policy, seed: int = 0) -> Any:
    """Some, of the size of the initial ones; the same for teams that have parameters in common."""
    return drawn_parameters(policy, seed)


@lru_cache
def stepper(policy: Policy) -> Any:
    """The compiled `policy.apply_with`."""
    return jax.jit(policy.apply_with)


def greedy(policy: Policy, batch_shape: tuple[int, ...] = ()) -> Any:
    """The noise that makes every choice the likeliest."""
    return policy.greedy_noise(batch_shape)


def observe(
    env: Any, seed: int, batch_shape: tuple[int, ...] = (), alive: Any = None
) -> Observation:
    """Agents on random cells that see random things; blind agents see nothing, as in the task."""
    random = np.random.default_rng(seed)
    shape = (*batch_shape, env.num_agents)
    table = np.asarray(env.state_table())
    view = random.normal(size=(*shape, *env.view_shape)).astype(np.float32)
    sighted = np.array([env.sighted_classes[c] for c in env.agent_class])
    return Observation(
        state=table[random.integers(len(table), size=shape)],
        view=np.where(sighted[:, None, None, None], view, np.float32(0)),
        alive=None if alive is None else np.asarray(alive, bool),
    )


def shapes(policy: Policy) -> Any:
    """The parameter tree with a shape for each leaf."""
    return jax.tree.map(lambda leaf: leaf.shape, jax.eval_shape(policy.init, jax.random.key(0)))


def size(policy: Policy) -> int:
    """How many numbers the parameters are."""
    leaves = jax.tree.leaves(jax.eval_shape(policy.init, jax.random.key(0)))
    return sum(leaf.size for leaf in leaves)


@lru_cache
def listener(policy: Policy, steps: int = 1) -> Any:
    """A compiled function that says who hears whom, at given noise and talk.

    Its result is (N, N) bool: whether the logits of agent j (row) in the last of `steps` steps
    depend on what agent i (column) saw in the first. `adjust` may replace fields of the carry after
    the first step, as `{"gate": ...}`.
    """

    def last_logits(view, params, obs, noise, adjust):
        carry = policy.initial_carry()
        carry, output = policy.apply_with(params, carry, obs.replace(view=view), noise)
        for _ in range(steps - 1):
            carry, output = policy.apply_with(params, carry.replace(**adjust), obs, noise)
        return output.logits

    @jax.jit
    def heard(params, obs, noise, adjust):
        slope = jax.jacrev(last_logits)(obs.view, params, obs, noise, adjust)
        return jnp.abs(slope).sum((1, 3, 4, 5)) > 0  # of (N, num_actions, N, c, m, m)

    def answer(obs: Observation, noise: Any = None, **adjust: Any) -> np.ndarray:
        adjust = {field: np.asarray(value, np.float32) for field, value in adjust.items()}
        return np.asarray(heard(parameters(policy), obs, noise or greedy(policy), adjust))

    return answer
