"""IC3Net and its special cases CommNet, IRIC and IC (Singh et al. 2019; Sukhbaatar et al. 2016).

Agents pass the mean of each other's hidden states through a dense layer into a shared LSTM; in
IC3Net each agent also decides, by a gate sampled one step ahead, whether it takes part at all.
"""

from typing import Any, ClassVar, Literal

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from sumajax.environments.states import SparseStates
from sumajax.policies.encoder import EncoderKind, ObservationEncoder
from sumajax.policies.layers import Dense, LSTMCell, lift, side_by_side
from sumajax.policies.types import Decision, PolicyModule, PolicyOutput, decide, mask_actions
from sumajax.records import exportable

SILENT, TALK = 0, 1

Message = Literal["mean", "talking", "max"]
"""What an agent hears of the others, see `heard_by_all`."""


@exportable
@struct.dataclass
class IC3NetCarry:
    """What the agents remember."""

    h: chex.Array  # (..., N, H) LSTM hidden state, the messages of the next step
    s: chex.Array  # (..., N, H) LSTM cell
    gate: chex.Array  # (..., N) float32: 1 where the agent chose to take part in the next step


class IC3NetCore(nn.Module):
    """One step from encoded observations: messages, LSTM, heads.

    Source: Singh et al. 2019 and its program; docs/reference/policies.md, IC3Net. Another `message`
    than the mean is this package's.
    """

    hidden: int
    num_actions: int
    communicates: bool = True
    gated: bool = True
    comm_passes: int = 1
    message: Message = "mean"

    def setup(self) -> None:
        passes = self.comm_passes if self.communicates else 0
        self.C = [Dense(self.hidden) for _ in range(passes)]
        self.lstm = LSTMCell(self.hidden, self.hidden)
        self.action = Dense(self.num_actions)
        self.value = Dense(1)
        if self.gated:
            self.gate = Dense(2)

    def __call__(
        self, carry: IC3NetCarry, x: chex.Array, alive: chex.Array | None = None
    ) -> tuple[chex.Array, chex.Array, dict[str, chex.Array], chex.Array]:
        """x (..., N, H), alive (..., N) -> h, s, logits by decision, value (..., N)."""
        h, s = carry.h, carry.s
        for message_layer in self.C:
            heard = heard_by_all(self.message, h, carry.gate, alive)
            h, s = self.lstm((h, s), x + message_layer(heard))
        if not self.communicates:
            h, s = self.lstm((h, s), x)
        heads = [self.action, self.value, *([self.gate] if self.gated else [])]
        action, value, *gate = side_by_side(heads, h)
        logits = {"action": action} | ({"gate": gate[0]} if gate else {})
        return h, s, logits, value[..., 0]


def heard_by_all(
    message: Message, h: chex.Array, gate: chex.Array, alive: chex.Array | None
) -> chex.Array:
    """(..., N, H): what each agent hears of h (..., N, H), gates (..., N).

    * `mean`: the published mean over all others, `mean_message`. One voice that knows something is
      half of it in a team of 3 and a ninth in a team of 10.
    * `talking`: the mean over the others who talk, `talking_message`.
    * `max`: feature by feature the largest of those who talk, `max_message`. What one voice says
      stands out however large the team is.

    In all of them a silent agent neither speaks nor hears.
    """
    return {"mean": mean_message, "talking": talking_message, "max": max_message}[message](
        h, gate, alive
    )


def mean_message(h: chex.Array, gate: chex.Array, alive: chex.Array | None = None) -> chex.Array:
    """(..., N, H): what each agent hears, sum over talking others of h / (number of others).

    A silent agent hears nothing either (the published program; the paper's formula gates the sender
    only), and the mean is over all others who are there, not over those who talk. Who is not there
    neither speaks nor hears.
    """
    gate, others = talking(gate, alive), count_others(gate, alive)
    spoken = gate[..., None] * h
    return gate[..., None] * (spoken.sum(-2, keepdims=True) - spoken) / others


def talking_message(h: chex.Array, gate: chex.Array, alive: chex.Array | None) -> chex.Array:
    """(..., N, H): what each agent hears, the mean of h over the others who talk; 0 without any."""
    gate = talking(gate, alive)
    spoken = gate[..., None] * h
    total = spoken.sum(-2, keepdims=True) - spoken
    return gate[..., None] * total / count_talking(gate)[..., None]


def max_message(h: chex.Array, gate: chex.Array, alive: chex.Array | None) -> chex.Array:
    """(..., N, H): what each agent hears, the largest h of all who talk, itself included."""
    gate = talking(gate, alive)
    talks = jnp.broadcast_to(gate[..., None], h.shape) > 0
    # h lies between -1 and 1, so -1 is no louder than anybody; the gate clears a silent team's.
    loudest = jnp.where(talks, h, jnp.asarray(-1, h.dtype)).max(-2, keepdims=True)
    return gate[..., None] * loudest


def count_talking(gate: chex.Array) -> chex.Array:
    """(..., N): how many others talk, at least 1, of gates (..., N) closed for who is not there."""
    return jnp.maximum(gate.sum(-1, keepdims=True) - gate, 1)


def weights_of_senders(
    message: Message, h: chex.Array, gate: chex.Array, alive: chex.Array | None
) -> chex.Array:
    """(..., N, N): the share that each sender (column) has in what each receiver (row) hears.

    Of `max` the share of the features in which it is the loudest.

    Args:
      h: (..., N, H) what is said; gate: (..., N) closed for who is not there.
    """
    pairs = gate[..., :, None] * gate[..., None, :]
    if message == "max":
        talks = jnp.broadcast_to(gate[..., None], h.shape) > 0
        loud = jnp.where(talks, h, jnp.asarray(-1, h.dtype))
        loudest = (loud == loud.max(-2, keepdims=True)).astype(h.dtype)
        share = (loudest / loudest.sum(-2, keepdims=True)).mean(-1)  # of features that tie, a part
        return pairs * share[..., None, :]
    pairs = pairs * lift(1 - jnp.eye(gate.shape[-1], dtype=pairs.dtype), pairs.ndim)
    if message == "talking":
        return pairs / count_talking(gate)[..., None]
    return pairs / count_others(gate, alive)


def talking(gate: chex.Array, alive: chex.Array | None) -> chex.Array:
    """(..., N): the gates (..., N), closed for who is not there; `alive` None: all always are."""
    return gate if alive is None else gate * alive.astype(gate.dtype)


def count_others(gate: chex.Array, alive: chex.Array | None) -> chex.Array | int:
    """How many others an agent has, at least 1: (..., 1, 1), or one number where all always are."""
    if alive is None:
        return max(gate.shape[-1] - 1, 1)
    return jnp.maximum(alive.astype(gate.dtype).sum(-1)[..., None, None] - 1, 1)


class IC3Net(PolicyModule):
    """IC3Net; with `gated=False` CommNet; with `communicates=False` independent controllers.

    Attributes:
      comm_passes: rounds of messages within a step.
      message: what is heard of the others: the published `mean` over all of them, or, for large
        teams, the mean over those `talking` or the `max`, see `heard_by_all`.
      talk_always: the gate is drawn and trained as ever, but taken as open from the second step on,
        as the published program does in Traffic Junction.
      fresh_memory: an agent that takes another's place starts without its memory; in the published
        program it goes on with it.
    """

    hidden: int = 128
    communicates: bool = True
    gated: bool = True
    comm_passes: int = 1
    encoder: EncoderKind = "flat"
    talk_always: bool = False
    fresh_memory: bool = False
    message: Message = "mean"

    critic_parameters: ClassVar[frozenset[str]] = frozenset({"value"})

    def setup(self) -> None:
        self.observation = ObservationEncoder(self.hidden, self.encoder)
        self.core = IC3NetCore(
            self.hidden,
            self.team.num_actions,
            self.communicates,
            self.gated,
            self.comm_passes,
            self.message,
        )

    def encode_states(self, states: chex.Array | SparseStates) -> chex.Array:
        return self.observation.encode_states(states)

    def encode_listed(self, states: SparseStates) -> chex.Array:
        return self.encode_states(states)

    def __call__(
        self,
        carry: IC3NetCarry,
        state_features: chex.Array,
        view: chex.Array,
        noise: Any,
        alive: chex.Array | None = None,
    ) -> tuple[IC3NetCarry, PolicyOutput]:
        x = self.observation(state_features, view, self.team.sighted)
        talked = talking(carry.gate, alive)
        h, s, logits, value = self.core(carry, x, alive)
        action_logits = mask_actions(logits["action"], self.team)
        decisions: dict[str, Decision] = {"action": decide(action_logits, noise["action"])}
        gate = carry.gate
        if self.gated:
            decisions["gate"] = decide(logits["gate"], noise["gate"])
            gate = decisions["gate"].choice.astype(h.dtype)
            gate = jnp.ones_like(gate) if self.talk_always else gate
        output = PolicyOutput(
            decisions=decisions,
            value=value,
            communication=talked,
            attention=weights_of_senders(self.message, carry.h, talked, alive),
        )
        return IC3NetCarry(h, s, gate), output

    def initial_carry(self, batch_shape: tuple[int, ...]) -> IC3NetCarry:
        shape = (*batch_shape, self.team.num_agents)
        zeros = jnp.zeros((*shape, self.hidden), jnp.float32)
        # A gated agent starts silent (irrelevant: h is zero); without a gate everybody talks.
        gate = jnp.full(shape, float(self.communicates and not self.gated), zeros.dtype)
        return IC3NetCarry(zeros, zeros, gate)

    def memory(self, carry: IC3NetCarry) -> chex.Array:
        return carry.h

    def sample_noise(self, key: chex.PRNGKey, batch_shape: tuple[int, ...]) -> Any:
        shape = (*batch_shape, self.team.num_agents)
        action_key, gate_key = jax.random.split(key)
        action_shape = (*shape, self.team.num_actions)
        noise = {"action": jax.random.gumbel(action_key, action_shape, jnp.float32)}
        if self.gated:
            noise["gate"] = jax.random.gumbel(gate_key, (*shape, 2), jnp.float32)
        return noise


VARIANTS = {
    "ic3net": (IC3Net, {}),
    "commnet": (IC3Net, {"gated": False, "talk_always": False}),
    "iric": (IC3Net, {"communicates": False, "gated": False, "talk_always": False}),
    "ic": (IC3Net, {"communicates": False, "gated": False, "talk_always": False}),
}
"""Names of this file's policies. IC differs from IRIC, and CommNet from IC3Net, also in the reward:
a team mean, which is a setting of the learner."""
