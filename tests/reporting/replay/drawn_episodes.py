"""A made-up episode to draw."""

from typing import Any

import numpy as np

from sumajax.reporting import Episode


def episode(steps: int = 3, size: tuple[int, int] = (5, 6), **changes: Any) -> Episode:
    """A capture agent (the last) and predators that stand still; 0 and 1 talk to each other."""
    agents = 3
    attention = np.zeros((steps, agents, agents))
    attention[:, 0, 1] = attention[:, 1, 0] = 0.5
    communication = np.zeros((steps, agents))
    communication[:, :2] = 1
    cells = np.stack([np.arange(agents), np.arange(agents)], axis=-1)
    agent_class = np.zeros(agents, int)
    agent_class[-1] = 1
    fields = {
        "agents": np.broadcast_to(cells, (steps + 1, agents, 2)),
        "prey": np.array([4, 1]),
        "reached": np.zeros((steps + 1, agents), bool),
        "captured": np.broadcast_to(agent_class == 0, (steps + 1, agents)),
        "actions": np.full((steps, agents), 4),
        "attention": attention,
        "communication": communication,
        "reward": np.zeros((steps, agents)),
        "agent_class": agent_class,
        "size": size,
        "vision": 1,
    }
    return Episode(**{**fields, **changes})
