"""`sumajax evaluate RUN`: trained policies on any task that fits them.

sumajax evaluate runs/pp_transfer-ic3net-fast
sumajax evaluate runs/pp_transfer-ic3net-fast --sizes 5 10 --teams 3 5 8
sumajax evaluate runs/pcp_transfer-hetnet-fast --teams 3+2 --json all.json
sumajax evaluate runs/mine/checkpoints/transfer --modes greedy --replay best.gif
sumajax evaluate pp-10x10-ic3net --replay r.gif
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from sumajax import checkpoint, reporting, store
from sumajax.checkpoint import CheckpointError
from sumajax.cli.domains import (
    DOMAINS,
    domain_of,
    grid_label,
    parse_size,
    parse_team,
    team_label,
    with_size,
)
from sumajax.cli.options import keep_compiled, parse, plain_errors
from sumajax.environments.types import Environment
from sumajax.environments.wrapper import rewrapped, unwrapped
from sumajax.evaluation import EPISODES, Agent, load_agent, shortest_path_steps
from sumajax.experiment.records import EVALUATION_SEED, held_out
from sumajax.experiment.summary import figure_text
from sumajax.keys import key_of
from sumajax.learning import parallel
from sumajax.policies import Policy
from sumajax.reporting.metrics import EVAL
from sumajax.sources import source_of, stage_directories
from sumajax.upsampling import StateUpsampled

Mode = Literal["sampled", "greedy"]
MAX_EPISODES = 65_536


@dataclass(frozen=True)
class EvaluateConfig:
    """Plays trained policies on held-out starts: every policy on every grid with every team."""

    path: tyro.conf.Positional[Path]
    """Directory of a run (all its policies), of one of its checkpoints/<arm>, or one checkpoint; or
    the name of a trained policy of the package, as pp-10x10-ic3net."""
    sizes: tuple[str, ...] = ()
    """Grids, as 10 or 10x20, that divide the policy's own; those it was trained on if not given."""
    teams: tuple[str, ...] = ()
    """Numbers of predators, or of predators+capture agents as 3+2; each grid's own if not given."""
    arms: tuple[str, ...] = ()
    """Stages of the run, as transfer or scratch; all if not given."""
    seeds: tuple[int, ...] = ()
    """Seeds of the run; all if not given."""
    modes: tuple[Mode, ...] = ("sampled", "greedy")
    """Sampled actions, or every choice the likeliest."""
    episodes: int = EPISODES
    """How many of the held-out starts to play."""
    max_steps: int | None = None
    """Step limit; the trained task's of that grid, or of the largest, if not given."""
    json: Path | None = None
    """Write all figures to this file."""
    replay: Path | None = None
    """Write an episode of the first policy and seed on the last task: .gif, or .png for a strip."""


@dataclass(frozen=True)
class Trained:
    """A policy as its checkpoint describes it, with the parameters of the asked seeds."""

    name: str
    meta: dict[str, Any]
    task: Any  # as trained on, before any upsampling
    grid: tuple[int, int]  # at which it sees the state
    seeds: tuple[int, ...]
    agents: tuple[Agent, ...]  # by seed

    def on(self, task: Any) -> tuple[Environment, Policy]:
        """The task as this policy sees it, and the policy for that team.

        Raises:
          ValueError: when it does not fit; names both values.
        """
        try:
            env: Any = rewrapped(self.agents[0].env, task)
            if env is task and task.shape != self.grid:
                env = StateUpsampled(task, self.grid)
        except ValueError:
            mine, theirs = grid_label(self.grid), grid_label(task.shape)
            raise ValueError(
                f"policy {self.name} sees a {mine} grid, and {theirs} does not divide it; choose "
                "--sizes that do."
            ) from None
        policy = self.agents[0].policy.shaped_for(env)
        checkpoint.check_compatible(self.meta, env, policy, f"policy {self.name}")
        return env, policy


def load(config: EvaluateConfig) -> list[Trained]:
    """The policies to evaluate, the run's last stage first.

    Raises:
      CheckpointError: when there is none, or one is damaged or lacks a seed; ValueError: for an arm
        the run does not have.
    """
    if not config.path.is_dir() and not store.is_named(config.path):
        raise CheckpointError(
            f"{config.path} is no directory of a run or of checkpoints, nor the name of a trained "
            f"policy of the package; it has {', '.join(store.names())}."
        )
    found = stage_directories(config.path)
    if not found:
        if config.arms:
            raise ValueError(
                f"{config.path} is one policy; --arms is for a whole run with checkpoints/<stage>."
            )
        return [_trained(config.path, None, config.seeds)]
    for arm in config.arms:
        if arm not in found:
            raise ValueError(f"{config.path} has no arm {arm!r}; it has {', '.join(found)}.")
    return [
        _trained(found[arm], arm, config.seeds) for arm in found if arm in (config.arms or found)
    ]


def _trained(place: Path, arm: str | None, seeds: tuple[int, ...]) -> Trained:
    source = source_of(place)
    meta = source.meta
    saved = tuple(meta.get("seeds", (0,)))
    for seed in seeds:
        if seed not in saved:
            raise CheckpointError(f"{source.name} holds seeds {list(saved)}, not {seed}.")
    seeds = seeds or saved
    agents = tuple(load_agent(place, seed=seed) for seed in seeds)
    env: Any = agents[0].env
    task: Any = unwrapped(env)
    name = arm or (place.name if store.is_named(place) else str(meta.get("arm", place.name)))
    return Trained(name, meta, task, env.state_shape[1:], seeds, agents)


def tasks_of(config: EvaluateConfig, trained: Sequence[Trained]) -> list[Any]:
    """Every asked grid with every asked team, each once; those of the policies if not given.

    Raises:
      ValueError: for what is no size or team, or a task that cannot be.
    """
    known = sorted({policy.task for policy in trained}, key=lambda task: task.shape)
    sizes = [parse_size(size) for size in config.sizes] or [task.shape for task in known]
    tasks: list[Any] = []
    for size in dict.fromkeys(sizes):
        like = next((task for task in known if task.shape == size), known[-1])
        for team in _teams(config.teams, like):
            tasks.append(with_size(like, size, team, config.max_steps))
    return list(dict.fromkeys(tasks))


def _teams(teams: Sequence[str], like: Any) -> Iterator[dict[str, int]]:
    """What to change in `like` for each team."""
    if not teams:
        yield {}
    for team in teams:
        yield parse_team(team, domain_of(like))


def play(policy: Trained, task: Any, mode: Mode, episodes: int) -> dict[str, Any]:
    """Means over the held-out starts, one per seed (the EVAL of summary.json)."""
    env, shaped = policy.on(task)
    return held_out(env, shaped, [agent.params for agent in policy.agents], episodes, mode)


def run_evaluation(config: EvaluateConfig) -> dict[str, Any]:
    """Evaluates, prints the table, writes the files asked for and returns what --json holds.

    Raises:
      ValueError, OSError: one sentence each, all that can be known before any episode is played.
    """
    _check(config)
    trained = load(config)
    tasks = tasks_of(config, trained)
    for policy in trained:
        for task in tasks:
            policy.on(task)
    report = {
        "path": str(config.path),
        "policies": {
            policy.name: {
                "trained_on": label(policy.task),
                "policy": policy.meta["policy"]["name"],
                "epoch": policy.meta.get("epoch"),
                "seeds": list(policy.seeds),
            }
            for policy in trained
        },
        "tasks": [_play_all(config, trained, task) for task in tasks],
    }
    if config.json is not None:
        _check_new("json", config.json)
        reporting.write_json(config.json, report)
    reporting.print_table(table(report), title=f"steps taken and success: {config.path}")
    if config.replay is not None:
        _check_new("replay", config.replay)
        _write_replay(config, trained[0], tasks[-1])
    return report


def _check(config: EvaluateConfig) -> None:
    if not 1 <= config.episodes <= MAX_EPISODES:
        raise ValueError(f"episodes must be 1 to {MAX_EPISODES}, got {config.episodes}.")
    if not config.modes:
        raise ValueError("modes must name sampled, greedy or both.")
    for option, path in (("json", config.json), ("replay", config.replay)):
        _check_new(option, path)


def _play_all(config: EvaluateConfig, trained: Sequence[Trained], task: Any) -> dict[str, Any]:
    """Every policy on one task, beside the bound of shortest paths."""
    bound = shortest_path_steps(task, config.episodes)
    entry: dict[str, Any] = {
        "task": checkpoint.describe(task, trained[0].agents[0].policy)["task"],
        "label": label(task),
        "shortest_path_steps": None if bound is None else float(np.mean(bound)),
        "policies": {},
    }
    for policy in trained:
        print(f"{label(task)}: {policy.name}", file=sys.stderr, flush=True)
        entry["policies"][policy.name] = {
            mode: play(policy, task, mode, config.episodes) for mode in config.modes
        }
    return entry


def table(report: dict[str, Any]) -> list[dict[str, Any]]:
    """A row per task and mode, a column per policy: means over the seeds."""
    rows = []
    for entry in report["tasks"]:
        modes = next(iter(entry["policies"].values()))
        for mode in modes:
            row: dict[str, Any] = {"grid, team": entry["label"], "actions": mode}
            for name, of_mode in entry["policies"].items():
                steps, success = (np.mean(of_mode[mode][k]) for k in ("steps_taken", "success"))
                row[name] = f"{steps:.2f} {success:6.1%}"
            bound = entry["shortest_path_steps"]
            rows.append(row | {"bound": None if bound is None else f"{bound:.2f}"})
            rows += [_figure_row(entry, mode, name) for name in modes[mode] if name not in EVAL]
    return rows


def _figure_row(entry: dict[str, Any], mode: str, figure: str) -> dict[str, Any]:
    """A figure of the domain's own."""
    values = {name: figure_text(of[mode][figure]) for name, of in entry["policies"].items()}
    words = f"{mode}, {figure.replace('_', ' ')}"
    return {"grid, team": entry["label"], "actions": words, **values, "bound": None}


def label(task: Any) -> str:
    """A task in a few characters: grid and team."""
    known = any(type(task) is domain.task for domain in DOMAINS.values())
    return f"{grid_label(task.shape)}, {team_label(task) if known else task.num_agents}"


def _check_new(option: str, path: Path | None) -> None:
    if path is None:
        return
    if path.exists():
        raise ValueError(f"{path} exists; choose another --{option}, nothing is overwritten.")
    if not path.parent.is_dir():
        raise ValueError(f"{path.parent} is no directory; make it or choose another --{option}.")
    if option == "replay" and path.suffix not in (".gif", ".png"):
        raise ValueError(f"replay {path.name} must end in .gif, or .png for a strip of moments.")


def _write_replay(config: EvaluateConfig, trained: Trained, task: Any) -> None:
    env, policy = trained.on(task)
    episode = reporting.record_episode(
        env,
        policy,
        trained.agents[0].params,
        key_of(EVALUATION_SEED),
        greedy="sampled" not in config.modes,
    )
    assert config.replay is not None
    write = reporting.write_gif if config.replay.suffix == ".gif" else reporting.write_strip
    write(episode, config.replay)


def main(arguments: list[str] | None = None) -> None:
    """Reads the options and evaluates; without `arguments` those of the program."""
    with plain_errors("stopped; no file was written."):
        prog = None if arguments is None else "sumajax evaluate"
        config = parse(EvaluateConfig, EvaluateConfig(path=tyro.MISSING), arguments, prog=prog)
        keep_compiled()
        parallel.choose_devices(1, 1, 1)
        run_evaluation(config)
