"""Traffic Junction as its rules say: who moves, who enters, who pays, and what a car sees."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax.environments import Environment, TrafficJunction
from sumajax.environments.traffic_junction import (
    BRAKE,
    GAS,
    Arrivals,
    draw_arrivals,
    flat_observation,
    reset,
    step_with,
)
from sumajax.upsampling import StateUpsampled

EASY = TrafficJunction(num_cars=3)
MEDIUM = TrafficJunction("medium", num_cars=4, max_steps=12)
EPISODES = 1000
KEY = jax.random.key(0)

move = jax.jit(step_with, static_argnums=0)
step = jax.jit(lambda env, state, actions: env.step(state, actions), static_argnums=0)
start = jax.jit(lambda env, key: env.reset(key), static_argnums=0)
observe = jax.jit(lambda env, state: env.observe(state), static_argnums=0)
look = jax.jit(
    lambda env, state: (env.observe(state), env.state_index(state), env.view(state)),
    static_argnums=0,
)
draw = jax.jit(draw_arrivals, static_argnums=0)


def arrivals(env, cars=()) -> Arrivals:
    """Cars as (entry, slot, route of the entry)."""
    fields = np.zeros((3, len(env.roads.entries)), np.int32)
    for entry, slot, choice in cars:
        fields[:, entry] = 1, slot, choice
    return Arrivals(happens=jnp.asarray(fields[0] == 1), slot=fields[1], choice=fields[2])


def play(env, plan, state=None):
    """States and transitions of steps given as (actions, arriving cars)."""
    states, transitions = [start(env, KEY) if state is None else state], []
    for actions, cars in plan:
        state, transition = move(env, states[-1], jnp.asarray(actions), arrivals(env, cars))
        states.append(state)
        transitions.append(transition)
    return states, transitions


def rewards(transitions):
    return np.array([transition.reward for transition in transitions])


def cell(env, state, slot):
    return tuple(env.roads.cell[int(state.place[slot])].tolist())


GO, STAY = [GAS] * 3, [BRAKE] * 3


class TestConfiguration:
    @pytest.mark.parametrize(
        ("difficulty", "expected"),
        [
            ("easy", (6, 5, 20, 0.3, (2, 7, 7))),
            ("medium", (14, 10, 40, 0.2, (2, 14, 14))),
            ("hard", (18, 20, 80, 0.05, (2, 18, 18))),
        ],
    )
    def test_what_is_not_given_is_as_published(self, difficulty, expected):
        env = TrafficJunction(difficulty)
        got = (env.size, env.num_agents, env.max_steps, env.arrival_rate, env.state_shape)
        assert got == expected
        assert isinstance(env, Environment)
        assert env.view_shape == (4, 3, 3)
        assert env.action_mask.shape == (env.num_agents, 2)
        assert env.action_mask.all()
        assert env.agent_class.tolist() == [0] * env.num_agents

    @pytest.mark.parametrize(
        ("settings", "sentence"),
        [
            ({"difficulty": "extreme"}, "difficulty 'extreme' is unknown; choose one of easy"),
            ({"size": 7}, "size 7 of the easy junction must be even and at least 5"),
            ({"size": 6, "vision": 3}, "size 6 of the easy junction must be even and at least 7"),
            ({"difficulty": "hard", "size": 10}, "must be a multiple of 3, at least 9"),
            ({"difficulty": "hard", "size": 6}, "must be a multiple of 3, at least 9"),
            ({"num_cars": 1}, "num_cars must be at least 2, got 1"),
            ({"vision": 0.5}, "vision must be a whole number, got 0.5"),
            ({"max_steps": 0}, "max_steps must be at least 1"),
            ({"arrival_rate": 1.5}, "arrival_rate is a chance between 0 and 1, got 1.5"),
            ({"final_arrival_rate": "x"}, "final_arrival_rate is a chance between 0 and 1"),
            ({"rate_epochs": (0, 2_000_000)}, "rate_epochs must end by 1000000, got"),
            ({"rate_epochs": (1,)}, "rate_epochs are two whole numbers"),
        ],
    )
    def test_mistakes(self, settings, sentence):
        with pytest.raises(ValueError, match=sentence):
            TrafficJunction(**settings)

    @pytest.mark.parametrize(("actions", "sentence"), [([0, 0], "shape"), ([0, 2, 0], "action 2")])
    def test_wrong_actions(self, actions, sentence):
        with pytest.raises(ValueError, match=sentence):
            EASY.step(EASY.reset(KEY), jnp.array(actions))


class TestCars:
    def test_an_episode_starts_empty(self):
        state = EASY.reset(KEY)
        assert not EASY.alive(state).any()
        seen = observe(EASY, state)
        assert not seen.state.any()
        assert not seen.view.any()
        assert not seen.alive.any()

    def test_gas_goes_on_and_brake_stays(self):
        states, _ = play(EASY, [(GO, [(0, 1, 0)]), (GO, []), (STAY, []), (GO, [])])
        assert [cell(EASY, state, 1) for state in states[1:]] == [(0, 3), (1, 3), (1, 3), (2, 3)]
        assert [int(state.last_action[1]) for state in states[1:]] == [0, 0, 1, 0]
        assert [int(state.wait[1]) for state in states[1:]] == [0, 1, 2, 3]
        for state in states[1:]:
            assert EASY.alive(state).tolist() == EASY.active(state).tolist() == [False, True, False]

    def test_nobody_blocks_anybody(self):
        plan = [(GO, [(0, 0, 0)]), (STAY, [(0, 1, 0)]), ([BRAKE, GAS, GAS], [])]
        states, _ = play(EASY, plan)
        assert cell(EASY, states[-1], 1) == (1, 3)

    def test_a_car_leaves_with_the_step_after_its_last_cell(self):
        states, transitions = play(EASY, [(GO, [(0, 2, 0)])] + [(GO, [])] * 7)
        assert cell(EASY, states[-2], 2) == (6, 3)
        assert [t.left.tolist()[2] for t in transitions] == [False] * 7 + [True]
        assert not states[-1].alive.any()
        assert int(states[-1].wait[2]) == 0
        assert transitions[-1].reward.tolist() == [0, 0, 0]

    def test_actions_of_empty_slots_mean_nothing(self):
        plans = ([(GO, [(1, 0, 0)])] + [([BRAKE, a, b], [])] * 3 for a, b in ((0, 1), (1, 0)))
        (first, _), (second, _) = (play(EASY, plan) for plan in plans)
        for a, b in zip(first, second, strict=True):
            np.testing.assert_array_equal(a.place, b.place)
            np.testing.assert_array_equal(a.last_action, b.last_action)


class TestArrivals:
    def test_a_slot_left_in_a_step_is_free_in_it(self):
        plan = [(GO, [(0, 2, 0)])] + [(GO, [])] * 6 + [(GO, [(1, 2, 0)])]
        states, transitions = play(EASY, plan)
        assert transitions[-1].left.tolist() == [False, False, True]
        assert states[-1].alive.tolist() == [False, False, True]
        assert cell(EASY, states[-1], 2) == (3, 0)
        assert int(states[-1].wait[2]) == 0
        assert float(transitions[-1].reward[2]) == 0

    @pytest.mark.parametrize("forgets", [False, True])
    def test_a_new_car_has_the_last_action_of_its_slot(self, forgets):
        env = TrafficJunction(num_cars=2, reset_last_action=forgets)
        plan = [([GAS] * 2, [(0, 0, 0)])] + [([GAS] * 2, [])] * 6
        plan += [([BRAKE] * 2, []), ([GAS] * 2, [(1, 0, 0)])]
        states, _ = play(env, plan)
        assert int(states[-1].last_action[0]) == (0 if forgets else 1)

    def test_an_occupied_slot_is_not_given_away(self):
        states, _ = play(EASY, [(GO, [(0, 1, 0)]), (STAY, [(1, 1, 0)])])
        assert cell(EASY, states[-1], 1) == (0, 3)

    def test_an_occupied_entry_does_not_stop_an_arrival(self):
        states, transitions = play(EASY, [(GO, [(0, 0, 0)]), (STAY, [(0, 1, 0)])])
        assert EASY.collided(states[-1]).tolist() == [True, True, False]
        np.testing.assert_allclose(transitions[-1].reward, [-10.01, -10, 0], rtol=1e-6)

    def test_at_rate_one_they_come_until_the_slots_are_full(self):
        env = TrafficJunction("medium", num_cars=6, arrival_rate=1.0)
        state = env.reset(KEY)
        counts = []
        for _ in range(3):
            state, _ = step(env, state, jnp.full(6, BRAKE))
            counts.append(int(state.alive.sum()))
        assert counts == [4, 6, 6]

    def test_at_rate_zero_nobody_comes(self):
        env = TrafficJunction("medium", arrival_rate=0.0)
        many = jax.vmap(lambda key: draw(env, key, jnp.zeros(10, bool), 0.0))
        assert not many(jax.random.split(KEY, 5000)).happens.any()

    def test_every_empty_slot_and_every_route_is_equally_likely(self):
        alive = jnp.array([0, 1, 0, 0, 1, 0, 0, 0, 1, 0], bool)
        env, draws = TrafficJunction("medium"), 20_000
        drawn = jax.jit(jax.vmap(lambda key: draw_arrivals(env, key, alive, 1.0)))(
            jax.random.split(KEY, draws)
        )
        assert drawn.happens.all()
        slots = np.sort(np.asarray(drawn.slot), axis=-1)
        assert (np.diff(slots) > 0).all()  # distinct
        assert set(np.unique(slots)) == set(np.flatnonzero(~alive))
        for g in range(4):
            share = np.bincount(drawn.slot[:, g], minlength=10)[~np.asarray(alive)] / draws
            np.testing.assert_allclose(share, 1 / 7, atol=4 * math.sqrt(1 / 7 / draws))
            share = np.bincount(drawn.choice[:, g], minlength=3) / draws
            np.testing.assert_allclose(share, 1 / 3, atol=4 * math.sqrt(1 / 3 / draws))
        pairs = np.asarray(drawn.slot[:, 0] * 10 + drawn.slot[:, 1])
        share = np.unique(pairs, return_counts=True)[1] / draws
        np.testing.assert_allclose(share, 1 / 42, atol=4.5 * math.sqrt(1 / 42 / draws))

    def test_each_entry_has_its_own_chance_and_full_means_none(self):
        many = jax.vmap(lambda key: draw(MEDIUM, key, jnp.zeros(4, bool), 0.2))
        happens = np.asarray(many(jax.random.split(KEY, 20_000)).happens)
        np.testing.assert_allclose(happens.mean(0), 0.2, atol=4 * math.sqrt(0.16 / 20_000))
        together = np.corrcoef(happens.T)[np.triu_indices(4, 1)]
        np.testing.assert_allclose(together, 0, atol=0.03)
        assert not draw(MEDIUM, KEY, jnp.ones(4, bool), 1.0).happens.any()

    def test_the_last_slot_goes_to_the_first_entry(self):
        last = jnp.array([True, True, False, True])
        drawn = draw(MEDIUM, KEY, last, 1.0)
        assert drawn.happens.tolist() == [True, False, False, False]
        assert int(drawn.slot[0]) == 2

    def test_a_rate_may_be_set_at_reset_and_traced(self):
        @jax.jit
        @jax.vmap
        def after_a_step(rate):
            return MEDIUM.step(reset(MEDIUM, KEY, rate), jnp.zeros(4, jnp.int32))

        states, _ = after_a_step(np.array([0.0, 1.0], np.float32))
        assert states.alive.sum(-1).tolist() == [0, 4]


class TestReward:
    def test_grows_with_the_steps_since_entering(self):
        _, transitions = play(EASY, [(GO, [(0, 0, 0)]), (GO, []), (STAY, []), (GO, [])])
        np.testing.assert_allclose(rewards(transitions)[:, 0], [0, -0.01, -0.02, -0.03], rtol=1e-6)

    def test_of_a_collision_is_paid_by_all_in_every_step_of_it(self):
        plan = [(GO, [(0, 0, 0)]), (STAY, [(0, 1, 0)]), (STAY, [(0, 2, 0)]), (GO, [])]
        states, transitions = play(EASY, [*plan, ([BRAKE, GAS, GAS], [])])
        expected = [[0] * 3, [-10.01, -10, 0], [-10.02, -10.01, -10], [-10.03, -10.02, -10.01]]
        expected += [[-0.04, -10.03, -10.02]]
        np.testing.assert_allclose(rewards(transitions), expected, rtol=1e-6)
        assert [t.success.item() for t in transitions] == [True] + [False] * 4
        assert states[-1].alive.all()  # nobody is taken away

    def test_one_collision_fails_the_episode_for_good(self):
        plan = [(GO, [(0, 0, 0)]), (STAY, [(0, 1, 0)]), ([BRAKE, GAS, GAS], []), (STAY, [])]
        states, transitions = play(EASY, plan)
        assert not EASY.collided(states[-1]).any()
        assert not transitions[-1].success


class TestEnd:
    def test_only_the_step_limit_ends_an_episode(self):
        env = TrafficJunction(num_cars=2, max_steps=3)
        _, transitions = play(env, [([GAS] * 2, [])] * 4)
        assert [t.truncated.item() for t in transitions] == [False, False, True, True]
        assert not any(t.terminated for t in transitions)
        assert [int(t.steps_taken) for t in transitions] == [1, 2, 3, 4]


class TestSight:
    def test_roads_cars_outside_and_the_own_last_action(self):
        plan = [(GO, [(0, 0, 0)]), (GO, [(0, 1, 0)]), (STAY, [])]
        states, _ = play(EASY, plan)
        view = observe(EASY, states[-1]).view
        road, cars, outside, last_action = view[0]  # it is at (1, 3)
        np.testing.assert_array_equal(road, [[0, 1, 0]] * 3)
        np.testing.assert_array_equal(cars, [[0, 1, 0], [0, 1, 0], [0, 0, 0]])
        np.testing.assert_array_equal(outside, [[1, 0, 1]] * 3)
        np.testing.assert_array_equal(last_action, np.ones((3, 3)))
        above = view[1]  # at (0, 3): beyond the border is no road
        np.testing.assert_array_equal(above[0], [[0, 0, 0], [0, 1, 0], [0, 1, 0]])
        np.testing.assert_array_equal(above[2], 1 - above[0])
        assert not view[2].any()

    def test_cars_are_counted(self):
        states, _ = play(EASY, [(GO, [(0, 0, 0)]), (STAY, [(0, 1, 0)]), (STAY, [(0, 2, 0)])])
        assert observe(EASY, states[-1]).view[:, 1, 1, 1].tolist() == [3, 3, 3]

    @pytest.mark.parametrize("env", [EASY, MEDIUM, TrafficJunction("hard", 9, 5, arrival_rate=0.5)])
    def test_the_table_has_every_state_tensor(self, env):
        table, state = np.asarray(env.state_table()), start(env, KEY)
        np.testing.assert_array_equal(table, env.sparse_states().dense())
        random = np.random.default_rng(0)
        for _ in range(8):
            seen, index, view = look(env, state)
            np.testing.assert_array_equal(table[index], seen.state)
            np.testing.assert_array_equal(view, seen.view)
            np.testing.assert_array_equal(seen.alive, state.alive)
            actions = (random.random(env.num_agents) < 0.3).astype(np.int32)
            state, _ = step(env, state, actions)

    def test_a_very_large_grid_has_no_table_but_a_list(self):
        env = TrafficJunction("hard", 60, 2)
        assert env.state_table() is None
        assert env.sparse_states().shape == env.state_shape

    def test_easy_upsampled_has_the_shapes_of_medium(self):
        small, large = StateUpsampled(TrafficJunction("easy"), 14), TrafficJunction("medium")
        assert small.state_shape == large.state_shape
        assert small.view_shape == large.view_shape
        state = start(small, KEY).replace(alive=np.ones(5, bool), place=np.zeros(5, np.int32))
        seen = observe(small, state).state[0]
        np.testing.assert_array_equal(np.argwhere(seen[0]), [[0, 6], [0, 7], [1, 6], [1, 7]])
        assert small.alive(state).all()

    def test_the_originals_observation_has_empty_slots_at_the_corner(self):
        env = TrafficJunction("hard", 9, 4)  # the first lane's cell (1, 1) sees (0, 0)
        states, _ = play(env, [([GAS] * 4, [(0, 0, 0)]), ([GAS] * 4, [])])
        flat = jax.jit(flat_observation, static_argnums=(0, 2))(env, states[-1], "scalar")[0]
        assert flat[:4].tolist() == [0, 0, 0.125, 0.125]
        cars = flat[4:].reshape(3, 3, 2)[..., 1]
        np.testing.assert_array_equal(cars, [[3, 0, 0], [0, 1, 0], [0, 0, 0]])
        assert observe(env, states[-1]).view[0, 1, 0, 0] == 0
        with pytest.raises(ValueError, match="vocabulary 'words' is unknown"):
            flat_observation(env, states[-1], "words")


def test_who_has_come_is_part_of_what_is_seen():
    """The same as of the step: into an empty slot, or one that was left in it."""
    states, transitions = play(
        EASY,
        [
            (GO, [(0, 0, 0)]),
            (GO, [(1, 2, 0)]),
            *[(GO, [])] * 5,
            (GO, [(0, 0, 0)]),  # in which slot 0 is left
            (GO, []),
        ],
    )
    assert [transition.left.tolist() for transition in transitions[6:8]] == [
        [False] * 3,
        [True, False, False],
    ]
    seen = [np.flatnonzero(observe(EASY, state).entered).tolist() for state in states]
    assert seen == [[], [0], [2], [], [], [], [], [], [0], []]


def test_figures_of_merit():
    """Collisions per car, mean delay and cars through, as amounts and counts of each step."""
    brakes = [BRAKE, GAS, GAS]
    states, transitions = play(
        EASY,
        [
            (GO, [(0, 0, 0)]),  # one comes
            (brakes, [(0, 1, 0)]),  # it waits, and another comes into it
            (brakes, []),  # waits again; the other goes on
            *[(GO, [])] * 6,  # of seven cells the other has one more to go
            (GO, [(0, 1, 0)]),  # both are out but one; a third comes
        ],
    )
    steps = zip(states, transitions, states[1:], strict=False)
    measured = np.array([EASY.measure(*step) for step in steps])
    collisions, delay, through = np.moveaxis(measured, 1, 0)
    assert collisions.tolist() == [[0, 1], [2, 1], *[[0, 0]] * 7, [0, 1]]
    assert delay[:, 0].tolist() == [0, 1, 1, *[0] * 7]
    assert (delay[:, 1] == collisions[:, 1]).all()
    assert through[:, 0].sum() == sum(int(t.left.sum()) for t in transitions) == 2
    assert not through[:, 1].any()  # no episode has ended


class TestCurriculum:
    def test_a_rate_stays_unless_it_is_to_rise(self):
        for last in (None, 0.1, 0.05):
            env = TrafficJunction(arrival_rate=0.1, final_arrival_rate=last, rate_epochs=(0, 4))
            assert env.rates(np.arange(6)).tolist() == [0.1] * 6

    def test_it_rises_by_hundredths_in_its_epochs(self):
        """Rounded down, and as float division has it: 0.15 and 0.2 become 0.14 and 0.19."""
        env = TrafficJunction(arrival_rate=0.1, final_arrival_rate=0.2, rate_epochs=(2, 6))
        np.testing.assert_allclose(
            env.rates(np.arange(8)), [0.1, 0.1, 0.12, 0.14, 0.17, *[0.19] * 3]
        )

    def test_an_epoch_counts_once(self):
        env = TrafficJunction(arrival_rate=0.1, final_arrival_rate=0.2, rate_epochs=(2, 6))
        np.testing.assert_allclose(env.rates([2, 2, 3, 1]), [0.12, 0.12, 0.14, 0.14])

    def test_an_episode_is_at_the_last_rate_or_at_that_of_its_epoch(self):
        env = TrafficJunction(arrival_rate=0.1, final_arrival_rate=0.2, rate_epochs=(2, 6))
        assert env.last_arrival_rate == 0.2
        assert float(env.reset(KEY).arrival_rate) == np.float32(0.2)
        rates = jax.vmap(lambda epoch: env.reset_in_epoch(KEY, epoch).arrival_rate)(jnp.arange(9))
        np.testing.assert_array_equal(rates, env.rates(np.arange(9)).astype(np.float32))

    def test_a_rate_that_does_not_rise_is_that_of_every_episode(self):
        constant = {"final_arrival_rate": 0.05, "rate_epochs": (0, 4)}
        for settings in ({}, constant, {"final_arrival_rate": 0.3, "rate_epochs": (0, 1)}):
            env = TrafficJunction(arrival_rate=0.1, **settings)
            assert not env.rises
            for state in (env.reset(KEY), env.reset_in_epoch(KEY, 7)):
                assert float(state.arrival_rate) == np.float32(0.1)


class TestPrograms:
    def test_environments_side_by_side_are_as_each_alone(self):
        keys = jax.random.split(KEY, 4)
        states, together = jax.jit(jax.vmap(MEDIUM.reset))(keys), jax.jit(jax.vmap(MEDIUM.step))
        alone = [start(MEDIUM, key) for key in keys]
        for time in range(5):
            actions = jax.random.bernoulli(jax.random.key(time), 0.3, (4, 4)).astype(jnp.int32)
            states, transitions = together(states, actions)
            for e in range(4):
                alone[e], transition = step(MEDIUM, alone[e], actions[e])
                mine = jax.tree.map(lambda leaf, e=e: leaf[e], (states, transitions))
                for ours, theirs in zip(
                    jax.tree.leaves(mine), jax.tree.leaves((alone[e], transition)), strict=True
                ):
                    if jnp.issubdtype(ours.dtype, jax.dtypes.prng_key):
                        ours, theirs = jax.random.key_data(ours), jax.random.key_data(theirs)
                    np.testing.assert_allclose(ours, theirs, rtol=1e-6)

    def test_the_key_in_the_state_draws_apart(self):
        """From environment to environment and from step to step; one key gives one episode."""

        def places(key):
            state, seen = start(MEDIUM, key), []
            for _ in range(8):
                state, _ = step(MEDIUM, state, jnp.zeros(4, jnp.int32))
                seen.append(np.asarray(state.place))
            return np.array(seen)

        first, again, other = places(jax.random.key(1)), places(jax.random.key(1)), places(KEY)
        np.testing.assert_array_equal(first, again)
        assert (first != other).any()
        before = MEDIUM.reset(KEY)
        after, _ = step(MEDIUM, before, jnp.zeros(4, jnp.int32))
        assert (jax.random.key_data(before.key) != jax.random.key_data(after.key)).any()

    def test_given_arrivals_use_no_key(self):
        before = MEDIUM.reset(KEY)
        after, _ = MEDIUM.step_with(before, jnp.zeros(4, jnp.int32), arrivals(MEDIUM))
        assert after.key == before.key


def brakes(share):
    def success_and_return(env):
        """(EPISODES,) success, and return per slot."""

        def one_step(carry, key):
            action_key, _ = jax.random.split(key)
            actions = jax.random.bernoulli(action_key, share, (EPISODES, env.num_agents))
            states, transition = jax.vmap(env.step)(carry, actions.astype(jnp.int32))
            return states, (transition.success, transition.reward.mean(-1))

        states = jax.vmap(env.reset)(jax.random.split(jax.random.key(2), EPISODES))
        keys = jax.random.split(jax.random.key(3), env.max_steps)
        _, (success, reward) = jax.lax.scan(one_step, states, keys)
        return success[-1], reward.sum(0)

    return jax.jit(success_and_return, static_argnums=0)


always_gas, uniform = brakes(0.0), brakes(0.5)


@pytest.mark.parametrize(
    ("difficulty", "rate", "episodes", "gas", "random"),
    [
        ("easy", 0.1, 1000, (0.862, -0.73), (0.416, -10.68)),
        ("easy", 0.3, 1000, (0.291, -4.66), (0.006, -40.88)),
        ("medium", 0.05, 500, (0.728, -2.25), (0.162, -14.21)),
        ("medium", 0.2, 500, (0.026, -20.79), (0.000, -69.97)),
        ("hard", 0.05, 300, (0.070, -12.90), (0.000, -56.69)),
    ],
)
def test_reference_levels(difficulty, rate, episodes, gas, random):
    """Success and return per slot of always gas, and of uniform actions, are the original's."""
    env = TrafficJunction(difficulty, arrival_rate=rate)
    for policy, (success, returned) in ((always_gas, gas), (uniform, random)):
        done, returns = (np.asarray(x) for x in policy(env))
        both = math.sqrt(1 / episodes + 1 / EPISODES)
        spread = max(math.sqrt(success * (1 - success)), math.sqrt(1 / episodes))
        assert abs(done.mean() - success) < 4 * both * spread + 0.0005
        assert abs(returns.mean() - returned) < 4 * both * returns.std() + 0.005


class TestHoldUps:
    """Lessons in which cars before a crossing have to stay, until some time after the rise."""

    ENV = TrafficJunction(num_cars=3, hold_up=0.5, rate_epochs=(1, 10), arrival_rate=0.0)

    def before_the_crossing(self, epoch):
        """Down two cells in, right one."""
        down, right = self.ENV.roads.first_places[:, 0]
        return self.ENV.reset_in_epoch(KEY, jnp.int32(epoch)).replace(
            place=jnp.array([down + 2, right + 1, self.ENV.roads.nowhere]),
            alive=jnp.array([True, True, False]),
        )

    def test_it_falls_to_nothing_once_the_rate_has_risen(self):
        epochs = (0, 10, 13, 19, 30)
        chances = [float(self.before_the_crossing(epoch).hold_up) for epoch in epochs]
        np.testing.assert_allclose(chances, [0.5, 0.5, 0.5 * 6 / 9, 0, 0])
        assert float(self.ENV.reset(KEY).hold_up) == 0

    def test_only_who_is_about_to_enter_a_crossing_is_held_up(self):
        env, first = self.ENV, self.before_the_crossing(0)
        held = first.replace(hold_up=jnp.float32(1))
        after, _ = step(env, held, jnp.zeros(3, jnp.int32))
        moved = np.asarray(after.place - first.place)[:2]
        assert moved.tolist() == [0, 1]
        assert after.last_action[:2].tolist() == [BRAKE, GAS]

    def test_as_often_as_it_says(self):
        first = self.before_the_crossing(0)
        keys = jax.random.split(KEY, EPISODES)
        states = jax.vmap(lambda key: first.replace(key=key))(keys)
        after, _ = jax.vmap(lambda state: step(self.ENV, state, jnp.zeros(3, jnp.int32)))(states)
        share = float((after.place[:, 0] == first.place[0]).mean())
        assert abs(share - 0.5) < 4 * math.sqrt(0.25 / EPISODES)

    def test_arrivals_are_those_of_the_task_without(self):
        ends = []
        for env in (TrafficJunction(num_cars=3), TrafficJunction(num_cars=3, hold_up=0.5)):
            state = start(env, KEY)
            for _ in range(4):
                state, _ = step(env, state, jnp.zeros(3, jnp.int32))
            ends.append(state)
        for name in ("place", "alive", "wait"):
            np.testing.assert_array_equal(*(getattr(state, name) for state in ends))
