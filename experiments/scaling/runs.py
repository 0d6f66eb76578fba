"""Runs of the study: one directory for an experiment and its seeds, trained, then played."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.paper.results import write_csv
from experiments.scaling.plans import Study, limits
from experiments.scaling.results import COLUMNS, PLAYED, Row, read_csv, rows_of_run, task_label
from sumajax import checkpoint
from sumajax.environments.types import Environment
from sumajax.environments.wrapper import unwrapped
from sumajax.evaluation import EPISODES, evaluate
from sumajax.experiment import Experiment, Stage, run_experiment
from sumajax.experiment.records import EVALUATION_SEED, MODES, by_seed
from sumajax.experiment.run import Run, Where
from sumajax.keys import key_of
from sumajax.transfer import fresh_states

ZERO_SHOT, END, ELSEWHERE = "zero shot", "end", "elsewhere"
"""When a policy was played: before and after its stage, and after it on another task."""
ELSEWHERE_EPISODES = 256
"""On other tasks than its own, where a figure of two digits will do."""


@dataclass(frozen=True)
class StudyRun:
    """A study with seeds that are trained side by side, and its directory."""

    study: Study
    seeds: tuple[int, ...]
    directory: Path
    devices: int = 1

    @cached_property
    def experiment(self) -> Experiment:
        return self.study.experiment(self.seeds)

    @property
    def run(self) -> Run:
        return Run(self.experiment, self.directory, Where(devices=self.devices))

    @property
    def has_ended(self) -> bool:
        return (self.directory / "summary.json").exists()

    def finish(self, episodes: int = EPISODES) -> dict[str, list[Row]]:
        """Trains and plays what is still missing; the rows of all of it."""
        if not self.has_ended:
            run_experiment(self.experiment, self.directory, Where(devices=self.devices))
        self.play(episodes)
        return rows_of_run(self.study, self.experiment, self.directory)

    # --- Held-out episodes at every limit ------------------------------------------------------

    def play(self, episodes: int = EPISODES) -> None:
        """Every policy that a stage begins or ends with, on the held-out starts.

        A row is kept as soon as it is known, so an interrupted run plays nothing twice.
        """
        file = self.directory / PLAYED
        for stage, when, env, params in self._policies():
            rows = read_csv(file)
            label = task_label(env)
            known = {(r["stage"], r["when"], r["task"], r["mode"]) for r in rows}
            modes: tuple[str, ...] = MODES[:1] if when == ELSEWHERE else MODES
            modes = tuple(m for m in modes if (stage.name, when, label, m) not in known)
            if not modes:
                continue
            count = min(episodes, ELSEWHERE_EPISODES) if when == ELSEWHERE else episodes
            rows += self._played(stage, when, env, params(), modes, count)
            write_csv(file, COLUMNS["held_out"], rows)
            steps = {r["mode"]: r["steps_taken"] for r in rows[-len(modes) :]}
            print(f"{self.study.name} {stage.name}, {when}, {label}: {steps}", flush=True)

    def _policies(self) -> Iterator[tuple[Stage, str, Environment, Any]]:
        """(stage, when, task, its parameters when they are asked for)."""
        chain = self.experiment.chain
        for stage in self.experiment.stages:
            if stage.start is not None:
                yield stage, ZERO_SHOT, stage.env, partial(self._first, stage)
            yield stage, END, stage.env, partial(self._last, stage)
        if any(stage.resize for stage in chain):
            return
        for stage in chain:
            for other in chain:
                # What a stage brings to the next one is its zero shot.
                if other not in (stage, following(chain, stage)):
                    yield stage, ELSEWHERE, other.env, partial(self._last, stage)

    def _first(self, stage: Stage) -> Any:
        return self.run.first_states(stage).params

    def _last(self, stage: Stage) -> Any:
        like = jax.eval_shape(lambda: fresh_states(self.run.stage_run(stage))).params
        return checkpoint.load_params(self.run.checkpoints(stage), like)

    def _played(
        self,
        stage: Stage,
        when: str,
        env: Environment,
        params: Any,
        modes: Sequence[str],
        episodes: int,
    ) -> list[Row]:
        """A row per seed, way of choosing actions and limit.

        An agent does not see how much time is left, so what a team does in a shorter limit is the
        beginning of what it does in a longer one: all limits are read off one set of episodes.
        """
        policy, key = self.experiment.policy_on(env), key_of(EVALUATION_SEED)
        rows = []
        for seed, one in zip(self.seeds, by_seed(params), strict=True):
            for mode in modes:
                played = evaluate(env, policy, one, key, episodes=episodes, greedy=mode == "greedy")
                steps, success = np.asarray(played.steps_taken), np.asarray(played.success)
                rows += [
                    {
                        "experiment": self.study.name,
                        "stage": stage.name,
                        "seed": seed,
                        "when": when,
                        "task": task_label(env),
                        "mode": mode,
                        "limit": limit,
                        "episodes": episodes,
                        "steps_taken": float(np.minimum(steps, limit).mean()),
                        "success": float((success & (steps <= limit)).mean()),
                    }
                    for limit in limits(unwrapped(env))
                ]
        return rows


def following(chain: Sequence[Stage], stage: Stage) -> Stage | None:
    """The stage of a chain that comes after another."""
    place = chain.index(stage) + 1
    return chain[place] if place < len(chain) else None


def begun(study: Study, runs: Path) -> list[tuple[int, ...]]:
    """Seeds of the study's runs, finished or not."""
    found = sorted((runs / study.name).glob("seeds-*/config.json"))
    return [tuple(map(int, path.parent.name.split("-")[1:])) for path in found]


def study_runs(study: Study, seeds: Sequence[int], runs: Path, devices: int) -> list[StudyRun]:
    """The runs in which all `seeds` are: those that were begun as they were begun, and one with
    the seeds that are in none.
    """
    groups = [group for group in begun(study, runs) if set(group) & set(seeds)]
    left = set(seeds).difference(*groups)
    if left:
        groups.append(tuple(sorted(left)))
    return [
        StudyRun(study, group, runs / study.name / f"seeds-{'-'.join(map(str, group))}", devices)
        for group in groups
    ]
