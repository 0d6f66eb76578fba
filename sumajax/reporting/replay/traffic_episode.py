"""One episode of Traffic Junction as numpy arrays: everything a replay shows of it."""

from dataclasses import dataclass

import jax
import numpy as np

from sumajax.environments.roads import Roads
from sumajax.environments.traffic_junction import State, TrafficJunction, collided


@dataclass(frozen=True)
class TrafficEpisode:
    """Everything a replay shows of T steps of N slots for cars, as numpy arrays.

    Frame t of T + 1 is the junction before step t with what is said and done in that step; the last
    frame is the outcome.
    """

    roads: Roads
    place: np.ndarray  # (T+1, N) int: where on which route (`Roads.cell`)
    alive: np.ndarray  # (T+1, N) bool: a car is in the slot
    collided: np.ndarray  # (T+1, N) bool: it shares its cell
    actions: np.ndarray  # (T, N) int: 0 gas, 1 brake
    attention: np.ndarray  # (T, N, N) weight of sender j (column) at receiver i (row)
    communication: np.ndarray  # (T, N) in [0, 1]: share of its means a car used to talk
    success: bool  # no collision

    @classmethod
    def of(
        cls,
        task: TrafficJunction,
        states: State,
        actions: np.ndarray,
        attention: np.ndarray,
        communication: np.ndarray,
        success: bool,
    ) -> "TrafficEpisode":
        """From what was recorded step by step; what empty slots say is left out."""
        alive = np.asarray(states.alive)
        there = alive[:-1]
        return cls(
            roads=task.roads,
            place=np.asarray(states.place),
            alive=alive,
            collided=np.asarray(jax.vmap(lambda state: collided(task, state))(states)),
            actions=actions,
            attention=attention * there[:, :, None] * there[:, None],
            communication=communication * there,
            success=success,
        )

    @property
    def size(self) -> tuple[int, int]:
        """(rows, columns) of the grid."""
        return self.roads.shape

    @property
    def num_steps(self) -> int:
        """T."""
        return len(self.actions)

    @property
    def num_agents(self) -> int:
        """N."""
        return self.alive.shape[1]

    def cars(self, moment: int) -> list[int]:
        """The slots that hold a car."""
        return [int(slot) for slot in np.flatnonzero(self.alive[moment])]

    def cell(self, moment: int, slot: int) -> np.ndarray:
        """(2,) row and column of a car."""
        return self.roads.cell[self.place[moment, slot]]

    def way(self, moment: int, slot: int) -> np.ndarray:
        """(cells, 2) what is left of a car's route, its own cell first."""
        place = self.place[moment, slot]
        return self.roads.routes[self.roads.route[place]][self.roads.position[place] :]

    def heading(self, moment: int, slot: int) -> np.ndarray:
        """(2,) rows and columns to the next cell; on the last one, those from the cell before."""
        place = self.place[moment, slot]
        after = place if self.roads.ended[place + 1] else place + 1
        return self.roads.cell[after] - self.roads.cell[after - 1]
