"""The optimisers against their written formulas."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax.learning import LearnerConfig
from sumajax.learning.optimiser import annealed, learning_rate, make_optimiser

STEPS = 5


def gradients(scale=1.0):
    """A few gradients of a small tree; one leaf is far smaller than the other."""
    rng = np.random.default_rng(0)
    return [
        {"a": scale * rng.normal(size=3), "b": {"c": 1e-6 * scale * rng.normal(size=(2, 2))}}
        for _ in range(STEPS)
    ]


def directions(config, grads):
    """What the optimiser makes of a sequence of gradients, in float64."""
    with jax.enable_x64(True):
        optimiser = make_optimiser(config)
        grads = jax.tree.map(jnp.asarray, grads)
        memory, result = optimiser.init(grads[0]), []
        for grad in grads:
            direction, memory = optimiser.update(grad, memory)
            result.append(direction)
        return jax.tree.map(np.asarray, result)


def assert_same(ours, expected):
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-9), ours, expected)


def rmsprop(grads):
    """v <- .97 v + .03 g^2 from v = 0; g / (sqrt(v) + 1e-6) (the programs' PyTorch)."""
    v, result = jax.tree.map(np.zeros_like, grads[0]), []
    for grad in grads:
        v = jax.tree.map(lambda v, g: 0.97 * v + 0.03 * g**2, v, grad)
        result.append(jax.tree.map(lambda v, g: g / (np.sqrt(v) + 1e-6), v, grad))
    return result


def adam(grads):
    """Kingma and Ba 2015, with beta .9 and .999 and epsilon 1e-8."""
    m = v = jax.tree.map(np.zeros_like, grads[0])
    result = []
    for t, grad in enumerate(grads, start=1):
        m = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, m, grad)
        v = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, v, grad)
        step = partial(adam_step, t=t)
        result.append(jax.tree.map(step, m, v))
    return result


def adam_step(m, v, t):
    return m / (1 - 0.9**t) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)


def clipped(grads, limit):
    """To a norm over all leaves of at most `limit`."""
    norms = [np.sqrt(sum((g**2).sum() for g in jax.tree.leaves(grad))) for grad in grads]
    return [
        jax.tree.map(lambda g, n=norm: g * min(1.0, limit / n), grad)
        for norm, grad in zip(norms, grads, strict=True)
    ]


def test_rmsprop_has_its_epsilon_outside_the_root():
    config = LearnerConfig(optimiser="rmsprop", max_grad_norm=None)
    assert_same(directions(config, gradients()), rmsprop(gradients()))


def test_adam():
    config = LearnerConfig(optimiser="adam", max_grad_norm=None)
    assert_same(directions(config, gradients()), adam(gradients()))


@pytest.mark.parametrize("scale", [0.1, 100.0], ids=["short", "long"])
def test_gradients_are_clipped_before_they_are_scaled(scale):
    config = LearnerConfig(optimiser="rmsprop", max_grad_norm=0.5)
    grads = gradients(scale)
    assert_same(directions(config, grads), rmsprop(clipped(grads, 0.5)))


def test_nothing_is_clipped_here_where_every_environment_was():
    config = LearnerConfig(optimiser="rmsprop", max_grad_norm=0.5, clip_per_env=True)
    assert_same(directions(config, gradients(100.0)), rmsprop(gradients(100.0)))


FEW = {"num_envs": 100, "rollout_length": 20}  # 10 updates an epoch


def test_without_annealing_nothing_changes():
    config = LearnerConfig(**FEW, learning_rate=0.5)
    assert [float(learning_rate(config, n)) for n in (0, 1, 1000)] == [0.5] * 3


def test_annealing_is_linear_and_then_stays():
    config = LearnerConfig(**FEW, anneal_epochs=2, anneal_to=0.2)
    left = [float(annealed(config, updates)) for updates in (0, 5, 10, 20, 50)]
    np.testing.assert_allclose(left, [1.0, 0.8, 0.6, 0.2, 0.2], rtol=1e-6)


def test_annealing_and_warm_up_of_the_rate():
    config = LearnerConfig(
        **FEW, learning_rate=0.1, warmup_epochs=1, anneal_epochs=2, anneal_to=0.0
    )
    rates = [float(learning_rate(config, updates)) for updates in (0, 4, 9, 15, 20, 30)]
    expected = [0.1 * 0.1, 0.5 * 0.8 * 0.1, 0.55 * 0.1, 0.25 * 0.1, 0.0, 0.0]
    np.testing.assert_allclose(rates, expected, rtol=1e-6, atol=1e-9)


def test_the_critics_rate_comes_first_and_the_warm_up_after_it():
    config = LearnerConfig(
        **FEW, learning_rate=0.1, critic_epochs=1, critic_rate=0.5, warmup_epochs=1
    )
    rates = [float(learning_rate(config, updates)) for updates in (0, 9, 10, 14, 19, 30)]
    np.testing.assert_allclose(rates, [0.5, 0.5, 0.01, 0.05, 0.1, 0.1], rtol=1e-6)
