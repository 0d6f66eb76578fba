"""The roads of Traffic Junction: lanes, entries, routes, and the tables made of them."""

from itertools import pairwise

import numpy as np
import pytest

from sumajax.environments.roads import roads

GRIDS = [("easy", 4), ("easy", 6), ("easy", 8), ("medium", 4), ("medium", 14)]
GRIDS += [("hard", 9), ("hard", 12), ("hard", 15), ("hard", 18)]
each_grid = pytest.mark.parametrize(("difficulty", "size"), GRIDS)


@pytest.mark.parametrize(
    ("difficulty", "size", "side", "road_cells", "entries", "lengths"),
    [
        ("easy", 6, 7, 13, 2, [[7]] * 2),
        ("medium", 14, 14, 52, 4, [[14, 13, 15]] * 4),
        (
            *("hard", 18, 18, 128, 8),
            [[18, 17, 27, 9, 19, 26, 20] if g in (0, 3, 5, 6) else [18, 25, 19, 17, 16, 26, 11]
             for g in range(8)],
        ),
    ],
)  # fmt: skip
def test_published_sizes(difficulty, size, side, road_cells, entries, lengths):
    where = roads(difficulty, size)
    assert where.shape == (side, side)
    assert where.road.sum() == road_cells
    assert len(where.entries) == entries
    assert [len(route) for route in where.routes] == np.concatenate(lengths).tolist()


@each_grid
def test_routes(difficulty, size):
    """From entry to border, cell by cell, no cell twice, never against another route's traffic."""
    where = roads(difficulty, size)
    steps = set()
    for number, route in enumerate(where.routes):
        cells = [tuple(cell) for cell in route.tolist()]
        assert cells[0] == where.entries[number // where.routes_per_entry]
        assert any(side in (0, where.shape[0] - 1) for side in cells[-1])
        assert len(set(cells)) == len(cells)
        assert (np.abs(np.diff(route, axis=0)).sum(1) == 1).all()
        assert where.road[tuple(route.T)].all()
        steps |= set(pairwise(cells))
    assert len({route.tobytes() for route in where.routes}) == len(where.routes)
    assert not steps & {(after, before) for before, after in steps}
    assert not where.road[0, 0]


def test_turns_of_the_hard_junction():
    """Right and away, and left and then right, from the first entry."""
    where = roads("hard", 18)
    right = [(row, 4) for row in range(5)] + [(4, column) for column in (3, 2, 1, 0)]
    left_right = [(row, 4) for row in range(6)] + [(5, column) for column in range(5, 13)]
    left_right += [(row, 12) for row in range(6, 18)]
    assert [tuple(cell) for cell in where.routes[3].tolist()] == right
    assert [tuple(cell) for cell in where.routes[5].tolist()] == left_right


@pytest.mark.parametrize("size", [4, 6, 10, 38])
def test_easy_roads_upsampled_by_two_are_mediums(size):
    large = np.kron(roads("easy", size).road, np.ones((2, 2), bool))
    np.testing.assert_array_equal(large, roads("medium", 2 * size + 2).road)


@each_grid
def test_places_list_every_route_with_its_end(difficulty, size):
    where = roads(difficulty, size)
    assert where.nowhere == sum(len(route) + 1 for route in where.routes)
    for number, route in enumerate(where.routes):
        of_route = where.route == number
        np.testing.assert_array_equal(where.cell[of_route][:-1], route)
        assert where.ended[of_route].tolist() == [False] * len(route) + [True]
        assert where.position[of_route].tolist() == list(range(len(route) + 1))
        entry, choice = divmod(number, where.routes_per_entry)
        assert where.first_places[entry, choice] == np.flatnonzero(of_route)[0]
    assert where.ended[where.nowhere]


@pytest.mark.parametrize(("difficulty", "size", "count"), [("easy", 6, 15), ("medium", 14, 109)])
def test_places_with_the_same_way_ahead_share_a_state(difficulty, size, count):
    where = roads(difficulty, size)
    dense = where.states.dense()
    assert len(dense) == count == len(np.unique(dense, axis=0))
    assert not dense[where.state_row[where.ended]].any()


@pytest.mark.parametrize("vision", [0, 1, 3])
def test_lines_tell_roads_in_a_window(vision):
    where = roads("hard", 9)
    around = np.pad(where.road, vision)
    side = 2 * vision + 1
    for place in np.flatnonzero(~where.ended):
        row, column = where.cell[place]
        rows, columns = where.lines(vision)[place]
        expected = around[row : row + side, column : column + side]
        np.testing.assert_array_equal(rows[:, None] * columns > 1, expected)
    assert not where.lines(vision)[where.ended].any()


@each_grid
def test_a_car_gives_way_before_each_crossing_of_its_route(difficulty, size):
    where = roads(difficulty, size)
    for route, cells in enumerate(where.routes):
        on = [where.layout.is_crossing((int(row), int(column))) for row, column in cells]
        before = [not here and ahead for here, ahead in pairwise(on)]
        found = where.gives_way[where.route == route]
        assert found.tolist() == [*before, False, False]  # the last cell, and the end
    assert not where.gives_way[where.nowhere]
