"""The optimisers of the presets."""

import chex
import jax.numpy as jnp
import optax

from sumajax.learning.config import LearnerConfig

RMSPROP_DECAY, RMSPROP_EPS = 0.97, 1e-6
"""The originals' settings (docs/reference/learning.md, Optimisers)."""


def annealed(config: LearnerConfig, updates: chex.Numeric) -> chex.Numeric:
    """What annealing leaves of the learning rate and the entropy weight after so many updates."""
    if not config.anneal_epochs:
        return 1.0
    length = config.anneal_epochs * config.updates_per_epoch
    return optax.linear_schedule(1.0, config.anneal_to, length)(jnp.asarray(updates, jnp.float32))


def learning_rate(config: LearnerConfig, updates: chex.Numeric) -> chex.Numeric:
    """Of the next update, after so many: `critic_rate` while the critic learns alone, then warmed
    up, then annealed.

    Adam's first steps have the size of the rate whatever the gradient's: on a policy that was
    trained elsewhere they are noise, and the warm-up keeps them from wrecking it.
    """
    rate = config.learning_rate * annealed(config, updates)
    alone = config.critic_epochs * config.updates_per_epoch
    if config.warmup_epochs:
        following = jnp.asarray(updates - alone, jnp.float32) + 1
        warm = following / (config.warmup_epochs * config.updates_per_epoch)
        rate = rate * jnp.minimum(warm, 1.0)
    return jnp.where(updates < alone, config.critic_rate, rate) if alone else rate


def make_optimiser(config: LearnerConfig) -> optax.GradientTransformation:
    """Clipping, then Adam or RMSprop, before the learning rate.

    The rate stays outside, so that memory carried from another stage brings no schedule with it.
    """
    scale = {
        "adam": optax.scale_by_adam,
        # v <- .97 v + .03 g^2, p <- p - lr g / (sqrt(v) + eps): optax puts eps inside the root
        # unless told otherwise, which here would damp a thousand times more.
        "rmsprop": lambda: optax.scale_by_rms(
            decay=RMSPROP_DECAY, eps=RMSPROP_EPS, initial_scale=0.0, eps_in_sqrt=False
        ),
    }[config.optimiser]()
    if config.max_grad_norm is not None and not config.clip_per_env:
        scale = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), scale)
    # One vector instead of a tree: a few programs to compile instead of a few for every leaf.
    return optax.flatten(scale)
