"""Trains the same thing on one device and on two, in a process that has two; prints differences.

Run by test_parallel.py, since the number of devices is fixed when JAX is first used.
"""

import json

import jax
import numpy as np
from trajectories import TINY_TASK, tiny_learner

from sumajax.learning import parallel

SEEDS = [0, 1]


def trained(learner, seeds, devices):
    """Figures and parameters after an epoch, a critic's of its own too."""
    mesh = parallel.make_mesh(len(seeds), learner.config.num_envs, devices)
    states = parallel.place(parallel.init_seeds(learner, seeds), mesh)
    train = parallel.compile_train(learner, mesh, 1, states)
    states, metrics = train(states)
    critic = states.critic and states.critic.params
    return jax.tree.map(np.asarray, (states.params, critic, metrics)), dict(mesh.shape)


def difference(a, b):
    """The largest of all leaves, relative to 1 or to the number itself."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(float((np.abs(x - y) / np.maximum(np.abs(x), 1)).max()) for x, y in pairs)


def compare():
    learner = tiny_learner(TINY_TASK, num_envs=200, rollout_length=20, advantages="normalised")
    together, _ = trained(learner, SEEDS, 1)
    over_seeds, seeds_mesh = trained(learner, SEEDS, 2)
    over_envs, envs_mesh = trained(learner, SEEDS[:1], 2)
    first, second = (jax.tree.map(lambda x, s=s: x[s : s + 1], together) for s in (0, 1))
    judged = tiny_learner(TINY_TASK, num_envs=200, rollout_length=20, critic="state")
    alone, shared = (trained(judged, SEEDS[:1], devices)[0] for devices in (1, 2))
    return {
        "own_critic": difference(alone, shared),
        "devices": jax.device_count(),
        "seeds_mesh": seeds_mesh,
        "over_seeds": difference(together, over_seeds),
        "envs_mesh": envs_mesh,
        "over_envs": difference(first, over_envs),
        "between_seeds": difference(first, second),
    }


parallel.use_cpu_devices(2)
print(json.dumps(compare()))
