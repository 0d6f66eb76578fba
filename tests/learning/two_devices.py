"""Trains the same thing on one device and on two, in a process that has two; prints differences.

Run by test_parallel.py, since the number of devices is fixed when JAX is first used.
"""

import json

import jax
import numpy as np
from beginnings import begun_seeds
from trajectories import TINY_TASK, tiny_learner

from sumajax.learning import parallel

SEEDS = [0, 1]


def trained(learner, seeds, devices):
    """Parameters and figures after an epoch, and a critic's parameters."""
    mesh = parallel.make_mesh(len(seeds), learner.config.num_envs, devices)
    states = parallel.place(begun_seeds(learner, seeds), mesh)
    train = parallel.compile_train(learner, mesh, 1, states)
    states, metrics = train(states)
    found = {"policy": (states.params, metrics), "critic": states.critic.params}
    return jax.tree.map(np.asarray, found), dict(mesh.shape)


def difference(a, b):
    """The largest of all leaves, relative to 1 or to the number itself."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(float((np.abs(x - y) / np.maximum(np.abs(x), 1)).max()) for x, y in pairs)


def compare():
    """With a critic of its own; that of a policy over devices: test_hosts.py."""
    settings = {"num_envs": 200, "rollout_length": 20, "advantages": "normalised"}
    learner = tiny_learner(TINY_TASK, critic="state", **settings)
    together, _ = trained(learner, SEEDS, 1)
    over_seeds, seeds_mesh = trained(learner, SEEDS, 2)
    over_envs, envs_mesh = trained(learner, SEEDS[:1], 2)
    first, second = (jax.tree.map(lambda x, s=s: x[s : s + 1], together) for s in (0, 1))
    return {
        "own_critic": difference(first["critic"], over_envs["critic"]),
        "devices": jax.device_count(),
        "seeds_mesh": seeds_mesh,
        "over_seeds": difference(together, over_seeds),
        "envs_mesh": envs_mesh,
        "over_envs": difference(first, over_envs),
        "between_seeds": difference(first, second),
    }


parallel.use_cpu_devices(2)
print(json.dumps(compare()))
