"""`sumajax marl-eval RUN...`: results of runs in the JSON form of marl-eval."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from sumajax.cli.options import parse, plain_errors
from sumajax.experiment.marl_eval import marl_eval
from sumajax.reporting.metrics import write_json


@dataclass(frozen=True)
class MarlEvalConfig:
    """Writes the held-out results of finished runs, all stages and seeds, as the JSON that
    marl-eval reads for intervals over seeds, sample-efficiency curves and performance profiles.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Directories of finished runs."""
    output: Path = Path("marl-eval.json")
    """File to write; must not be there yet."""


def main(arguments: list[str] | None = None) -> None:
    """Reads the options and writes the file."""
    with plain_errors("stopped; no file was written."):
        default = MarlEvalConfig(runs=tyro.MISSING)
        config = parse(MarlEvalConfig, default, arguments, prog="sumajax marl-eval")
        if not config.runs:
            raise ValueError("marl-eval needs at least one directory of a run.")
        if config.output.exists():
            raise ValueError(
                f"{config.output} exists; choose another --output, nothing is overwritten."
            )
        write_json(config.output, marl_eval(config.runs))
        print(f"{config.output}: {len(config.runs)} runs.")
