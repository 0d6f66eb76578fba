"""Seconds per epoch, measured as the paper's Table II: one seed, epoch after epoch, alone."""

import math
import os
import time
from statistics import mean, stdev
from typing import Any

import jax
from sumajax.cli.transfer_config import SOURCE, TransferConfig

from sumajax.experiment.run import Run
from sumajax.learning import parallel
from sumajax.transfer import fresh_states, transferred_states


def seconds_per_epoch(config: TransferConfig, arm: str, epochs: int) -> dict[str, Any]:
    """Mean and standard error over `epochs` epochs, after one that does not count.

    Compilation is apart; the policy trains on from epoch to epoch, as it does in a run.
    """
    load = os.getloadavg()[0]
    run = Run.of(config)
    stage = run.stage(arm)
    source = config.source_checkpoint
    if arm == SOURCE or source is None:
        states = fresh_states(stage)
    else:
        states = transferred_states(stage, source)
    states = parallel.place(states, run.mesh)
    train = parallel.compile_train(stage.learner, run.mesh, 1, states)
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
