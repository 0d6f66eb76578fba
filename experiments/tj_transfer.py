"""Traffic Junction: from easy 7x7 with 5 cars to medium 14x14 with 10, by state upsampling.

python experiments/tj_transfer.py
python experiments/tj_transfer.py --policy magic --seeds 0 1 2 --upsampling corner
python experiments/tj_transfer.py --difficulties hard hard --sizes 9 18

The same as `sumajax transfer tj`.
"""

from sumajax.cli.transfer import main

if __name__ == "__main__":
    main("tj")
