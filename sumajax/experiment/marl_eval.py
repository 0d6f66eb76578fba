"""Results of finished runs in the JSON form that marl-eval reads, written without that library.

    {environment: {task: {algorithm: {"seed_0": {
        "step_0": {"step_count": 0, "elapsed_time": 0.0, "success": [0.7], ...},
        ...,
        "absolute_metrics": {"success": [1.0], ...}}}}}}

The form is that of Gorsane et al. 2022, "Towards a Standardised Performance Evaluation Protocol for
Cooperative MARL". Every step is one evaluation over the run's held-out starts, sampled actions, and
a metric's list holds its mean over them: a run keeps no episodes one by one.
"""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sumajax.description import CheckpointError, rebuild_task
from sumajax.environments.types import Environment
from sumajax.environments.wrapper import unwrapped
from sumajax.reporting.metrics import read_metrics

METRICS = ("steps_taken", "success", "return")

Steps = list[dict[str, Any]]
"""Evaluations of one seed in a stage, in order: step_count, elapsed_time, and the metrics."""


def marl_eval(runs: Sequence[Path]) -> dict[str, Any]:
    """All stages of all runs, as marl-eval's JSON.

    An algorithm is a policy and a stage, as `ic3net, transfer`; a step's count and time are those
    of the stage's own training, what came before it not counted.

    Raises:
      ValueError: for a directory that is no finished run, or a seed that two runs both have.
    """
    found: dict[str, Any] = {}
    for run in runs:
        plan, records = _read(run, "config.json")["experiment"], _read(run, "stages.json")
        for stage in plan["stages"]:
            environment, task = _task(stage)
            algorithm = f"{plan['policy']['name']}, {stage['name']}"
            of_algorithm = (
                found.setdefault(environment, {}).setdefault(task, {}).setdefault(algorithm, {})
            )
            for place, seed in enumerate(plan["seeds"]):
                if f"seed_{seed}" in of_algorithm:
                    raise ValueError(
                        f"{run} has seed {seed} of {algorithm} on {task}, which a run before it "
                        "has too; give runs of different seeds, policies or tasks."
                    )
                steps = _steps(run, stage["name"], records[stage["name"]], seed, place)
                of_algorithm[f"seed_{seed}"] = _numbered(steps)
    return found


def _read(run: Path, name: str) -> Any:
    try:
        if not (run / "summary.json").exists():
            raise ValueError(f"{run} is no finished run; its summary.json is not there.")
        return json.loads((run / name).read_text())
    except OSError as error:
        raise ValueError(f"{run / name} cannot be read ({error.strerror}).") from None


def _task(stage: dict[str, Any]) -> tuple[str, str]:
    """Names of a stage's environment and task: its class, and its grid, team and how it is seen."""
    described = stage["task"]
    try:
        env = rebuild_task({"task": described})
    except CheckpointError:  # a domain that the package does not know
        return described["class"].rpartition(".")[-1], stage["name"]
    task: Any = unwrapped(env)
    own, seen = _grid(task), _grid(env)
    name = f"{own}, {task.num_agents} agents" + ("" if own == seen else f", seen at {seen}")
    return type(task).__name__, name


def _grid(env: Environment) -> str:
    return "x".join(map(str, env.state_shape[-2:]))


def _steps(run: Path, arm: str, record: dict[str, Any], seed: int, place: int) -> Steps:
    """Zero shot, the evaluations on the way, and the one at the end."""
    seconds = {
        row["epoch"]: row["seconds"]
        for row in read_metrics(run / "metrics.csv")
        if (row["arm"], row["seed"]) == (arm, seed)
    }
    steps: Steps = []
    if record.get("zero_shot"):
        steps.append(_step(0, 0.0, _of_seed(record["zero_shot"]["sampled"], place)))
    for row in _rows(run / "evaluations.csv"):
        if (row["arm"], int(row["seed"])) == (arm, seed):
            values = {name: float(row[name]) for name in METRICS}
            steps.append(_step(int(row["env_steps"]), seconds[int(row["epoch"])], values))
    result = record["result"]
    if not steps or steps[-1]["step_count"] < result["env_steps"]:
        last = _of_seed(result["evaluation"]["sampled"], place)
        steps.append(_step(result["env_steps"], max(seconds.values()), last))
    return steps


def _rows(file: Path) -> list[dict[str, str]]:
    """None where nothing was evaluated on the way."""
    return list(csv.DictReader(file.read_text().splitlines())) if file.exists() else []


def _of_seed(evaluation: dict[str, Any], place: int) -> dict[str, float]:
    return {name: evaluation[name][place] for name in METRICS}


def _step(count: int, seconds: float, values: dict[str, float]) -> dict[str, Any]:
    lists = {name: [value] for name, value in values.items()}
    return {"step_count": count, "elapsed_time": seconds, **lists}


def _numbered(steps: Steps) -> dict[str, Any]:
    """By number; the last evaluation is the one to compare policies by."""
    absolute = {name: steps[-1][name] for name in METRICS}
    return {f"step_{i}": step for i, step in enumerate(steps)} | {"absolute_metrics": absolute}
