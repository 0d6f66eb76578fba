"""Returns and advantages against their slow definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sumajax.learning import returns

SHAPE = (5, 2)  # (T, ...); one shape, so one program

reals = arrays.arrays(np.float64, SHAPE, elements=st.floats(-10, 10))
last_reals = arrays.arrays(np.float64, SHAPE[1:], elements=st.floats(-10, 10))
ends = arrays.arrays(np.bool_, SHAPE)
fractions = st.floats(0, 1)

quick = settings(max_examples=50, deadline=None)


def in_float64(function, *inputs):
    with jax.enable_x64(True):
        return np.asarray(jax.jit(function)(*map(jnp.asarray, inputs)))


def slow_returns(reward, discount, last_return):
    """C_t = sum_k (product of discounts from t to t+k-1) r_{t+k}, the last one followed by C_T."""
    result = np.zeros_like(reward)
    for t in range(len(reward)):
        for k in range(t, len(reward)):
            result[t] += discount[t:k].prod(0) * reward[k]
        result[t] += discount[t:].prod(0) * last_return
    return result


def slow_advantages(reward, discount, value, last_value, lambda_):
    """A_t = sum_k lambda^k (product of discounts) delta_{t+k}."""
    result, following = np.zeros_like(reward), np.concatenate([value[1:], last_value[None]])
    delta = reward + discount * following - value
    for t in range(len(reward)):
        for k in range(t, len(reward)):
            result[t] += lambda_ ** (k - t) * discount[t:k].prod(0) * delta[k]
    return result


@quick
@given(reals, ends, fractions, last_reals)
def test_returns(reward, last, gamma, last_return):
    discount = gamma * ~last
    ours = in_float64(returns.discounted_returns, reward, discount, last_return)
    np.testing.assert_allclose(ours, slow_returns(reward, discount, last_return), atol=1e-9)


@quick
@given(reals, ends, fractions, reals, last_reals, fractions)
def test_advantages(reward, last, gamma, value, last_value, lambda_):
    inputs = reward, gamma * ~last, value, last_value, lambda_
    ours = in_float64(returns.generalised_advantages, *inputs)
    np.testing.assert_allclose(ours, slow_advantages(*inputs), atol=1e-9)


@quick
@given(reals, ends, fractions, reals, last_reals)
def test_advantages_with_lambda_one_are_returns_less_value(reward, last, gamma, value, beyond):
    discount = gamma * ~last
    ours = in_float64(returns.generalised_advantages, reward, discount, value, beyond, 1.0)
    expected = in_float64(returns.discounted_returns, reward, discount, beyond) - value
    np.testing.assert_allclose(ours, expected, atol=1e-9)


def test_advantages_with_lambda_zero_look_one_step_ahead():
    reward, value = np.array([1.0, 2.0]), np.array([10.0, 20.0])
    ours = in_float64(
        returns.generalised_advantages, reward, np.array([0.5, 0.5]), value, np.array(40.0), 0.0
    )
    np.testing.assert_allclose(ours, [1 + 10 - 10, 2 + 20 - 20])


def test_nothing_crosses_the_end_of_an_episode():
    reward, discount = np.array([1.0, 2.0, 4.0]), np.array([1.0, 0.0, 1.0])
    ours = in_float64(returns.discounted_returns, reward, discount, np.array(100.0))
    np.testing.assert_allclose(ours, [3.0, 2.0, 104.0])


@quick
@given(reals, fractions)
def test_mixing_in_the_team_keeps_its_mean(individual, weight):
    mixed = in_float64(returns.mix_team, individual, weight)
    np.testing.assert_allclose(mixed.mean(-1), individual.mean(-1), atol=1e-9)
    own = in_float64(returns.mix_team, individual, 0.0)
    # XLA flushes subnormal numbers to zero: an absolute bound far below any reward.
    np.testing.assert_allclose(own, individual, atol=1e-300)
    team = in_float64(returns.mix_team, individual, 1.0)
    means = np.broadcast_to(individual.mean(-1)[:, None], SHAPE)
    np.testing.assert_allclose(team, means, atol=1e-300)
    np.testing.assert_allclose(mixed, weight * team + (1 - weight) * own, atol=1e-9)


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(AssertionError):
        returns.discounted_returns(jnp.zeros((3, 2)), jnp.zeros(3), jnp.zeros(2))
    with pytest.raises(AssertionError):
        returns.discounted_returns(jnp.zeros((3, 2)), jnp.zeros((3, 2)), jnp.zeros(3))
