"""A number that is not finite stops its seed at the last good state, and nothing else."""

from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beginnings import begin, random_parameters
from probes import MatchView
from trajectories import tiny_learner

from sumajax.learning import Learner, guard

NAN, INF = float("nan"), float("inf")
EPOCHS = 3
HARMS = ("nothing", "NaN loss", "infinite loss", "NaN gradient", "infinite gradient", "NaN memory")


@dataclass(frozen=True, eq=False)
class Harmed(Learner):
    """Does as it should up to the beginning of the second epoch."""

    harm: int = 0  # may be traced: one program for all

    def _gradient(self, params, actors, draws, updates):
        grads, (actors, tally) = super()._gradient(params, actors, draws, updates)
        now = updates == self.config.updates_per_epoch
        wrong = jnp.array([0, NAN, INF, NAN, INF, 0])[self.harm]
        in_loss = jnp.where(now & (self.harm <= 2), wrong, 0)
        in_gradient = jnp.where(now & (self.harm > 2), wrong, 0)
        loss = tally.loss.replace(value=tally.loss.value + in_loss)
        grads = jax.tree.map(lambda g: g + in_gradient, grads)
        return grads, (actors, tally.replace(loss=loss))


@cache
def runs():
    """States and metrics (harms, epochs, ...) after each epoch, all from one start."""
    base = tiny_learner(MatchView(), num_envs=200, rollout_length=20)

    def one(harm):
        learner = Harmed(base.env, base.policy, base.config, harm=harm)
        state = begin(learner, random_parameters(base.policy), jax.random.key(0))
        bad_memory = jax.tree.map(lambda x: x + jnp.where(harm == 5, NAN, 0), state.opt_state)
        state = state.replace(opt_state=bad_memory)

        def epoch(state, _):
            state, metrics = learner.epoch(state)
            numbers = state.replace(key=jax.random.key_data(state.key))
            return state, (numbers, metrics)

        return jax.lax.scan(epoch, state, length=EPOCHS)[1]

    states, metrics = jax.jit(jax.vmap(one))(jnp.arange(len(HARMS)))
    return jax.tree.map(np.asarray, states), jax.tree.map(np.asarray, metrics)


def test_without_harm_it_goes_on():
    states, metrics = runs()
    np.testing.assert_array_equal(states.updates[0], [5, 10, 15])
    np.testing.assert_array_equal(metrics.fault[0], [0, 0, 0])
    np.testing.assert_array_equal(metrics.env_steps[0], [20_000] * 3)


@pytest.mark.parametrize("harm", range(1, 5), ids=HARMS[1:5])
def test_the_last_good_state_is_kept(harm):
    """Bit for bit: parameters, optimiser, environments and memory as the first epoch left them."""
    states, metrics = runs()
    kept = jax.tree.map(lambda x: x[harm, -1], states)
    good = jax.tree.map(lambda x: x[0, 0], states)
    jax.tree.map(np.testing.assert_array_equal, kept, good)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(kept.params))
    fault = {1: "loss became NaN", 2: "loss became infinite"}
    fault |= {3: "gradient became NaN", 4: "gradient became infinite"}
    code = 1 + guard.FAULTS.index(fault[harm])
    np.testing.assert_array_equal(metrics.fault[harm], [0, code, code])


@pytest.mark.parametrize("harm", range(1, 5), ids=HARMS[1:5])
def test_figures_are_of_updates_that_were_taken(harm):
    _, metrics = runs()
    ours, good = (jax.tree.map(lambda x, i=i: x[i], metrics) for i in (harm, 0))
    np.testing.assert_array_equal(ours.env_steps, [20_000, 0, 0])
    for name in ("steps_taken", "entropy", "policy_loss", "value_loss", "gradient_norm"):
        np.testing.assert_array_equal(getattr(ours, name)[0], getattr(good, name)[0])
        assert np.isnan(getattr(ours, name)[1:]).all()


def test_parameters_that_would_not_be_finite_are_not_taken():
    states, metrics = runs()
    assert metrics.fault[5].tolist() == [1 + guard.FAULTS.index("parameters became NaN")] * 3
    assert states.updates[5].tolist() == [0, 0, 0]
    assert all(np.isfinite(leaf[5]).all() for leaf in jax.tree.leaves(states.params))


@pytest.mark.parametrize(
    ("loss", "norm", "params", "fault"),
    [
        (1.0, 2.0, [3.0], None),
        (NAN, NAN, [NAN], "loss became NaN"),
        (-INF, NAN, [1.0], "loss became infinite"),
        (1.0, INF, [NAN], "gradient became infinite"),
        (1.0, NAN, [NAN], "gradient became NaN"),
        (1.0, 1.0, [1.0, NAN], "parameters became NaN"),
        (1.0, 1.0, [INF, 1.0], "parameters became infinite"),
    ],
)
def test_the_first_quantity_is_named(loss, norm, params, fault):
    found = guard.faults_of(jnp.float32(loss), jnp.float32(norm), {"w": jnp.array(params)})
    named = [name for name, count in zip(guard.FAULTS, found, strict=True) if count]
    assert named == ([fault] if fault else [])
    code = int(guard.first_fault(found * 40))
    assert code == (1 + guard.FAULTS.index(fault) if fault else 0)
