"""Trained policies on any task that fits them: other grids, other teams, sampled and greedy.

python experiments/evaluate.py runs/pp_transfer-ic3net-fast
python experiments/evaluate.py runs/pp_transfer-ic3net-fast --sizes 5 10 --teams 3 5 8
python experiments/evaluate.py runs/pcp_transfer-hetnet-fast --teams 3+2 --json all.json
python experiments/evaluate.py runs/mine/checkpoints/transfer --modes greedy --replay best.gif
"""

import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import tyro

from sumajax import checkpoint, reporting
from sumajax.checkpoint import CheckpointError
from sumajax.cli.command_line import parse, plain_errors, prepare_jax
from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.environments.types import Environment
from sumajax.evaluation import (
    ARMS,
    EPISODES,
    Agent,
    evaluate,
    load_agent,
    shortest_path_steps,
)
from sumajax.policies import Policy
from sumajax.reporting.metrics import evaluation_summary
from sumajax.upsampling import StateUpsampled

Mode = Literal["sampled", "greedy"]
EVALUATION_SEED = 7
"""Of the policy's own randomness; the starts are fixed in the package."""
MAX_EPISODES = 65_536


@dataclass(frozen=True)
class EvaluateConfig:
    """Plays trained policies on held-out starts: every policy on every grid with every team."""

    path: tyro.conf.Positional[Path]
    """Directory of a run (all its policies), of one of its checkpoints/<arm>, or one checkpoint."""
    sizes: tuple[str, ...] = ()
    """Grids, as 10 or 10x20, that divide the policy's own; those it was trained on if not given."""
    teams: tuple[str, ...] = ()
    """Numbers of predators, or of predators+capture agents as 3+2; each grid's own if not given."""
    arms: tuple[str, ...] = ()
    """Policies of the run: source, transfer, scratch; all if not given."""
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
    task: PredatorCapturePrey  # as trained on, before any upsampling
    grid: tuple[int, int]  # at which it sees the state
    scale: str
    seeds: tuple[int, ...]
    agents: tuple[Agent, ...]  # by seed

    def on(self, task: PredatorCapturePrey) -> tuple[Environment, Policy]:
        """The task as this policy sees it, and the policy for that team.

        Raises:
          ValueError: when it does not fit; names both values.
        """
        try:
            env: Any = task
            if task.shape != self.grid:
                env = StateUpsampled(task, self.grid, self.scale)  # type: ignore[arg-type]
        except ValueError:
            raise ValueError(
                f"policy {self.name} sees a {_grid(self.grid)} grid, and {_grid(task.shape)} does "
                "not divide it; choose --sizes that do."
            ) from None
        policy = self.agents[0].policy
        described = checkpoint.describe(env, policy)["task"]
        env, policy = checkpoint.rebuild({**self.meta, "task": described})
        checkpoint.check_compatible(self.meta, env, policy, f"policy {self.name}")
        return env, policy


def load(config: EvaluateConfig) -> list[Trained]:
    """The policies to evaluate, in the order transfer, scratch, source.

    Raises:
      CheckpointError: when there is none, or one is damaged or lacks a seed; ValueError: for an arm
        the run does not have.
    """
    if not config.path.is_dir():
        raise CheckpointError(f"{config.path} is no directory of a run or of checkpoints.")
    folder = config.path / "checkpoints"
    found = {arm: folder / arm for arm in ARMS if (folder / arm).is_dir()}
    if not found:
        if config.arms:
            raise ValueError(
                f"{config.path} is one policy; --arms is for a whole run with checkpoints/<arm>."
            )
        return [_trained(config.path, None, config.seeds)]
    for arm in config.arms:
        if arm not in found:
            raise ValueError(f"{config.path} has no arm {arm!r}; it has {', '.join(found)}.")
    return [
        _trained(found[arm], arm, config.seeds) for arm in found if arm in (config.arms or ARMS)
    ]


def _trained(directory: Path, arm: str | None, seeds: tuple[int, ...]) -> Trained:
    meta = checkpoint.read_meta(directory)
    saved = tuple(meta.get("seeds", (0,)))
    for seed in seeds:
        if seed not in saved:
            raise CheckpointError(f"{directory} holds seeds {list(saved)}, not {seed}.")
    seeds = seeds or saved
    agents = tuple(load_agent(directory, seed=saved.index(seed)) for seed in seeds)
    env: Any = agents[0].env
    task = getattr(env, "env", env)
    if not isinstance(task, PredatorCapturePrey):
        raise CheckpointError(
            f"{directory} is of a policy for {type(task).__name__}; this program knows "
            "Predator-Prey and Predator-Capture-Prey."
        )
    name = arm or str(meta.get("arm", directory.name))
    scale = getattr(env, "scale", "none")
    return Trained(name, meta, task, env.state_shape[1:], scale, seeds, agents)


def tasks_of(config: EvaluateConfig, trained: Sequence[Trained]) -> list[PredatorCapturePrey]:
    """Every asked grid with every asked team, each once; those of the policies if not given.

    Raises:
      ValueError: for what is no size or team, or a task that cannot be.
    """
    known = sorted({policy.task for policy in trained}, key=lambda task: task.shape)
    sizes = [_parse_size(size) for size in config.sizes] or [task.shape for task in known]
    tasks: list[PredatorCapturePrey] = []
    for size in dict.fromkeys(sizes):
        like = next((task for task in known if task.shape == size), known[-1])
        limit = like.max_steps if config.max_steps is None else config.max_steps
        for changes in _teams(config.teams, like):
            plain = size[0] if size[0] == size[1] else size
            tasks.append(replace(like, size=plain, max_steps=limit, **changes))
    return list(dict.fromkeys(tasks))


def _teams(teams: Sequence[str], like: PredatorCapturePrey) -> Iterator[dict[str, Any]]:
    """What to change in `like` for each team."""
    if not teams:
        yield {}
    for team in teams:
        if not re.fullmatch(r"\d{1,6}(\+\d{1,6})?", team):
            raise ValueError(f"team {team!r} is no number of predators, or two as 3+2.")
        predators, _, capturers = team.partition("+")
        if isinstance(like, PredatorPrey):
            if capturers:
                raise ValueError(
                    f"team {team} has capture agents, and Predator-Prey has none; "
                    f"give the number of predators, as {predators}."
                )
            yield {"num_predators": int(predators)}
        elif not capturers:
            raise ValueError(
                f"team {team} does not say how many capture agents; give both, as {team}+1."
            )
        else:
            yield {"num_predators": int(predators), "num_capturers": int(capturers)}


def _parse_size(text: str) -> tuple[int, int]:
    if not re.fullmatch(r"\d{1,6}(x\d{1,6})?", text):
        raise ValueError(f"size {text!r} is no side of a grid, or rows x columns as 10x20.")
    rows, _, columns = text.partition("x")
    return int(rows), int(columns or rows)


def play(policy: Trained, task: PredatorCapturePrey, mode: Mode, episodes: int) -> dict[str, Any]:
    """Means over the held-out starts, one per seed (the EVAL of summary.json)."""
    env, shaped = policy.on(task)
    means = []
    for agent in policy.agents:
        result = evaluate(
            env,
            shaped,
            agent.params,
            jax.random.key(EVALUATION_SEED),
            episodes=episodes,
            greedy=mode == "greedy",
        )
        means.append(jax.tree.map(lambda x: float(x.mean()), result))
    return evaluation_summary(
        episodes,
        [mean.steps_taken for mean in means],
        [mean.success for mean in means],
        [mean.episode_return for mean in means],
    )


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
    reporting.print_table(table(report), title=f"steps taken and success: {config.path}")
    if config.json is not None:
        _check_new("json", config.json)
        reporting.write_json(config.json, report)
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


def _play_all(
    config: EvaluateConfig, trained: Sequence[Trained], task: PredatorCapturePrey
) -> dict[str, Any]:
    """Every policy on one task, beside the bound of shortest paths."""
    bound: Any = shortest_path_steps(task, config.episodes)
    entry: dict[str, Any] = {
        "task": checkpoint.describe(task, trained[0].agents[0].policy)["task"],
        "label": label(task),
        "shortest_path_steps": float(np.mean(bound)),
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
            rows.append(row | {"bound": f"{entry['shortest_path_steps']:.2f}"})
    return rows


def label(task: PredatorCapturePrey) -> str:
    """A task in a few characters: grid and team."""
    team = str(task.num_predators)
    if not isinstance(task, PredatorPrey):
        team += f"+{task.num_capturers}"
    return f"{_grid(task.shape)}, {team}"


def _grid(shape: tuple[int, int]) -> str:
    return f"{shape[0]}x{shape[1]}"


def _check_new(option: str, path: Path | None) -> None:
    if path is None:
        return
    if path.exists():
        raise ValueError(f"{path} exists; choose another --{option}, nothing is overwritten.")
    if not path.parent.is_dir():
        raise ValueError(f"{path.parent} is no directory; make it or choose another --{option}.")
    if option == "replay" and path.suffix not in (".gif", ".png"):
        raise ValueError(f"replay {path.name} must end in .gif, or .png for a strip of moments.")


def _write_replay(config: EvaluateConfig, trained: Trained, task: PredatorCapturePrey) -> None:
    env, policy = trained.on(task)
    episode = reporting.record_episode(
        env,
        policy,
        trained.agents[0].params,
        jax.random.key(EVALUATION_SEED),
        greedy="sampled" not in config.modes,
    )
    assert config.replay is not None
    write = reporting.write_gif if config.replay.suffix == ".gif" else reporting.write_strip
    write(episode, config.replay)


def main() -> None:
    """Reads the options and evaluates."""
    with plain_errors("stopped; no file was written."):
        config = parse(EvaluateConfig, EvaluateConfig(path=tyro.MISSING))
        prepare_jax(1)
        run_evaluation(config)


if __name__ == "__main__":
    main()
