"""How much work a compiled update is, whatever the machine: a slow-down in kind shows here.

The bounds are what was counted when they were set (c152d25), and a margin for other versions of
XLA. A change that does less may lower them; one that does more has to say what for.
"""

import jax
import pytest
from compiled_loops import loops_of
from matrix_products import multiply_adds, products

from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.learning import make_learner, preset
from sumajax.policies import make_policy

PP = PredatorPrey(10, 5, vision=1, max_steps=200)
PCP = PredatorCapturePrey(10, 3, 2, vision=1, max_steps=200)

MULTIPLY_ADDS = [("ic3net", PP, 2_419_000), ("magic", PP, 2_646_000), ("hetnet", PCP, 1_950_000)]
"""Per environment step: rollout, loss and derivatives, the table of states included."""
OPERATIONS = [("ic3net", PP, 148), ("magic", PP, 307), ("hetnet", PCP, 515)]
"""Operations that the two scan bodies of an update start, forward and back together."""


def update_of(name, env):
    learner = make_learner(env, make_policy(name, env), preset("fast", name))
    return learner, jax.eval_shape(learner.init, jax.random.key(0))


@pytest.mark.parametrize(("name", "env", "bound"), MULTIPLY_ADDS)
def test_multiply_adds_of_an_update(name, env, bound):
    learner, state = update_of(name, env)
    config = learner.config
    steps = config.num_envs * config.rollout_length
    counted = multiply_adds(products(learner.update, state)) / steps
    assert 0.9 * bound < counted < 1.01 * bound


@pytest.mark.slow
@pytest.mark.parametrize(("name", "env", "bound"), OPERATIONS)
def test_operations_of_a_step(name, env, bound):
    learner, state = update_of(name, env)
    program = jax.jit(learner.update).lower(state).compile().as_text()
    assert 0.5 * bound < sum(operations_of_loops(program)[:2]) < 1.1 * bound


def operations_of_loops(program):
    """Operations that one turn of each loop starts, the largest loop first."""
    _, *loops = loops_of(program).all_loops()
    return sorted((loop.operations for loop in loops), reverse=True)


def test_operations_are_counted_by_loop():
    def loop(x):
        return jax.lax.fori_loop(0, 5, lambda _, y: jax.numpy.sort(y @ y), x)

    program = jax.jit(loop).lower(jax.numpy.ones((3, 3))).compile().as_text()
    body, *others = operations_of_loops(program)
    assert not others
    assert 2 <= body <= 4  # the product, the sort, and at most the counter and a copy
