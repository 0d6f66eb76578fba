"""HetNet (Seraj et al. 2022): graph attention between and within two classes of agents.

Predators (P) see and remember what they saw; capture agents (A) know only where they are. Every
pair of classes has messages and attention of its own, and a state node per class collects what
that class's critic reads. Messages are real vectors, or bits that the receivers decode.
"""

from typing import Any, ClassVar, Literal

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import struct
from jax.nn.initializers import normal

from sumajax.environments.states import SparseStates
from sumajax.policies.attention import relation_attention, seen_through
from sumajax.policies.encoder import (
    STATE_FEATURES,
    VIEW_FEATURES,
    EncoderKind,
    StateEncoder,
    ViewEncoder,
)
from sumajax.policies.layers import (
    Dense,
    LSTMCell,
    add_bias,
    lift,
    product,
    straight_through_bit,
    uniform_fan_in,
)
from sumajax.policies.types import (
    PolicyModule,
    PolicyOutput,
    TeamSpec,
    decide,
    mask_actions,
)
from sumajax.records import exportable

Meta = Literal["normalised", "repo"]
Critic = Literal["class", "agent"]

NODES = ("P", "A", "S")
"""Predators, capture agents, and the two state nodes: the first is P's, the second A's."""
BITS = "bits"
"""What the decoders of binary messages read, as the other layers read nodes."""
AGENT_RELATIONS = ("p2p", "a2p", "p2a", "a2a")
STATE_NODE = {"p2s": slice(0, 1), "a2s": slice(1, 2)}
"""Which of the two state nodes hears in a relation."""
STATE_RELATIONS = tuple(STATE_NODE)
"""Relations, sender class first; a state node hears its own class only and tells nobody."""

CRITIC_PARAMETERS = frozenset(
    {"critic_P", "critic_A", "agent_critic_P", "agent_critic_A"}
    | {
        f"{layer}_{part}"
        for layer in ("self_S", *STATE_RELATIONS)
        for part in ("kernel", "bias", "dst", "src")
    }
)
"""State nodes tell nobody: what they hear and how is for the value alone."""

CLASS_ACTIONS = (5, 6)
"""Widths of the two classes' heads, whatever the task: a capture agent can also capture."""
CRITIC_FEATURES = 8
META_FEATURES = 4
META_CONSTANT = 500.0
"""The published program's fourth entry of the team descriptor (its paper says: the time step)."""
META_SCALE = (10.0, 10.0, 20.0, META_CONSTANT)
"""Divisors of the default descriptor; the raw one starts the critic 100 times too high."""


@exportable
@struct.dataclass
class HetNetCarry:
    """What the agents remember, predators first."""

    h_state: chex.Array  # (..., N, 128) hidden state of the LSTM on the own position
    s_state: chex.Array  # (..., N, 128) its cell
    h_obs: chex.Array  # (..., N_P, 32) hidden state of the predators' LSTM on the view
    s_obs: chex.Array  # (..., N_P, 32) its cell


@struct.dataclass
class Exchange:
    """The messages of one layer."""

    weights: dict[str, chex.Array]  # by relation with an edge: (..., receivers, senders, K)
    bits: chex.Array | None  # (..., N, bits) of 0 and 1, for binary messages
    bit_logits: chex.Array | None  # (..., N, bits, 2)


Folded = dict[str, tuple[chex.Array, chex.Array]]
"""Kernel and bias by what they read: a node's features, or bits."""


def sender_of(relation: str) -> str:
    """The class that sends in a relation: P for "p2a"."""
    return relation[0].upper()


def receiver_of(relation: str) -> str:
    """The class that receives in a relation: A for "p2a"."""
    return relation[-1].upper()


class HetLayer(nn.Module):
    """One layer of heterogeneous graph attention (docs/reference/policies.md, HetNet).

    All parameters exist whatever the team, so that they fit any other team.

    Attributes:
      in_features, features: input width, and output width per head, of P, A and S.
      average: mean over the heads instead of ReLU and concatenation.
      bits: length of a binary message; None for real-valued messages.
    """

    in_features: tuple[int, int, int]
    features: tuple[int, int, int]
    heads: int
    average: bool = False
    bits: int | None = None

    def setup(self) -> None:
        self.in_width = dict(zip(NODES, self.in_features, strict=True))
        self.out_width = dict(zip(NODES, self.features, strict=True))
        dense: dict[str, tuple[int, int]] = {}
        for node in NODES:
            dense[f"self_{node}"] = (self.in_width[node], self.heads * self.out_width[node])
        for relation in STATE_RELATIONS if self.bits else AGENT_RELATIONS + STATE_RELATIONS:
            width = self.heads * self.out_width[receiver_of(relation)]
            dense[relation] = (self.in_width[sender_of(relation)], width)
        if self.bits:
            dense["binarize"] = (1, 2)
            for node in ("P", "A"):
                dense[f"enc_{node}"] = (self.in_width[node], self.bits)
                dense[f"dec_{node}"] = (self.bits, self.heads * self.out_width[node])
        self.dense = {name: self._dense(name, *shape) for name, shape in dense.items()}
        self.vectors = {name: self._vectors(name) for name in AGENT_RELATIONS + STATE_RELATIONS}

    def _dense(self, name: str, fan_in: int, fan_out: int) -> tuple[chex.Array, chex.Array]:
        init = uniform_fan_in(fan_in)
        kernel = self.param(f"{name}_kernel", init, (fan_in, fan_out))
        return kernel, self.param(f"{name}_bias", init, (fan_out,))

    def _vectors(self, relation: str) -> tuple[chex.Array, chex.Array]:
        width = self.out_width[receiver_of(relation)]
        init = normal((4 / ((self.heads + 1) * width)) ** 0.5, jnp.float32)
        dst = self.param(f"{relation}_dst", init, (self.heads, width))
        return dst, self.param(f"{relation}_src", init, (self.heads, width))

    def fold(self, relations: tuple[str, ...]) -> Folded:
        """All the layers that read the same thing, and their scores, as one: kernel and bias.

        Args:
          relations: those that have an edge, from `present_relations`.
        """
        folded = {}
        for read in (*NODES, BITS) if self.bits else NODES:
            columns = [self._column(*what) for what in self._readings(read, relations).values()]
            kernels, biases = zip(*columns, strict=True)
            folded[read] = (jnp.concatenate(kernels, axis=-1), jnp.concatenate(biases))
        return folded

    def __call__(
        self,
        features: dict[str, chex.Array],
        noise: chex.Array | None = None,
        folded: Folded | None = None,
    ) -> tuple[dict[str, chex.Array], Exchange]:
        """One round of messages.

        Args:
          features: "P" (..., N_P, F_P), "A" (..., N_A, F_A), "S" (..., 2, F_S); a class may be
            empty.
          noise: (..., N, bits) logistic, predators first; only for binary messages.
          folded: what `fold` returns, for who has it already.

        Returns:
          the next layer's features by node, and the messages.
        """
        num_p = features["P"].shape[-2]
        relations = present_relations(num_p, features["A"].shape[-2])
        folded = folded or self.fold(relations)
        linear: dict[str, chex.Array] = {}
        for node in NODES:
            linear |= self._apply(node, relations, features[node], folded)
        bits = bit_logits = None
        if self.bits:
            codes = jnp.concatenate([linear.pop("enc_P"), linear.pop("enc_A")], axis=-2)
            bits, bit_logits = self._binarize(codes, noise)
            linear |= self._decode(self._apply(BITS, relations, bits, folded), relations, num_p)
        state = self._split_heads(linear["self_S"])
        result = {"P": self._split_heads(linear["self_P"])}
        result |= {"A": self._split_heads(linear["self_A"])}
        result |= {relation: state[..., node, :, :] for relation, node in STATE_NODE.items()}
        weights = {}
        for relation in relations:
            to = relation if relation in STATE_RELATIONS else receiver_of(relation)
            hears = STATE_NODE.get(relation, slice(None))
            heard, weights[relation] = relation_attention(
                linear[f"{relation}_dst"][..., hears, :],
                linear[f"{relation}_src"],
                self._split_heads(linear[relation]),
                exclude_self=sender_of(relation) == to,
            )
            result[to] = result[to] + heard
        return self._merge(result), Exchange(weights, bits, bit_logits)

    def _readings(
        self, read: str, relations: tuple[str, ...]
    ) -> dict[str, tuple[str, chex.Array | None]]:
        """All that is linear in a node's features, or in the bits: by name a dense layer, and for
        a score the attention vectors that the layer's output is seen through.
        """
        if read == BITS:
            layers = ["dec_P", "dec_A"]
        else:
            spoken_by = [r for r in relations if sender_of(r) == read and r in self.dense]
            code = [name for name in (f"enc_{read}",) if name in self.dense]
            layers = [f"self_{read}", *spoken_by, *code]
        readings: dict[str, tuple[str, chex.Array | None]] = {name: (name, None) for name in layers}
        for relation in relations:
            dst, src = self.vectors[relation]
            receiver = receiver_of(relation)
            message = relation if relation in self.dense else f"dec_{receiver}"
            if f"self_{receiver}" in layers:
                readings[f"{relation}_dst"] = (f"self_{receiver}", dst)
            if message in layers:
                readings[f"{relation}_src"] = (message, src)
        return readings

    def _column(self, layer: str, vectors: chex.Array | None) -> tuple[chex.Array, chex.Array]:
        """Kernel and bias of a layer, or of the scores that its output gives."""
        kernel, bias = self.dense[layer]
        if vectors is None:
            return kernel, bias
        return seen_through(kernel, vectors), seen_through(bias, vectors)

    def _apply(
        self, read: str, relations: tuple[str, ...], x: chex.Array, folded: Folded
    ) -> dict[str, chex.Array]:
        """All that is linear in x, by name, as a single product."""
        kernel, bias = folded[read]
        readings = self._readings(read, relations)
        widths = [
            self.dense[layer][1].shape[0] if vectors is None else self.heads
            for layer, vectors in readings.values()
        ]
        y = add_bias(product(x, kernel), bias)
        parts = jnp.split(y, np.cumsum(widths)[:-1].tolist(), axis=-1)
        return dict(zip(readings, parts, strict=True))

    def _binarize(
        self, codes: chex.Array, noise: chex.Array | None
    ) -> tuple[chex.Array, chex.Array]:
        """Codes (..., N, bits) -> bits, logits (..., N, bits, 2); one 1 -> 2 layer for all."""
        kernel, bias = self.dense["binarize"]
        logits = add_bias(codes[..., None] * lift(kernel[0], codes.ndim + 1), bias)
        return straight_through_bit(logits, noise), logits

    def _decode(
        self, decoded: dict[str, chex.Array], relations: tuple[str, ...], num_p: int
    ) -> dict[str, chex.Array]:
        """What the receivers' decoders made of all bits -> messages and scores by relation."""
        said_by = {"P": slice(None, num_p), "A": slice(num_p, None)}
        messages = {}
        for relation in filter(AGENT_RELATIONS.__contains__, relations):
            senders = said_by[sender_of(relation)]
            messages[relation] = decoded[f"dec_{receiver_of(relation)}"][..., senders, :]
            messages[f"{relation}_src"] = decoded[f"{relation}_src"][..., senders, :]
        return messages

    def _split_heads(self, y: chex.Array) -> chex.Array:
        """(..., N, K O) -> (..., N, K, O)."""
        return y.reshape(*y.shape[:-1], self.heads, y.shape[-1] // self.heads)

    def _merge(self, result: dict[str, chex.Array]) -> dict[str, chex.Array]:
        """(..., R, K, O) by receiver -> features by node: head mean, or ReLU and concatenation."""
        batch = jnp.broadcast_shapes(*(y.shape[:-3] for y in result.values()))
        state = [
            jnp.broadcast_to(y, (*batch, *y.shape[-3:])) for y in (result["p2s"], result["a2s"])
        ]
        nodes = {"P": result["P"], "A": result["A"], "S": jnp.concatenate(state, axis=-3)}
        if self.average:
            return {node: y.mean(-2) for node, y in nodes.items()}
        return {
            node: nn.relu(y).reshape(*y.shape[:-2], y.shape[-2] * y.shape[-1])
            for node, y in nodes.items()
        }


class HetGraph(nn.Module):
    """Two graph layers and the class critics, from agent features."""

    in_features: tuple[int, int]  # of P and A
    heads: int = 4
    features: int = 16
    bits: int | None = None
    critic: Critic = "class"

    def setup(self) -> None:
        self.layer1 = HetLayer(
            (*self.in_features, META_FEATURES), (self.features,) * 3, self.heads, bits=self.bits
        )
        self.layer2 = HetLayer(
            (self.heads * self.features,) * 3,
            (*CLASS_ACTIONS, CRITIC_FEATURES),
            self.heads,
            average=True,
            bits=self.bits,
        )
        self.critic_P = Dense(1)
        self.critic_A = Dense(1)
        if self.critic == "agent":
            self.agent_critic_P = Dense(1)
            self.agent_critic_A = Dense(1)

    def fold(self, num_p: int, num_a: int) -> tuple[Folded, Folded]:
        """Of both layers, for a team of so many."""
        relations = present_relations(num_p, num_a)
        return self.layer1.fold(relations), self.layer2.fold(relations)

    def __call__(
        self,
        f_p: chex.Array,
        f_a: chex.Array,
        meta: chex.Array,
        noise: chex.Array | None = None,
        folded: tuple[Folded, Folded] | None = None,
    ) -> tuple[dict[str, chex.Array], chex.Array, tuple[Exchange, Exchange]]:
        """f_p (..., N_P, F_P), f_a (..., N_A, F_A), meta (2, 4), noise (..., 2, N, bits) by layer.

        Returns:
          logits "P" (..., N_P, 5) and "A" (..., N_A, 6), value of each class (..., 2) or with
          `critic="agent"` of each agent (..., N), and the messages of each layer.
        """
        noises = (noise[..., 0, :, :], noise[..., 1, :, :]) if noise is not None else (None, None)
        layer1, layer2 = folded or (None, None)
        nodes = {"P": f_p, "A": f_a, "S": lift(meta, f_p.ndim)}
        hidden, first = self.layer1(nodes, noises[0], layer1)
        out, second = self.layer2(hidden, noises[1], layer2)
        state = nn.relu(out["S"])
        critics = (self.critic_P(state[..., 0, :]), self.critic_A(state[..., 1, :]))
        value = jnp.concatenate(critics, axis=-1)
        if self.critic == "agent":
            value = self._of_agents(value, hidden)
        logits = {"P": out["P"], "A": out["A"]}
        return logits, value, (first, second)

    def _of_agents(self, of_class: chex.Array, hidden: dict[str, chex.Array]) -> chex.Array:
        """Value of each class (..., 2) -> of each agent (..., N): and what sets it apart."""
        apart = [self.agent_critic_P(hidden["P"])[..., 0], self.agent_critic_A(hidden["A"])[..., 0]]
        return jnp.concatenate([of_class[..., i : i + 1] + y for i, y in enumerate(apart)], axis=-1)


class HetNetCore(nn.Module):
    """One step from encoded observations: two LSTMs and the graph layers."""

    state_features: int = STATE_FEATURES
    view_features: int = VIEW_FEATURES
    heads: int = 4
    features: int = 16
    bits: int | None = None
    critic: Critic = "class"

    def setup(self) -> None:
        state, view = self.state_features, self.view_features
        self.lstm_state = LSTMCell(state, state)
        self.lstm_obs = LSTMCell(view, view)
        self.graph = HetGraph(
            (state + view, state), self.heads, self.features, self.bits, self.critic
        )

    def project_states(self, x_state: chex.Array) -> chex.Array:
        """Encoded states (..., 128) -> (..., 512), the form `__call__` reads them in."""
        return self.lstm_state.project_input(x_state)

    def __call__(
        self,
        carry: HetNetCarry,
        projected_state: chex.Array,
        x_obs: chex.Array,
        meta: chex.Array,
        noise: chex.Array | None = None,
        folded: tuple[Folded, Folded] | None = None,
    ) -> tuple[HetNetCarry, dict[str, chex.Array], chex.Array, tuple[Exchange, Exchange]]:
        """projected_state (..., N, 512), x_obs (..., N_P, 32); the rest as in `HetGraph`."""
        num_p = x_obs.shape[-2]
        h_state, s_state = self.lstm_state.step_projected(
            (carry.h_state, carry.s_state), projected_state
        )
        h_obs, s_obs = self.lstm_obs((carry.h_obs, carry.s_obs), x_obs)
        f_p = jnp.concatenate([h_state[..., :num_p, :], h_obs], axis=-1)
        logits, value, exchanges = self.graph(f_p, h_state[..., num_p:, :], meta, noise, folded)
        return HetNetCarry(h_state, s_state, h_obs, s_obs), logits, value, exchanges


class HetNet(PolicyModule):
    """HetNet; with `bits` the agents exchange messages of that many bits.

    Attributes:
      meta: the team descriptor read by the state nodes: `normalised`
        [N_P / 10, N_A / 10, rows / 20, 1], or `repo`, the published raw numbers.

    Raises:
      ValueError: for a team with other classes or actions than P's 5 and A's 6, with capture
        agents that see (their features have no place for it), or whose agents come and go.
    """

    bits: int | None = None
    meta: Meta = "normalised"
    encoder: EncoderKind = "flat"
    critic: Critic = "class"

    critic_parameters: ClassVar[frozenset[str]] = CRITIC_PARAMETERS

    def __post_init__(self) -> None:
        _check_team(self.team)
        super().__post_init__()

    def setup(self) -> None:
        self.state_encoder = StateEncoder(self.encoder)
        self.view_encoder = ViewEncoder(self.encoder)
        self.core = HetNetCore(bits=self.bits, critic=self.critic)

    def encode_states(self, states: chex.Array | SparseStates) -> chex.Array:
        return self.core.project_states(self.state_encoder(states))

    def encode_listed(self, states: SparseStates) -> chex.Array:
        return self.encode_states(states)

    def fold(self) -> dict[str, Any]:
        layers = self.core.graph.fold(self.team.class_size(0), self.team.class_size(1))
        return {"layers": layers}

    def __call__(
        self, carry: HetNetCarry, state_features: chex.Array, view: chex.Array, noise: Any
    ) -> tuple[HetNetCarry, PolicyOutput]:
        num_p, num_a = self.team.class_size(0), self.team.class_size(1)
        x_obs = self.view_encoder(view[..., :num_p, :, :, :])
        meta = jnp.asarray(team_descriptor(self.team, self.meta), state_features.dtype)
        carry, logits, value, exchanges = self.core(
            carry, state_features, x_obs, meta, noise.get("bits"), self.folded()["layers"]
        )
        agent_logits = mask_actions(_join_logits(logits, self.team.num_actions), self.team)
        batch = value.shape[:-1]
        output = PolicyOutput(
            decisions={"action": decide(agent_logits, noise["action"])},
            value=self._of_agents(value),
            communication=_talk(exchanges, (*batch, num_p + num_a)),
            attention=_attention_matrix(exchanges[0].weights, num_p, num_a, batch),
        )
        return carry, output

    def _of_agents(self, value: chex.Array) -> chex.Array:
        """(..., 2) or (..., N) -> (..., N)."""
        if self.critic == "agent":
            return value
        capturer = np.array(self.team.agent_class) == 1
        return jnp.where(lift(capturer, value.ndim), value[..., 1:], value[..., :1])

    def initial_carry(self, batch_shape: tuple[int, ...]) -> HetNetCarry:
        state = jnp.zeros((*batch_shape, self.team.num_agents, STATE_FEATURES), jnp.float32)
        view = jnp.zeros((*batch_shape, self.team.class_size(0), VIEW_FEATURES), jnp.float32)
        return HetNetCarry(state, state, view, view)

    def memory(self, carry: HetNetCarry) -> chex.Array:
        blind = [(0, 0)] * (carry.h_obs.ndim - 2) + [(0, self.team.class_size(1)), (0, 0)]
        return jnp.concatenate([carry.h_state, jnp.pad(carry.h_obs, blind)], axis=-1)

    def sample_noise(self, key: chex.PRNGKey, batch_shape: tuple[int, ...]) -> Any:
        shape = (*batch_shape, self.team.num_agents, self.team.num_actions)
        action_key, bit_key = jax.random.split(key)
        noise = {"action": jax.random.gumbel(action_key, shape, jnp.float32)}
        if self.bits:
            shape = (*batch_shape, 2, self.team.num_agents, self.bits)
            noise["bits"] = jax.random.logistic(bit_key, shape, jnp.float32)
        return noise


def team_descriptor(team: TeamSpec, meta: Meta) -> np.ndarray:
    """(2, 4): what both state nodes read about the team and its grid."""
    raw = [team.class_size(0), team.class_size(1), team.state_shape[-2], META_CONSTANT]
    scale = META_SCALE if meta == "normalised" else np.ones(META_FEATURES)
    return np.tile(np.array(raw) / np.array(scale), (2, 1))


def present_relations(num_p: int, num_a: int) -> tuple[str, ...]:
    """Relations with at least one edge: nobody sends to itself, and a class may be empty."""
    size = {"P": num_p, "A": num_a, "S": 2}

    def present(relation: str) -> bool:
        sender, receiver = sender_of(relation), receiver_of(relation)
        return size[receiver] > 0 and size[sender] > int(sender == receiver)

    return tuple(filter(present, AGENT_RELATIONS + STATE_RELATIONS))


def _join_logits(logits: dict[str, chex.Array], num_actions: int) -> chex.Array:
    """Per class (..., N_c, 5 or 6) -> (..., N, num_actions); what is missing is for the mask."""
    widened = [
        jnp.pad(y, [(0, 0)] * (y.ndim - 1) + [(0, num_actions - y.shape[-1])])
        for y in (logits["P"], logits["A"])
        if y.shape[-2]
    ]
    return jnp.concatenate(widened, axis=-2)


def _talk(exchanges: tuple[Exchange, ...], shape: tuple[int, ...]) -> chex.Array:
    """(..., N): share of the bits an agent set, over both layers; 1 for real-valued messages."""
    bits = [exchange.bits for exchange in exchanges if exchange.bits is not None]
    return jnp.concatenate(bits, axis=-1).mean(-1) if bits else jnp.ones(shape, jnp.float32)


def _attention_matrix(
    weights: dict[str, chex.Array], num_p: int, num_a: int, batch: tuple[int, ...]
) -> chex.Array:
    """Weights (..., R, S, K) by relation -> (..., N, N), the mean over the heads.

    The rows of an agent that hears both classes sum to two: each relation is normalised by itself.
    """
    size = {"P": num_p, "A": num_a}

    def block(relation: str) -> chex.Array:
        if relation in weights:
            return weights[relation].mean(-1)
        shape = (*batch, size[receiver_of(relation)], size[sender_of(relation)])
        return jnp.zeros(shape, jnp.float32)

    rows = [jnp.concatenate([block(f"p2{to}"), block(f"a2{to}")], axis=-1) for to in ("p", "a")]
    return jnp.concatenate(rows, axis=-2)


def _check_team(team: TeamSpec) -> None:
    if team.agents_leave:
        raise ValueError(
            "hetnet has no message for an agent that is not there, and agents of this task come "
            "and go; use another policy."
        )
    if list(team.agent_class) != sorted(team.agent_class) or max(team.agent_class) > 1:
        raise ValueError(
            "hetnet is made for predators (class 0) followed by capture agents (class 1), "
            f"got agent classes {team.agent_class}."
        )
    for agent_class, mask in zip(team.agent_class, team.action_mask, strict=True):
        width = CLASS_ACTIONS[agent_class]
        if team.num_actions < width or any(mask[width:]):
            raise ValueError(
                f"hetnet gives agents of class {agent_class} {width} actions, but the task has "
                f"{team.num_actions} and allows them {sum(mask)}; use another policy."
            )
    if 1 in team.agent_class and team.sighted_classes[1]:
        raise ValueError(
            "hetnet's capture agents have no way to see: set capture_vision=None or use another "
            "policy."
        )


VARIANTS: dict[str, tuple[type[PolicyModule], dict[str, Any]]] = {
    "hetnet": (HetNet, {"bits": None}),
    "hetnet-binary": (HetNet, {"bits": 16}),
}
"""Names of this file's policies."""
