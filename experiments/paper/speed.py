"""Seconds per epoch, measured as the paper's Table II: one seed, epoch after epoch, alone."""

import math
import os
import time
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import jax

from sumajax.experiment import Experiment
from sumajax.experiment.run import Run, Where
from sumajax.learning import parallel

PASSES = 2
"""Times that every row is measured, each time after all the others: what a machine does in another
hour shows between passes, not within one."""
QUIET_LOAD = 0.5
"""Mean number of running processes over a minute (`os.getloadavg`) under which a row begins."""
PATIENCE_SECONDS = 600.0
"""Longest wait for that; the row before it is over after two minutes."""
_LOOK_SECONDS = 5.0


def wait_until_quiet() -> bool:
    """Waits for a load under `QUIET_LOAD`; False when it did not come."""
    until = time.monotonic() + PATIENCE_SECONDS
    while os.getloadavg()[0] >= QUIET_LOAD:
        if time.monotonic() > until:
            return False
        time.sleep(_LOOK_SECONDS)
    return True


def seconds_per_epoch(
    experiment: Experiment, directory: Path, devices: int, epochs: int
) -> dict[str, Any]:
    """Mean and standard error over `epochs` epochs of a stage, after one that does not count.

    Compilation is apart; the policy trains on from epoch to epoch, as it does in a run.

    Args:
      experiment: of one stage.
      directory: of a run, in which nothing is written.
    """
    load = os.getloadavg()[0]
    run = Run(experiment, directory, Where(devices))
    (stage,) = experiment.stages
    mesh = run.mesh(stage)
    states = parallel.place(run.first_states(stage), mesh)
    train = parallel.compile_train(run.stage_run(stage).learner, mesh, 1, states)
    seconds = []
    for _ in range(epochs + 1):
        began = time.perf_counter()
        states, _ = jax.block_until_ready(train(states))
        seconds.append(time.perf_counter() - began)
    counted = seconds[1:]
    error = stdev(counted) / math.sqrt(len(counted)) if len(counted) > 1 else math.nan
    return {
        "epochs": epochs,
        "seconds": mean(counted),
        "standard_error": error,
        "load_before": load,
    }
