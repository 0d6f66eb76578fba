"""Predator-Prey (PP): predators with limited sight must all reach one stationary prey.

The case of Predator-Capture-Prey without capture agents: two entity channels, five actions, the
same engine. Source: Singh et al. 2019 (IC3Net), section 4.1 of the paper and its published program.
"""

from dataclasses import dataclass, field
from typing import ClassVar

from sumajax.environments.predator_capture_prey import (
    PredatorCapturePrey,
    State,
    active,
    observe,
    reset,
    state_at,
    step,
    view,
)

__all__ = ["PredatorPrey", "State", "active", "observe", "reset", "state_at", "step", "view"]


@dataclass(frozen=True)
class PredatorPrey(PredatorCapturePrey):
    """Configuration of the task; see `PredatorCapturePrey` for the fields and the errors."""

    num_predators: int = 3
    num_capturers: int = field(default=0, init=False, repr=False)
    capture_reward: str = field(default="default", init=False, repr=False)  # type: ignore[assignment]
    capture_vision: None = field(default=None, init=False, repr=False)

    entities: ClassVar[tuple[str, ...]] = ("predators", "prey")
    num_actions: ClassVar[int] = 5
