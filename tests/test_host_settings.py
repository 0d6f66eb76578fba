"""Settings of JAX that a program may have for itself: the same results, to the precision asked for.

They are global, so a package in such a program has them too.
"""

import contextlib
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

from sumajax import checkpoint, evaluate, load_agent, make_learner, make_policy, preset
from sumajax.compat.gymnax import AutoReset
from sumajax.compat.jaxmarl import JaxMARLEnv
from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.evaluation import evaluate_random, held_out_keys, shortest_path_steps
from sumajax.keys import key_of
from sumajax.learning.parallel import seed_keys
from sumajax.upsampling import StateUpsampled

PP = PredatorPrey(size=2, num_predators=2, max_steps=25, reward_mode="cooperative")
PCP = PredatorCapturePrey(size=3, num_predators=2, num_capturers=1, max_steps=6)
FEW = 4

NARROW = {"float32", "int32", "uint32", "bool"}

SAME = [
    {"jax_enable_x64": True},
    {
        # Each of them refuses something, and changes nothing that it does not refuse.
        "jax_numpy_rank_promotion": "raise",
        "jax_numpy_dtype_promotion": "strict",
        "jax_legacy_prng_key": "error",
        "jax_enable_custom_prng": True,
        "jax_debug_nans": True,
        "jax_debug_infs": True,
        "jax_debug_key_reuse": True,
    },
    {"jax_default_prng_impl": "rbg"},
    {"jax_default_prng_impl": "unsafe_rbg"},
    {"jax_check_tracer_leaks": True, "jax_enable_checks": True},
    {"jax_default_matmul_precision": "highest"},
]
"""What changes no number, but in the last digits."""
OTHER = [
    {"jax_threefry_partitionable": False, "jax_default_matmul_precision": "bfloat16"},
    {"jax_default_matmul_precision": "BF16_BF16_F32"},
]
"""What asks for other numbers: other random ones, or fewer digits."""
STRICTEST = {
    "jax_enable_x64": True,
    "jax_numpy_rank_promotion": "raise",
    "jax_numpy_dtype_promotion": "strict",
    "jax_legacy_prng_key": "error",
}


@contextlib.contextmanager
def set_to(settings):
    before = {name: getattr(jax.config, name) for name in settings}
    for name, value in settings.items():
        jax.config.update(name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def name_of(settings):
    return ",".join(f"{name.removeprefix('jax_')}={value}" for name, value in settings.items())


def results(directory, env=PP):
    """A small training from its key to its checkpoint, and what the policy then does."""
    policy = make_policy("ic3net", env, hidden=4, encoder="linear")
    config = preset("fast", num_envs=2000, rollout_length=10)
    learner = make_learner(env, policy, config)
    state, metrics = learner.train(jax.jit(learner.init)(key_of(3)), 3)
    whole = jax.tree.map(lambda x: x[None], {"params": jax.device_get(state.params)})
    checkpoint.save(directory, whole, checkpoint.describe(env, policy, seeds=[7]))
    agent = load_agent(directory, seed=7)

    @jax.jit
    def acted(start, *keys):
        obs = env.observe(env.reset(start))
        return [
            agent.act(agent.initial_carry(), obs, key, greedy=greedy)
            for key, greedy in zip(keys, (False, True), strict=True)
        ]

    held_out = [
        evaluate(env, policy, agent.params, key_of(5), episodes=FEW, greedy=greedy)
        for greedy in (False, True)
    ]
    figures = ("steps_taken", "success", "episode_return", "entropy", "value_loss", "gradient_norm")
    return {
        "trained": state.params,
        "saved": agent.params,
        "metrics": {name: getattr(metrics, name) for name in figures},
        "held out": held_out,
        "random": evaluate_random(env, policy, key_of(5), episodes=FEW),
        "bound": shortest_path_steps(env, FEW),
        "acted": acted(key_of(1), key_of(2), key_of(3)),
    }


@cache
def ordinary(make_directory):
    return jax.device_get(results(make_directory("ordinary") / "saved"))


def assert_narrow(tree):
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        assert str(leaf.dtype) in NARROW, (jax.tree_util.keystr(path), leaf.dtype)


@pytest.mark.parametrize("settings", SAME, ids=name_of)
def test_the_same_results(settings, tmp_path, tmp_path_factory):
    expected = ordinary(tmp_path_factory.mktemp)
    with set_to(settings):
        found = jax.device_get(results(tmp_path / "saved"))
    assert_narrow(found)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), found, expected
    )


def test_an_epoch_in_which_no_episode_ended_is_no_error():
    """Its means are of nothing: NaN, which nobody has to compute 0 / 0 for."""
    policy = make_policy("iric", PP, hidden=2, encoder="linear")
    learner = make_learner(PP, policy, preset("fast", num_envs=2000, rollout_length=10))
    with set_to({"jax_debug_nans": True}):
        _, shapes = jax.eval_shape(lambda key: learner.epoch(learner.init(key)), key_of(0))
        metrics = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        assert np.isnan(metrics.steps_taken)
        assert np.isnan(metrics.success)


def test_without_compiling():
    """Every operation by itself; those of the update, of which there are many, are only traced so,
    each loop and branch written out, and run at once."""
    env = PredatorPrey(size=2, num_predators=2, max_steps=2)
    policy = make_policy("iric", env, hidden=2, encoder="linear")
    learner = make_learner(env, policy, preset("fast", num_envs=2, rollout_length=2))
    state = jax.jit(learner.init)(key_of(0))
    expected = jax.jit(learner.update)(state)[0].params
    with set_to({"jax_disable_jit": True}):
        written_out = jax.make_jaxpr(lambda state: learner.update(state)[0].params)(state)
        assert int(evaluate(env, policy, expected, key_of(1), episodes=2).steps_taken.max()) <= 2
    assert not {"jit", "pjit", "scan"} & {step.primitive.name for step in written_out.eqns}
    leaves = jax.jit(jaxpr_as_fun(written_out))(*jax.tree.leaves(state))
    found = jax.tree.unflatten(jax.tree.structure(expected), leaves)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), found, expected
    )


@pytest.mark.parametrize("settings", OTHER, ids=name_of)
def test_other_numbers_are_still_numbers(settings, tmp_path):
    with set_to(settings):
        found = jax.device_get(results(tmp_path / "saved"))
    assert_narrow(found)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found["trained"]))
    assert (found["metrics"]["gradient_norm"] > 0).all()


@pytest.mark.parametrize("name", ["rbg", "unsafe_rbg"])
def test_a_seed_and_the_held_out_starts_are_the_same_ones(name):
    before = [jax.random.key_data(keys) for keys in (held_out_keys(FEW), seed_keys([3]))]
    with set_to({"jax_default_prng_impl": name}):
        after = [jax.random.key_data(keys) for keys in (held_out_keys(FEW), seed_keys([3]))]
    jax.tree.map(np.testing.assert_array_equal, before, after)


@pytest.mark.parametrize("name", ["rbg", "unsafe_rbg"])
def test_keys_of_another_kind(name):
    """A program may hand over whichever keys it has."""
    policy = make_policy("ic3net", PCP, hidden=4, encoder="linear")
    learner = make_learner(PCP, policy, preset("fast", num_envs=4, rollout_length=5))
    state = jax.jit(learner.init)(jax.random.key(0, impl=name))
    state, tally = jax.jit(learner.update)(state)
    assert int(tally.env_steps) == 20
    assert jax.random.key_impl(state.key) == name


CASES = [
    ("ic3net", StateUpsampled(PredatorPrey(size=3, num_predators=2), 6, scale="mass"), "fast"),
    ("iric", StateUpsampled(PredatorPrey(size=3, num_predators=2), 6, fill="corner"), "fast"),
    ("commnet", PredatorPrey(size=3, num_predators=2, reward_mode="competitive"), "paper"),
    ("magic", PCP, "fast"),
    ("hetnet", PCP, "paper"),
    ("hetnet-binary", PredatorPrey(size=3, num_predators=2), "fast"),
]


@pytest.mark.parametrize(("name", "env", "settings"), CASES, ids=[case[0] for case in CASES])
def test_every_policy_under_the_strictest(name, env, settings):
    """One update and its way back through time, as it is traced: every operation is checked then.

    The first leaf that were of 64 bits would be refused by the loop over the steps.
    """
    small = {} if name.startswith("hetnet") else {"hidden": 4}
    size = {"num_envs": 4, "rollout_length": 5} if settings == "fast" else {}
    more = {"warmup_epochs": 1, "anneal_epochs": 2, "advantages": "normalised"}
    with set_to(STRICTEST):
        policy = make_policy(name, env, **small)
        learner = make_learner(env, policy, preset(settings, name, **size, **more))
        state = jax.eval_shape(learner.init, key_of(0))
        after, tally = jax.eval_shape(learner.update, state)
        assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(
            lambda x: (x.shape, x.dtype), state
        )
        assert_narrow((state.params, state.actors, tally))
        held_out = jax.eval_shape(
            lambda params: evaluate(env, policy, params, key_of(0), episodes=FEW), state.params
        )
        assert_narrow(held_out)


@pytest.mark.parametrize(
    "env",
    [
        PP,
        PCP,
        PredatorCapturePrey(size=3, num_capturers=1, capture_vision=0, capture_reward="second"),
        StateUpsampled(PCP, 6, scale="mass"),
    ],
    ids=["PP", "PCP", "PCP that sees", "upsampled"],
)
def test_tasks_under_the_strictest(env):
    """Called one by one, and by other libraries' programs, with numbers as these have them."""
    actions = np.zeros(env.num_agents, np.int64)
    with set_to(STRICTEST):
        state = env.reset(key_of(0))
        stepped = env.step(state, jnp.asarray(actions))
        assert_narrow((state, stepped, env.observe(state), env.state_table()))
        assert_narrow((env.active(state), env.shortest_steps(state)))
        task, other = AutoReset(env), JaxMARLEnv(env)
        assert_narrow(task.step(key_of(1), task.reset(key_of(0))[1], actions))
        by_agent = dict(zip(other.agents, actions, strict=True))
        assert_narrow(other.step(key_of(1), other.reset(key_of(0))[1], by_agent))
