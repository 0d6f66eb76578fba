"""State upsampling: the operator, and a task seen at another task's size."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sumajax.environments import Environment, PredatorCapturePrey, PredatorPrey
from sumajax.policies import make_policy
from sumajax.upsampling import StateUpsampled, upsample

factors = st.integers(1, 3)


def states(rows: int, columns: int) -> np.ndarray:
    """(2, 1, rows, columns) of different numbers."""
    return np.arange(2.0 * rows * columns, dtype=np.float32).reshape(2, 1, rows, columns)


def block_mean(state, down: int, right: int) -> np.ndarray:
    rows, columns = state.shape[-2:]
    blocks = state.reshape(*state.shape[:-2], rows // down, down, columns // right, right)
    return blocks.mean((-3, -1))


class TestUpsample:
    def test_every_cell_becomes_a_block_of_its_value(self):
        large = upsample(jnp.array([[1.0, 2.0], [3.0, 4.0]]), 2)
        assert large.tolist() == [[1, 1, 2, 2], [1, 1, 2, 2], [3, 3, 4, 4], [3, 3, 4, 4]]

    def test_a_pair_of_factors_scales_rows_and_columns_apart(self):
        large = upsample(jnp.array([[1.0, 2.0], [3.0, 4.0]]), (1, 3))
        assert large.tolist() == [[1, 1, 1, 2, 2, 2], [3, 3, 3, 4, 4, 4]]

    @settings(deadline=None, max_examples=9)
    @given(down=factors, right=factors)
    def test_the_block_mean_takes_it_back(self, down, right):
        small = states(3, 2)
        large = upsample(small, (down, right))
        assert large.shape == (2, 1, 3 * down, 2 * right)
        np.testing.assert_allclose(block_mean(large, down, right), small)

    @settings(deadline=None, max_examples=3)
    @given(factor=factors)
    def test_the_mass_grows_with_the_square_of_the_factor(self, factor):
        one_hot = np.zeros((3, 3), np.float32)
        one_hot[1, 2] = 1
        assert upsample(one_hot, factor).sum() == factor**2

    def test_the_factor_one_is_the_identity(self):
        np.testing.assert_array_equal(upsample(states(3, 2), 1), states(3, 2))

    @settings(deadline=None, max_examples=6)
    @given(first=factors, second=factors)
    def test_two_steps_are_one_by_the_product(self, first, second):
        twice = upsample(upsample(states(2, 3), first), second)
        np.testing.assert_array_equal(twice, upsample(states(2, 3), first * second))

    @pytest.mark.parametrize("factor", [0, -1, (2, 0), 1.5, (2,)])
    def test_a_factor_that_is_no_positive_whole_number_is_refused(self, factor):
        sentence = (
            f"the upsampling factor must be a positive int or (rows, columns), got {factor!r}."
        )
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
            upsample(states(2, 2), factor)


TASKS = [
    PredatorPrey(size=5, num_predators=3),
    PredatorPrey(size=(2, 3), num_predators=2),
    PredatorCapturePrey(size=5, num_predators=2, num_capturers=1),
]


class TwoChannels(PredatorPrey):
    """The own cell, and how far down and right it is."""

    @property
    def state_shape(self):
        return (2, *self.shape)

    def state_table(self):
        cells = super().state_table()
        return jnp.concatenate(
            [cells, cells * jnp.arange(1.0, 1 + len(cells))[:, None, None, None]], 1
        )

    def observe(self, state):
        seen = super().observe(state)
        return seen.replace(state=self.state_table()[self.state_index(state)])


def twice(env, **changes) -> StateUpsampled:
    return StateUpsampled(env, size=(2 * env.shape[0], 2 * env.shape[1]), **changes)


class TestStateUpsampled:
    @pytest.mark.parametrize("env", TASKS, ids=str)
    def test_only_the_state_tensor_changes(self, env):
        suma, key = twice(env), jax.random.key(0)
        state = jax.jit(suma.reset)(key)
        jax.tree.map(np.testing.assert_array_equal, state, jax.jit(env.reset)(key))
        actions = jnp.arange(env.num_agents) % env.num_actions
        for _ in range(3):
            np.testing.assert_array_equal(suma.view(state), env.view(state))
            np.testing.assert_array_equal(suma.state_index(state), env.state_index(state))
            np.testing.assert_array_equal(suma.active(state), env.active(state))
            assert suma.shortest_steps(state) == env.shortest_steps(state)
            ours, theirs = suma.step(state, actions), env.step(state, actions)
            jax.tree.map(np.testing.assert_array_equal, ours, theirs)
            state, _ = ours

    @pytest.mark.parametrize("env", TASKS, ids=str)
    def test_the_team_and_its_task_are_those_of_the_source(self, env):
        suma = twice(env)
        assert isinstance(suma, Environment)
        for name in ("num_agents", "num_actions", "max_steps", "view_shape", "sighted_classes"):
            assert getattr(suma, name) == getattr(env, name)
        np.testing.assert_array_equal(suma.agent_class, env.agent_class)
        np.testing.assert_array_equal(suma.action_mask, env.action_mask)

    @pytest.mark.parametrize("scale", ["none", "mass"])
    @pytest.mark.parametrize("env", TASKS, ids=str)
    def test_the_state_tensor_has_the_shape_of_the_target(self, env, scale):
        suma = twice(env, scale=scale)
        state = jax.jit(env.reset)(jax.random.key(1))
        ours, theirs = suma.observe(state), env.observe(state)
        assert ours.state.shape == (env.num_agents, *suma.state_shape)
        assert suma.state_shape == (1, 2 * env.shape[0], 2 * env.shape[1])
        value = 1 if scale == "none" else 0.25
        np.testing.assert_array_equal(ours.state, value * upsample(theirs.state, 2))
        np.testing.assert_array_equal(ours.view, theirs.view)

    @pytest.mark.parametrize("scale", ["none", "mass"])
    @pytest.mark.parametrize("env", TASKS, ids=str)
    def test_every_state_tensor_is_in_the_table(self, env, scale):
        state = jax.jit(env.reset)(jax.random.key(2))
        for task in (env, twice(env, scale=scale)):
            table = task.state_table()
            assert table.shape == (env.shape[0] * env.shape[1], *task.state_shape)
            np.testing.assert_array_equal(table[task.state_index(state)], task.observe(state).state)

    def test_the_sides_may_grow_by_different_factors(self):
        suma = StateUpsampled(PredatorPrey(size=(2, 3), num_predators=2), size=(2, 9))
        assert suma.factor == (1, 3)
        state = suma.state_at([[0, 1], [1, 2]], [0, 0])
        assert jnp.argwhere(suma.observe(state).state[0, 0]).tolist() == [[0, 3], [0, 4], [0, 5]]

    def test_its_own_size_changes_nothing(self):
        env = TASKS[0]
        state = jax.jit(env.reset)(jax.random.key(3))
        same = StateUpsampled(env, size=5).observe(state)
        jax.tree.map(np.testing.assert_array_equal, same, env.observe(state))

    def test_upsampling_composes(self):
        env = PredatorPrey(size=3, num_predators=2)
        state = jax.jit(env.reset)(jax.random.key(4))
        in_two = StateUpsampled(StateUpsampled(env, size=6), size=12)
        at_once = StateUpsampled(env, size=12)
        np.testing.assert_array_equal(in_two.observe(state).state, at_once.observe(state).state)

    @pytest.mark.parametrize(("size", "named"), [(12, "12x12"), (3, "3x3"), ((10, 7), "10x7")])
    def test_a_size_that_is_no_multiple_is_refused_naming_both(self, size, named):
        sentence = (
            f"the target size {named} is not a whole multiple of the source size 5x5; "
            "choose sides that divide."
        )
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
            StateUpsampled(PredatorPrey(size=5), size=size)

    @pytest.mark.parametrize("size", [0, 7.5, (10,)])
    def test_what_is_no_size_is_refused(self, size):
        sentence = f"size must be a positive int or (rows, columns), got {size!r}."
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
            StateUpsampled(PredatorPrey(size=5), size=size)

    def test_in_the_corner_nothing_is_upsampled(self):
        env = PredatorPrey(size=2, num_predators=2)
        cornered = StateUpsampled(env, size=4, fill="corner")
        small, large = env.state_table(), cornered.state_table()
        assert large.shape == (4, 1, 4, 4)
        np.testing.assert_array_equal(large[:, :, :2, :2], small)
        assert large.sum() == small.sum()
        state = env.reset(jax.random.key(0))
        assert cornered.observe(state).state.shape == (2, 1, 4, 4)

    def test_an_unknown_fill_is_refused(self):
        with pytest.raises(ValueError, match="fill 'middle' is unknown; choose one of blocks, c"):
            StateUpsampled(PredatorPrey(size=2, num_predators=2), size=4, fill="middle")

    def test_an_unknown_scale_is_refused(self):
        sentence = "scale 'sum' is unknown; choose one of none, mass."
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
            StateUpsampled(PredatorPrey(size=5), size=10, scale="sum")

    @pytest.mark.parametrize(("scale", "fill"), [("none", "blocks"), ("mass", "blocks"),
                                                 ("none", "corner")])  # fmt: skip
    def test_every_channel_is_kept(self, scale, fill):
        """Also in two steps, and whatever becomes of the blocks."""
        env = TwoChannels(size=(2, 3), num_predators=2)
        state = jax.jit(env.reset)(jax.random.key(0))
        suma = StateUpsampled(StateUpsampled(env, (2, 6), scale, fill), (4, 6), scale, fill)
        assert suma.state_shape == (2, 4, 6)
        seen, table = suma.observe(state).state, suma.state_table()
        assert seen.shape == (2, 2, 4, 6)
        assert table.shape == (6, 2, 4, 6)
        np.testing.assert_array_equal(table[suma.state_index(state)], seen)
        np.testing.assert_array_equal(suma.sparse_states().dense(), table)
        for channel in range(2):
            own = env.observe(state).state[:, channel : channel + 1]
            whole = StateUpsampled(PredatorPrey(size=(2, 3)), (4, 6), scale, fill)._transform(own)
            np.testing.assert_array_equal(seen[:, channel : channel + 1], whole)

    @pytest.mark.parametrize("name", ["ic3net", "magic", "hetnet"])
    def test_policies_read_every_channel(self, name):
        env = StateUpsampled(TwoChannels(size=(2, 3), num_predators=2), (4, 6))
        policy = make_policy(name, env)
        assert policy.team.state_shape == (2, 4, 6)
        states = env.sparse_states()
        random = np.random.default_rng(0)
        params = jax.tree.map(  # any: HetNet's own are drawn by a program of seconds
            lambda leaf: jnp.asarray(random.normal(size=leaf.shape) / 10, leaf.dtype),
            jax.eval_shape(policy.init, jax.random.key(0)),
        )
        listed = jax.jit(lambda p: policy.encode_listed(p, states))(params)
        direct = jax.jit(policy.encode_states)(params, jnp.asarray(states.dense()))
        np.testing.assert_allclose(listed, direct, atol=1e-5)
        without = jax.jit(policy.encode_states)(params, jnp.asarray(states.dense()).at[:, 1].set(0))
        assert np.abs(direct - without).max(-1).min() > 1e-4

    def test_configurations_are_values(self):
        assert StateUpsampled(TASKS[0], size=10) == StateUpsampled(TASKS[0], size=10)
        assert StateUpsampled(TASKS[1], size=[4, 6]) == StateUpsampled(TASKS[1], size=(4, 6))
        assert len({StateUpsampled(TASKS[0], size=s) for s in (10, 10, 15)}) == 2
