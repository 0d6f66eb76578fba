"""Whole updates of the original programs against `Learner.update`, every field of `a2c_*`.

A recorded batch becomes a task of one environment whose rewards, ends and encoded observations are
those of the file, and the recorded choices are forced on the policy by its noise. What is compared
then comes out of the learner itself: rollout, loss, gradient, RMSprop step.
tests/data/policies/README.md, section 4, and README_tarmac.md define the fields.
"""

import re
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any
from unittest import mock

import chex
import jax
import jax.numpy as jnp
import numpy as np
import policy_data as data
import pytest
from flax import linen as nn
from flax import struct

from sumajax.environments.types import Observation, Transition
from sumajax.learning import LearnerConfig, losses, optimiser, preset, returns
from sumajax.learning.learner import LOSSES, Learner, TrainState
from sumajax.learning.rollout import Actors, Draws, Trajectory
from sumajax.policies.ic3net import IC3Net, IC3NetCore
from sumajax.policies.tarmac import TarMAC, TarMACCore
from sumajax.policies.types import Policy, TeamSpec

Arrays = dict[str, Any]

FORCED = 1e4
"""Gumbel noise with which a choice is made whatever its logits are."""

DTYPES = {"float64": np.float64, "float32": np.float32}
TOLERANCE = {np.float64: 1e-9, np.float32: 1e-5}

RECORDINGS = [path for path in data.recordings() if path.stem.startswith("a2c_")]
each_recording = pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
each_precision = pytest.mark.parametrize("dtype", DTYPES.values(), ids=DTYPES)


@struct.dataclass
class RecordedState:
    """Before a step."""

    row: chex.Array  # () int32 number of the step
    alive: chex.Array  # (N,) bool: who is there


@dataclass(frozen=True, eq=False)
class RecordedEpisodes:
    """The steps of all recorded episodes, one after the other."""

    reward: np.ndarray  # (rows, N)
    last: np.ndarray  # (rows,) 0 or 1
    t: np.ndarray  # (rows,) step number within the episode
    max_steps: int
    num_actions: int
    # (rows, N) 0 or 1, where agents come and go: who is there after a step, who left with it
    counted: np.ndarray | None = None
    completed: np.ndarray | None = None

    @property
    def agents_leave(self) -> bool:
        return self.counted is not None

    @property
    def num_agents(self) -> int:
        return self.reward.shape[1]

    @property
    def agent_class(self) -> np.ndarray:
        return np.zeros(self.num_agents, np.int32)

    @property
    def action_mask(self) -> np.ndarray:
        return np.ones((self.num_agents, self.num_actions), bool)

    state_shape = view_shape = (1, 1, 1)
    sighted_classes = (True,)

    def step(self, state: RecordedState, actions: chex.Array) -> tuple[RecordedState, Transition]:
        row, alive, left = state.row, state.alive, None
        last, time = jnp.asarray(self.last)[row] == 1, jnp.asarray(self.t)[row] + 1
        if self.agents_leave:
            alive = jnp.asarray(self.counted)[row] == 1
            left = jnp.asarray(self.completed)[row] == 1
        transition = Transition(
            reward=jnp.asarray(self.reward)[row],
            terminated=last & (time != self.max_steps),
            truncated=last & (time == self.max_steps),
            success=last & (time != self.max_steps),
            steps_taken=time,
            left=left,
        )
        return RecordedState(row + 1, alive), transition

    def view(self, state: RecordedState) -> chex.Array:
        return jnp.zeros((self.num_agents, *self.view_shape))

    def state_index(self, state: RecordedState) -> chex.Array:
        return state.row * self.num_agents + jnp.arange(self.num_agents)

    def state_table(self) -> chex.Array:
        return jnp.zeros((self.reward.size, *self.state_shape))

    def observe(self, state: RecordedState) -> Observation:
        return Observation(jnp.zeros((self.num_agents, *self.state_shape)), self.view(state))

    def active(self, state: RecordedState) -> chex.Array:
        return jnp.ones(self.num_agents, bool)

    def alive(self, state: RecordedState) -> chex.Array:
        return state.alive


class RecordedEncoder(nn.Module):
    """Encoded observations as parameters: so there is a gradient with respect to them too."""

    shape: tuple[int, int, int]  # (rows, N, H)

    def setup(self) -> None:
        self.x = self.param("x", nn.initializers.zeros, self.shape)

    def encode_states(self, states: chex.Array) -> chex.Array:
        return self.x.reshape(len(states), -1)

    def __call__(self, features: chex.Array, view: chex.Array, sighted: Any) -> chex.Array:
        return features

    def see(self, view: chex.Array, sighted: Any) -> chex.Array:
        """Nothing: all is in the features."""
        return jnp.zeros((*view.shape[:-3], 0), self.x.dtype)

    def view_kernel(self) -> chex.Array:
        return jnp.zeros((0, self.shape[-1]), self.x.dtype)


class RecordedIC3Net(IC3Net):
    """IC3Net after its encoder."""

    rows: int = 0

    def setup(self) -> None:
        self.observation = RecordedEncoder((self.rows, self.team.num_agents, self.hidden))
        self.core = IC3NetCore(
            self.hidden, self.team.num_actions, self.communicates, self.gated, self.comm_passes
        )


class RecordedTarMAC(TarMAC):
    """TarMAC after its encoder."""

    rows: int = 0

    def setup(self) -> None:
        self.observation = RecordedEncoder((self.rows, self.team.num_agents, self.hidden))
        self.core = TarMACCore(self.hidden, self.team.num_actions, self.gated, self.comm_passes)


@dataclass(frozen=True, eq=False)
class RecordedLearner(Learner):
    """The learner, with a given start and given choices instead of its own draws.

    It keeps what its loss was given and made of it, and the gradients, as `update` is traced.
    """

    given: tuple[Actors, Draws] | None = None
    kept: list[tuple[Any, Arrays]] = field(default_factory=list)  # gradients, `out.*`

    def _inputs(self, state: TrainState) -> Any:
        return self.given

    def _objective(self, *inputs: Any) -> Any:
        results = {}

        def actor_critic(trajectory: Trajectory, valid: chex.Array, beyond: chex.Array, *rest: Any):
            loss, parts = losses.actor_critic(trajectory, valid, beyond, *rest)
            results.update(batch_results(self.config, trajectory, beyond, loss, parts))
            return loss, parts

        with mock.patch.dict(LOSSES, actor_critic=actor_critic):
            loss, (actors, tally) = super()._objective(*inputs)
        return loss, ((actors, results), tally)

    def _gradient(self, *inputs: Any) -> Any:
        gradients, ((actors, results), tally) = super()._gradient(*inputs)
        self.kept.append((gradients, results))
        return gradients, (actors, tally)


def part(fields: Arrays, k: int) -> Arrays:
    """The fields of update k without their prefix."""
    return {n[3:]: y for n, y in fields.items() if n.startswith(f"u{k}.")}


def recorded_task(fields: Arrays, updates: list[Arrays]) -> tuple[RecordedEpisodes, Policy]:
    def rows(name: str) -> np.ndarray:
        return np.concatenate([update[name] for update in updates])

    env = RecordedEpisodes(
        reward=rows("in.reward"),
        last=rows("in.last"),
        t=rows("in.t"),
        max_steps=int(fields["cfg.max_steps"]),
        num_actions=fields["p0.action.bias"].shape[0],
    )
    if fields.get("cfg.masks"):
        env = replace(env, counted=rows("in.counted"), completed=rows("in.completed"))
    passes = sum(k.startswith("p0.C_") and k.endswith(".kernel") for k in fields)
    shared = {
        "team": TeamSpec.of(env),
        "hidden": fields["p0.lstm.w_hh"].shape[0],
        "gated": bool(fields["cfg.gated"]),
        "comm_passes": passes,
        "talk_always": bool(fields.get("cfg.talk_always", 0)),
        "rows": len(env.reward),
    }
    if "p0.query.kernel" in fields:
        return env, Policy("tarmac", RecordedTarMAC(**shared))
    return env, Policy("ic3net", RecordedIC3Net(communicates=passes > 0, **shared))


def settings(fields: Arrays) -> LearnerConfig:
    """Preset `paper`, with what the file says for itself."""
    return preset(
        "paper",
        num_envs=1,
        whole_episodes=False,  # a batch of whole episodes is given
        gamma=float(fields["cfg.gamma"]),
        team_reward=float(fields["cfg.mean_ratio"]),
        value_weight=float(fields["cfg.value_coeff"]),
        learning_rate=float(fields["cfg.lr"]),
        detach_gap=int(fields["cfg.detach_gap"]),
    )


def recorded_inputs(policy: Policy, update: Arrays, first: int, dtype: Any) -> tuple[Actors, Draws]:
    """Where the update at row `first` starts, and the noise that forces its choices."""
    n, num_agents = update["in.action"].shape
    alive = update.get("in.alive", np.ones((n, num_agents))) == 1
    states = RecordedState(first + jnp.arange(n)[:, None], jnp.asarray(alive)[:, None])
    following = jax.tree.map(lambda x: jnp.roll(x, -1, axis=0), states)
    widths = {"action": policy.team.num_actions, "gate": 2}
    chosen = {"action": update["in.action"], "gate": update.get("in.gate_action")}
    noise = {
        name: FORCED * jax.nn.one_hot(choice, widths[name], dtype=dtype)[:, None]
        for name, choice in chosen.items()
        if choice is not None
    }
    carry = jax.tree.map(lambda c: c.astype(dtype), policy.initial_carry((1,)))
    first_state = jax.tree.map(lambda x: x[0], states)
    start = Actors(first_state, carry, jnp.zeros((1, num_agents), dtype))
    return start, Draws(noise=noise, fresh=following)


def batch_results(
    config: LearnerConfig,
    trajectory: Trajectory,
    beyond: chex.Array,
    loss: chex.Array,
    parts: losses.LossParts,
) -> Arrays:
    """Every `out.*` of an update."""
    target = losses.estimate_returns(trajectory, beyond, config)
    decisions = trajectory.decisions
    by_step = {
        "out.value": trajectory.value,
        "out.logp_taken": sum(losses.log_prob_and_entropy(d)[0] for d in decisions.values()),
        "out.returns": target,
        "out.advantages": target - trajectory.value,
    }
    by_step |= {f"out.logp_{k}": jax.nn.log_softmax(d.logits) for k, d in decisions.items()}
    sums = {"out.policy_loss": parts.policy, "out.value_loss": parts.value, "out.loss": loss}
    return {name: y[:, 0] for name, y in by_step.items()} | sums


def update_results(learner: RecordedLearner, state: TrainState) -> tuple[TrainState, Arrays]:
    """The state after an update, and its `out.*` and `grad.*` (`grad.x` of the whole file)."""
    next_state, tally = learner.update(state.replace(actors=learner.given[0]))
    gradients, results = learner.kept.pop()
    grads = jax.tree.map(lambda g: g / tally.env_steps, gradients["policy"]["params"])
    results |= data.dotted(grads["core"], "grad.") | {"grad.x": grads["observation"]["x"]}
    return next_state.replace(actors=None), results


@lru_cache(maxsize=16)
def answer(path: Path, dtype: Any) -> Arrays:
    """Every result of a file, computed in `dtype`: `u1.out.*`, `u1.grad.*`, `p1.*`, and so on."""
    with jax.enable_x64(dtype == np.float64):
        fields = {k: v.astype(dtype) for k, v in data.load(path).items() if v.dtype.kind == "f"}
        fields = data.load(path) | fields
        published = {"RMSPROP_DECAY": "cfg.alpha", "RMSPROP_EPS": "cfg.eps"}
        with mock.patch.multiple(optimiser, **{k: float(fields[v]) for k, v in published.items()}):
            return jax.tree.map(np.asarray, answer_updates(fields, dtype))


def answer_updates(fields: Arrays, dtype: Any) -> Arrays:
    updates = [part(fields, k + 1) for k in range(int(fields["cfg.n_updates"]))]
    env, policy = recorded_task(fields, updates)
    learner = RecordedLearner(env, policy, settings(fields))
    x = np.concatenate([update["in.x"] for update in updates])
    params = {"params": {"core": data.nested(fields, "p0."), "observation": {"x": x}}}
    state = TrainState(
        params=params,
        opt_state=jax.jit(optimiser.make_optimiser(learner.config).init)(params),
        actors=None,
        key=None,
        updates=np.int32(0),
    )

    def answered(update, first, state):
        given = recorded_inputs(policy, update, first, dtype)
        return update_results(replace(learner, given=given), state)

    results, first = {}, 0
    for k, update in enumerate(updates, start=1):
        end = first + len(update["in.x"])
        state, answers = jax.jit(partial(answered, update, first))(state)
        answers["grad.x"] = np.asarray(answers["grad.x"])[first:end]
        results |= {f"u{k}.{name}": y for name, y in answers.items()}
        results |= data.dotted(state.params["params"]["core"], f"p{k}.")
        first = end
    return results


def expected(path: Path) -> Arrays:
    """The recorded results: every field that is neither given nor configuration."""
    results = re.compile(r"u\d+\.(out|grad)\.|p[1-9]\d*\.")
    return {name: y for name, y in data.load(path).items() if results.match(name)}


def test_there_are_recordings():
    assert RECORDINGS, f"no a2c_* in {data.directory()}"


@each_precision
@each_recording
def test_every_recorded_result(path, dtype):
    wanted, ours = expected(path), answer(path, dtype)
    assert not set(wanted) - set(ours), "fields that nothing answers"
    for name, value in wanted.items():
        assert ours[name].dtype == dtype, name
        tolerance = TOLERANCE[dtype]
        np.testing.assert_allclose(ours[name], value, rtol=tolerance, atol=tolerance, err_msg=name)


@each_recording
def test_nothing_else_is_in_the_file(path):
    """So that a field this test does not know cannot go unchecked."""
    given = re.compile(r"cfg\.|p0\.|u\d+\.in\.")
    names = set(data.load(path)) - set(expected(path))
    assert not [name for name in names if not given.match(name)]


@each_recording
def test_returns_by_their_definition(path):
    """`discounted_returns` and `mix_team` alone, beside the advantage estimates of the loss."""
    fields = data.load(path)
    with jax.enable_x64(True):
        for k in range(1, int(fields["cfg.n_updates"]) + 1):
            update = part(fields, k)
            ongoing = np.broadcast_to(1 - update["in.last"][:, None], update["in.reward"].shape)
            ongoing = ongoing * (1 - update.get("in.completed", 0))
            individual = returns.discounted_returns(
                jnp.asarray(update["in.reward"]),
                jnp.asarray(fields["cfg.gamma"] * ongoing),
                jnp.zeros(ongoing.shape[1]),
            )
            mixed = returns.mix_team(individual, float(fields["cfg.mean_ratio"]))
            np.testing.assert_allclose(mixed, update["out.returns"], rtol=1e-12, atol=1e-12)


@each_recording
def test_the_recorded_gates_were_used(path):
    """Gates used at a step are those chosen one step before, closed at the start of an episode."""
    fields = data.load(path)
    for k in range(1, int(fields["cfg.n_updates"]) + 1):
        update = part(fields, k)
        if "in.gate" in update:
            before = np.roll(update["in.gate_action"], 1, axis=0)
            if fields.get("cfg.talk_always"):
                before = np.ones_like(before)
            used = np.where(update["in.reset"][:, None], 0, before)
            np.testing.assert_array_equal(used, update["in.gate"])
