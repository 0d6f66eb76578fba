"""TarMAC (Das et al. 2019): attention over messages, with or without IC3Net's gate.

What an agent hears is not the mean of the others' messages but a sum of all of them, its own
included, weighted by how well each sender's signature answers the receiver's query. Everything
else is IC3Net's (Singh et al. 2019): encoder, LSTM, heads and the gate that is drawn one step
ahead. This is the form of the published program of MAGIC's baselines, which adapts one by TarMAC's
first author: the LSTM runs once per round of messages.
"""

from typing import Any, ClassVar, Literal

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn

from sumajax.environments.states import SparseStates
from sumajax.policies.encoder import EncoderKind, ObservationEncoder
from sumajax.policies.ic3net import IC3NetCarry, talking
from sumajax.policies.layers import Dense, LSTMCell, product, side_by_side
from sumajax.policies.types import Decision, PolicyModule, PolicyOutput, decide, mask_actions

KEY_FEATURES = 16
"""Width of queries and signatures, in the paper and in the program."""
UNHEARD = -1e9
"""Score of a sender that does not talk: its weight is exactly 0. Not minus infinity: were everybody
silent, the softmax would have no value and its derivative would spoil all others."""

ScoreScale = Literal["hidden", "key"]


class TarMACCore(nn.Module):
    """One step from encoded observations: rounds of attention and LSTM, then the heads.

    Attributes:
      comm_passes: rounds of messages within a step, each of them a step of the LSTM.
      score_scale: scores are divided by the root of the `hidden` width (the program) or of the
        `key`s' width (the paper).
    """

    hidden: int
    num_actions: int
    gated: bool = True
    comm_passes: int = 1
    score_scale: ScoreScale = "hidden"

    def setup(self) -> None:
        self.query = Dense(KEY_FEATURES)
        self.key = Dense(KEY_FEATURES)
        self.message = Dense(self.hidden)
        self.C = [Dense(self.hidden) for _ in range(self.comm_passes)]
        self.lstm = LSTMCell(self.hidden, self.hidden)
        self.action = Dense(self.num_actions)
        self.value = Dense(1)
        if self.gated:
            self.gate = Dense(2)

    def project_input(self, x: chex.Array) -> chex.Array:
        """Encoded observations (..., H), or what is constant in them, -> (..., 4H)."""
        return self.lstm.project_input(x)

    def fold(self, view_kernel: chex.Array) -> dict[str, Any]:
        """Products of weights that every step needs.

        Between an agent's memory and the LSTM of who hears it there are three linear maps (message,
        C, input) and only a weighted sum besides. So the memories are summed, and the maps are one.
        The signature's bias adds the same to all scores of a receiver, which changes no weight.

        Args:
          view_kernel: (V, H), which turns what is seen into its share of the encoded observation.
        """
        hidden = self.hidden
        query, query_bias = weights_of(self.query, hidden)
        key, _ = weights_of(self.key, hidden)
        message, message_bias = weights_of(self.message, hidden)
        scale = {"hidden": hidden, "key": KEY_FEATURES}[self.score_scale] ** -0.5
        rounds = []
        for layer in self.C:
            kernel, bias = weights_of(layer, hidden)
            biases = jnp.stack([bias, message_bias @ kernel])
            rounds.append(
                {
                    "heard": self.lstm.fold(message @ kernel),  # (2H, 4H)
                    "biases": product(biases, self.lstm.w_ih),  # (2, 4H): always, if anybody talks
                }
            )
        return {
            "view": product(view_kernel, self.lstm.w_ih),  # (V, 4H)
            "scores": jnp.concatenate([scale * query, key], axis=-1),  # (H, 2K)
            "query_bias": scale * query_bias,  # (K,)
            "rounds": tuple(rounds),
        }

    def __call__(
        self,
        carry: IC3NetCarry,
        projected: chex.Array,
        seen: chex.Array,
        folded: dict[str, Any],
        alive: chex.Array | None = None,
    ) -> tuple[chex.Array, chex.Array, dict[str, chex.Array], chex.Array, chex.Array]:
        """projected (..., N, 4H), seen (..., N, V), alive (..., N).

        Returns:
          h, s, logits by decision, value (..., N) and attention (..., R, N, N) of each round, row
          i of receiver i.
        """
        h, s = carry.h, carry.s
        there = None if alive is None else alive.astype(h.dtype)
        talks = talking(carry.gate, alive) if self.gated else there  # None: all, always
        x = projected + product(seen, folded["view"])
        attention = []
        for of_round in folded["rounds"]:
            query, key = jnp.split(product(h, folded["scores"]), 2, axis=-1)
            query = query + jnp.broadcast_to(folded["query_bias"], query.shape)
            weights = attend(query, key, talks, there)
            heard = jnp.einsum("...ij,...jh->...ih", weights, h)
            state_bias, message_bias = (
                jnp.broadcast_to(bias, x.shape) for bias in of_round["biases"]
            )
            if talks is not None:
                message_bias = message_bias * hears(talks, there)[..., None]
            h, s = self.lstm.step_folded(
                (h, s), x + state_bias + message_bias, heard, of_round["heard"]
            )
            attention.append(weights)
        heads = [self.action, self.value, *([self.gate] if self.gated else [])]
        action, value, *gate = side_by_side(heads, h)
        logits = {"action": action} | ({"gate": gate[0]} if gate else {})
        return h, s, logits, value[..., 0], jnp.stack(attention, axis=-3)


def weights_of(layer: Dense, in_features: int) -> tuple[chex.Array, chex.Array]:
    """kernel and bias of a layer that has both."""
    kernel, bias = layer.weights(in_features)
    assert bias is not None
    return kernel, bias


def attend(
    query: chex.Array,
    key: chex.Array,
    talks: chex.Array | None = None,
    there: chex.Array | None = None,
) -> chex.Array:
    """(..., N, N): weight of each sender (column) at each receiver (row), a softmax over senders.

    A row is 0 where nobody talks, or where the receiver is not there. A silent agent hears.

    Args:
      query, key: (..., N, K) of receivers and senders, the query already scaled.
      talks, there: (..., N) of 0 and 1; None: everybody.
    """
    scores = jnp.einsum("...ik,...jk->...ij", query, key)
    if talks is None:
        return jax.nn.softmax(scores, axis=-1)
    sends = jnp.broadcast_to(talks[..., None, :], scores.shape)
    weights = jax.nn.softmax(jnp.where(sends > 0, scores, UNHEARD), axis=-1) * sends
    return weights if there is None else weights * there[..., :, None]


def hears(talks: chex.Array, there: chex.Array | None) -> chex.Array:
    """(..., N): 1 where an agent hears anybody, 0 where not: the sum of its weights."""
    anybody = jnp.broadcast_to(talks.max(-1, keepdims=True), talks.shape)
    return anybody if there is None else anybody * there


class TarMAC(PolicyModule):
    """TarMAC with IC3Net's gate; with `gated=False` everybody always talks.

    Attributes:
      comm_passes: rounds of messages within a step; the paper's best has two.
      score_scale: the root of which width divides the scores, see `TarMACCore`.
      talk_always: the gate is drawn and trained as ever, but taken as open from the second step on,
        as the published program does in Traffic Junction.
      fresh_memory: an agent that takes another's place starts without its memory; in the published
        program it goes on with it.
    """

    hidden: int = 128
    gated: bool = True
    comm_passes: int = 1
    encoder: EncoderKind = "flat"
    score_scale: ScoreScale = "hidden"
    talk_always: bool = False
    fresh_memory: bool = False

    critic_parameters: ClassVar[frozenset[str]] = frozenset({"value"})

    def setup(self) -> None:
        self.observation = ObservationEncoder(self.hidden, self.encoder)
        self.core = TarMACCore(
            self.hidden, self.team.num_actions, self.gated, self.comm_passes, self.score_scale
        )

    def encode_states(self, states: chex.Array | SparseStates) -> chex.Array:
        return self.core.project_input(self.observation.encode_states(states))

    def encode_listed(self, states: SparseStates) -> chex.Array:
        return self.encode_states(states)

    def fold(self) -> dict[str, Any]:
        return self.core.fold(self.observation.view_kernel())

    def __call__(
        self,
        carry: IC3NetCarry,
        state_features: chex.Array,
        view: chex.Array,
        noise: Any,
        alive: chex.Array | None = None,
    ) -> tuple[IC3NetCarry, PolicyOutput]:
        seen = self.observation.see(view, self.team.sighted)
        h, s, logits, value, attention = self.core(
            carry, state_features, seen, self.folded(), alive
        )
        action_logits = mask_actions(logits["action"], self.team)
        decisions: dict[str, Decision] = {"action": decide(action_logits, noise["action"])}
        talked = gate = carry.gate
        if self.gated:
            decisions["gate"] = decide(logits["gate"], noise["gate"])
            gate = decisions["gate"].choice.astype(h.dtype)
            gate = jnp.ones_like(gate) if self.talk_always else gate
        output = PolicyOutput(
            decisions=decisions,
            value=value,
            communication=talking(talked, alive),
            attention=attention.mean(-3),
        )
        return IC3NetCarry(h, s, gate), output

    def initial_carry(self, batch_shape: tuple[int, ...]) -> IC3NetCarry:
        shape = (*batch_shape, self.team.num_agents)
        zeros = jnp.zeros((*shape, self.hidden), jnp.float32)
        return IC3NetCarry(zeros, zeros, jnp.full(shape, float(not self.gated), zeros.dtype))

    def memory(self, carry: IC3NetCarry) -> chex.Array:
        return carry.h

    def sample_noise(self, key: chex.PRNGKey, batch_shape: tuple[int, ...]) -> Any:
        shape = (*batch_shape, self.team.num_agents)
        action_key, gate_key = jax.random.split(key)
        actions = (*shape, self.team.num_actions)
        noise = {"action": jax.random.gumbel(action_key, actions, jnp.float32)}
        if self.gated:
            noise["gate"] = jax.random.gumbel(gate_key, (*shape, 2), jnp.float32)
        return noise


VARIANTS: dict[str, tuple[type[PolicyModule], dict[str, Any]]] = {
    "tarmac": (TarMAC, {"gated": False, "talk_always": False}),
    "tarmac-ic3net": (TarMAC, {}),
}
"""Names of this file's policies. They differ also in the reward, a setting of the learner: `tarmac`
is trained on the team's mean, `tarmac-ic3net` on each agent's own."""
