"""The benchmarks are programs, not a package: their own folder is on their path."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
