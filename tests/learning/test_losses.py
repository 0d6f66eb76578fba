"""The actor-critic loss against a slow rendering of its formula."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trajectories import random_trajectory

from sumajax.learning import LearnerConfig, losses
from sumajax.policies import Decision
from sumajax.policies.types import MASKED_LOGIT

LENGTHS = [[3, 7], [7, 2]]
"""Episodes of two environments; those of 7 steps hit the limit."""
PLAIN = LearnerConfig(advantages="raw", mask_inactive=False, team_reward=0.0, entropy_weight=0.0)
CONFIGS = {
    "plain": PLAIN,
    "discounted to the limit": replace(PLAIN, bootstrap_timeouts=False, gamma=0.9, gae_lambda=0.5),
    "the team's mean": replace(PLAIN, team_reward=0.25),
    "agents that are done do not act": replace(PLAIN, mask_inactive=True),
    "centred": replace(PLAIN, advantages="centred", mask_inactive=True),
    "normalised": replace(PLAIN, advantages="normalised", mask_inactive=True),
    "entropy bonus": replace(PLAIN, entropy_weight=0.1),
}
ENTROPY_SCALE = 0.5


def log_softmax(logits):
    return logits - np.log(np.exp(logits).sum(-1, keepdims=True))


def slow_advantages(trajectory, last_value, config):
    """(T, E, N), step by step."""
    value, reward = np.asarray(trajectory.value), np.array(trajectory.reward)
    later, following, result = np.zeros_like(last_value), last_value, np.zeros_like(value)
    for t in reversed(range(len(value))):
        for env in range(value.shape[1]):
            if trajectory.last[t, env]:
                later[env] = following[env] = 0
                if config.bootstrap_timeouts and trajectory.truncated[t, env]:
                    following[env] = value[t, env]  # stands for the observation never made
        delta = reward[t] + config.gamma * following - value[t]
        result[t] = later = delta + config.gamma * config.gae_lambda * later
        following = value[t].copy()
    return result


def slow_loss(trajectory, valid, last_value, config, logits, value):
    """The loss as a number; `trajectory` holds the constants, `logits` and `value` the rest."""
    constant = np.asarray(trajectory.value)
    target = slow_advantages(trajectory, last_value, config) + constant
    target = (1 - config.team_reward) * target + config.team_reward * target.mean(-1, keepdims=True)
    counts = np.broadcast_to(valid[..., None], value.shape)
    acts = counts & np.asarray(trajectory.active) if config.mask_inactive else counts
    advantages = target - constant
    if config.advantages != "raw":
        advantages = advantages - advantages[acts].mean()
    if config.advantages == "normalised":
        advantages = advantages / advantages[acts].std()
    policy = entropy = 0.0
    for name, decision in trajectory.decisions.items():
        log_prob = log_softmax(logits[name])
        taken = np.take_along_axis(log_prob, np.asarray(decision.choice)[..., None], -1)[..., 0]
        if name == "action":
            policy -= (advantages * taken)[acts].sum()
            entropy -= (np.exp(log_prob) * log_prob).sum(-1)[acts].sum()
        else:  # what an agent says still counts when it moves no more
            policy -= (advantages * taken)[counts].sum()
    critic = ((value - target) ** 2)[counts].sum()
    bonus = config.entropy_weight * ENTROPY_SCALE * entropy
    return config.policy_weight * policy + config.value_weight * critic - bonus


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_loss_and_its_gradient(config):
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        trajectory, valid = random_trajectory(rng, LENGTHS, decisions={"action": 4, "gate": 2})
        valid[:2] = False  # steps that must not count, also at the start
        last_value = rng.normal(size=trajectory.value.shape[1:])

        def loss(logits, value):
            decisions = {
                name: Decision(logits[name], decision.choice)
                for name, decision in trajectory.decisions.items()
            }
            seen = trajectory.replace(decisions=decisions, value=value)
            return losses.actor_critic(
                seen, jnp.asarray(valid), jnp.asarray(last_value), config, ENTROPY_SCALE
            )

        logits = {name: decision.logits for name, decision in trajectory.decisions.items()}
        run = jax.jit(jax.value_and_grad(loss, (0, 1), has_aux=True))
        (ours, parts), gradients = jax.tree.map(np.asarray, run(logits, trajectory.value))
    logits, value = jax.tree.map(np.asarray, (logits, trajectory.value))

    def slow(logits, value):
        return slow_loss(trajectory, valid, last_value.copy(), config, logits, value)

    np.testing.assert_allclose(ours, slow(logits, value), rtol=1e-6)
    step = 1e-5
    for _ in range(5):
        direction = jax.tree.map(lambda x: rng.normal(size=x.shape), (logits, value))
        ahead, behind = (
            slow(*jax.tree.map(lambda x, d, s=s: x + s * d, (logits, value), direction))
            for s in (step, -step)
        )
        products = jax.tree.map(lambda g, d: (g * d).sum(), gradients, direction)
        along = sum(jax.tree.leaves(products))
        np.testing.assert_allclose(along, (ahead - behind) / (2 * step), rtol=1e-5)
    acting = trajectory.active | (not config.mask_inactive)
    assert parts.acting == (valid[..., None] & acting).sum()


def test_a_step_limit_is_no_end():
    """Two steps cut by the limit: the value after it is taken to be the one before it."""
    trajectory, _ = random_trajectory(np.random.default_rng(0), [[2]], (0,), max_steps=2, beyond=0)
    trajectory = trajectory.replace(
        reward=jnp.array([[[1.0]], [[2.0]]]), value=jnp.array([[[10.0]], [[20.0]]])
    )
    goes_on = replace(PLAIN, gamma=0.5, gae_lambda=1.0, bootstrap_timeouts=True)
    ends = replace(goes_on, bootstrap_timeouts=False)
    beyond = jnp.array([[1000.0]])  # of the next episode: never looked at
    last = 2 + 0.5 * 20
    bootstrapped = losses.estimate_advantages(trajectory, beyond, goes_on)
    np.testing.assert_allclose(np.ravel(bootstrapped), [1 + 0.5 * last - 10, last - 20])
    terminal = losses.estimate_advantages(trajectory, beyond, ends)
    np.testing.assert_allclose(np.ravel(terminal), [1 + 0.5 * 2 - 10, 2 - 20])


def test_a_segment_that_stops_midway_is_bootstrapped():
    trajectory, _ = random_trajectory(np.random.default_rng(0), [[]], (0,), beyond=1)
    trajectory = trajectory.replace(reward=jnp.ones((1, 1, 1)), value=jnp.full((1, 1, 1), 3.0))
    config = replace(PLAIN, gamma=0.5)
    ours = losses.estimate_advantages(trajectory, jnp.array([[8.0]]), config)
    np.testing.assert_allclose(np.ravel(ours), [1 + 0.5 * 8 - 3])


def test_log_probability_and_entropy():
    logits = jnp.log(jnp.array([[0.5, 0.25, 0.25], [0.1, 0.1, 0.8]]))
    taken, entropy = losses.log_prob_and_entropy(Decision(logits, jnp.array([1, 2])))
    np.testing.assert_allclose(taken, np.log([0.25, 0.8]), rtol=1e-5)
    probability = np.exp(logits)
    np.testing.assert_allclose(entropy, -(probability * logits).sum(-1), rtol=1e-5)


def test_an_action_that_a_class_does_not_have():
    """It has no part in the entropy and, with probability 0, no gradient, not even a NaN."""
    logits = jnp.array([0.3, -0.2, MASKED_LOGIT])
    decision = Decision(logits, jnp.array(0))
    alone = Decision(logits[:2], jnp.array(0))
    for ours, expected in zip(
        losses.log_prob_and_entropy(decision), losses.log_prob_and_entropy(alone), strict=True
    ):
        np.testing.assert_allclose(ours, expected, rtol=1e-6)

    def both(logits):
        return sum(losses.log_prob_and_entropy(Decision(logits, jnp.array(0))))

    gradient = jax.grad(both)(logits)
    assert np.isfinite(gradient).all()
    assert gradient[2] == 0


def test_normalise():
    """Mean 0 and standard deviation 1 over the entries that count, whatever the others are."""
    rng = np.random.default_rng(0)
    x, weight = rng.normal(5.0, 3.0, size=(50, 4)), (rng.uniform(size=(50, 4)) < 0.5) * 1.0
    x[weight == 0] *= 100
    ours = np.asarray(losses.normalise(jnp.asarray(x, jnp.float32), jnp.asarray(weight)))
    counted = ours[weight == 1]
    np.testing.assert_allclose([counted.mean(), counted.std()], [0, 1], atol=1e-5)


def test_normalise_what_does_not_vary():
    ours = losses.normalise(jnp.full((4, 2), 0.1), jnp.ones((4, 2)))
    np.testing.assert_allclose(ours, 0.0, atol=1e-2)


def test_normalise_over_devices_is_over_all_of_them():
    rng = np.random.default_rng(0)
    x, weight = rng.normal(size=(2, 30)), (rng.uniform(size=(2, 30)) < 0.5) * 1.0
    x, weight = jnp.asarray(x, jnp.float32), jnp.asarray(weight)
    apart = jax.vmap(lambda x, w: losses.normalise(x, w, "d"), axis_name="d")(x, weight)
    np.testing.assert_allclose(apart, losses.normalise(x, weight), rtol=1e-5, atol=1e-6)
