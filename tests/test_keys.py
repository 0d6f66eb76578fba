"""No random key is used twice, as JAX's own checker sees it: it reads programs, and runs none."""

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.key_reuse._core import check_key_reuse

from sumajax.environments import PredatorCapturePrey, TrafficJunction
from sumajax.learning import make_learner, preset
from sumajax.learning.rollout import draw
from sumajax.policies import make_policy

ENV = PredatorCapturePrey(size=3, num_predators=1, num_capturers=1, max_steps=3)


def learner(policy="ic3net", settings="fast"):
    small = {} if policy.startswith("hetnet") else {"hidden": 4}
    made = make_policy(policy, ENV, **small)
    size = {"num_envs": 2, "rollout_length": 2} if settings == "fast" else {}
    return make_learner(ENV, made, preset(settings, policy, **size))


@pytest.fixture
def key():
    return jax.random.key(0)


def test_the_checker_sees_a_second_use(key):
    def twice(key):
        return jax.lax.scan(lambda s, _: (s + jax.random.uniform(key), None), 0.0, length=2)

    with pytest.raises(jax.errors.KeyReuseError):
        check_key_reuse(twice, key)


def test_reset(key):
    check_key_reuse(ENV.reset, key)


@pytest.mark.parametrize("policy", ["ic3net", "magic", "hetnet-binary"])
def test_parameters_and_draws(policy, key):
    made = make_policy(policy, ENV)
    check_key_reuse(made.init, key)
    check_key_reuse(lambda key: draw(ENV, made, jax.random.split(key, 2), 3), key)


@pytest.mark.parametrize("settings", ["fast", "paper"])
def test_updates(settings, key):
    trained = learner(settings=settings)
    state = jax.eval_shape(trained.init, key)

    def two_updates(state):
        return jax.lax.scan(lambda s, _: trained.update(s), state, length=2)[1].env_steps

    check_key_reuse(trained.init, key)
    check_key_reuse(two_updates, state)


def test_a_step_with_arrivals(key):
    junction = TrafficJunction(num_cars=2)

    def steps(key):
        state = junction.reset(key)
        for _ in range(2):
            state, _ = junction.step(state, jnp.zeros(2, jnp.int32))
        return state

    check_key_reuse(steps, key)
