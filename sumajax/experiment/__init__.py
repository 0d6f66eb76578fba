"""Experiments: a plan of stages, its run, its directory and what it leaves there."""

from sumajax.experiment.plan import Experiment, Stage, chain
from sumajax.experiment.run import run_experiment

__all__ = ["Experiment", "Stage", "chain", "run_experiment"]
