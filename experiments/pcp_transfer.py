"""Predator-Capture-Prey: from 5x5 to 10x10 by state upsampling (paper section V).

python experiments/pcp_transfer.py                       # 2 predators, 1 capture agent -> 3, 2
python experiments/pcp_transfer.py --target.num-predators 2 --target.num-capturers 1

The same as `sumajax transfer pcp`.
"""

from sumajax.cli.transfer import main

if __name__ == "__main__":
    main("pcp")
