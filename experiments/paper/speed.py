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
