"""Where state upsampling has to work: 20x20, 40x40, Predator-Capture-Prey and rectangular grids.

python experiments/scale.py --parts pp20 pp40 --seeds 0 1 2
python experiments/scale.py --parts rivals --policies hetnet --seeds 0
python experiments/scale.py --rebuild                 # tables and figures alone

Chains of stages against training from scratch, direct transfer and simpler rivals, the cost of the
sources counted. Stop it when you like; the same command goes on, and what is finished is not run
again. What is run for how long is in `scaling/plans.py`.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # the clone: `scaling` is a package of it

from experiments.scaling.program import main

if __name__ == "__main__":
    main()
