"""Predator-Prey: from 5x5 with 3 predators to 10x10 with 5, by state upsampling (paper section V).

python experiments/pp_transfer.py
python experiments/pp_transfer.py --policy commnet --seeds 0 1 2 --output runs/mine
python experiments/pp_transfer.py --sizes 5 10 20 --teams 3 5 10 --epochs 50 60 30

The same as `sumajax transfer pp`.
"""

from sumajax.cli.transfer import main

if __name__ == "__main__":
    main("pp")
