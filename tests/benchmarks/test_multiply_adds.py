"""The work of a policy's step: the published counts, and what our program does of it."""

import jax
import jax.numpy as jnp
import pytest
from matrix_products import Product, multiply_adds, products, step_products
from multiply_adds import COUNTS, of_step, tarmac

from sumajax.environments import PredatorCapturePrey, PredatorPrey, TrafficJunction
from sumajax.policies import POLICIES, TeamSpec, make_policy

PP_SMALL, PP_LARGE = (PredatorPrey(10, n, vision=1, max_steps=200) for n in (3, 5))
PCP_SMALL, PCP_LARGE = (
    PredatorCapturePrey(10, p, c, vision=1, max_steps=200) for p, c in ((2, 1), (3, 2))
)
PUBLISHED = [
    ("ic3net", PP_SMALL, 512_832),
    ("ic3net", PP_LARGE, 856_000),
    ("magic", PP_SMALL, 691_968),
    ("magic", PP_LARGE, 1_184_640),
    ("tarmac-ic3net", PP_SMALL, 574_416),
    ("tarmac-ic3net", PP_LARGE, 958_800),
    ("hetnet", PP_SMALL, 534_976),
    ("hetnet", PP_LARGE, 889_256),
    ("hetnet", PCP_SMALL, 553_684),
    ("hetnet", PCP_LARGE, 914_452),
]


@pytest.mark.parametrize(("policy", "env", "count"), PUBLISHED)
def test_counts_of_the_specification(policy, env, count):
    assert of_step(policy, env) == count


@pytest.mark.parametrize(("env", "count"), [(PP_SMALL, 1_079_520), (PP_LARGE, 1_802_080)])
def test_counts_of_two_rounds(env, count):
    assert tarmac(TeamSpec.of(env), rounds=2) == count


def test_every_policy_has_a_count():
    assert set(COUNTS) == set(POLICIES)


def test_ic3net_does_what_was_published_less_what_the_table_holds():
    """The state's half of the merging layer is in the table; messages are sums, not products."""
    merge, messages = 5 * 128 * 128, 5 * 5 * 128
    done = multiply_adds(step_products(PP_LARGE, make_policy("ic3net", PP_LARGE), 1))
    assert done == of_step("ic3net", PP_LARGE) - merge - messages


def test_a_team_that_comes_and_goes_does_what_one_that_stays_does():
    """As many agents, with as many actions to choose from: masks are no products."""
    medium = TrafficJunction("medium")
    done = multiply_adds(step_products(medium, make_policy("ic3net", medium), 1))
    assert done == of_step("ic3net", medium) - 10 * 128 * 128 - 10 * 10 * 128


def test_tarmac_does_what_ic3net_does_and_a_little():
    """Its message layers are folded into the LSTM; scores and weights per pair are all there is."""
    scores, pairs = 5 * 2 * 128 * 16, 5 * 5 * (16 + 128)
    ic3net, ours = (
        multiply_adds(step_products(PP_LARGE, make_policy(name, PP_LARGE), 1))
        for name in ("ic3net", "tarmac-ic3net")
    )
    merge, through_the_lstm = 5 * 32 * 128, 5 * 32 * 512  # what is seen, to H or to 4H
    c, heard = 5 * 128 * 128, 5 * 128 * 512
    own = 5 * 128 * 512  # the input of IC3Net's LSTM
    assert ours - ic3net == scores + pairs + through_the_lstm - merge + heard - c - own


@pytest.mark.parametrize("env", [PP_LARGE, PCP_LARGE], ids=["pp", "pcp"])
@pytest.mark.parametrize("name", ["ic3net", "magic", "tarmac-ic3net", "hetnet", "hetnet-binary"])
def test_products_are_nearly_all_that_the_compiler_counts(name, env):
    """XLA's own analysis adds what is not a product: at most a twentieth."""
    policy, num_envs = make_policy(name, env), 4
    counted = 2 * multiply_adds(step_products(env, policy, num_envs))

    def inputs(key):
        params = policy.prepare(policy.init(key))
        states = jnp.zeros((env.num_agents, *policy.team.state_shape))
        width = policy.encode_states(params, states).shape[-1]
        return (
            params,
            policy.initial_carry((num_envs,)),
            jnp.zeros((num_envs, env.num_agents, width)),
            jnp.zeros((num_envs, env.num_agents, *policy.team.view_shape)),
            policy.sample_noise(key, (num_envs,)),
        )

    analysis = jax.jit(policy.step).lower(*jax.eval_shape(inputs, jax.random.key(0)))
    assert counted <= analysis.cost_analysis()["flops"] <= 1.05 * counted


def test_products_of_loops_and_calls_are_counted():
    def loop(x, w):
        step = jax.jit(lambda x: (jnp.tanh(x @ w), None))
        return jax.lax.scan(lambda x, _: step(x), x, length=7)[0] @ w

    counted = products(loop, jnp.zeros((3, 4)), jnp.zeros((4, 4)))
    assert counted == {Product(batch=1, m=3, k=4, n=4): 8}


def test_products_of_a_batch():
    counted = products(
        lambda x, w: jnp.einsum("bij,bjk->bik", x, w), jnp.zeros((2, 3, 4)), jnp.zeros((2, 4, 5))
    )
    assert counted == {Product(batch=2, m=3, k=4, n=5): 1}
    assert multiply_adds(counted) == 2 * 3 * 4 * 5
