"""summary.json and the closing table of a run, from its plan and the records of its stages."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sumajax.environments.types import Environment, figure_names, merit_of
from sumajax.environments.wrapper import unwrapped
from sumajax.experiment.plan import Experiment, Stage, described
from sumajax.experiment.records import MODES, StageRecords
from sumajax.reporting import metrics as metrics_file

MOST_NAMED = 3
"""Parameters that a line names; more are counted, and stages.json has them all."""


def summarise(
    experiment: Experiment,
    stages: StageRecords,
    references: Mapping[str, Mapping[str, Any]],
    rows: Iterable[Mapping[str, Any]],
) -> dict[str, Any]:
    """What summary.json holds.

    `source` is the first stage of the chain, `transfer` the target, `scratch` the stage that learns
    the target from fresh parameters; each is null where there is none. Chains of more than two
    stages have `stages` and `cost` beside them.

    Args:
      references: a random team and the shortest paths, by stage.
      rows: of metrics.csv.
    """
    chain, target, scratch = experiment.chain, experiment.target, experiment.scratch
    begins = chain[0] if chain[0].start is None else None
    transferred = target if target.start is not None else None
    roles = {"source": begins, "transfer": transferred, "scratch": scratch}
    zero_shot = stages[target.name].get("zero_shot") or {}
    stops = {
        stage.name: stages[stage.name]["stops"]
        for stage in experiment.stages
        if stages[stage.name]["stops"]
    }
    return {
        "experiment": experiment.name,
        "policy": experiment.policy_name,
        "preset": experiment.preset,
        "seeds": list(experiment.seeds),
        **{role: stage and stages[stage.name]["result"] for role, stage in roles.items()},
        "zero_shot": zero_shot.get("sampled"),
        "comparison": metrics_file.comparison(
            rows,
            experiment.threshold,
            {role: stage.name for role, stage in roles.items() if stage and role != "source"},
            merit_of(target.env),
        ),
        "zero_shot_greedy": zero_shot.get("greedy"),
        "references": references,
        "untrained_in_source": stages[target.name].get("untrained", []),
        **(_of_chain(experiment, stages) if len(chain) > 2 else {}),
        **({"stops": stops} if stops else {}),
    }


def _of_chain(experiment: Experiment, stages: StageRecords) -> dict[str, Any]:
    """`stages` in order, the last the target, and `cost`, of all seeds: per stage and in all."""
    tasks = {stage["name"]: stage["task"] for stage in described(experiment)["stages"]}
    entries = [
        {
            "name": stage.name,
            "task": tasks[stage.name],
            "zero_shot": (stages[stage.name].get("zero_shot") or {}).get("sampled"),
            "zero_shot_greedy": (stages[stage.name].get("zero_shot") or {}).get("greedy"),
            **stages[stage.name]["result"],
            "cost": stages[stage.name]["cost"],
        }
        for stage in experiment.chain
    ]
    names = ("env_steps", "cpu_seconds")
    cost: dict[str, Any] = {name: [entry["cost"][name] for entry in entries] for name in names}
    cost["total"] = {name: sum(cost[name]) for name in names}
    if experiment.scratch is not None:
        cost["scratch"] = stages[experiment.scratch.name]["cost"]
    return {"stages": entries, "cost": cost}


def stage_labels(experiment: Experiment) -> dict[str, str]:
    """What each stage is called in a picture: its task and where it starts."""
    labels = {}
    for stage in experiment.stages:
        start = stage.start if isinstance(stage.start, str) else "checkpoint"
        how = "from scratch" if stage.start is None else f"after {start}"
        labels[stage.name] = f"{stage.name}: {grid_label(stage.env)}, {how}"
    return labels


def grid_label(env: Environment) -> str:
    """The task's own grid, as 10x10."""
    return "x".join(map(str, unwrapped(env).state_shape[-2:]))


def untrained_line(names: Sequence[str]) -> str:
    """One sentence about the parameters that the stage before left as they were first drawn."""
    named, more = ", ".join(names[:MOST_NAMED]), len(names) - MOST_NAMED
    others = f" and {more} more (stages.json)" if more > 0 else ""
    return f"the team before had no use for, so as random as they began: {named}{others}."


def table(experiment: Experiment, summary: Mapping[str, Any], records: StageRecords) -> list[Any]:
    """The closing table: a row per stage and reference: steps taken and success, over the seeds."""
    rows = []
    for stage in experiment.stages:
        record = records[stage.name]
        if record.get("zero_shot"):
            rows.append(_row("zero shot", stage, record["zero_shot"]))
        stops = [f"seed {stop['seed']} stopped" for stop in record["stops"]]
        name = f"{stage.name} ({', '.join(stops)})" if stops else stage.name
        rows.append(_row(name, stage, record["result"]["evaluation"], record["result"]))
    tasks = {stage.env: stage for stage in reversed(experiment.stages)}
    for stage in sorted(tasks.values(), key=experiment.stages.index):
        reference = summary["references"][stage.name]
        random = {
            "steps_taken": reference["random_steps_taken"],
            "success": reference["random_success"],
        }
        rows.append(_row("random", stage, {"sampled": random}))
        if reference["shortest_path_steps"] is not None:
            bound = {"steps_taken": reference["shortest_path_steps"], "success": 1.0}
            rows.append(_row("shortest", stage, {"greedy": bound}))
    return rows


def _row(
    name: str,
    stage: Stage,
    evaluation: Mapping[str, Any],
    result: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    sampled, greedy = (evaluation.get(mode, {}) for mode in MODES)
    steps = np.atleast_1d(sampled.get("steps_taken", []))
    cost = f"{result['env_steps'] / 1e6:.1f} M, {result['train_seconds']:.0f} s" if result else None
    return {
        "policy": f"{name} {grid_label(stage.env)}",
        "sampled": _steps(sampled),
        "seeds": f"{steps.min():.1f}-{steps.max():.1f}" if steps.size > 1 else None,
        "greedy": _steps(greedy),
        "cost": cost,
        **{
            name.replace("_", " "): figure_text(sampled[name]) if name in sampled else None
            for name in figure_names(stage.env)
        },
    }


def figure_text(values: Any) -> str:
    """Mean of a domain's own figure over the seeds."""
    return f"{np.mean(values):.3f}"


def _steps(evaluation: Mapping[str, Any]) -> str | None:
    """Mean steps taken and success over the seeds."""
    if not evaluation:
        return None
    return f"{np.mean(evaluation['steps_taken']):.2f} {np.mean(evaluation['success']):6.1%}"
