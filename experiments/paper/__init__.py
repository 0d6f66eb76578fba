"""The paper's evidence in one command, run from the clone: `python -m experiments.paper`."""
