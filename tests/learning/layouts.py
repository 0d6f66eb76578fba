"""Trains a tiny stage, or goes on with it, on some devices of some hosts.

python layouts.py '{"hosts": 2, "host": 0, "coordinator": "127.0.0.1:1234", "devices": 1,
                    "cache": "directory", "stages": [["directory", devices, epochs], ..]}'

Run by test_hosts.py, since devices and hosts are fixed when JAX is first used. `devices` are those
of each host, and in a stage those of all hosts that are used.
"""

import json
import sys
from pathlib import Path

import jax
from trajectories import TINY_TASK, tiny_learner

from sumajax import hosts
from sumajax.learning import parallel
from sumajax.transfer import StageRun, fresh_states, run_stage

SEED = 3
NUM_ENVS = 200


def stage_of(directory, epochs):
    learner = tiny_learner(
        TINY_TASK, num_envs=NUM_ENVS, rollout_length=20, advantages="normalised", anneal_epochs=2
    )
    return StageRun("source", learner, epochs, (SEED,), Path(directory))


def train(directory, devices, epochs):
    stage = stage_of(directory, epochs)
    mesh = parallel.make_mesh(1, NUM_ENVS, devices)
    run_stage(stage, lambda: fresh_states(stage), mesh=mesh, chunk=1)


if __name__ == "__main__":
    layout = json.loads(sys.argv[1])
    parallel.use_cpu_devices(layout["devices"])
    # Each layout is compiled once, however often a stage begins or goes on with it.
    jax.config.update("jax_compilation_cache_dir", layout["cache"])
    if layout.get("hosts", 1) > 1:
        hosts.connect(layout["hosts"], layout["host"], layout["coordinator"])
    with hosts.leading():
        for chosen in layout["stages"]:
            train(*chosen)
        hosts.first_does(lambda: None)  # no host leaves before the last file is written
