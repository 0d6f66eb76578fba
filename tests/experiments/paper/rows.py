"""Rows of curves.csv, by hand, and where the kept ones are."""

from pathlib import Path

RESULTS = Path(__file__).parents[3] / "experiments" / "results"


def curve(experiment, arm, seed, steps, preset="paper"):
    """Rows of one seed: an epoch of 20,000 environment steps and 2 s for each of `steps`."""
    return [
        {
            "experiment": experiment,
            "arm": arm,
            "preset": preset,
            "seed": seed,
            "epoch": epoch,
            "env_steps": 20_000 * epoch,
            "seconds": 2.0 * epoch,
            "seeds_at_once": 2,
            "steps_taken": float(taken),
            "success": 1.0,
        }
        for epoch, taken in enumerate(steps, start=1)
    ]


def arms(name, preset="paper", **steps):
    """Rows of whole arms: for each the (seeds, epochs) steps taken."""
    return [
        row
        for arm, seeds in steps.items()
        for seed, taken in enumerate(seeds)
        for row in curve(name, arm.replace("_", "-"), seed, taken, preset)
    ]
