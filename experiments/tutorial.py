"""From an empty grid to a team that was trained, carried to a larger grid and can be watched.

Run it whole, `python experiments/tutorial.py`, or cell by cell in an editor that knows `# %%`
(Jupyter, VS Code). It takes some two minutes on two CPU cores, and each run writes to a directory
of its own under `runs/`. What a cell prints stands below it, as it came out once; on another
machine the last digits differ.
"""

# %% [markdown]
# ## 1. An environment is a frozen description and two pure functions
#
# Three predators search a 5x5 grid for a prey that does not move. Each sees one cell around itself,
# knows its own cell, and is told nothing else.

# %%
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from sumajax import (
    PredatorPrey,
    StateUpsampled,
    evaluate,
    load_agent,
    make_learner,
    make_policy,
    preset,
)
from sumajax.environments.types import Environment
from sumajax.evaluation import evaluate_random, shortest_path_steps
from sumajax.learning.scaling import for_stage
from sumajax.reporting import learning_curves, record_episode, rows_of, write_gif, write_strip
from sumajax.transfer import Chunk, StageRun, fresh_states, run_stage, transferred_states

OUTPUT = Path("runs") / time.strftime("tutorial-%Y%m%d-%H%M%S")
OUTPUT.mkdir(parents=True)

small = PredatorPrey(size=5, num_predators=3, vision=1, max_steps=80)
state = small.reset(jax.random.key(0))
print("predators at", state.agents.tolist(), "prey at", state.prey.tolist())

stay = jnp.full(3, 4)  # 0 up, 1 right, 2 down, 3 left, 4 stay
state, transition = small.step(state, stay)
print("reward of a step:", [round(r, 2) for r in transition.reward.tolist()])

# predators at [[4, 3], [4, 4], [1, 4]] prey at [2, 3]
# reward of a step: [-0.05, -0.05, -0.05]      (each step costs an agent that has not arrived)

# %% [markdown]
# ## 2. Upsampling changes one tensor
#
# The state tensor of an agent is its own cell on the grid. Upsampled to 10x10 each cell becomes a
# 2x2 block, so a policy that reads 10x10 can be trained on the small task. Views, actions, rewards
# and ends stay as they are.

# %%
source = StateUpsampled(small, size=10)
target = PredatorPrey(size=10, num_predators=5, vision=1, max_steps=200)
print("native", small.observe(state).state.shape, "upsampled", source.observe(state).state.shape)
print(source.observe(state).state[0, 0].astype(int))

# native (3, 1, 5, 5) upsampled (3, 1, 10, 10)
# [[0 0 0 0 0 0 0 0 0 0]                       (the first predator's cell: row 4, column 3)
#  ..
#  [0 0 0 0 0 0 1 1 0 0]
#  [0 0 0 0 0 0 1 1 0 0]]

# %% [markdown]
# ## 3. Train on the small task
#
# A stage is a learner, a number of epochs (20,000 environment steps each), seeds and a directory.
# Five epochs at a time are one compiled call, followed by a checkpoint.

# %%
EPOCHS = 15
rows: list[dict] = []


def stage_of(arm: str, env: Environment) -> StageRun:
    """IC3Net on `env` with the settings of the preset `fast`, as an experiment would train it."""
    settings = for_stage(preset("fast"), env, EPOCHS, transferred=arm == "transfer")
    learner = make_learner(env, make_policy("ic3net", env), settings)
    return StageRun(arm, learner, EPOCHS, seeds=(0,), directory=OUTPUT / "checkpoints" / arm)


def follow(stage: StageRun) -> Callable[[Chunk], None]:
    """Prints the last epoch of each chunk and keeps all of them for the curves."""

    def on_chunk(chunk: Chunk) -> None:
        metrics, epochs = chunk.metrics, np.arange(chunk.first_epoch, chunk.epoch) + 1
        values = {"env_steps": 20_000 * epochs, "steps_taken": metrics.steps_taken}
        rows.extend(rows_of(stage.arm, stage.seeds, chunk.first_epoch + 1, values))
        last = f"{metrics.steps_taken[0, -1]:5.1f} steps, success {metrics.success[0, -1]:.2f}"
        print(f"{stage.arm:8} epoch {chunk.epoch:2}: {last}, {chunk.seconds:.0f} s")

    return on_chunk


source_stage = stage_of("source", source)
trained = run_stage(source_stage, lambda: fresh_states(source_stage), on_chunk=follow(source_stage))

# source   epoch  5:  33.6 steps, success 0.85, 3 s
# source   epoch 10:   7.6 steps, success 1.00, 3 s
# source   epoch 15:   6.4 steps, success 1.00, 3 s

# %% [markdown]
# ## 4. Carry it over, and train from scratch beside it
#
# Parameters do not know how many agents there are or how large the grid is; they are read back from
# the checkpoint, compared with the new task, and trained on.

# %%
transfer_stage, scratch_stage = stage_of("transfer", target), stage_of("scratch", target)
start = transferred_states(transfer_stage, source_stage.directory)
untrained = jax.tree.map(lambda leaf: leaf[0], start.params)  # seed 0, before any training there
run_stage(transfer_stage, lambda: start, on_chunk=follow(transfer_stage))
rival = run_stage(
    scratch_stage, lambda: fresh_states(scratch_stage), on_chunk=follow(scratch_stage)
)

# transfer epoch  5:  89.0 steps, success 0.74, 5 s     (the critic alone learns at first)
# transfer epoch 10:  31.3 steps, success 0.99, 5 s
# transfer epoch 15:  20.7 steps, success 1.00, 5 s
# scratch  epoch  5: 194.1 steps, success 0.08, 5 s
# scratch  epoch 10: 192.0 steps, success 0.12, 5 s
# scratch  epoch 15: 173.3 steps, success 0.30, 5 s

# %% [markdown]
# ## 5. Judge it on held-out starts
#
# The same 1,024 starts for everybody, with a random team and the shortest paths as the two ends of
# the scale.

# %%
agent = load_agent(OUTPUT / "checkpoints" / "transfer")
scratch = load_agent(OUTPUT / "checkpoints" / "scratch")
key = jax.random.key(0)
teams = {
    "zero shot": evaluate(target, agent.policy, untrained, key),
    "transferred": evaluate(target, agent.policy, agent.params, key),
    "from scratch": evaluate(target, scratch.policy, scratch.params, key),
    "random": evaluate_random(target, agent.policy, key),
}
for name, result in teams.items():
    print(f"{name:13}{result.steps_taken.mean():7.1f} steps, success {result.success.mean():.3f}")
bound = shortest_path_steps(target)
assert bound is not None  # a task need not offer one; these do
print(f"{'shortest':13}{bound.mean():7.1f} steps")

# zero shot       85.0 steps, success 0.713
# transferred     21.4 steps, success 1.000
# from scratch   167.5 steps, success 0.432
# random         198.9 steps, success 0.021
# shortest        10.5 steps

# %% [markdown]
# ## 6. Look at it
#
# Curves of both arms over environment steps, and an episode: who sees what, who talks, who arrives.

# %%
learning_curves(rows, OUTPUT / "curves.png", x="env_steps", after={"transfer": ["source"]})
episode = record_episode(target, agent.policy, agent.params, jax.random.key(3))
write_gif(episode, OUTPUT / "replay.gif")
write_strip(episode, OUTPUT / "replay.png")
print(f"an episode of {episode.num_steps} steps is in {OUTPUT / 'replay.gif'}")


class Picture:
    """A file that a notebook shows below the cell."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def _repr_png_(self) -> bytes:
        return self.file.read_bytes()


# an episode of 21 steps is in runs/tutorial-20261126-130638/replay.gif

# %%
Picture(OUTPUT / "curves.png")

# %%
Picture(OUTPUT / "replay.png")

# %% [markdown]
# ## 7. Let it act in a program of your own
#
# `act` is pure: batch it, jit it, put it inside a larger program.

# %%
states = jax.vmap(target.reset)(jax.random.split(jax.random.key(1), 8))
carry, action = jax.jit(agent.act)(
    agent.initial_carry((8,)), jax.vmap(target.observe)(states), jax.random.key(2)
)
print("actions of 8 teams of 5:", action.shape)

# actions of 8 teams of 5: (8, 5)
