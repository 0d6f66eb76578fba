"""What every policy promises to those who use it, whatever it does inside."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax.policies import Policy, TeamSpec
from sumajax.policies.ic3net import IC3Net
from sumajax.policies.types import MASKED_LOGIT, decide, mask_actions

from .teams import (
    CAPTURE_FIVE,
    CAPTURE_THREE,
    NAMES,
    PREY_FIVE,
    PREY_THREE,
    greedy,
    observe,
    parameters,
    shapes,
    small,
    stepper,
)

each_policy = pytest.mark.parametrize("name", NAMES)


def play(policy, env, seeds, reorder=None):
    """The outputs of greedy steps on observations drawn from `seeds`, of one episode."""
    step, carry, outputs = stepper(policy), policy.initial_carry(), []
    # Parameters of the smaller team, so that they are also shown to serve the larger one.
    params = parameters(small(policy.name, CAPTURE_THREE))
    for seed in seeds:
        obs = observe(env, seed)
        if reorder is not None:
            obs = jax.tree.map(lambda y: y[reorder], obs)
        carry, output = step(params, carry, obs, greedy(policy))
        outputs.append(output)
    return outputs


@pytest.mark.parametrize(
    ("few", "many"),
    [(PREY_THREE, PREY_FIVE), (CAPTURE_THREE, CAPTURE_FIVE)],
    ids=["predator-prey", "predator-capture-prey"],
)
@each_policy
def test_parameters_do_not_depend_on_the_size_of_the_team(name, few, many):
    assert shapes(small(name, few)) == shapes(small(name, many))


@each_policy
def test_parameters_of_a_small_team_serve_a_large_one(name):
    """Carried from 2 predators and 1 capture agent to 3 and 2, as in the published transfer."""
    (output,) = play(small(name, CAPTURE_FIVE), CAPTURE_FIVE, seeds=[0])
    assert output.logits.shape == (5, 6)
    chex.assert_tree_all_finite(output)


@each_policy
def test_agents_of_a_class_are_interchangeable(name):
    """Reordering what the agents see reorders what they do, messages and memory included."""
    policy, order = small(name, CAPTURE_FIVE), np.array([1, 2, 0, 4, 3])
    *_, output = play(policy, CAPTURE_FIVE, seeds=[0, 1, 2])
    *_, swapped = play(policy, CAPTURE_FIVE, seeds=[0, 1, 2], reorder=order)
    np.testing.assert_allclose(swapped.logits, output.logits[order], atol=1e-5)
    np.testing.assert_allclose(swapped.value, output.value[order], atol=1e-5)
    np.testing.assert_allclose(swapped.attention, output.attention[order][:, order], atol=1e-5)


@each_policy
def test_agents_remember_what_they_saw(name):
    policy = small(name, CAPTURE_THREE)
    _, after_one = play(policy, CAPTURE_THREE, seeds=[0, 9])
    _, after_other = play(policy, CAPTURE_THREE, seeds=[1, 9])
    assert (jnp.abs(after_one.logits - after_other.logits).max(-1) > 1e-6).all()


@each_policy
def test_blind_agents_do_not_read_their_view(name):
    policy, obs = small(name, CAPTURE_THREE), observe(CAPTURE_THREE, 0)
    told = obs.replace(view=np.where(np.arange(3)[:, None, None, None] == 2, 7.0, obs.view))
    carry, noise = policy.initial_carry(), greedy(policy)
    step = stepper(policy)
    chex.assert_trees_all_equal(
        step(parameters(policy), carry, obs, noise), step(parameters(policy), carry, told, noise)
    )


@each_policy
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_greedy_noise_is_zeros_like_what_is_drawn(name, batch):
    policy, key = small(name, CAPTURE_THREE), jax.random.key(0)
    drawn, noise = policy.sample_noise(key, batch), policy.greedy_noise(batch)
    chex.assert_trees_all_equal_shapes_and_dtypes(noise, drawn)
    assert not any(leaf.any() for leaf in jax.tree.leaves(noise))
    either = jax.jit(policy.sample_noise, static_argnums=1)
    chex.assert_trees_all_equal(either(key, batch, True), noise)
    chex.assert_trees_all_equal(either(key, batch, False), drawn)


@each_policy
def test_zero_noise_is_greedy(name):
    for output in play(small(name, CAPTURE_THREE), CAPTURE_THREE, seeds=[0, 1]):
        for decision in output.decisions.values():
            np.testing.assert_array_equal(decision.choice, decision.logits.argmax(-1))


@pytest.fixture(scope="module", params=NAMES)
def many_samples(request):
    """A policy, its observation and noise of 500 environments, and what it did with them."""
    env, batch = CAPTURE_THREE, (500,)
    policy = small(request.param, env)
    obs, noise = observe(env, 0, batch), policy.sample_noise(jax.random.key(1), batch)
    carry = policy.initial_carry(batch)
    following, output = stepper(policy)(parameters(policy), carry, obs, noise)
    chex.assert_trees_all_equal_shapes_and_dtypes(carry, following)
    return policy, obs, noise, output


def test_output_has_the_promised_shapes_and_ranges(many_samples):
    *_, output = many_samples
    chex.assert_shape(output.action, (500, 3))
    chex.assert_shape(output.logits, (500, 3, 6))
    chex.assert_shape([output.value, output.communication], (500, 3))
    chex.assert_shape(output.attention, (500, 3, 3))
    assert output.action.dtype == jnp.int32
    assert ((output.communication >= 0) & (output.communication <= 1)).all()
    assert (output.attention >= 0).all()
    chex.assert_tree_all_finite(output)


def test_a_batch_of_steps_is_its_single_steps(many_samples):
    policy, obs, noise, output = many_samples
    for environment in (0, 499):
        alone = jax.tree.map(lambda y, e=environment: y[e], (obs, noise))
        _, expected = stepper(policy)(parameters(policy), policy.initial_carry(), *alone)
        ours = jax.tree.map(lambda y, e=environment: y[e], output)
        chex.assert_trees_all_close(ours, expected, atol=1e-5)


def test_actions_a_class_does_not_have_are_never_taken(many_samples):
    *_, output = many_samples
    allowed = CAPTURE_THREE.action_mask
    probability = np.asarray(jax.nn.softmax(output.logits))
    assert (probability[..., ~allowed] == 0).all()
    taken = np.stack([(output.action == action).any(0) for action in range(6)], axis=-1)
    np.testing.assert_array_equal(taken, allowed)


@each_policy
def test_what_is_prepared_for_many_steps_changes_nothing(name):
    """Features gathered by cell and folded weights: the values and gradients of a step alone."""
    env, policy = CAPTURE_THREE, small(name, CAPTURE_THREE)
    obs, noise = observe(env, 0, (2,)), policy.sample_noise(jax.random.key(1), (2,))
    cell = obs.state.reshape(2, env.num_agents, -1).argmax(-1)
    table = np.asarray(env.state_table())

    def direct(params):
        return policy.apply_with(params, policy.initial_carry((2,)), obs, noise)[1]

    def from_table(params):
        features, params = policy.encode_states(params, table)[cell], policy.prepare(params)
        return policy.step(params, policy.initial_carry((2,)), features, obs.view, noise)[1]

    def gradient_and_output(act):
        def loss(params):
            output = act(params)
            return (jax.nn.softmax(output.logits) ** 2).sum() + (output.value**2).sum(), output

        return jax.jit(jax.grad(loss, has_aux=True))(parameters(policy))

    (gradient, output), expected = gradient_and_output(from_table), gradient_and_output(direct)
    chex.assert_trees_all_close(output, expected[1], atol=1e-5)
    chex.assert_trees_all_close(gradient, expected[0], atol=1e-4, rtol=1e-4)


@each_policy
def test_a_listed_state_is_encoded_as_the_state_itself(name):
    policy, states = small(name, CAPTURE_THREE), CAPTURE_THREE.sparse_states()
    listed = jax.jit(lambda params: policy.encode_listed(params, states))(parameters(policy))
    direct = jax.jit(policy.encode_states)(parameters(policy), jnp.asarray(states.dense()))
    np.testing.assert_allclose(listed, direct, atol=1e-5)


def test_a_module_that_encodes_anew_is_given_whole_states():
    class Doubled(IC3Net):
        def encode_states(self, states):
            return super().encode_states(2 * states)

    module = Doubled(small("ic3net").team, hidden=16)
    policy, states = Policy("doubled", module), PREY_THREE.sparse_states()
    params = parameters(small("ic3net"))
    expected = policy.encode_states(params, jnp.asarray(states.dense()))
    np.testing.assert_allclose(policy.encode_listed(params, states), expected, atol=1e-5)


@each_policy
def test_a_step_is_traced_once(name):
    policy = small(name, CAPTURE_THREE)
    carry = policy.initial_carry()
    traces = []

    @jax.jit
    def act(*arguments):
        traces.append(name)
        return policy.apply(*arguments)

    for seed in range(3):
        obs = observe(CAPTURE_THREE, seed)
        carry, _ = act(parameters(policy), carry, obs, jax.random.key(seed))
    assert traces == [name]


@each_policy
def test_only_the_value_depends_on_what_is_the_critics_alone(name):
    """The decisions depend on everything else, in this step or by what the agents remember."""
    policy = small(name, CAPTURE_FIVE)
    params, obs = parameters(policy), observe(CAPTURE_FIVE, 0)

    def outcome(params, weights):
        carry, total = policy.initial_carry(), 0.0
        for _ in range(2):
            carry, output = policy.apply_with(params, carry, obs, greedy(policy))
            logits = [decision.logits for decision in output.decisions.values()]
            seen = {"value": output.value, "policy": (*logits, carry)}
            for key, weight in weights.items():
                total += weight * sum(
                    jnp.where(abs(leaf) < -MASKED_LOGIT / 2, leaf, 0.0).sum()
                    for leaf in jax.tree.leaves(seen[key])
                )
        return total

    of_policy, of_value = (
        jax.jit(jax.grad(outcome))(params, {key: 1.0}) for key in ("policy", "value")
    )
    alone = policy.only_critic(params)
    for critic, g_policy, g_value in zip(
        *map(jax.tree.leaves, (alone, of_policy, of_value)), strict=True
    ):
        if g_policy.any() or g_value.any():  # not what a closed gate leaves without a part
            assert critic == (not g_policy.any())
    assert any(jax.tree.leaves(alone))


def test_apply_rejects_observations_of_another_task():
    policy, other = small("ic3net"), observe(CAPTURE_THREE, 0)
    with pytest.raises(AssertionError):
        policy.apply(parameters(policy), policy.initial_carry(), other, jax.random.key(0))


def test_decide_samples_from_its_logits():
    logits = jnp.log(jnp.array([0.7, 0.2, 0.1]))
    choice = decide(logits, jax.random.gumbel(jax.random.key(0), (20_000, 3))).choice
    np.testing.assert_allclose(np.bincount(choice) / choice.size, [0.7, 0.2, 0.1], atol=0.01)


def test_team_spec_says_what_the_task_says():
    team = TeamSpec.of(CAPTURE_FIVE)
    assert team.num_agents == 5
    assert (team.class_size(0), team.class_size(1)) == (3, 2)
    assert team.sighted.tolist() == [True, True, True, False, False]
    assert (team.state_shape, team.view_shape) == ((1, 4, 4), (3, 3, 3))
    assert hash(team) == hash(TeamSpec.of(CAPTURE_FIVE))


def test_mask_actions_touches_only_what_an_agent_cannot_do():
    logits = jnp.arange(18.0).reshape(3, 6)
    masked = mask_actions(logits, TeamSpec.of(CAPTURE_THREE))
    np.testing.assert_array_equal(masked[:2, 5], [MASKED_LOGIT] * 2)
    np.testing.assert_array_equal(masked[:, :5], logits[:, :5])
    assert masked[2, 5] == logits[2, 5]
