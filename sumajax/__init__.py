"""Multi-agent reinforcement learning scaled by state upsampling, as one compiled JAX program."""

from sumajax.checkpoint import load, load_npz, save, save_npz
from sumajax.environments import PredatorCapturePrey, PredatorPrey, TrafficJunction
from sumajax.evaluation import evaluate, load_agent, pretrained
from sumajax.learning import LearnerConfig, make_learner, preset
from sumajax.policies import make_policy
from sumajax.upsampling import StateUpsampled, upsample

__version__ = "0.2.0"

__all__ = [
    "LearnerConfig",
    "PredatorCapturePrey",
    "PredatorPrey",
    "StateUpsampled",
    "TrafficJunction",
    "evaluate",
    "load",
    "load_agent",
    "load_npz",
    "make_learner",
    "make_policy",
    "preset",
    "pretrained",
    "save",
    "save_npz",
    "upsample",
]
