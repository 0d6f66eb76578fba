"""Matrix products are in float32 wherever they are done, unless JAX was told otherwise."""

import jax
import jax.numpy as jnp
import pytest

from sumajax.environments import PredatorCapturePrey
from sumajax.evaluation import evaluate
from sumajax.learning import make_learner, preset
from sumajax.policies import POLICIES, make_policy

ENV = PredatorCapturePrey(4, 2, 1, vision=1, max_steps=5)
KEY = jax.random.key(0)


def products_of(function, *arguments):
    """The precision of each matrix product of a function, from its program."""

    def gather(jaxpr):
        for equation in jaxpr.eqns:
            if equation.primitive.name == "dot_general":
                yield equation.params["precision"]
            for value in equation.params.values():
                for part in value if isinstance(value, tuple | list) else (value,):
                    inner = part if hasattr(part, "eqns") else getattr(part, "jaxpr", None)
                    if inner is not None:
                        yield from gather(inner)

    return list(gather(jax.make_jaxpr(function)(*arguments).jaxpr))


HIGHEST = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)


@pytest.mark.parametrize("settings", ["fast", "paper"])
@pytest.mark.parametrize("name", ["ic3net", "magic", "hetnet"])
def test_every_product_of_an_update(name, settings):
    learner = make_learner(ENV, make_policy(name, ENV), preset(settings, name))
    found = products_of(learner.update, jax.eval_shape(learner.init, KEY))
    assert len(found) > 20
    assert set(found) == {HIGHEST}


@pytest.mark.parametrize("name", POLICIES)
def test_every_product_of_an_evaluation_and_of_a_step(name):
    policy = make_policy(name, ENV)
    params = jax.eval_shape(policy.init, KEY)
    found = products_of(lambda p: evaluate(ENV, policy, p, KEY, episodes=4), params)
    obs = jax.eval_shape(lambda: ENV.observe(ENV.reset(KEY)))
    carry = jax.eval_shape(policy.initial_carry)
    found += products_of(policy.apply, params, carry, obs, KEY)
    assert set(found) == {HIGHEST}


def test_what_jax_was_told_goes_before():
    policy = make_policy("ic3net", ENV)
    params = jax.eval_shape(policy.init, KEY)
    table = jnp.asarray(ENV.state_table())
    with jax.default_matmul_precision("bfloat16"):
        found = products_of(policy.encode_states, params, table)
    assert HIGHEST not in found
    assert set(products_of(policy.encode_states, params, table)) == {HIGHEST}
