"""Runs an experiment: every stage of its plan in order, with its files, from where it stopped."""

import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from sumajax import checkpoint, hosts, reporting
from sumajax.environments.types import merit_of
from sumajax.experiment import records
from sumajax.experiment.directory import claimed
from sumajax.experiment.interrupt import stop_when_asked
from sumajax.experiment.plan import Experiment, Stage, described
from sumajax.experiment.records import MODES, StageRecords, by_seed, held_out, references
from sumajax.experiment.summary import stage_labels, summarise, table, untrained_line
from sumajax.keys import key_of
from sumajax.learning import EPOCH_STEPS, TrainState, make_learner, parallel
from sumajax.learning.mixed import mixed_with
from sumajax.policies import Policy
from sumajax.reporting import metrics as metrics_file
from sumajax.reporting.loggers import Loggers, check_installed
from sumajax.transfer import (
    CHUNK,
    Chunk,
    StageRun,
    Stop,
    fresh_states,
    run_stage,
    saved_epoch,
    saved_parts,
    transferred_states,
    untrained_parameters,
)

NOT_HERE = "Ctrl-C on host 0 stops all hosts, with a checkpoint; again here: this one, at once."


@dataclass(frozen=True)
class Where:
    """Where a run is computed and shown; no part of what it is, and free to change on resuming.

    Attributes:
      devices: of each host, to spread seeds and environments over; None: all that can share them.
      num_hosts: processes that train as one, see `sumajax.hosts`.
      log: where to show the metrics beside metrics.csv.
      chunk: epochs between two checkpoints.
      options: the command line's, kept in config.json for `--config`.
    """

    devices: int | None = None
    num_hosts: int = 1
    log: Sequence[str] = ()
    chunk: int = CHUNK
    options: dict[str, Any] = field(default_factory=dict)


def run_experiment(
    experiment: Experiment, directory: str | os.PathLike[str], where: Where | None = None
) -> dict[str, Any]:
    """Runs, or goes on with, a whole experiment; prints its table and returns its summary.

    Args:
      directory: of the run, made if missing; everything it leaves is there.

    Raises:
      ValueError, OSError: one sentence each, before any long work.
    """
    with hosts.leading():
        run = Run(experiment, Path(directory), where or Where())
        if hosts.several():
            _check_hosts(run)
        run.check()
        summary = _lead(run) if hosts.is_first() else _follow(run)
        stops = hosts.first_does(lambda: summary.get("stops", {}))
    return {**summary, "stops": stops} if stops else summary


@dataclass(frozen=True)
class Run:
    """An experiment and its place."""

    experiment: Experiment
    directory: Path
    where: Where

    def check(self) -> None:
        """Refuses what cannot be run, before anything is written or compiled."""
        check_installed(self.where.log)
        self.experiment.check()
        for stage in self.experiment.stages:
            hosts.first_does(partial(self._check_start, stage))
            self.mesh(stage)

    def _check_start(self, stage: Stage) -> None:
        """What a stage that has not begun starts from, if that was made elsewhere."""
        begun = checkpoint.latest(self.checkpoints(stage)) is not None
        if isinstance(stage.start, Path) and not begun:
            run, start = self.stage_run(stage), self.start(stage)
            carry = stage.carry_optimiser
            saved_parts(run, start, carry_optimiser=carry, resize=stage.resize)

    def mesh(self, stage: Stage) -> Mesh:
        seeds, envs, where = len(self.experiment.seeds), stage.learner.num_envs, self.where
        envs = envs if stage.beside is None else envs // 2
        of_each = parallel.choose_devices(seeds, envs, where.devices, where.num_hosts)
        return parallel.make_mesh(seeds, envs, where.num_hosts * of_each)

    def checkpoints(self, stage: Stage) -> Path:
        return self.directory / "checkpoints" / stage.name

    def start(self, stage: Stage) -> Path:
        """The checkpoints that a stage goes on from."""
        if isinstance(stage.start, Path):
            return stage.start
        return self.checkpoints(self.experiment.by_name[str(stage.start)])

    def stage_run(self, stage: Stage) -> StageRun:
        policy = self.experiment.policy_on(stage.env)
        learner = make_learner(stage.env, policy, stage.trained_with)
        if stage.beside is not None:
            learner = mixed_with(learner, stage.beside)
        return StageRun(
            stage.name,
            learner,
            stage.epochs,
            self.experiment.seeds,
            self.checkpoints(stage),
            looked_at=None if stage.until is None else stage.until.window,
        )

    def first_states(self, stage: Stage) -> TrainState:
        """What training begins with: fresh, or taken over."""
        if stage.start is None:
            return fresh_states(self.stage_run(stage))
        return transferred_states(
            self.stage_run(stage),
            self.start(stage),
            carry_optimiser=stage.carry_optimiser,
            leave_out=stage.leave_out,
            resize=stage.resize,
        )


class Recorder:
    """Trains the stages of a run and keeps its files up to date."""

    def __init__(
        self, run: Run, directory: Path, progress: reporting.Progress, loggers: Loggers
    ) -> None:
        self.run, self.directory, self.progress = run, directory, progress
        self.loggers = loggers
        self.metrics = directory / "metrics.csv"
        self.evaluations = directory / "evaluations.csv"
        self.stages = StageRecords(directory / "stages.json")
        self._cost: dict[str, Cost] = {}

    def unfinished(self) -> list[str]:
        """The stages that are still to be trained, or to be evaluated, in order."""
        stages = self.run.experiment.stages
        return [stage.name for stage in stages if "result" not in self.stages[stage.name]]

    def train(self, stage: Stage) -> None:
        """A stage from its start or last checkpoint to its end, evaluated before and after."""
        if stage.start is not None and "zero_shot" not in self.stages[stage.name]:
            self._look(stage)
        run, experiment = self.run, self.run.experiment
        stage_run = run.stage_run(stage)
        self._resume(stage_run)
        with stop_when_asked(self.progress.say) as asked:
            result = run_stage(
                stage_run,
                partial(run.first_states, stage),
                mesh=run.mesh(stage),
                meta={
                    "experiment": experiment.name,
                    "preset": experiment.preset,
                    "follows": [before.name for before in experiment.ancestors(stage)]
                    or ([] if stage.start is None else ["elsewhere"]),
                },
                on_chunk=partial(self._record, stage, stage_run),
                on_resume=lambda epoch: self.progress.say(
                    f"{stage.name}: going on from epoch {epoch}."
                ),
                on_stop=lambda stop: self.progress.say(f"{stage.name}: {stop}."),
                stop_asked=asked,
                ended=partial(self._ended, stage),
                chunk=run.where.chunk,
            )
        if result.epoch < stage.epochs:
            self.progress.say(f"{stage.name}: still after epoch {result.epoch} of {stage.epochs}.")
        cost = self._cost[stage.name]
        arm = metrics_file.arm_summary(
            env_steps=int(cost.env_steps.mean()),
            epochs=result.epoch,
            compile_seconds=result.compile_seconds,
            train_seconds=cost.seconds,
            **self._evaluate(stage, result.states.params),
        )
        self.stages.update(
            stage.name,
            result=arm,
            cost={"env_steps": int(cost.env_steps.sum()), "cpu_seconds": cost.cpu_seconds},
            stops=[asdict(stop) for stop in result.stops],
        )

    def finish(self) -> dict[str, Any]:
        """Writes curves, replay and, last of all, the summary, and returns it."""
        experiment = self.run.experiment
        levels: dict[str, dict[str, Any]] = {}
        for stage in experiment.stages:
            same = [s.name for s in experiment.stages if s.env == stage.env]
            levels[stage.name] = levels.get(same[0]) or references(
                stage.env, experiment.policy_on(stage.env), experiment.episodes
            )
        rows = metrics_file.read_metrics(self.metrics)
        reporting.learning_curves(
            rows,
            self.directory / "curves.png",
            y=merit_of(experiment.target.env),
            bounds=_bounds(levels[experiment.target.name], merit_of(experiment.target.env)),
            labels=stage_labels(experiment),
            after={
                stage.name: [before.name for before in experiment.ancestors(stage)]
                for stage in experiment.stages
            },
        )
        self._replay(experiment.target)
        summary = summarise(experiment, self.stages, levels, rows)
        reporting.write_json(self.directory / "summary.json", summary)
        return summary

    def _resume(self, stage_run: StageRun) -> None:
        """Cuts every file back to the last checkpoint."""
        arm, done = stage_run.arm, saved_epoch(stage_run)
        metrics_file.truncate_after(self.metrics, arm, done)
        records.truncate_evaluations(self.evaluations, arm, done)
        self._cost[arm] = Cost.so_far(self.metrics, stage_run)
        self.loggers.resume(arm, int(np.max(self._cost[arm].env_steps)))
        self.progress.begin(arm, done)

    def _look(self, stage: Stage) -> None:
        """Evaluates what a stage starts from, before any training there, and says which parameters
        the stage before did not train.
        """
        learner = self.run.stage_run(stage).learner
        params = self.run.first_states(stage).params
        untrained = [
            name
            for name in untrained_parameters(
                self.run.start(stage), learner, params, self.run.experiment.seeds
            )
            if not set(name.split("/")) & set(stage.leave_out)
        ]
        if untrained:
            self.progress.say(f"{stage.name}: {untrained_line(untrained)}")
        self.stages.update(stage.name, zero_shot=self._evaluate(stage, params), untrained=untrained)

    def _evaluate(self, stage: Stage, params: Any) -> dict[str, dict[str, Any]]:
        """Held-out episodes, `sampled` and `greedy`; `params` (S, ...)."""
        experiment = self.run.experiment
        policy: Policy = experiment.policy_on(stage.env)
        return {
            mode: held_out(stage.env, policy, by_seed(params), experiment.episodes, mode)
            for mode in MODES
        }

    def _ended(self, stage: Stage, epoch: int, stops: Sequence[Stop]) -> bool:
        """Whether the stage has stopped improving, if that ends it."""
        if stage.until is None:
            return False
        stopped = {stop.seed for stop in stops}
        seeds = [seed for seed in self.run.experiment.seeds if seed not in stopped]
        rows = metrics_file.read_metrics(self.metrics)
        return stage.until.ends(rows, stage.name, seeds, epoch, stage.env.max_steps)

    def _record(self, stage: Stage, stage_run: StageRun, chunk: Chunk) -> None:
        """Rows, a held-out evaluation where one is due, and progress."""
        arm, count, before = stage.name, chunk.epoch - chunk.first_epoch, self._cost[stage.name]
        self._cost[arm], columns = before.after(chunk)
        values = {name: getattr(chunk.metrics, name) for name in _FIGURES}
        values |= {"return": chunk.metrics.episode_return, **columns}
        rows = metrics_file.rows_of(arm, stage_run.seeds, chunk.first_epoch + 1, values)
        metrics_file.append_rows(self.metrics, rows)
        self.loggers.log(rows)
        experiment = self.run.experiment
        every = experiment.evaluates_every(stage)
        if every and chunk.epoch // every > chunk.first_epoch // every:
            policy, params = stage_run.learner.policy, by_seed(chunk.states.params)
            evaluation = held_out(stage.env, policy, params, experiment.episodes, "sampled")
            env_steps = columns["env_steps"][:, -1]
            records.append_evaluation(
                self.evaluations, arm, stage_run.seeds, chunk.epoch, env_steps, evaluation
            )
        latest = {
            "steps_taken": _mean(chunk.metrics.steps_taken[:, -1]),
            "success": _mean(chunk.metrics.success[:, -1]),
            "env_steps_per_second": len(stage_run.seeds) * count * EPOCH_STEPS / chunk.seconds,
        }
        self.progress.advance(arm, chunk.epoch, latest)

    def _replay(self, stage: Stage) -> None:
        """One held-out episode of the first seed's last policy, where the domain can be drawn."""
        policy = self.run.experiment.policy_on(stage.env)
        like = jax.eval_shape(lambda: fresh_states(self.run.stage_run(stage))).params
        params = checkpoint.load_params(self.run.checkpoints(stage), like)
        try:
            episode = reporting.record_episode(
                stage.env,
                policy,
                jax.tree.map(lambda x: x[0], params),
                key_of(records.EVALUATION_SEED),
                greedy=True,
            )
        except ValueError as error:  # a domain without anything to draw
            self.progress.say(f"no replay: {error}")
            return
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


@dataclass(frozen=True)
class Cost:
    """What a stage has cost so far."""

    env_steps: np.ndarray  # (S,) int
    seconds: float = 0.0  # wall time of training
    cpu_seconds: float = 0.0  # user and system time of the process, in training

    @classmethod
    def so_far(cls, metrics: Path, stage: StageRun) -> "Cost":
        """In the rows that an earlier run left."""
        rows = metrics_file.read_metrics(metrics) if metrics.exists() else []
        last = {row["seed"]: row for row in rows if row["arm"] == stage.arm}  # in order of epochs
        if not last:
            return cls(np.zeros(len(stage.seeds), int))
        env_steps = np.array([last[seed]["env_steps"] for seed in stage.seeds], int)
        row = last[stage.seeds[0]]
        cpu = float(np.nan_to_num(row["cpu_seconds"]))  # no number in runs from before it was kept
        return cls(env_steps, row["seconds"], cpu)

    def after(self, chunk: Chunk) -> tuple["Cost", dict[str, np.ndarray]]:
        """The cost after a chunk, and its columns in metrics.csv, epoch by epoch."""
        count = chunk.epoch - chunk.first_epoch
        env_steps = self.env_steps[:, None] + np.cumsum(np.asarray(chunk.metrics.env_steps), -1)
        share = np.arange(1, count + 1) / count
        columns = {
            "env_steps": env_steps,
            "seconds": self.seconds + chunk.seconds * share,
            "cpu_seconds": self.cpu_seconds + chunk.cpu_seconds * share,
        }
        seconds = self.seconds + chunk.seconds
        cpu_seconds = self.cpu_seconds + chunk.cpu_seconds
        return Cost(env_steps[:, -1], seconds, cpu_seconds), columns


def _mean(values: np.ndarray) -> float:
    """Over those that are numbers; NaN if none is."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")


def _bounds(reference: dict[str, Any], merit: str) -> dict[str, float]:
    if merit == "success":
        return {"random policy": round(reference["random_success"], 3)}
    levels = {
        "random policy": reference["random_steps_taken"],
        "shortest paths": reference["shortest_path_steps"],
    }
    return {name: round(value, 1) for name, value in levels.items() if value is not None}


def _check_hosts(run: Run) -> None:
    """Refuses hosts that were started differently: each would wait for what the others never do."""
    plans = hosts.everyone_says(
        {**described(run.experiment), "devices of each host": jax.local_device_count()}
    )
    for host, other in enumerate(plans):
        for name, value in plans[0].items():
            if other[name] != value:
                raise ValueError(
                    f"host {host} has {name} {other[name]}, host 0 has {value}; start every host "
                    "with the same options but --host."
                )


def _follow(run: Run) -> dict[str, Any]:
    """A host's share of the training, while host 0 has the files and the screen."""
    with stop_when_asked(lambda _: print(NOT_HERE, file=sys.stderr, flush=True)):
        for name in hosts.first_does(list[str]):
            stage = run.experiment.by_name[name]
            stage_run, start = run.stage_run(stage), partial(run.first_states, stage)
            run_stage(stage_run, start, mesh=run.mesh(stage), chunk=run.where.chunk)
    return {}


def _lead(run: Run) -> dict[str, Any]:
    """The whole experiment with its files; returns its summary."""
    experiment = run.experiment
    epochs = {stage.name: stage.epochs for stage in experiment.stages}
    with (
        claimed(run.directory, described(experiment), run.where.options) as directory,
        reporting.Progress(epochs) as progress,
        Loggers(run.where.log, directory, described(experiment)) as loggers,
    ):
        for stage in experiment.stages:
            # A finished stage saves no more, which would remove what a killed check left there.
            checkpoint.remove_unfinished(run.checkpoints(stage))
            checkpoint.check_directory(run.checkpoints(stage))
        recorder = Recorder(run, directory, progress, loggers)
        for name in hosts.first_does(recorder.unfinished):
            recorder.train(experiment.by_name[name])
        summary = recorder.finish()
    rows = table(experiment, summary, recorder.stages)
    reporting.print_table(rows, title=f"{experiment.name}: {directory}")
    return summary
