"""MAGIC (Niu et al. 2021): a scheduler draws who hears whom, graph attention carries messages.

Two rounds of messages per step, each over a directed graph drawn edge by edge. Messages reach the
heads of the same step only: nothing that was heard is remembered.
"""

from typing import Any, ClassVar, Literal

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct
from jax.scipy.linalg import block_diag

from sumajax.environments.states import SparseStates
from sumajax.policies.attention import GraphAttention
from sumajax.policies.encoder import EncoderKind, ObservationEncoder
from sumajax.policies.layers import (
    Dense,
    LSTMCell,
    add_bias,
    lift,
    product,
    side_by_side,
    straight_through_bit,
    uniform_fan_in,
)
from sumajax.policies.types import PolicyModule, PolicyOutput, decide, mask_actions
from sumajax.records import exportable

Setting = Literal["medium", "hard", "complete"]

SETTINGS: dict[str, dict[str, Any]] = {
    "medium": {"encoder_heads": 8, "second_graph": True, "decode_messages": False},
    "hard": {"encoder_heads": 4, "second_graph": False, "decode_messages": True},
    "complete": {"drawn": False, "second_graph": False, "decode_messages": True},
}
"""What differs between the published arguments: 10x10 with 5 agents, 20x20 with 10, and Traffic
Junction, where no graph is drawn and everybody hears everybody who is there."""


@exportable
@struct.dataclass
class MAGICCarry:
    """What the agents remember."""

    h: chex.Array  # (..., N, H) LSTM hidden state
    s: chex.Array  # (..., N, H) LSTM cell


class Scheduler(nn.Module):
    """For every ordered pair of agents the logits of an edge, for each of Q graphs.

    An MLP 2G -> G/2 -> G/2 -> 2 on [e_i | e_j] per graph. Its first layer is linear in each half,
    so it is done per agent, and only a sum of two terms is left to do per pair.
    """

    in_features: int
    graphs: int

    def setup(self) -> None:
        wide, narrow = 2 * self.in_features, self.in_features // 2
        for layer, (fan_in, fan_out) in enumerate([(wide, narrow), (narrow, narrow), (narrow, 2)]):
            init, q = uniform_fan_in(fan_in), self.graphs
            setattr(
                self, f"kernel_{layer}", self.param(f"kernel_{layer}", init, (q, fan_in, fan_out))
            )
            setattr(self, f"bias_{layer}", self.param(f"bias_{layer}", init, (q, fan_out)))

    def fold(self) -> dict[str, chex.Array]:
        """The kernels of all graphs side by side: of receivers and senders, then block diagonal."""
        receiver, sender = jnp.split(self.kernel_0, 2, axis=1)
        return {
            "first": jnp.concatenate([*receiver, *sender], axis=-1),  # (G, 2 Q G/2)
            "second": block_diag(*self.kernel_1),  # (Q G/2, Q G/2)
            "third": block_diag(*self.kernel_2),  # (Q G/2, Q 2)
        }

    def __call__(self, e: chex.Array, folded: dict[str, chex.Array] | None = None) -> chex.Array:
        """e (..., N, G) -> logits (..., Q, N, N, 2); row i receives, column j sends."""
        kernels = self.fold() if folded is None else folded
        receiver, sender = jnp.split(product(e, kernels["first"]), 2, axis=-1)
        pairs = receiver[..., :, None, :] + sender[..., None, :, :]
        x = nn.relu(add_bias(pairs, self.bias_0.reshape(-1)))
        x = nn.relu(add_bias(product(x, kernels["second"]), self.bias_1.reshape(-1)))
        logits = add_bias(product(x, kernels["third"]), self.bias_2.reshape(-1))
        return jnp.moveaxis(logits.reshape(*pairs.shape[:-1], self.graphs, 2), -2, -4)


class MAGICCore(nn.Module):
    """One step from encoded observations: LSTM, scheduler, two rounds of messages, heads.

    Source: Niu et al. 2021 and its program; docs/reference/policies.md, MAGIC.

    Attributes:
      drawn: whether a scheduler draws who hears whom; without one everybody hears everybody, and
        the attention is neither normalised nor without the own message.
    """

    hidden: int
    num_actions: int
    encoder_heads: int = 8
    encoder_features: int = 32
    first_heads: int = 4
    first_features: int = 32
    second_heads: int = 1
    second_graph: bool = True
    decode_messages: bool = False
    drawn: bool = True

    def setup(self) -> None:
        hidden, first_width = self.hidden, self.first_heads * self.first_features
        self.lstm = LSTMCell(hidden, hidden)
        if self.drawn:
            self.gat_enc = GraphAttention(
                hidden, self.encoder_heads, self.encoder_features, average=True, self_loop="forced"
            )
            self.scheduler = Scheduler(self.encoder_features, graphs=2 if self.second_graph else 1)
        graph: dict[str, Any] = {
            "normalize": self.drawn,
            "self_loop": "given" if self.drawn else "forced",
        }
        self.gat1 = GraphAttention(hidden, self.first_heads, self.first_features, **graph)
        self.gat2 = GraphAttention(first_width, self.second_heads, hidden, average=True, **graph)
        if self.decode_messages:
            self.decoder = Dense(hidden)
        self.action = Dense(self.num_actions)
        self.value = Dense(1)

    def project_input(self, x: chex.Array) -> chex.Array:
        """Encoded observations (..., H), or what is constant in them, -> (..., 4H)."""
        return self.lstm.project_input(x)

    def fold(self, view_kernel: chex.Array) -> dict[str, Any]:
        """Products of weights that every step needs.

        Args:
          view_kernel: (V, H), which turns what is seen into its share of the encoded observation.
        """
        attention = ("gat_enc", "gat1", "gat2", "scheduler") if self.drawn else ("gat1", "gat2")
        folded: dict[str, Any] = {"lstm": self.lstm.fold(view_kernel)}
        return folded | {name: getattr(self, name).fold() for name in attention}

    def __call__(
        self,
        carry: MAGICCarry,
        projected: chex.Array,
        seen: chex.Array,
        graph_noise: chex.Array | None,
        folded: dict[str, Any],
        alive: chex.Array | None = None,
    ) -> tuple[MAGICCarry, chex.Array, chex.Array, chex.Array, chex.Array]:
        """projected (..., N, 4H), seen (..., N, V), graph_noise (..., Q, N, N) logistic.

        Q is 2, or 1 without a second graph; without drawn graphs there is no noise. Who is not
        `alive` (..., N) has no edge, no message of its own, and hears none.

        Returns:
          carry, action logits (..., N, num_actions), value (..., N), graphs (..., Q, N, N) 0/1 and
          the first round's attention (..., N, N), the mean over its heads.
        """
        h, s = self.lstm.step_folded((carry.h, carry.s), projected, seen, folded["lstm"])
        there = None if alive is None else alive.astype(h.dtype)[..., None]  # (..., N, 1)
        messages = h if there is None else h * there
        graphs = self._graphs(messages, there, graph_noise, folded)
        message, weights = self.gat1(messages, graphs[..., 0, :, :], folded["gat1"])
        message, _ = self.gat2(nn.elu(message), graphs[..., -1, :, :], folded["gat2"])
        if there is not None:
            message = message * there
        if self.decode_messages:
            message = self.decoder(message)
        y = jnp.concatenate([h, message], axis=-1)
        action, value = side_by_side([self.action, self.value], y)
        return MAGICCarry(h, s), action, value[..., 0], graphs, weights.mean(-1)

    def _graphs(
        self,
        messages: chex.Array,
        there: chex.Array | None,
        noise: chex.Array | None,
        folded: dict[str, Any],
    ) -> chex.Array:
        """(..., Q, N, N) 0/1: who hears whom, among those who are there."""
        pairs = None if there is None else there * jnp.swapaxes(there, -1, -2)  # (..., N, N)
        if not self.drawn:
            shape = (*messages.shape[:-1], messages.shape[-2])
            complete = jnp.ones(shape, messages.dtype) if pairs is None else pairs
            return complete[..., None, :, :]
        encoded, _ = self.gat_enc(messages, pairs, folded["gat_enc"])
        graphs = straight_through_bit(self.scheduler(encoded, folded["scheduler"]), noise)
        return graphs if pairs is None else graphs * pairs[..., None, :, :]


class MAGIC(PolicyModule):
    """MAGIC with the published arguments for the medium (10x10) or the hard (20x20) task.

    Attributes:
      setting: `complete` are the arguments for Traffic Junction, without a scheduler.
      fresh_memory: an agent that takes another's place starts without its memory; in the published
        program it goes on with it.
    """

    hidden: int = 128
    setting: Setting = "medium"
    encoder: EncoderKind = "flat"
    fresh_memory: bool = False

    critic_parameters: ClassVar[frozenset[str]] = frozenset({"value"})

    def setup(self) -> None:
        self.observation = ObservationEncoder(self.hidden, self.encoder)
        self.core = MAGICCore(self.hidden, self.team.num_actions, **SETTINGS[self.setting])

    def encode_states(self, states: chex.Array | SparseStates) -> chex.Array:
        return self.core.project_input(self.observation.encode_states(states))

    def encode_listed(self, states: SparseStates) -> chex.Array:
        return self.encode_states(states)

    def fold(self) -> dict[str, Any]:
        return self.core.fold(self.observation.view_kernel())

    def __call__(
        self,
        carry: MAGICCarry,
        state_features: chex.Array,
        view: chex.Array,
        noise: Any,
        alive: chex.Array | None = None,
    ) -> tuple[MAGICCarry, PolicyOutput]:
        seen = self.observation.see(view, self.team.sighted)
        carry, logits, value, graphs, attention = self.core(
            carry, state_features, seen, noise.get("graph"), self.folded(), alive
        )
        output = PolicyOutput(
            decisions={"action": decide(mask_actions(logits, self.team), noise["action"])},
            value=value,
            communication=edge_density(graphs, alive),
            attention=attention,
        )
        return carry, output

    def initial_carry(self, batch_shape: tuple[int, ...]) -> MAGICCarry:
        zeros = jnp.zeros((*batch_shape, self.team.num_agents, self.hidden), jnp.float32)
        return MAGICCarry(zeros, zeros)

    def memory(self, carry: MAGICCarry) -> chex.Array:
        return carry.h

    def sample_noise(self, key: chex.PRNGKey, batch_shape: tuple[int, ...]) -> Any:
        n, settings = self.team.num_agents, SETTINGS[self.setting]
        graphs = 2 if settings["second_graph"] else 1
        action_key, graph_key = jax.random.split(key)
        action_shape = (*batch_shape, n, self.team.num_actions)
        noise = {"action": jax.random.gumbel(action_key, action_shape, jnp.float32)}
        if settings.get("drawn", True):
            shape = (*batch_shape, graphs, n, n)
            noise["graph"] = jax.random.logistic(graph_key, shape, jnp.float32)
        return noise


def edge_density(graphs: chex.Array, alive: chex.Array | None = None) -> chex.Array:
    """Graphs (..., Q, N, N) -> (..., N): share of the others that each sender (column) reaches.

    The others are those `alive` (..., N), or all.
    """
    num_agents = graphs.shape[-1]
    to_others = graphs * lift(1 - jnp.eye(num_agents, dtype=graphs.dtype), graphs.ndim)
    others: chex.Array | int = max(num_agents - 1, 1)
    if alive is not None:
        others = jnp.maximum(alive.astype(graphs.dtype).sum(-1, keepdims=True) - 1, 1)
    return to_others.sum((-3, -2)) / (graphs.shape[-3] * others)


VARIANTS: dict[str, tuple[type[PolicyModule], dict[str, Any]]] = {"magic": (MAGIC, {})}
"""Names of this file's policies."""
