"""A transfer experiment: source stage, zero-shot look, then the target twice, with its files.

Shared by `pp_transfer.py` and `pcp_transfer.py`; everything that computes is in the package.
"""

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from sumajax import checkpoint, hosts, reporting
from sumajax.cli.transfer_config import SCRATCH, SOURCE, TRANSFER, TransferConfig
from sumajax.environments.types import Environment
from sumajax.evaluation import EPISODES, evaluate, evaluate_random, shortest_path_steps
from sumajax.experiment import evaluations_file
from sumajax.experiment.directory import claimed, described, plain
from sumajax.experiment.interrupt import stop_when_asked
from sumajax.learning import EPOCH_STEPS, TrainState, make_learner, parallel
from sumajax.policies import Policy, make_policy
from sumajax.reporting import metrics as metrics_file
from sumajax.reporting.loggers import Loggers, check_installed
from sumajax.transfer import (
    Chunk,
    Stage,
    fresh_states,
    run_stage,
    saved_epoch,
    saved_parts,
    transferred_states,
    untrained_parameters,
)
from sumajax.upsampling import Fill, StateUpsampled

EVALUATION_SEED = 7
"""Of the policy's own randomness in held-out episodes; the starts are fixed in the package."""


@dataclass(frozen=True)
class Run:
    """An experiment that has been checked: its tasks, its policy for each, its directory."""

    config: TransferConfig
    source: StateUpsampled
    source_policy: Policy
    target_policy: Policy

    @classmethod
    def of(cls, config: TransferConfig) -> "Run":
        """Builds both tasks and policies, and refuses what cannot be transferred."""
        check_installed(config.log)
        seen_at = config.source if config.upsampling == "none" else config.target
        fill: Fill = "corner" if config.upsampling == "corner" else "blocks"
        source = StateUpsampled(config.source, seen_at.size, config.scale, fill)
        settings = {} if config.encoder == "flat" else {"encoder": config.encoder}
        policies = [make_policy(config.policy, env, **settings) for env in (source, config.target)]
        run = cls(config, source, *policies)
        checkpoint.check_compatible(
            checkpoint.describe(source, run.source_policy),
            config.target,
            run.target_policy,
            "the source stage",
        )
        if config.source_checkpoint is not None:
            hosts.first_does(partial(run._check_source, config.source_checkpoint))
        return run

    def _check_source(self, checkpoints: Path) -> None:
        saved_parts(self.stage(TRANSFER), checkpoints, carry_optimiser=self.config.carry_optimiser)

    @cached_property
    def mesh(self) -> Mesh:
        config = self.config
        devices = config.hosts * config.num_devices
        return parallel.make_mesh(len(config.seeds), config.learner.num_envs, devices)

    def checkpoints(self, arm: str) -> Path:
        return self.config.directory / "checkpoints" / arm

    def stage(self, arm: str) -> Stage:
        config = self.config
        env, policy, epochs = (
            (self.source, self.source_policy, config.source_epochs)
            if arm == SOURCE
            else (config.target, self.target_policy, config.target_epochs)
        )
        anneal = epochs if config.preset == "fast" and not config.learner.anneal_epochs else 0
        rate = config.learner.learning_rate
        learner = replace(
            config.learner,
            anneal_epochs=anneal or config.learner.anneal_epochs,
            learning_rate=rate * config.learner.transfer_rate if arm == TRANSFER else rate,
        )
        return Stage(
            arm, make_learner(env, policy, learner), epochs, config.seeds, self.checkpoints(arm)
        )


class Recorder:
    """Runs the stages of an experiment and keeps its files up to date."""

    def __init__(
        self, run: Run, directory: Path, progress: reporting.Progress, loggers: Loggers
    ) -> None:
        self.run, self.directory, self.progress = run, directory, progress
        self.loggers = loggers
        self.metrics = directory / "metrics.csv"
        self.evaluations = directory / "evaluations.csv"
        self.arms: dict[str, dict[str, Any]] = {}
        self.zero_shot: dict[str, dict[str, Any]] = {}
        self.untrained: list[str] = []  # parameters that the source left as drawn
        self.params: dict[str, Any] = {}
        self.stops: dict[str, list[dict[str, Any]]] = {}
        self._cost: dict[str, tuple[np.ndarray, float]] = {}  # env steps (S,), seconds so far

    def train(self, arm: str, start: Callable[[], TrainState]) -> None:
        """Trains an arm to its end, a row per seed and epoch on the way, and evaluates it."""
        stage = self.run.stage(arm)
        done = saved_epoch(stage)
        metrics_file.truncate_after(self.metrics, arm, done)
        evaluations_file.truncate_after(self.evaluations, arm, done)
        self._cost[arm] = _cost_so_far(self.metrics, stage)
        self.loggers.resume(arm, int(np.max(self._cost[arm][0])))
        self.progress.begin(arm, done)
        config = self.run.config
        with stop_when_asked(self.progress.say) as asked:
            result = run_stage(
                stage,
                start,
                mesh=self.run.mesh,
                meta={"experiment": config.experiment, "preset": config.preset},
                on_chunk=lambda chunk: self._record(stage, chunk),
                on_resume=lambda epoch: self.progress.say(f"{arm}: going on from epoch {epoch}."),
                on_stop=lambda stop: self.progress.say(f"{arm}: {stop}."),
                stop_asked=asked,
            )
        self.params[arm] = result.states.params
        if result.stops:
            self.stops[arm] = [asdict(stop) for stop in result.stops]
        env_steps, seconds = self._cost[arm]
        self.arms[arm] = metrics_file.arm_summary(
            env_steps=int(env_steps.mean()),
            epochs=stage.epochs,
            compile_seconds=result.compile_seconds,
            train_seconds=seconds,
            **self.evaluate(stage, result.states.params),
        )

    def look(self, source: Path, params: Any) -> None:
        """Evaluates the source's policy on the target, before any training there, and says which
        of its parameters the source did not train.
        """
        self.zero_shot = self.evaluate(self.run.stage(TRANSFER), params)
        config = self.run.config
        self.untrained = [
            name
            for name in untrained_parameters(source, params, config.seeds)
            if not set(name.split("/")) & set(config.leave_out)
        ]
        if self.untrained:
            self.progress.say(
                f"{TRANSFER}: {len(self.untrained)} parameters are as random as they began, the "
                f"source's team has no use for them: {', '.join(self.untrained)}."
            )

    def evaluate(self, stage: Stage, params: Any) -> dict[str, dict[str, Any]]:
        """Held-out episodes, `sampled` and `greedy`."""
        return {
            mode: _evaluation(stage.learner.env, stage.learner.policy, params, mode == "greedy")
            for mode in ("sampled", "greedy")
        }

    def finish(self) -> dict[str, Any]:
        """Writes curves, replay and, last of all, the summary, and returns it."""
        config = self.run.config
        references = _references(self.run)
        rows = metrics_file.read_metrics(self.metrics)
        end = TRANSFER if TRANSFER in self.arms else SOURCE
        task = "target" if TRANSFER in self.arms else "source"
        reporting.learning_curves(
            rows, self.directory / "curves.png", bounds=_levels(references[task])
        )
        self._replay(end)
        summary: dict[str, Any] = {
            "experiment": config.experiment,
            "policy": config.policy,
            "preset": config.preset,
            "seeds": list(config.seeds),
            "arms": self.arms,
            "zero_shot": self.zero_shot.get("sampled"),
            "comparison": metrics_file.comparison(rows, config.threshold),
            "zero_shot_greedy": self.zero_shot.get("greedy"),
            "references": references,
            "untrained_in_source": self.untrained,
            **({"stops": self.stops} if self.stops else {}),
        }
        metrics_file.write_summary(self.directory / "summary.json", **summary)
        return summary

    def _record(self, stage: Stage, chunk: Chunk) -> None:
        """Rows, a held-out evaluation where one is due, and progress."""
        arm, count = stage.arm, chunk.epoch - chunk.first_epoch
        steps, seconds = self._cost[arm]
        env_steps = steps[:, None] + np.cumsum(np.asarray(chunk.metrics.env_steps), axis=-1)
        clock = seconds + chunk.seconds * np.arange(1, count + 1) / count
        values = {name: getattr(chunk.metrics, name) for name in _FIGURES}
        values |= {"return": chunk.metrics.episode_return, "env_steps": env_steps, "seconds": clock}
        rows = metrics_file.rows_of(arm, stage.seeds, chunk.first_epoch + 1, values)
        metrics_file.append_rows(self.metrics, rows)
        self.loggers.log(rows)
        self._cost[arm] = (env_steps[:, -1], seconds + chunk.seconds)
        every = self.run.config.evaluate_every
        if arm != SOURCE and every and chunk.epoch // every > chunk.first_epoch // every:
            held_out = _evaluation(
                stage.learner.env, stage.learner.policy, chunk.states.params, greedy=False
            )
            evaluations_file.append(
                self.evaluations, stage, chunk.epoch, env_steps[:, -1], held_out
            )
        latest = {
            "steps_taken": _mean(chunk.metrics.steps_taken[:, -1]),
            "success": _mean(chunk.metrics.success[:, -1]),
            "env_steps_per_second": len(stage.seeds) * count * EPOCH_STEPS / chunk.seconds,
        }
        self.progress.advance(arm, chunk.epoch, latest)

    def _replay(self, arm: str) -> None:
        """One held-out episode of the first seed's final policy."""
        learner = self.run.stage(arm).learner
        params = jax.tree.map(lambda x: x[0], self.params[arm])
        episode = reporting.record_episode(
            learner.env, learner.policy, params, jax.random.key(EVALUATION_SEED), greedy=True
        )
        reporting.write_gif(episode, self.directory / "replay.gif")


_FIGURES = (
    "steps_taken",
    "success",
    "entropy",
    "policy_loss",
    "value_loss",
    "gradient_norm",
    "communication",
)
"""Columns of metrics.csv that are fields of `Metrics` by the same name."""


def _mean(values: np.ndarray) -> float:
    """Over those that are numbers; NaN if none is."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")


def _evaluation(env: Environment, policy: Policy, params: Any, greedy: bool) -> dict[str, Any]:
    """Means over the held-out starts, one per seed of `params` (S, ...)."""
    num_seeds = jax.tree.leaves(params)[0].shape[0]
    results = [
        evaluate(
            env,
            policy,
            jax.tree.map(lambda x, seed=seed: np.asarray(x[seed]), params),
            jax.random.key(EVALUATION_SEED),
            greedy=greedy,
        )
        for seed in range(num_seeds)
    ]
    means = [jax.tree.map(lambda x: float(x.mean()), result) for result in results]
    return metrics_file.evaluation_summary(
        EPISODES,
        [mean.steps_taken for mean in means],
        [mean.success for mean in means],
        [mean.episode_return for mean in means],
    )


def _references(run: Run) -> dict[str, dict[str, Any]]:
    """A random policy and the shortest-path bound on the held-out starts of both tasks."""
    references = {}
    for name, env, policy in (
        ("source", run.source, run.source_policy),
        ("target", run.config.target, run.target_policy),
    ):
        random = evaluate_random(env, policy, jax.random.key(EVALUATION_SEED))
        bound = shortest_path_steps(env)
        references[name] = {
            "random_steps_taken": float(random.steps_taken.mean()),
            "random_success": float(random.success.mean()),
            "shortest_path_steps": None if bound is None else float(bound.mean()),
        }
    return references


def _levels(reference: dict[str, Any]) -> dict[str, float]:
    levels = {
        "random policy": reference["random_steps_taken"],
        "shortest paths": reference["shortest_path_steps"],
    }
    return {name: round(value, 1) for name, value in levels.items() if value is not None}


def _cost_so_far(metrics: Path, stage: Stage) -> tuple[np.ndarray, float]:
    """(S,) environment steps of each seed, and seconds, in the rows an earlier run left."""
    rows = metrics_file.read_metrics(metrics) if metrics.exists() else []
    last = {row["seed"]: row for row in rows if row["arm"] == stage.arm}  # in order of epochs
    env_steps = [last[seed]["env_steps"] if last else 0 for seed in stage.seeds]
    return np.array(env_steps, int), last[stage.seeds[0]]["seconds"] if last else 0.0


def run_experiment(config: TransferConfig) -> dict[str, Any]:
    """Runs, or goes on with, the whole experiment; prints its table and returns its summary.

    Raises:
      ValueError, OSError: one sentence each, before any long work.
    """
    with hosts.leading():
        if hosts.several():
            _check_hosts(config)
        run = Run.of(config)
        arms = _arms(config)
        summary = _lead(run, arms) if hosts.is_first() else _follow(run, arms)
        stops = hosts.first_does(lambda: summary.get("stops", {}))
    return {**summary, "stops": stops} if stops else summary


def _check_hosts(config: TransferConfig) -> None:
    """Refuses hosts that were started differently: each would wait for what the others never do."""
    options = hosts.everyone_says(
        {**described(config), "devices of each host": jax.local_device_count()}
    )
    for host, other in enumerate(options):
        for name, value in options[0].items():
            if other[name] != value:
                raise ValueError(
                    f"host {host} has {name} {other[name]}, host 0 has {value}; start every host "
                    "with the same options but --host."
                )


def _arms(config: TransferConfig) -> list[str]:
    """The stages there are to train, in order."""
    arms = [SOURCE] if config.source_checkpoint is None else []
    if config.target_epochs:
        arms += [TRANSFER, SCRATCH] if config.scratch else [TRANSFER]
    return arms


def _follow(run: Run, arms: list[str]) -> dict[str, Any]:
    """A host's share of the training, while host 0 has the files and the screen."""
    with stop_when_asked(lambda _: print(NOT_HERE, file=sys.stderr, flush=True)):
        for stage in map(run.stage, arms):
            run_stage(stage, partial(fresh_states, stage), mesh=run.mesh)
    return {}


NOT_HERE = "Ctrl-C on host 0 stops all hosts, with a checkpoint; again here: this one, at once."


def _lead(run: Run, arms: list[str]) -> dict[str, Any]:
    """The whole experiment with its files; returns its summary."""
    config = run.config
    epochs = {arm: run.stage(arm).epochs for arm in arms}
    run.mesh  # noqa: B018 - refused, if it is, before anything is written
    with (
        claimed(config) as directory,
        reporting.Progress(epochs) as progress,
        Loggers(config.log, directory, plain(asdict(config))) as loggers,
    ):
        recorder = Recorder(run, directory, progress, loggers)
        source = config.source_checkpoint or run.checkpoints(SOURCE)
        if SOURCE in arms:
            recorder.train(SOURCE, lambda: fresh_states(run.stage(SOURCE)))
        if TRANSFER in arms:
            stage = run.stage(TRANSFER)

            def transferred() -> TrainState:
                return transferred_states(
                    stage,
                    source,
                    carry_optimiser=config.carry_optimiser,
                    leave_out=config.leave_out,
                )

            recorder.look(source, transferred().params)
            recorder.train(TRANSFER, transferred)
        if SCRATCH in arms:
            recorder.train(SCRATCH, lambda: fresh_states(run.stage(SCRATCH)))
        summary = recorder.finish()
    reporting.print_table(table(run, summary), title=f"{config.experiment}: {directory}")
    return summary


def table(run: Run, summary: dict[str, Any]) -> list[dict[str, Any]]:
    """The closing table: a row per arm and reference: steps taken and success, over the seeds."""
    grid = {
        "source": "x".join(map(str, run.config.source.shape)),
        "target": "x".join(map(str, run.config.target.shape)),
    }
    rows = []
    for arm, result in summary["arms"].items():
        task = grid["source" if arm == SOURCE else "target"]
        cost = {"steps": result["env_steps"], "seconds": result["train_seconds"]}
        stops = [f"seed {stop['seed']} stopped" for stop in summary.get("stops", {}).get(arm, [])]
        name = f"{arm} ({', '.join(stops)})" if stops else arm
        rows.append(_row(name, task, result["evaluation"], **cost))
        if arm == SOURCE and summary["zero_shot"]:
            evaluation = {"sampled": summary["zero_shot"], "greedy": summary["zero_shot_greedy"]}
            rows.append(_row("zero shot", grid["target"], evaluation))
    for name, reference in summary["references"].items():
        bound = {"steps_taken": reference["shortest_path_steps"], "success": 1.0}
        random = {
            "steps_taken": reference["random_steps_taken"],
            "success": reference["random_success"],
        }
        rows.append(_row("random", grid[name], {"sampled": random}))
        rows.append(_row("shortest", grid[name], {"greedy": bound}))
    return rows


def _row(name: str, task: str, evaluation: dict[str, Any], **cost: Any) -> dict[str, Any]:
    sampled = evaluation.get("sampled", {})
    steps = np.atleast_1d(sampled.get("steps_taken", []))
    return {
        "policy": f"{name} {task}",
        "sampled": _steps(sampled),
        "seeds": f"{steps.min():.1f}-{steps.max():.1f}" if steps.size > 1 else None,
        "greedy": _steps(evaluation.get("greedy", {})),
        "cost": f"{cost['steps'] / 1e6:.1f} M, {cost['seconds']:.0f} s" if cost else None,
    }


def _steps(evaluation: dict[str, Any]) -> str | None:
    """Mean steps taken and success over the seeds."""
    if not evaluation:
        return None
    return f"{np.mean(evaluation['steps_taken']):.2f} {np.mean(evaluation['success']):6.1%}"
