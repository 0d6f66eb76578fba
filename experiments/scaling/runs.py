"""A run of the study: trained, then played on its own tasks and on the others of its chain."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from experiments.paper.results import write_csv
from experiments.scaling.plans import Study, limits
from experiments.scaling.results import COLUMNS, PLAYED, rows_of_run, task_label
from experiments.studies import Row, StudyRun, read_csv
from sumajax import checkpoint
from sumajax.environments.types import Environment
from sumajax.environments.wrapper import unwrapped
from sumajax.evaluation import EPISODES, evaluate
from sumajax.experiment import Stage
from sumajax.experiment.records import EVALUATION_SEED, MODES, by_seed
from sumajax.keys import key_of
from sumajax.transfer import fresh_states

ZERO_SHOT, END, ELSEWHERE = "zero shot", "end", "elsewhere"
"""When a policy was played: before and after its stage, and after it on another task."""
ELSEWHERE_EPISODES = 256
"""On other tasks than its own, where a figure of two digits will do."""


def finish(found: StudyRun[Study], episodes: int = EPISODES) -> dict[str, list[Row]]:
    """Trains and plays what is still missing; the rows of all of it."""
    found.train()
    play(found, episodes)
    return rows_of_run(found)


# --- Held-out episodes at every limit -----------------------------------------------------------


def play(found: StudyRun[Study], episodes: int = EPISODES) -> None:
    """Every policy that a stage begins or ends with, on the held-out starts.

    A row is kept as soon as it is known, so an interrupted run plays nothing twice.
    """
    file = found.directory / PLAYED
    for stage, when, env, params in _policies(found):
        rows = read_csv(file)
        label = task_label(env)
        known = {(r["stage"], r["when"], r["task"], r["mode"]) for r in rows}
        modes: tuple[str, ...] = MODES[:1] if when == ELSEWHERE else MODES
        modes = tuple(m for m in modes if (stage.name, when, label, m) not in known)
        if not modes:
            continue
        count = min(episodes, ELSEWHERE_EPISODES) if when == ELSEWHERE else episodes
        rows += [
            {"stage": stage.name, "when": when, **row}
            for row in _played(found, env, params(), modes, count)
        ]
        write_csv(file, COLUMNS["held_out"], rows)
        steps = {r["mode"]: r["steps_taken"] for r in rows[-len(modes) :]}
        print(f"{found.study.name} {stage.name}, {when}, {label}: {steps}", flush=True)


def _policies(found: StudyRun[Study]) -> Iterator[tuple[Stage, str, Environment, Any]]:
    """(stage, when, task, its parameters when they are asked for)."""
    chain = found.experiment.chain
    for stage in found.experiment.stages:
        if stage.start is not None:
            yield stage, ZERO_SHOT, stage.env, partial(_first, found, stage)
        yield stage, END, stage.env, partial(_last, found, stage)
    if any(stage.resize for stage in chain):
        return
    for stage in chain:
        for other in chain:
            # What a stage brings to the next one is its zero shot.
            if other not in (stage, following(chain, stage)):
                yield stage, ELSEWHERE, other.env, partial(_last, found, stage)


def _first(found: StudyRun[Study], stage: Stage) -> Any:
    return found.run.first_states(stage).params


def _last(found: StudyRun[Study], stage: Stage) -> Any:
    like = jax.eval_shape(lambda: fresh_states(found.run.stage_run(stage))).params
    return checkpoint.load_params(found.run.checkpoints(stage), like)


def _played(
    found: StudyRun[Study], env: Environment, params: Any, modes: Sequence[str], episodes: int
) -> Iterator[Row]:
    """A row per seed, way of choosing actions and limit.

    An agent does not see how much time is left, so what a team does in a shorter limit is the
    beginning of what it does in a longer one: all limits are read off one set of episodes.
    """
    policy, key = found.experiment.policy_on(env), key_of(EVALUATION_SEED)
    for seed, one in zip(found.seeds, by_seed(params), strict=True):
        for mode in modes:
            played = evaluate(env, policy, one, key, episodes=episodes, greedy=mode == "greedy")
            steps, success = np.asarray(played.steps_taken), np.asarray(played.success)
            for limit in limits(unwrapped(env)):
                yield {
                    "experiment": found.study.name,
                    "seed": seed,
                    "task": task_label(env),
                    "mode": mode,
                    "limit": limit,
                    "episodes": episodes,
                    "steps_taken": float(np.minimum(steps, limit).mean()),
                    "success": float((success & (steps <= limit)).mean()),
                }


def following(chain: Sequence[Stage], stage: Stage) -> Stage | None:
    """The stage of a chain that comes after another."""
    place = chain.index(stage) + 1
    return chain[place] if place < len(chain) else None
