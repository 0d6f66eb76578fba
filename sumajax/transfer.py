"""Source stage -> checkpoint -> target stage (paper section IV-B), through files.

A stage trains one policy on one task for some epochs, several seeds side by side, and leaves
checkpoints from which it goes on when it is started again, and from which a target stage starts.
Of several hosts (`sumajax.hosts`) the first alone has files; all train.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from sumajax import checkpoint, hosts
from sumajax.checkpoint import CheckpointError
from sumajax.learning import parallel
from sumajax.learning.guard import FAULTS
from sumajax.learning.learner import Learner, Metrics, TrainState
from sumajax.policies.encoder import Resize, resized_table, table_grid
from sumajax.sources import Source, source_of

CHUNK = 5
"""Epochs of a compiled call: between two looks at the metrics, and between two checkpoints."""


@dataclass(frozen=True)
class StageRun:
    """A stage of training, ready to run.

    Attributes:
      arm: its name in the files.
      epochs: it has at most.
      directory: of its checkpoints.
      looked_at: after every so many epochs something is asked of it, `ended` of `run_stage`; what
        a compiled call trains ends there.
    """

    arm: str
    learner: Learner
    epochs: int
    seeds: tuple[int, ...]
    directory: Path
    looked_at: int | None = None


@dataclass(frozen=True)
class Stop:
    """A seed that went no further because a number of its training was not finite any more."""

    seed: int
    epoch: int  # in which it happened, counted from 1
    fault: str  # one of `guard.FAULTS`

    def __str__(self) -> str:
        return (
            f"seed {self.seed} stopped in epoch {self.epoch}: its {self.fault}; "
            "the last good state is kept"
        )


class StoppedError(ValueError):
    """Every seed of a stage has stopped."""


@dataclass(frozen=True)
class StageResult:
    """What came of it: the last states, stacked over seeds, and what this run of it cost."""

    states: TrainState
    first_epoch: int  # epochs that an earlier run had done
    compile_seconds: float
    train_seconds: float
    epoch: int  # that it came to
    stops: tuple[Stop, ...] = ()  # seeds whose last state is of an earlier epoch


@dataclass(frozen=True)
class Chunk:
    """News from a stage: epochs `first_epoch`+1 to `epoch` are done."""

    first_epoch: int
    epoch: int
    states: TrainState  # stacked over seeds
    metrics: Metrics  # leaves (seeds, epochs of the chunk)
    seconds: float  # wall time of the chunk
    compile_seconds: float = 0.0  # before it
    cpu_seconds: float = 0.0  # user and system time of the process in the chunk's training alone


def fresh_states(stage: StageRun) -> TrainState:
    """Untrained states, stacked over the stage's seeds."""
    return parallel.init_seeds(stage.learner, list(stage.seeds))


def transferred_states(
    stage: StageRun,
    source: Path,
    *,
    carry_optimiser: bool = False,
    leave_out: tuple[str, ...] = (),
    resize: Resize | None = None,
) -> TrainState:
    """States that start from the parameters in the checkpoints of another stage.

    Everything else, memory and environments included, is fresh; the optimiser's memory too unless
    `carry_optimiser`. A seed starts from the source's seed of that number, or all from its only
    one.

    Args:
      source: of the stage's checkpoints, or of a run, whose last stage is meant; or the name of a
        trained policy of the package.
      leave_out: modules of the policy whose parameters stay fresh, as `state_encoder`.
      resize: how the state encoder's position table comes from the source's grid to this stage's;
        None: the policy has one grid in both.

    Raises:
      CheckpointError: as for `saved_parts`.
      ValueError: for a module that the policy does not have.
    """
    fresh = fresh_states(stage)
    saved = saved_parts(stage, source, carry_optimiser=carry_optimiser, resize=resize)
    carried = {
        field: jax.tree.map(
            lambda x, y: jnp.broadcast_to(jnp.asarray(x), y.shape), part, getattr(fresh, field)
        )
        for field, part in saved.items()
    }
    params = _without(carried.pop("params"), fresh.params, leave_out)
    return parallel.init_seeds_from(stage.learner, list(stage.seeds), params, **carried)


def _without(params: Any, fresh: Any, modules: tuple[str, ...]) -> Any:
    """`params`, but of `modules` the `fresh` ones."""
    within = {
        path: {str(key.key) for key in path[:-1]}
        for path, _ in jax.tree_util.tree_leaves_with_path(params)
    }
    known = sorted(set().union(*within.values()) - {"params"})
    for module in modules:
        if module not in known:
            raise ValueError(f"the policy has no module {module!r}; it has {', '.join(known)}.")
    return jax.tree_util.tree_map_with_path(
        lambda path, x, y: y if within[path] & set(modules) else x, params, fresh
    )


def saved_parts(
    stage: StageRun,
    source: Path,
    *,
    carry_optimiser: bool = False,
    resize: Resize | None = None,
) -> dict[str, Any]:
    """What `stage` would take over from `source`, by field of its states; compiles nothing.

    Raises:
      CheckpointError: when there is no good checkpoint, or it does not fit: the sentence names the
        setting or the leaf and both values.
    """
    found, learner = source_of(source), stage.learner
    meta, any_grid = found.meta, resize is not None
    checkpoint.check_compatible(meta, learner.env, learner.policy, found.name, any_grid=any_grid)
    saved_seeds = meta.get("seeds", [0])
    by_number = set(stage.seeds) <= set(saved_seeds)
    if not by_number and len(saved_seeds) != 1:
        raise CheckpointError(
            f"{found.name} holds seeds {saved_seeds}, this stage has {list(stage.seeds)}; give "
            "seeds that it holds, or checkpoints of one seed."
        )
    like = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((len(saved_seeds), *x.shape[1:]), x.dtype),
        jax.eval_shape(lambda: fresh_states(stage)),
    )
    fields = ("params", "opt_state") if carry_optimiser else ("params",)
    if resize is None:
        saved = {field: found.load(getattr(like, field), field) for field in fields}
    else:
        saved = {"params": _resized(found, learner, like.params, resize)}
    if not by_number:
        return saved
    places = np.array([saved_seeds.index(seed) for seed in stage.seeds])
    return jax.tree.map(lambda x: x[places], saved)


def _resized(found: Source, learner: Learner, like: Any, method: Resize) -> Any:
    """The parameters of a source, with the position table brought to the learner's grid.

    Args:
      like: shapes of the parameters here, leaves (seeds, ...).
    """
    kind: Any = getattr(learner.policy.module, "encoder", None)
    before = table_grid(kind, tuple(found.meta["state_shape"]))
    after = table_grid(kind, learner.policy.team.state_shape)

    def as_saved(path: Any, x: Any) -> Any:
        shape = (x.shape[0], math.prod(before), x.shape[2]) if _is_table(path) else x.shape
        return jax.ShapeDtypeStruct(shape, x.dtype)

    def brought(path: Any, x: Any) -> Any:
        return resized_table(x, before, after, method) if _is_table(path) else x

    by_path = jax.tree_util.tree_map_with_path
    return by_path(brought, found.load(by_path(as_saved, like)))


def _is_table(path: Any) -> bool:
    """Whether a leaf of a policy's parameters is the state encoder's position table."""
    return tuple(getattr(key, "key", None) for key in path[-3:]) == (
        "state_encoder",
        "dense",
        "kernel",
    )


def untrained_parameters(
    source: Path, learner: Learner, params: Any, seeds: tuple[int, ...]
) -> list[str]:
    """Names of the parameters that training the source left as they were first drawn.

    A team of two predators and one capture agent has nobody to train what passes between two
    capture agents, and where there is one sender an attention weight is 1 whatever its parameters:
    they enter the target stage as random as they began.

    Args:
      learner: of the source, or another of the same policy: the first draw depends on nothing else.
      params: what was transferred from `source`, leaves (seeds, ...).
      seeds: whose they are, where they may be some of the source's.
    """
    meta = source_of(source).meta
    if "untrained" in meta:
        return list(meta["untrained"])
    saved_seeds = meta.get("seeds", [0])
    by_number = set(seeds) <= set(saved_seeds)
    drawn = parallel.init_seeds(learner, list(seeds if by_number else saved_seeds)).params
    pairs = zip(jax.tree_util.tree_leaves_with_path(params), jax.tree.leaves(drawn), strict=True)
    return [
        "/".join(str(key.key) for key in path)
        for (path, after), before in pairs
        if np.array_equal(after, np.broadcast_to(before, after.shape))
    ]


def run_stage(
    stage: StageRun,
    start: Callable[[], TrainState],
    *,
    mesh: Mesh | None = None,
    meta: dict[str, Any] | None = None,
    on_chunk: Callable[[Chunk], None] = lambda chunk: None,
    on_resume: Callable[[int], None] = lambda epoch: None,
    stop_asked: Callable[[], bool] = lambda: False,
    on_stop: Callable[[Stop], None] = lambda stop: None,
    ended: Callable[[int, tuple[Stop, ...]], bool] = lambda epoch, stops: False,
    chunk: int = CHUNK,
) -> StageResult:
    """Trains the stage to its end, from its last checkpoint if it has one, else from `start()`.

    Args:
      mesh: devices, see `learning.parallel`; None: one.
      meta: added to the description of each checkpoint.
      on_chunk: called after every chunk, before its checkpoint is written: what it writes may be
        ahead of the checkpoints when a run is killed, and cut back, but is never behind.
      on_resume: called first with the epoch that training goes on from.
      stop_asked: called after every checkpoint; True stops there, with a KeyboardInterrupt.
      on_stop: called once for each seed that stops; the others go on.
      ended: asked after every checkpoint, and of the one that training goes on from, with its epoch
        and the seeds that have stopped; True ends the stage there, before its last epoch.

    Every host calls this with the same stage; only the first one's `start`, `stop_asked` and
    `ended` are called, and only it touches the directory.

    Raises:
      StoppedError: when the last seed has stopped; its checkpoint is written.
      HostError: on the other hosts, what went wrong on the first.
    """
    num_seeds, num_envs = len(stage.seeds), stage.learner.config.num_envs
    mesh = mesh or parallel.make_mesh(num_seeds, num_envs, 1)
    about: dict[str, Any] = {"arm": stage.arm, "seeds": list(stage.seeds), **(meta or {})}
    description = checkpoint.describe(stage.learner.env, stage.learner.policy, **about)
    first_epoch, stops, whole = _begin(stage, start, description)
    if first_epoch:
        on_resume(first_epoch)
    states = parallel.place(whole, mesh)
    compile_seconds = train_seconds = 0.0
    chunks = _chunks(stage, mesh, states, first_epoch, chunk)
    epoch, over = first_epoch, False
    if first_epoch:
        over = hosts.first_does(lambda: ended(first_epoch, stops))
    while len(stops) < num_seeds and not over and (news := next(chunks, None)) is not None:
        whole = news.states
        compile_seconds += news.compile_seconds
        train_seconds += news.seconds
        on_chunk(news)
        for stop in _new_stops(stage, news, stops):
            on_stop(stop)
            stops += (stop,)
        meta_now = {**description, "epoch": news.epoch, "stops": [asdict(stop) for stop in stops]}
        if hosts.first_does(partial(_save, stage, whole, meta_now, stop_asked)):
            raise KeyboardInterrupt
        epoch = news.epoch
        over = hosts.first_does(partial(ended, epoch, stops))
    if len(stops) == num_seeds:
        raise StoppedError(
            f"no seed of the {stage.arm} stage is left ({stops[0]}); try a lower learning rate or "
            "max_grad_norm in another directory."
        )
    return StageResult(whole, first_epoch, compile_seconds, train_seconds, epoch, stops)


def _begin(
    stage: StageRun, start: Callable[[], TrainState], description: dict[str, Any]
) -> tuple[int, tuple[Stop, ...], TrainState]:
    """The epoch that the stage goes on from, which seeds had stopped, and its states.

    A new stage is saved before its first epoch.
    """
    (is_new, first_epoch, stopped), states = hosts.first_makes(
        lambda: _resumed(stage, start), lambda: jax.eval_shape(lambda: fresh_states(stage))
    )
    if is_new:
        hosts.first_does(partial(_save, stage, states, {**description, "epoch": 0}))
    return first_epoch, tuple(Stop(**stop) for stop in stopped), states


def _save(
    stage: StageRun,
    states: TrainState,
    meta: dict[str, Any],
    stop_asked: Callable[[], bool] = lambda: False,
) -> bool:
    """Writes a checkpoint; whether to stop after it."""
    checkpoint.save(stage.directory, states, meta)
    return stop_asked()


def _chunks(
    stage: StageRun, mesh: Mesh, states: TrainState, first_epoch: int, longest: int
) -> Iterator[Chunk]:
    """Trains from `first_epoch` to the stage's end; compiles when the first chunk is asked for."""
    length = _chunk_length(stage.epochs, first_epoch, longest, stage.looked_at)
    train: parallel.Train | None = None
    for epoch in range(first_epoch, stage.epochs, length):
        began = time.perf_counter()
        train = train or parallel.compile_train(stage.learner, mesh, length, states)
        compiled = time.perf_counter()
        hosts.meet()
        met, cpu = time.perf_counter(), time.process_time()
        states, metrics = jax.block_until_ready(train(states))
        seconds, cpu_seconds = time.perf_counter() - met, time.process_time() - cpu
        whole, news = hosts.gathered((states, metrics))
        news = jax.device_get(news)
        yield Chunk(epoch, epoch + length, whole, news, seconds, compiled - began, cpu_seconds)


def _new_stops(stage: StageRun, news: Chunk, known: tuple[Stop, ...]) -> list[Stop]:
    """Seeds that have stopped; the number of updates they have taken says when."""
    stopped = {stop.seed for stop in known}
    faults, updates = np.asarray(news.metrics.fault), np.asarray(news.states.updates)
    return [
        Stop(
            seed,
            int(updates[i]) // stage.learner.config.updates_per_epoch + 1,
            FAULTS[faults[i, -1] - 1],
        )
        for i, seed in enumerate(stage.seeds)
        if faults[i, -1] and seed not in stopped
    ]


def saved_epoch(stage: StageRun) -> int:
    """The epoch that the stage would go on from."""
    if checkpoint.latest(stage.directory) is None:
        return 0
    return checkpoint.read_meta(stage.directory)["epoch"]


def _resumed(
    stage: StageRun, start: Callable[[], TrainState]
) -> tuple[tuple[bool, int, list[dict[str, Any]]], TrainState]:
    """Whether the stage is new, the epoch it goes on from, which seeds had stopped; its states."""
    if checkpoint.latest(stage.directory) is None:
        return (True, 0, []), start()
    like = jax.eval_shape(lambda: fresh_states(stage))
    states, meta = checkpoint.load(stage.directory, like)
    resumed = (False, meta["epoch"], meta.get("stops", []))
    return resumed, jax.tree.map(jnp.asarray, states)


def _chunk_length(epochs: int, done: int, longest: int, looked_at: int | None = None) -> int:
    """The longest chunk that reaches the end, and every epoch at which the stage is `looked_at`, in
    equal parts, so that one program is compiled.

    A resumed stage takes the chunks of an uninterrupted one: other chunks are other programs, and
    look at the policy in other epochs.
    """
    for left in (epochs, epochs - done):
        left = math.gcd(left, looked_at or left)
        length = max((n for n in range(1, longest + 1) if left % n == 0), default=1)
        if done % length == 0:
            return length
    return 1
