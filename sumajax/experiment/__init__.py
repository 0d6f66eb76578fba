"""Experiments: a plan of stages, its run, its directory and what it leaves there."""

from sumajax.experiment.plan import Experiment, Stage, chain
from sumajax.experiment.run import run_experiment
from sumajax.experiment.stillness import Still

__all__ = ["Experiment", "Stage", "Still", "chain", "run_experiment"]
