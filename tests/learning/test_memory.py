"""Training holds on to nothing: resident memory over ten thousand updates."""

import os
from pathlib import Path

import jax
import pytest
from trajectories import tiny_learner

UPDATES = 10_000
MOST = 16
"""Megabytes; ten thousand states of this learner would be more than a hundred."""


def resident_megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads Linux's /proc")
def test_memory_over_ten_thousand_updates(capsys):
    """One call of a compiled update for each, as a program of one's own may do it."""
    learner = tiny_learner(policy="ic3net", num_envs=2, rollout_length=10)
    update, state = jax.jit(learner.update), jax.jit(learner.init)(jax.random.key(0))
    seen = []
    for _ in range(10):
        for _ in range(UPDATES // 10):
            state, tally = update(state)
        assert int(tally.updates) == 1
        seen.append(resident_megabytes())
    with capsys.disabled():
        print(f"\nresident MB after each {UPDATES // 10} updates: {[round(mb, 1) for mb in seen]}")
    assert int(state.updates) == UPDATES
    assert seen[-1] - seen[0] < MOST
