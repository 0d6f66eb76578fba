"""The roads of Traffic Junction: lanes, entries, and every route a car can have.

Traffic keeps right, lanes are one cell wide and as long as the grid. Source: IC3Net's published
program (its three difficulties), checked cell by cell against recordings of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import product
from typing import Literal

import numpy as np

from sumajax.environments.grid import DOWN, LEFT, NOWHERE, RIGHT, UP
from sumajax.environments.states import SparseStates

Difficulty = Literal["easy", "medium", "hard"]

AHEAD = {UP: (-1, 0), RIGHT: (0, 1), DOWN: (1, 0), LEFT: (0, -1)}
CLOCKWISE = (UP, RIGHT, DOWN, LEFT)
STRAIGHT, TURN_RIGHT, TURN_LEFT = range(3)
QUARTER_TURNS = {STRAIGHT: 0, TURN_RIGHT: 1, TURN_LEFT: -1}

Cell = tuple[int, int]
Lanes = dict[int, tuple[int, ...]]
"""Heading -> the columns (up, down) or rows (left, right) of its lanes."""


@dataclass(frozen=True)
class Layout:
    """Where the lanes of one junction lie, and what its entries and their routes are."""

    side: int
    lanes: Lanes
    entries: tuple[tuple[Cell, int], ...]  # G pairs of cell and heading, in order of arrival
    turns: tuple[tuple[int, ...], ...]  # what the routes of an entry do at their first junctions
    blocks: tuple[tuple[int, int, int], ...]  # roads as (axis, first, end): rows 0, columns 1
    classes_per_road_cell: int  # the class of a cell that is no road, in the original's numbering

    def is_lane(self, cell: Cell, heading: int) -> bool:
        """Whether the cell lies on a lane of that heading."""
        across = cell[1] if heading in (UP, DOWN) else cell[0]
        return across in self.lanes.get(heading, ())

    def is_crossing(self, cell: Cell) -> bool:
        """Whether the cell lies on a lane across and on one along."""
        along = any(self.is_lane(cell, heading) for heading in (UP, DOWN))
        return along and any(self.is_lane(cell, heading) for heading in (LEFT, RIGHT))


@dataclass(frozen=True, eq=False)
class Roads:
    """A junction as tables. A place is a cell of a route; each route has one more, its end.

    P places: those of route 0, its end, those of route 1, its end, and so on, last `nowhere`: where
    a slot is that never held a car. d side of the grid, G entries.
    """

    layout: Layout
    routes: tuple[np.ndarray, ...]  # each (length, 2) int cells, by route id: entry after entry

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.layout.side, self.layout.side

    @property
    def entries(self) -> tuple[Cell, ...]:
        """G cells, in order of arrival."""
        return tuple(cell for cell, _ in self.layout.entries)

    @property
    def routes_per_entry(self) -> int:
        """Every entry has as many."""
        return len(self.routes) // len(self.entries)

    @cached_property
    def road(self) -> np.ndarray:
        """(d, d) bool: some lane has the cell."""
        road = np.zeros(self.shape, bool)
        for heading, lanes in self.layout.lanes.items():
            road[np.s_[:, lanes] if heading in (UP, DOWN) else np.s_[lanes, :]] = True
        return road

    @cached_property
    def cell(self) -> np.ndarray:
        """(P, 2) int32 cells; `NOWHERE` at the ends and beyond."""
        end = [[NOWHERE, NOWHERE]]
        parts = [part for route in self.routes for part in (route, end)]
        return np.concatenate([*parts, end]).astype(np.int32)

    @cached_property
    def route(self) -> np.ndarray:
        """(P,) int32 route id; -1 for nowhere."""
        lengths = [len(route) + 1 for route in self.routes]
        return np.append(np.repeat(np.arange(len(self.routes)), lengths), -1).astype(np.int32)

    @cached_property
    def position(self) -> np.ndarray:
        """(P,) int32 cells from the entry on, the route's length at its end; -1 for nowhere."""
        parts = [np.arange(len(route) + 1) for route in self.routes]
        return np.append(np.concatenate(parts), -1).astype(np.int32)

    @cached_property
    def ended(self) -> np.ndarray:
        """(P,) bool: a car at that place has left the junction."""
        return (self.cell == NOWHERE).all(-1)

    @cached_property
    def gives_way(self) -> np.ndarray:
        """(P,) bool: the next cell of the route is the first of a crossing."""
        crosses = np.array([self.layout.is_crossing((int(r), int(c))) for r, c in self.cell])
        return ~crosses & np.append(crosses[1:], False) & ~self.ended

    @cached_property
    def first_places(self) -> np.ndarray:
        """(G, routes per entry) int32: where each route begins."""
        return np.flatnonzero(self.position == 0).astype(np.int32).reshape(len(self.entries), -1)

    @property
    def nowhere(self) -> int:
        """The last place."""
        return len(self.cell) - 1

    @cached_property
    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        """The first place of each state tensor (S,), and the tensor of each place (P,)."""
        to_come = [
            self.routes[route][position:].tobytes()
            for route, position in zip(self.route[:-1], self.position[:-1], strict=True)
        ]
        first: dict[bytes, int] = {}
        for place, cells in enumerate([*to_come, b""]):
            first.setdefault(cells, place)
        number = {cells: row for row, cells in enumerate(first)}
        rows = [number[cells] for cells in [*to_come, b""]]
        return np.array(list(first.values())), np.array(rows, np.int32)

    @property
    def state_row(self) -> np.ndarray:
        """(P,) int32: the entry of `states` that is each place's."""
        return self._rows[1]

    @cached_property
    def states(self) -> SparseStates:
        """The S state tensors (2, d, d): own cell, and all cells ahead; 0 where there is no car.

        The way ahead is a set of cells, but with the own cell it has one order only: no route meets
        a cell twice. Where routes have joined, their places share a tensor.
        """
        side = self.layout.side
        longest = max(map(len, self.routes))
        cell = np.zeros((len(self._rows[0]), longest), np.int32)
        value = np.zeros(cell.shape, np.float32)
        for state, place in enumerate(self._rows[0]):
            if not self.ended[place]:
                row, column = self.routes[self.route[place]][self.position[place] :].T
                channel = np.arange(len(row)) > 0
                cell[state, : len(row)] = (channel * side + row) * side + column
                value[state, : len(row)] = 1
        return SparseStates(cell, value, (2, side, side))

    @cached_property
    def padded_routes(self) -> np.ndarray:
        """(routes, longest, 2) int32 cells, filled up with `NOWHERE`."""
        longest = max(map(len, self.routes))
        fill_up = partial(np.pad, constant_values=NOWHERE)
        padded = [fill_up(route, ((0, longest - len(route)), (0, 0))) for route in self.routes]
        return np.stack(padded).astype(np.int32)

    def lines(self, vision: int) -> np.ndarray:
        """(P, 2, m) int32: what the rows, and the columns, of the window around each place are.

        0 no part of the grid, 1 a line without a lane, 2 one with a lane on it. As lanes are as
        long as the grid, a cell is road where the product of its row and its column is 2 or 4.
        """
        kinds = [1 + self.road.all(1), 1 + self.road.all(0)]
        around = np.stack([np.pad(kind, vision) for kind in kinds]).astype(np.int32)
        reach = np.arange(2 * vision + 1)
        first = np.where(self.ended[:, None], 0, self.cell)  # of the window, in `around`
        lines = around[np.arange(2)[:, None], first[:, :, None] + reach]
        return np.where(self.ended[:, None, None], 0, lines)

    @property
    def outside_class(self) -> int:
        """The original's class of a cell that is no road."""
        return self.layout.classes_per_road_cell

    @cached_property
    def classes(self) -> np.ndarray:
        """(d, d) int32: the original's class of each cell.

        Roads are numbered one after another, row by row inside a road; the later one names the
        cells where two cross.
        """
        classes = np.full(self.shape, self.outside_class, np.int32)
        number = 0
        for axis, first, end in self.layout.blocks:
            block = np.s_[first:end, :] if axis == 0 else np.s_[:, first:end]
            count = classes[block].size
            classes[block] = number + np.arange(count).reshape(classes[block].shape)
            number += count
        return classes


@cache
def roads(difficulty: Difficulty, size: int) -> Roads:
    """The junction of one difficulty.

    Args:
      size: the original's size argument: even for easy and medium, a multiple of 3 for hard. Easy's
        grid has a side of one more.
    """
    layout = {"easy": _easy, "medium": _medium, "hard": _hard}[difficulty](size)
    return Roads(layout, tuple(_routes(layout)))


def _easy(size: int) -> Layout:
    """One road down, one to the right, without turns."""
    middle = (size + 1) // 2
    return Layout(
        side=size + 1,
        lanes={DOWN: (middle,), RIGHT: (middle,)},
        entries=(((0, middle), DOWN), ((middle, 0), RIGHT)),
        turns=((),),
        blocks=((0, middle, middle + 1), (1, middle, middle + 1)),
        # Twice the size, although the roads have two cells more: the original's slip.
        classes_per_road_cell=2 * size,
    )


def _medium(size: int) -> Layout:
    """One road each way, with two lanes."""
    middle, last = size // 2, size - 1
    return Layout(
        side=size,
        lanes={DOWN: (middle - 1,), UP: (middle,), RIGHT: (middle,), LEFT: (middle - 1,)},
        entries=(
            ((0, middle - 1), DOWN),
            ((last, middle), UP),
            ((middle, 0), RIGHT),
            ((middle - 1, last), LEFT),
        ),
        turns=((STRAIGHT,), (TURN_RIGHT,), (TURN_LEFT,)),
        blocks=((0, middle - 1, middle + 1), (1, middle - 1, middle + 1)),
        classes_per_road_cell=4 * size,
    )


def _hard(size: int) -> Layout:
    """Two roads each way, with two lanes: four junctions."""
    a, b, last = size // 3 - 2, 2 * size // 3, size - 1
    return Layout(
        side=size,
        lanes={DOWN: (a, b), UP: (a + 1, b + 1), RIGHT: (a + 1, b + 1), LEFT: (a, b)},
        entries=(
            *(((0, column), DOWN) for column in (a, b)),
            *(((row, 0), RIGHT) for row in (a + 1, b + 1)),
            *(((last, column), UP) for column in (a + 1, b + 1)),
            *(((row, last), LEFT) for row in (a, b)),
        ),
        turns=tuple(product((STRAIGHT, TURN_RIGHT, TURN_LEFT), repeat=2)),
        blocks=((0, a, a + 2), (0, b, b + 2), (1, a, a + 2), (1, b, b + 2)),
        classes_per_road_cell=8 * size,
    )


def _routes(layout: Layout) -> list[np.ndarray]:
    """Every different route, entry by entry, in the order of the turns."""
    routes = []
    for cell, heading in layout.entries:
        different = dict.fromkeys(_drive(layout, cell, heading, turns) for turns in layout.turns)
        routes += [np.array(route) for route in different]
    return routes


def _drive(layout: Layout, cell: Cell, heading: int, turns: Sequence[int]) -> tuple[Cell, ...]:
    """The cells from an entry to the border.

    Each crossing takes the next of `turns`, straight on when there are none left. A car turns when
    it is on a lane of its new heading: at once to the right, two cells later to the left.
    """
    to_come, wanted, route = list(turns), heading, [cell]
    while True:
        ahead = (cell[0] + AHEAD[heading][0], cell[1] + AHEAD[heading][1])
        if not (0 <= ahead[0] < layout.side and 0 <= ahead[1] < layout.side):
            return tuple(route)
        if layout.is_crossing(ahead) and not layout.is_crossing(cell):
            turn = to_come.pop(0) if to_come else STRAIGHT
            wanted = CLOCKWISE[(CLOCKWISE.index(heading) + QUARTER_TURNS[turn]) % len(CLOCKWISE)]
        cell = ahead
        route.append(cell)
        if wanted != heading and layout.is_lane(cell, wanted):
            heading = wanted
