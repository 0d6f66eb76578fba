"""Grid-world domains as pure functions; they know nothing of policies or learning."""

from sumajax.environments.predator_capture_prey import PredatorCapturePrey
from sumajax.environments.predator_prey import PredatorPrey
from sumajax.environments.states import SparseStates
from sumajax.environments.traffic_junction import TrafficJunction
from sumajax.environments.types import Environment, Observation, Transition
from sumajax.environments.wrapper import Wrapper, rewrapped, unwrapped

__all__ = [
    "Environment",
    "Observation",
    "PredatorCapturePrey",
    "PredatorPrey",
    "SparseStates",
    "TrafficJunction",
    "Transition",
    "Wrapper",
    "rewrapped",
    "unwrapped",
]
