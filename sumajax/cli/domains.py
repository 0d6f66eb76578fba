"""The domains that the command line knows: a line each."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sumajax.environments import PredatorCapturePrey, PredatorPrey, TrafficJunction
from sumajax.environments.types import Environment

SMALL_SIDE, SMALL_LIMIT = 5, 80
LARGE_LIMIT, STEPS_PER_SIDE = 200, 10
"""Step limits of grids: the paper's 80 on 5x5 and 200 on 10x10 (section V); from 20x20 on ten steps
for each cell of a side, several times the way across."""


def grid_of(task: Any, shape: tuple[int, int]) -> Any:
    """The field `size` of a task on a grid of that shape."""
    return shape[0] if shape[0] == shape[1] else shape


def junction_of(task: TrafficJunction, shape: tuple[int, int]) -> int:
    """The same of a junction, whose `size` is the original's argument.

    Raises:
      ValueError: for unequal sides.
    """
    rows, columns = shape
    if rows != columns:
        raise ValueError(f"a junction has equal sides, got {grid_label(shape)}; give one number.")
    return rows - (task.shape[0] - task.size)


@dataclass(frozen=True)
class Domain:
    """How people name the tasks of a domain.

    Attributes:
      experiment: name of its transfer in the files.
      source, target: the tasks of the paper.
      team: fields of the task that are the team's sizes, in the order they are given in, as 3+2.
      members: what they are called.
      policy: what is trained if nothing is said.
      policy_settings: as the domain's publications have them, for the policies that know them.
      size_of: of a task and a shape, the field `size` that gives the task a grid of that shape.
    """

    experiment: str
    source: Any
    target: Any
    team: tuple[str, ...]
    members: str
    policy: str = "ic3net"
    policy_settings: tuple[tuple[str, Any], ...] = ()
    size_of: Callable[[Any, tuple[int, int]], Any] = grid_of

    @property
    def task(self) -> type:
        return type(self.target)


DOMAINS: dict[str, Domain] = {
    "pp": Domain(
        "pp_transfer",
        PredatorPrey(size=5, num_predators=3, vision=1, max_steps=80),
        PredatorPrey(size=10, num_predators=5, vision=1, max_steps=200),
        ("num_predators",),
        "predators",
    ),
    "pcp": Domain(
        "pcp_transfer",
        PredatorCapturePrey(size=5, num_predators=2, num_capturers=1, max_steps=80),
        PredatorCapturePrey(size=10, num_predators=3, num_capturers=2, max_steps=200),
        ("num_predators", "num_capturers"),
        "predators+capture agents",
        policy="hetnet",
    ),
    "tj": Domain(
        "tj_transfer",
        TrafficJunction("easy"),
        TrafficJunction("medium"),
        ("num_cars",),
        "cars",
        # The published program takes IC3Net's gates for open in this domain.
        policy_settings=(("talk_always", True),),
        size_of=junction_of,
    ),
}


def domain_of(task: Environment) -> Domain:
    """The domain of a task.

    Raises:
      ValueError: for a task of none of them.
    """
    for domain in DOMAINS.values():
        if type(task) is domain.task:
            return domain
    known = ", ".join(domain.task.__name__ for domain in DOMAINS.values())
    raise ValueError(
        f"{type(task).__name__} is no domain of this program, which knows {known}; its size and "
        "team can be changed in a program of your own."
    )


def parse_size(text: str) -> tuple[int, int]:
    """(rows, columns) of 10 or 10x20.

    Raises:
      ValueError: for anything else.
    """
    if not re.fullmatch(r"\d{1,6}(x\d{1,6})?", text):
        raise ValueError(f"size {text!r} is no side of a grid, or rows x columns as 10x20.")
    rows, _, columns = text.partition("x")
    return int(rows), int(columns or rows)


def parse_team(text: str, domain: Domain) -> dict[str, int]:
    """The task's fields for a team, as 5, or 3+2 where there are two classes.

    Raises:
      ValueError: for anything else.
    """
    sizes = text.split("+")
    if not all(re.fullmatch(r"\d{1,6}", size) for size in sizes):
        raise ValueError(f"team {text!r} is no number of agents, or two as 3+2.")
    if len(sizes) != len(domain.team):
        example = "+".join(["3", "2"][: len(domain.team)])
        raise ValueError(
            f"team {text} has {len(sizes)} numbers, and {domain.task.__name__} has "
            f"{domain.members}; give them as {example}."
        )
    return dict(zip(domain.team, map(int, sizes), strict=True))


def step_limit(size: tuple[int, int]) -> int:
    """What is allowed on a grid if nothing is said."""
    side = max(size)
    return SMALL_LIMIT if side <= SMALL_SIDE else max(LARGE_LIMIT, STEPS_PER_SIDE * side)


def with_size(
    task: Any, size: tuple[int, int], team: dict[str, int], max_steps: int | None = None
) -> Any:
    """A task like `task` on another grid with another team."""
    limit = task.max_steps if max_steps is None else max_steps
    return replace(task, size=domain_of(task).size_of(task, size), max_steps=limit, **team)


def team_label(task: Any) -> str:
    """The team's sizes, as 3+2."""
    return "+".join(str(getattr(task, name)) for name in domain_of(task).team)


def grid_label(shape: Sequence[int]) -> str:
    """Rows and columns, as 10x20."""
    return "x".join(map(str, shape))
