"""HetNet's published loss against a slow rendering with explicit padding.

The formulas: docs/reference/learning.md, HetNet's loss.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beginnings import begin, begun, random_parameters
from probes import MatchView
from trajectories import random_trajectory

from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.learning import make_learner, preset
from sumajax.learning.hetnet_loss import episode_length, hetnet
from sumajax.learning.learner import clip_by_global_norm
from sumajax.policies import Decision, make_policy

CLASSES = {"2P1A": (0, 0, 1), "3P2A": (0, 0, 0, 1, 1), "3P": (0, 0, 0)}
MAX_STEPS = 7
LENGTHS = [[3, 7, 1, 5], [7, 7], [2, 6, 4]]
"""Episodes of each environment; afterwards it goes on with steps that must not count."""

CONFIG = preset("paper", "hetnet")


def slow_advantages(reward, value, gamma, lambda_):
    """(L, N) of one episode; the value beyond its last step is 0."""
    advantages, later = np.zeros_like(reward), np.zeros(reward.shape[1])
    next_value = np.concatenate([value[1:], np.zeros_like(value[:1])])
    for t in reversed(range(len(reward))):
        delta = reward[t] + gamma * next_value[t] - value[t]
        later = delta + gamma * lambda_ * later
        advantages[t] = later
    return advantages


def slow_loss_of_environment(logits, choice, value, constant, reward, lengths, agent_class):
    """Arrays (T, N, ...) of one environment, padded to (K, N, max_steps) as the original does.

    `constant` is `value` where no gradient goes through it.
    """
    ends = np.cumsum(lengths)
    episodes = [slice(end - n, end) for end, n in zip(ends, lengths, strict=True)]
    log_prob = logits - np.log(np.exp(logits).sum(-1, keepdims=True))
    raw = [
        slow_advantages(reward[e], constant[e], CONFIG.gamma, CONFIG.gae_lambda) for e in episodes
    ]
    policy = critic = 0.0
    for c in sorted(set(agent_class)):
        agents = [i for i, of in enumerate(agent_class) if of == c]
        padded = np.zeros((len(lengths), len(agents), MAX_STEPS))
        for k, n in enumerate(lengths):
            padded[k, :, :n] = raw[k][:, agents].T
        normalised = (padded - padded.mean()) / (padded.std(ddof=1) + np.finfo(np.float32).eps)
        for k, episode in enumerate(episodes):
            for a, agent in enumerate(agents):
                for t in range(lengths[k]):
                    taken = log_prob[episode][t, agent, choice[episode][t, agent]]
                    policy += -taken * normalised[k, a, t]
            target = (raw[k] + constant[episode])[:, agents].mean(1)
            critic += ((value[episode][:, agents[0]] - target) ** 2).mean()
    return (CONFIG.policy_weight * policy + CONFIG.value_weight * critic) / len(lengths)


def slow_loss(trajectory, logits, value, constant):
    """The sum over environments; arguments (T, E, N, ...)."""
    choice, reward = (
        np.asarray(trajectory.decisions["action"].choice),
        np.asarray(trajectory.reward),
    )
    return sum(
        slow_loss_of_environment(
            *(x[:, e] for x in (logits, choice, value, constant, reward)),
            LENGTHS[e],
            trajectory.agent_class,
        )
        for e in range(len(LENGTHS))
    )


@pytest.mark.parametrize("agent_class", CLASSES.values(), ids=CLASSES)
def test_loss_and_its_gradient(agent_class):
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        trajectory, valid = random_trajectory(rng, LENGTHS, agent_class, max_steps=MAX_STEPS)
        choice = trajectory.decisions["action"].choice
        # What follows the last episode must not matter, nor a value beyond the last step.
        beyond = jnp.full(trajectory.value.shape[1:], 1e3)

        def loss(logits, value):
            seen = trajectory.replace(decisions={"action": Decision(logits, choice)}, value=value)
            return hetnet(seen, jnp.asarray(valid), beyond, CONFIG, 1.0)[0]

        logits, value = trajectory.decisions["action"].logits, trajectory.value
        ours, gradients = jax.jit(jax.value_and_grad(loss, (0, 1)))(logits, value)
        logits, value, gradients = jax.tree.map(np.asarray, (logits, value, gradients))
    np.testing.assert_allclose(ours, slow_loss(trajectory, logits, value, value), rtol=1e-12)
    step = 1e-5
    for _ in range(10):
        d_logits = rng.normal(size=logits.shape)
        d_class = rng.normal(size=(*value.shape[:2], max(agent_class) + 1))
        d_value = d_class[..., list(agent_class)]  # the agents of a class share their value
        ahead, behind = (
            slow_loss(trajectory, logits + e * d_logits, value + e * d_value, value)
            for e in (step, -step)
        )
        along = (gradients[0] * d_logits).sum() + (gradients[1] * d_value).sum()
        np.testing.assert_allclose(along, (ahead - behind) / (2 * step), rtol=1e-6)


def test_length_of_the_episode_of_each_step():
    trajectory, valid = random_trajectory(np.random.default_rng(0), LENGTHS)
    lengths = np.asarray(episode_length(trajectory))
    for env, expected in enumerate(LENGTHS):
        np.testing.assert_array_equal(lengths[valid[:, env], env], np.repeat(expected, expected))


def test_each_environment_is_clipped_alone():
    """`clip_per_env`: the sum of the environments' gradients, each clipped to `max_grad_norm`."""
    env = MatchView(max_steps=3)
    policy = make_policy("iric", env, hidden=4, encoder="linear")
    config = replace(CONFIG, num_envs=4, rollout_length=2)
    whole = make_learner(env, policy, config)
    unclipped = replace(config, num_envs=1, max_grad_norm=None, clip_per_env=False)
    alone = make_learner(env, policy, unclipped)

    @jax.jit
    def gradient(state):
        inputs = whole._inputs(state)
        return inputs, whole._gradient(whole._weights(state), *inputs, state.updates)

    state = begun(whole)
    (actors, draws), (ours, (_, tally)) = jax.tree.map(np.asarray, gradient(state))
    weights = whole._weights(state)
    of_one = jax.jit(alone._gradient)
    parts = []
    for e in range(config.num_envs):
        lane = jax.tree.map(lambda x, e=e: x[e : e + 1], actors)
        lane_draws = jax.tree.map(lambda x, e=e: x[:, e : e + 1], draws)
        alone_gradient, _ = of_one(weights, lane, lane_draws, state.updates)
        parts.append(jax.tree.map(np.asarray, alone_gradient))
    norms = [float(np.sqrt(sum((g**2).sum() for g in jax.tree.leaves(part)))) for part in parts]
    assert max(norms) > config.max_grad_norm, "nothing to clip"
    scales = [min(1.0, config.max_grad_norm / norm) for norm in norms]
    expected = jax.tree.map(lambda *g: sum(s * x for s, x in zip(scales, g, strict=True)), *parts)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), ours, expected)
    assert int(tally.env_steps) == 3 * config.num_envs


def test_clipping_leaves_a_short_gradient_alone():
    grads = {"a": jnp.array([3.0, 0.0]), "b": jnp.array([4.0])}
    same = clip_by_global_norm(grads, 5.0)
    jax.tree.map(np.testing.assert_array_equal, same, grads)
    shorter = clip_by_global_norm(grads, 1.0)
    np.testing.assert_allclose(shorter["a"], [0.6, 0.0], rtol=1e-6)
    np.testing.assert_allclose(shorter["b"], [0.8], rtol=1e-6)


def test_a_gradient_of_zero_stays_zero():
    zero = {"a": jnp.zeros(3)}
    np.testing.assert_array_equal(clip_by_global_norm(zero, 0.75)["a"], zero["a"])


@pytest.mark.parametrize(
    "env",
    [
        # One class alone: its loss is checked above, and another learner takes long to compile.
        pytest.param(PredatorPrey(3, 2, max_steps=6), id="predator-prey", marks=pytest.mark.slow),
        pytest.param(PredatorCapturePrey(3, 2, 1, max_steps=6), id="predator-capture-prey"),
    ],
)
def test_an_update_of_hetnet_as_published(env):
    """The gradient handed to the optimiser is at most the clip of every environment together."""
    policy = make_policy("hetnet", env, encoder="linear")
    config = preset("paper", "hetnet", num_envs=2, rollout_length=4)
    learner = make_learner(env, policy, config)
    run = jax.jit(lambda params, key: learner.update(begin(learner, params, key)))
    state, tally = run(random_parameters(policy), jax.random.key(0))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.params))
    assert int(tally.episodes) >= config.num_envs
    assert int(tally.env_steps) >= config.num_envs * config.rollout_length
    most = config.max_grad_norm * config.num_envs / int(tally.env_steps)
    assert 0 < float(tally.gradient_norm) <= most * (1 + 1e-5)
