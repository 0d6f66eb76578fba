"""A wrapper is its task but for what it changes; one function finds the task inside."""

import copy
import pickle
from dataclasses import dataclass

import jax
import numpy as np
import pytest

from sumajax.environments import (
    Environment,
    PredatorCapturePrey,
    PredatorPrey,
    Wrapper,
    rewrapped,
    unwrapped,
)
from sumajax.upsampling import StateUpsampled

TASK = PredatorPrey(size=3, num_predators=2, max_steps=5)


@dataclass(frozen=True)
class OwnTask(PredatorPrey):
    """A domain with functions that no contract knows."""

    colour: str = "green"

    def alive(self, state):
        return ~state.reached

    def times(self, factor):
        return factor * self.max_steps


@dataclass(frozen=True)
class Patient(Wrapper):
    """Twice the step limit."""

    @property
    def max_steps(self):
        return 2 * self.env.max_steps


class Foreign:
    """Somebody else's wrapper: no `Wrapper`, but a task with a task in its field `env`."""

    def __init__(self, env):
        self.env = env

    def __getattr__(self, name):
        return getattr(self.__dict__["env"], name)


WRAPPERS = [Patient, lambda env: StateUpsampled(env, 6), lambda env: Patient(Patient(env))]
each_wrapper = pytest.mark.parametrize("wrap", WRAPPERS, ids=["own", "upsampled", "nested"])


@each_wrapper
def test_what_no_contract_knows_is_the_tasks_own(wrap):
    task = OwnTask(size=3, num_predators=2)
    env, state = wrap(task), task.reset(jax.random.key(0))
    np.testing.assert_array_equal(env.alive(state), task.alive(state))
    assert env.colour == "green"
    assert env.times(factor=3) == 240
    chosen = env.state_at([[0, 0], [1, 1]], [2, 2])
    assert env.shortest_steps(chosen) == 4


@each_wrapper
def test_what_the_task_does_not_have_the_wrapper_has_not(wrap):
    env = wrap(TASK)
    assert not hasattr(env, "colour")
    with pytest.raises(AttributeError, match="colour"):
        env.colour  # noqa: B018


@each_wrapper
def test_it_is_an_environment(wrap):
    env = wrap(TASK)
    assert isinstance(env, Environment)
    assert (env.num_agents, env.view_shape) == (2, TASK.view_shape)


@each_wrapper
def test_it_is_a_value(wrap):
    env, same = wrap(TASK), wrap(PredatorPrey(size=3, num_predators=2, max_steps=5))
    assert env == same
    assert hash(env) == hash(same)
    assert env != wrap(PredatorPrey(size=3, num_predators=1))
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env), copy.copy(env)):
        assert twin == env
        assert twin.num_agents == 2
    with pytest.raises(AttributeError):
        env.env = TASK


def test_it_is_compiled_once_for_equal_tasks():
    traces = []

    def start(env, key):
        traces.append(env)
        return env.reset(key)

    compiled = jax.jit(start, static_argnums=0)
    for _ in range(2):
        compiled(StateUpsampled(PredatorPrey(size=3, num_predators=2), 6), jax.random.key(0))
    assert len(traces) == 1


def test_what_it_changes_shows_through_wrappers_around_it():
    env = StateUpsampled(Patient(TASK), 6)
    assert (env.max_steps, env.state_shape) == (10, (1, 6, 6))
    assert Patient(StateUpsampled(TASK, 6)).state_shape == (1, 6, 6)


def test_the_innermost_task_is_found():
    assert unwrapped(TASK) is TASK
    assert unwrapped(Patient(TASK)) is TASK
    assert unwrapped(StateUpsampled(Patient(StateUpsampled(TASK, 6)), 12)) is TASK


def test_a_task_with_a_field_of_that_name_is_no_wrapper():
    @dataclass(frozen=True)
    class Named(PredatorPrey):
        env: str = "meadow"

    assert unwrapped(Named()) == Named()


def test_another_task_goes_into_the_same_wrappers():
    env = StateUpsampled(Patient(StateUpsampled(TASK, 6, fill="corner")), 12, scale="mass")
    other = PredatorCapturePrey(size=2, num_predators=1, num_capturers=1)
    again = rewrapped(env, other)
    assert again == StateUpsampled(
        Patient(StateUpsampled(other, 6, fill="corner")), 12, scale="mass"
    )
    assert rewrapped(TASK, other) is other
    with pytest.raises(ValueError, match="not a whole multiple of the source size 4x4"):
        rewrapped(env, PredatorPrey(size=4))
