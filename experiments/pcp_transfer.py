"""Predator-Capture-Prey: from 5x5 to 10x10 by state upsampling (paper section V).

python experiments/pcp_transfer.py                       # 2 predators, 1 capture agent -> 3, 2
python experiments/pcp_transfer.py --target.num-predators 2 --target.num-capturers 1
"""

from dataclasses import dataclass
from typing import ClassVar

from sumajax.cli.command_line import main
from sumajax.cli.transfer_config import TransferConfig
from sumajax.environments import PredatorCapturePrey


@dataclass(frozen=True)
class PCPTransfer(TransferConfig):
    """Predator-Capture-Prey: pre-train on a small grid with upsampled state, transfer to a large
    one, and compare with training there from scratch.
    """

    experiment: ClassVar[str] = "pcp_transfer"

    source: PredatorCapturePrey = PredatorCapturePrey(
        size=5, num_predators=2, num_capturers=1, max_steps=80
    )
    """The small task, whose state is upsampled to the target's size."""
    target: PredatorCapturePrey = PredatorCapturePrey(
        size=10, num_predators=3, num_capturers=2, max_steps=200
    )
    """The large task."""
    policy: str = "hetnet"


if __name__ == "__main__":
    main(PCPTransfer)
