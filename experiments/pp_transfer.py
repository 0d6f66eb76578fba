"""Predator-Prey: from 5x5 with 3 predators to 10x10 with 5, by state upsampling (paper section V).

python experiments/pp_transfer.py
python experiments/pp_transfer.py --policy commnet --seeds 0 1 2 --output runs/mine
"""

from dataclasses import dataclass
from typing import ClassVar

from sumajax.cli.command_line import main
from sumajax.cli.transfer_config import TransferConfig
from sumajax.environments import PredatorPrey


@dataclass(frozen=True)
class PPTransfer(TransferConfig):
    """Predator-Prey: pre-train on a small grid with upsampled state, transfer to a large one, and
    compare with training there from scratch.
    """

    experiment: ClassVar[str] = "pp_transfer"

    source: PredatorPrey = PredatorPrey(size=5, num_predators=3, vision=1, max_steps=80)
    """The small task, whose state is upsampled to the target's size."""
    target: PredatorPrey = PredatorPrey(size=10, num_predators=5, vision=1, max_steps=200)
    """The large task."""


if __name__ == "__main__":
    main(PPTransfer)
