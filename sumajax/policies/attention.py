"""Graph attention: the layer of MAGIC and the relation of HetNet (docs/reference/policies.md).

Both score a pair by the sum of one number of the receiver and one of the sender, K heads side by
side, and send the sender's projected features along. MAGIC keeps the graph as a factor, so that
gradients reach the scheduler that drew it; HetNet's relations are complete.
"""

from typing import Literal, get_args

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn
from jax.nn.initializers import normal

from sumajax.policies.layers import add_bias, lift, product

SLOPE = 0.2
"""Of the LeakyReLU below zero."""
ISOLATED = 1e-15
"""Weight of every sender, present or not, before renormalising: gives an isolated receiver a
gradient that can open its edges again."""
NO_EDGE = -1e30
"""Score of a pair that does not exist: its softmax is exactly 0."""

SelfLoop = Literal["removed", "forced", "given"]
SELF_LOOPS = get_args(SelfLoop)


def pair_scores(receiver: chex.Array, sender: chex.Array) -> chex.Array:
    """(..., R, K) and (..., S, K) -> (..., R, S, K) LeakyReLU of the sum of each pair."""
    return nn.leaky_relu(receiver[..., :, None, :] + sender[..., None, :, :], SLOPE)


def gather_messages(weights: chex.Array, messages: chex.Array) -> chex.Array:
    """Weights (..., R, S, K), messages (..., S, K, O) -> (..., R, K, O), a sum over senders."""
    return jnp.einsum("...ijk,...jko->...iko", weights, messages)


def seen_through(kernel: chex.Array, vectors: chex.Array) -> chex.Array:
    """Kernel (..., K O), attention vectors (K, O) -> (..., K): what turns its input into scores.

    A score is linear in the features it is read off, so it can be had with them in one product.
    """
    per_head = kernel.reshape(*kernel.shape[:-1], *vectors.shape)
    return jnp.einsum("...ko,ko->...k", per_head, vectors)


def relation_attention(
    receiver: chex.Array, sender: chex.Array, messages: chex.Array, exclude_self: bool = False
) -> tuple[chex.Array, chex.Array]:
    """What one relation of HetNet's adds to its receivers (docs/reference/policies.md, HetNet).

    Args:
      receiver, sender: (..., R, K) and (..., S, K), each agent's share of the scores.
      messages: (..., S, K, O).
      exclude_self: whether receiver i must not hear sender i; needs R = S > 1.

    Returns:
      (..., R, K, O) sums of messages, and the (..., R, S, K) weights, a softmax over senders.
    """
    scores = pair_scores(receiver, sender)
    if exclude_self:
        itself = jnp.eye(scores.shape[-2], dtype=scores.dtype)[..., None]
        scores = scores + lift(NO_EDGE * itself, scores.ndim)
    weights = jax.nn.softmax(scores, axis=-2)
    return gather_messages(weights, messages), weights


class GraphAttention(nn.Module):
    """MAGIC's attention layer over a drawn graph.

    Source: Niu et al. 2021; docs/reference/policies.md, Attention over a drawn graph.

    Attributes:
      heads, features: K and O.
      average: mean over the heads, (..., N, O), instead of concatenation, (..., N, K O).
      normalize: make the weights of the present edges of a receiver sum to one.
      self_loop: what happens to the diagonal of the graph.
    """

    in_features: int
    heads: int
    features: int
    average: bool = False
    normalize: bool = False
    self_loop: SelfLoop = "given"

    def setup(self) -> None:
        heads, features = self.heads, self.features
        # Xavier with gain sqrt(2); the attention vectors count K as fan-in and O as fan-out.
        weight_init = normal((4 / (self.in_features + heads * features)) ** 0.5, jnp.float32)
        vector_init = normal((4 / (heads + features)) ** 0.5, jnp.float32)
        self.W = self.param("W", weight_init, (self.in_features, heads * features))
        self.a_i = self.param("a_i", vector_init, (heads, features))
        self.a_j = self.param("a_j", vector_init, (heads, features))
        width = features if self.average else heads * features
        self.bias = self.param("bias", nn.initializers.zeros_init(), (width,), jnp.float32)

    def fold(self) -> chex.Array:
        """(D, K O + 2 K): W, and the attention vectors of receivers and senders seen through it."""
        vectors = [seen_through(self.W, a) for a in (self.a_i, self.a_j)]
        return jnp.concatenate([self.W, *vectors], axis=-1)

    def __call__(
        self,
        m: chex.Array,
        graph: chex.Array | None = None,
        folded: chex.Array | None = None,
    ) -> tuple[chex.Array, chex.Array]:
        """m (..., N, D), graph (..., N, N) -> output and weights (..., N, N, K).

        Rows of the graph receive, columns send; without a graph it is complete. `folded` is what
        `fold` returns, for who has it already.
        """
        y = product(m, self.fold() if folded is None else folded)
        width = self.heads * self.features
        w, receiver, sender = jnp.split(y, [width, width + self.heads], axis=-1)
        w = w.reshape(*w.shape[:-1], self.heads, self.features)
        scores = pair_scores(receiver, sender)
        if graph is None:
            graph = jnp.ones(scores.shape[-3:-1], scores.dtype)
        weights = self.weigh(scores, lift(graph, scores.ndim - 1))
        if self.average:  # over senders and heads at once
            y = jnp.einsum("...ijk,...jko->...io", weights, w) / self.heads
        else:
            y = gather_messages(weights, w).reshape(*m.shape[:-1], width)
        return add_bias(y, self.bias), weights

    def weigh(self, scores: chex.Array, graph: chex.Array) -> chex.Array:
        """Scores (..., N, N, K), graph (..., N, N) -> weights (..., N, N, K) over axis -2.

        The graph is a factor three times over, and an absent edge still counts exp(0) in the
        softmax. For a 0/1 graph the normalised value is a masked softmax, the derivative with
        respect to the graph is not.
        """
        identity = lift(jnp.eye(graph.shape[-1], dtype=graph.dtype), graph.ndim)
        if self.self_loop != "given":
            graph = graph * (1 - identity)
        if self.self_loop == "forced":
            graph = graph + identity
        edge = graph[..., None]
        weights = jax.nn.softmax(scores * edge, axis=-2) * edge
        if self.normalize:
            if self.self_loop != "forced":
                weights = weights + ISOLATED
            weights = weights / weights.sum(-2, keepdims=True) * edge
        return weights
