"""What every experiment's command line shares: options, devices, and errors in one sentence."""

import argparse
import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import tyro
from transfer_run import TransferConfig, run_experiment

from sumajax.learning import parallel, preset

CACHE = Path.home() / ".cache" / "sumajax" / "compiled"
"""Compiled programs; SUMAJAX_NO_CACHE=1 turns it off, JAX_COMPILATION_CACHE_DIR moves it."""


def main(experiment: type[TransferConfig]) -> None:
    """Reads the options of a transfer experiment and runs it."""
    with plain_errors():
        chosen = _presets(experiment, sys.argv[1:])
        # The subclass gives both tasks a default.
        default = experiment(learner=preset(chosen.preset, chosen.policy))  # type: ignore[call-arg]
        config = _parse(experiment, default)
        prepare_jax(config.devices)
        run_experiment(config)


@contextlib.contextmanager
def plain_errors() -> Iterator[None]:
    """What a person can get wrong becomes one sentence on standard error and exit status 2."""
    try:
        yield
    except (ValueError, OSError) as error:
        if os.environ.get("SUMAJAX_TRACEBACK"):
            raise
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("stopped; the same command goes on from the last checkpoint.", file=sys.stderr)
        raise SystemExit(130) from None


def prepare_jax(devices: int) -> None:
    """One CPU device per core, and compiled programs kept for the next time."""
    parallel.use_cpu_devices(devices)
    elsewhere = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if not os.environ.get("SUMAJAX_NO_CACHE") and not elsewhere:
        jax.config.update("jax_compilation_cache_dir", str(CACHE))


def _parse(experiment: type[TransferConfig], default: TransferConfig) -> TransferConfig:
    """The options; what the parser draws in a box for a mistake comes out as one sentence."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(experiment, default=default)
    except SystemExit as stop:
        if stop.code:
            # A title, then the text; the frame around them depends on the terminal's encoding.
            lines = [line.strip("│╭╮╰╯─- ") for line in said.getvalue().splitlines()]
            sentence = " ".join([line for line in lines if line][1:])
            sentence = re.split("For full helptext|Argument helptext", sentence)[0].strip()
            raise ValueError(re.sub(r"^Error parsing [\w.-]+: ", "", sentence)) from None
        raise


def _presets(experiment: type[TransferConfig], arguments: list[str]) -> argparse.Namespace:
    """Preset and policy alone: they decide the defaults of the learner's options."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("preset", "policy"):
        parser.add_argument(f"--{name}", default=getattr(experiment, name))
    with contextlib.suppress(argparse.ArgumentError):
        return parser.parse_known_args(arguments)[0]
    return parser.parse_args([])
