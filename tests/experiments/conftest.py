"""The experiments are programs, not a package: their folder is what `python experiments/x.py` sees."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))
