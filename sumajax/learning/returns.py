"""Returns and advantages along time; arrays are (T, ...), time first.

Step t has the observation and value of t and the reward that its action earned; `discount` is 0
where the episode ended with that step.
"""

import chex
import jax
import jax.numpy as jnp


def discounted_returns(
    reward: chex.Array, discount: chex.Array, last_return: chex.Array
) -> chex.Array:
    """(T, ...) C_t = r_t + discount_t C_{t+1}, with C_T = `last_return` (...)."""
    chex.assert_equal_shape([reward, discount])
    chex.assert_equal_shape([reward[0], last_return])

    def back(
        later: chex.Array, step: tuple[chex.Array, chex.Array]
    ) -> tuple[chex.Array, chex.Array]:
        r_t, discount_t = step
        now = r_t + discount_t * later
        return now, now

    return jax.lax.scan(back, last_return, (reward, discount), reverse=True)[1]


def generalised_advantages(
    reward: chex.Array,
    discount: chex.Array,
    value: chex.Array,
    last_value: chex.Array,
    lambda_: float,
) -> chex.Array:
    """(T, ...) generalised advantage estimates (Schulman et al. 2016, equation 16).

    delta_t = r_t + discount_t V_{t+1} - V_t, summed with weights (discount lambda)^k up to the end
    of the episode. With lambda 1 this is the discounted return minus V.

    Args:
      reward, discount, value: (T, ...).
      last_value: (...) value of the observation after the last step.
    """
    chex.assert_equal_shape([reward, discount, value])
    next_value = jnp.concatenate([value[1:], last_value[None]])
    delta = reward + discount * next_value - value
    return discounted_returns(delta, discount * lambda_, jnp.zeros_like(last_value))


def mix_team(
    individual: chex.Array, team_weight: float, places: chex.Array | None = None
) -> chex.Array:
    """(..., N): each agent's own part and the team's mean, weighted (the originals' mean_ratio).

    The mean is that of `places` (..., N), the returns of the agents' places, where these are not
    the agents' own.
    """
    team = (individual if places is None else places).mean(-1, keepdims=True)
    return team_weight * team + (1.0 - team_weight) * individual
