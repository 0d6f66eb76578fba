"""What a run keeps as it goes: rows of evaluations.csv, and each stage's result in stages.json."""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sumajax import reporting
from sumajax.environments.types import Environment, figure_names
from sumajax.evaluation import evaluate, evaluate_random, shortest_path_steps
from sumajax.keys import key_of
from sumajax.policies import Policy
from sumajax.reporting.metrics import evaluation_summary

EVALUATION_SEED = 7
"""Of the policy's own randomness in held-out episodes; the starts are fixed in the package."""

MODES = ("sampled", "greedy")
"""How a policy's choices are taken: drawn, or each the likeliest."""

COLUMNS = ("arm", "seed", "epoch", "env_steps", "steps_taken", "success", "return")
"""Of evaluations.csv: sampled actions on the held-out starts while a stage trains."""


# --- Held-out episodes -------------------------------------------------------------------------


def held_out(
    env: Environment, policy: Policy, params: Sequence[Any], episodes: int, mode: str
) -> dict[str, Any]:
    """Means over the held-out starts, one per entry of `params` (the EVAL of summary.json)."""
    key = key_of(EVALUATION_SEED)
    results = [
        evaluate(env, policy, one, key, episodes=episodes, greedy=mode == "greedy")
        for one in params
    ]
    own = [result.figures(env) for result in results]
    return evaluation_summary(
        episodes,
        *(
            [float(getattr(result, name).mean()) for result in results]
            for name in ("steps_taken", "success", "episode_return")
        ),
        **{name: [of_seed[name] for of_seed in own] for name in figure_names(env)},
    )


def by_seed(params: Any) -> list[Any]:
    """Parameters with a leading axis of seeds, one by one."""
    num_seeds = jax.tree.leaves(params)[0].shape[0]
    return [
        jax.tree.map(lambda x, place=place: np.asarray(x[place]), params)
        for place in range(num_seeds)
    ]


def references(env: Environment, policy: Policy, episodes: int) -> dict[str, Any]:
    """A random team, and the shortest paths, on the held-out starts of a task."""
    random = evaluate_random(env, policy, key_of(EVALUATION_SEED), episodes=episodes)
    bound = shortest_path_steps(env, episodes)
    return {
        "random_steps_taken": float(random.steps_taken.mean()),
        "random_success": float(random.success.mean()),
        "shortest_path_steps": None if bound is None else float(bound.mean()),
    }


# --- evaluations.csv ---------------------------------------------------------------------------


def append_evaluation(
    file: Path,
    arm: str,
    seeds: Sequence[int],
    epoch: int,
    env_steps: np.ndarray,
    evaluation: dict[str, Any],
) -> None:
    """A row per seed; the file is replaced in one rename."""
    rows = _read(file)
    for index, seed in enumerate(seeds):
        figures = [evaluation[name][index] for name in COLUMNS[4:]]
        rows.append([arm, seed, epoch, int(env_steps[index]), *figures])
    _write(file, rows)


def truncate_evaluations(file: Path, arm: str, epoch: int) -> None:
    """Cuts an arm back to `epoch`, as `truncate_after` does with metrics.csv."""
    rows = _read(file)
    kept = [row for row in rows if row[0] != arm or int(row[2]) <= epoch]
    if len(kept) < len(rows):
        _write(file, kept)


def _read(file: Path) -> list[list[Any]]:
    return list(csv.reader(file.read_text().splitlines()))[1:] if file.exists() else []


def _write(file: Path, rows: list[list[Any]]) -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([COLUMNS, *rows])
    reporting.write_text(file, text.getvalue())


# --- stages.json -------------------------------------------------------------------------------


class StageRecords:
    """What is known of each stage, by its name, kept on disk: a resumed run asks nothing twice."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._records: dict[str, dict[str, Any]] = (
            json.loads(file.read_text()) if file.exists() else {}
        )

    def __getitem__(self, stage: str) -> dict[str, Any]:
        """Its `zero_shot` and `untrained` once it has begun, and `result` once it has ended."""
        return self._records.get(stage, {})

    def update(self, stage: str, **known: Any) -> None:
        """Adds what is now known, in one rename."""
        self._records.setdefault(stage, {}).update(known)
        reporting.write_json(self._file, self._records)
