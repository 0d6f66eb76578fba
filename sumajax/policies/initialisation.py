"""How parameters start: as published, or with the signal of the observation amplified.

The originals' layers start uniform within +-1/sqrt(fan_in), a third of the variance that would
carry a signal through unchanged. Through the five layers between the prey in a window and the first
action that adds up: at the start a prey moves the action's log-probabilities by 1e-3 at most, and
it takes hundreds of updates before they notice. Gains of about sqrt(6), which keep the variance
through a layer with ReLU (He et al. 2015), end that.
"""

from typing import Any, Literal

import jax

Initialisation = Literal["amplified", "published"]

GAINS = {"state_encoder": 1.5, "view_encoder": 6**0.5, "merge_": 6**0.5, "w_ih": 6**0.5}
"""Factor on the weights (not the biases) of layers between observation and memory, by name."""


def amplify(params: Any) -> Any:
    """`params` with the weights of the input layers multiplied by their gain."""

    def leaf(path: tuple[Any, ...], weight: jax.Array) -> jax.Array:
        name = jax.tree_util.keystr(path)
        gain = next((gain for part, gain in GAINS.items() if part in name), 1.0)
        return weight if "bias" in name else weight * gain

    return jax.tree_util.tree_map_with_path(leaf, params)
