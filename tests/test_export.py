"""Compiled policy steps and tasks, written to a file and read in a program that has no policy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from sumajax import make_policy
from sumajax.environments import PredatorCapturePrey
from sumajax.keys import key_of

pytest.importorskip("flatbuffers", reason="jax.export writes with flatbuffers, not installed")

ENV = PredatorCapturePrey(size=3, num_predators=2, num_capturers=1, max_steps=6)


def read_back(function, *arguments):
    """`function` as it comes back from its serialised form."""
    written = export.export(jax.jit(function))(*arguments).serialize()
    return export.deserialize(written)


@pytest.mark.parametrize("name", ["ic3net", "magic", "hetnet-binary"])
def test_a_policy_step(name):
    """Carry, observation and output are the records they were."""
    policy = make_policy(name, ENV)
    params = jax.jit(policy.init)(key_of(0))
    carry, obs = policy.initial_carry(), ENV.observe(ENV.reset(key_of(1)))
    noise = policy.sample_noise(key_of(2), ())
    again = read_back(policy.apply_with, params, carry, obs, noise)
    expected = policy.apply_with(params, carry, obs, noise)
    found = again.call(params, carry, obs, noise)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), found, expected
    )


def test_a_step_of_the_task():
    state, actions = ENV.reset(key_of(1)), jnp.zeros(ENV.num_agents, jnp.int32)
    found = read_back(ENV.step, state, actions).call(state, actions)
    jax.tree.map(np.testing.assert_array_equal, found, ENV.step(state, actions))
