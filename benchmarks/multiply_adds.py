"""Multiply-adds of one team step of each published architecture, forwards, states by table.

These are the products the architecture needs, not what our program happens to do: where a product
is folded into another or into the per-cell table, the work is counted as published, so that the
share of the machine's speed that a policy reaches can be compared between programs.
"""

from collections.abc import Callable

from sumajax.environments.types import Environment
from sumajax.policies.encoder import STATE_FEATURES, VIEW_FEATURES, VIEW_KERNEL
from sumajax.policies.tarmac import KEY_FEATURES
from sumajax.policies.types import TeamSpec

HIDDEN = 128


def of_step(policy: str, env: Environment) -> int:
    """() of all agents of `env`, hidden width 128, one step."""
    return COUNTS[policy](TeamSpec.of(env))


def view_encoder(team: TeamSpec) -> int:
    """Of one agent: a 3x3 convolution to 32 channels, then a dense layer to 32."""
    channels, side, _ = team.view_shape
    kernel = min(VIEW_KERNEL, side)
    places = (side - kernel + 1) ** 2
    return places * VIEW_FEATURES * (kernel**2 * channels + VIEW_FEATURES)


def lstm(inputs: int, hidden: int) -> int:
    return 4 * hidden * (inputs + hidden)


def encoder(team: TeamSpec) -> int:
    """Of one agent: its view, and the layer that merges it with the state's features."""
    return view_encoder(team) + (STATE_FEATURES + VIEW_FEATURES) * HIDDEN


def ic3net(team: TeamSpec, communicates: bool = True, gated: bool = True) -> int:
    agents = team.num_agents
    heads = HIDDEN * (team.num_actions + 1 + 2 * gated)
    own = encoder(team) + lstm(HIDDEN, HIDDEN) + heads
    if not communicates:
        return agents * own
    return agents * (own + HIDDEN * HIDDEN) + agents**2 * HIDDEN


def magic(team: TeamSpec) -> int:
    """The setting `medium`: four heads of 32 in the message encoder, one of 128 in both rounds."""
    agents, width, heads, scheduler = team.num_agents, 32, 4, (64, 16, 8)
    message_encoder = HIDDEN * heads * width
    scores = 2 * heads * width
    round_width = HIDDEN
    own = (
        encoder(team)
        + lstm(HIDDEN, HIDDEN)
        + 2 * message_encoder
        + 2 * scores
        + 2 * (HIDDEN * round_width + 2 * round_width)
        + 2 * HIDDEN * (team.num_actions + 1)
    )
    first, second, third = scheduler
    schedulers = 2 * (first * second + second * third * 2 + third * 2 * 2)
    pair = schedulers + 2 * HIDDEN + 2 * round_width
    return agents * own + agents**2 * pair


def tarmac(team: TeamSpec, gated: bool = True, rounds: int = 1) -> int:
    """Queries, signatures and values of `KEY_FEATURES` and 128; the LSTM runs in every round."""
    agents = team.num_agents
    of_round = lstm(HIDDEN, HIDDEN) + 2 * HIDDEN * HIDDEN + 2 * HIDDEN * KEY_FEATURES
    heads = HIDDEN * (team.num_actions + 1 + 2 * gated)
    pairs = rounds * agents**2 * (KEY_FEATURES + HIDDEN)
    return agents * (encoder(team) + rounds * of_round + heads) + pairs


LAYER_WIDTH, LAYER_HEADS = 16, 4
STATE_WIDTH, META = 8, 4


def hetnet(team: TeamSpec) -> int:
    """Two heterogeneous layers; class 0 feels and sees, class 1 only feels (if it is blind)."""
    sizes = [team.class_size(c) for c in range(len(team.sighted_classes))]
    seen = [STATE_FEATURES + VIEW_FEATURES * sighted for sighted in team.sighted_classes]
    front = sum(
        size
        * (
            lstm(STATE_FEATURES, STATE_FEATURES)
            + sighted * (view_encoder(team) + lstm(VIEW_FEATURES, VIEW_FEATURES))
        )
        for size, sighted in zip(sizes, team.sighted_classes, strict=True)
    )
    wide = LAYER_WIDTH * LAYER_HEADS
    actions = [5 * LAYER_HEADS, 6 * LAYER_HEADS]
    first = _layer(sizes, seen, [wide, wide], META, wide)
    second = _layer(sizes, [wide, wide], actions, wide, STATE_WIDTH * LAYER_HEADS)
    return front + first + second + 2 * STATE_WIDTH


def _layer(sizes: list[int], inputs: list[int], outputs: list[int], meta: int, state: int) -> int:
    """One round: own transforms, every relation between classes, and one state node a class."""
    total = 2 * meta * state
    for source, size in enumerate(sizes):
        total += size * inputs[source] * (outputs[source] + state)
        total += (size + 1) * state + size * state  # scores and messages to the state node
        for target, others in enumerate(sizes):
            if not size or not others:
                continue
            edges = size * others - (size if source == target else 0)
            total += outputs[target] * (size * inputs[source] + size + others + edges)
    return total


COUNTS: dict[str, Callable[[TeamSpec], int]] = {
    "ic3net": ic3net,
    "commnet": lambda team: ic3net(team, gated=False),
    "iric": lambda team: ic3net(team, communicates=False, gated=False),
    "ic": lambda team: ic3net(team, communicates=False, gated=False),
    "magic": magic,
    "tarmac": lambda team: tarmac(team, gated=False),
    "tarmac-ic3net": tarmac,
    "hetnet": hetnet,
}
"""By policy name; binary messages are counted as the real-valued ones they replace."""
COUNTS["hetnet-binary"] = hetnet
