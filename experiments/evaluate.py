"""Plays trained policies on held-out starts; `sumajax evaluate` is the same.

python experiments/evaluate.py runs/pp_transfer-ic3net-fast --sizes 10 20 --teams 5 10
"""

from sumajax.cli.evaluate import main

if __name__ == "__main__":
    main()
