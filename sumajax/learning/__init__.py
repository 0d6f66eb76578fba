"""Rollout, returns, losses and the compiled training loop; nothing here knows of files or plots."""

from sumajax.learning.config import EPOCH_STEPS, LearnerConfig, preset
from sumajax.learning.learner import Learner, Metrics, TrainState, make_learner

__all__ = [
    "EPOCH_STEPS",
    "Learner",
    "LearnerConfig",
    "Metrics",
    "TrainState",
    "make_learner",
    "preset",
]
