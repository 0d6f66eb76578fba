"""The study of larger grids and teams behind `python experiments/scale.py`."""
