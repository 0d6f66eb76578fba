"""What every experiment's command line shares: options, devices, and errors in one sentence."""

import argparse
import contextlib
import dataclasses
import inspect
import io
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import jax
import tyro

from sumajax import hosts
from sumajax.cli.config_file import NOTE, with_config_file
from sumajax.cli.transfer_config import TransferConfig
from sumajax.experiment.run import run_experiment
from sumajax.learning import parallel, preset

CACHE = Path.home() / ".cache" / "sumajax" / "compiled"
"""Compiled programs; SUMAJAX_NO_CACHE=1 turns it off, JAX_COMPILATION_CACHE_DIR moves it."""

STOPPED = 3
"""Exit status of a run that ended, but in which a seed stopped on the way."""

Options = TypeVar("Options")
GOES_ON = "stopped; the same command goes on from the last checkpoint."


def main(experiment: type[TransferConfig]) -> None:
    """Reads the options of a transfer experiment and runs it."""
    with plain_errors():
        arguments = with_config_file(experiment, sys.argv[1:])
        chosen = _presets(experiment, arguments)
        # The subclass gives both tasks a default.
        default = experiment(learner=preset(chosen.preset, chosen.policy))  # type: ignore[call-arg]
        config = parse(experiment, default, arguments, NOTE)
        prepare_jax(config.num_devices)
        if config.coordinator is not None:
            hosts.connect(config.hosts, config.host, config.coordinator)
        if run_experiment(config).get("stops"):
            raise SystemExit(STOPPED)


@contextlib.contextmanager
def plain_errors(stopped: str = GOES_ON) -> Iterator[None]:
    """What a person can get wrong becomes one sentence on standard error and exit status 2.

    Args:
      stopped: what Ctrl-C says.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        if os.environ.get("SUMAJAX_TRACEBACK"):
            raise
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print(stopped, file=sys.stderr)
        raise SystemExit(130) from None


def prepare_jax(devices: int) -> None:
    """One CPU device per core, and compiled programs kept for the next time."""
    parallel.use_cpu_devices(devices)
    elsewhere = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if not os.environ.get("SUMAJAX_NO_CACHE") and not elsewhere:
        jax.config.update("jax_compilation_cache_dir", str(CACHE))


def parse(
    options: type[Options], default: Options, arguments: list[str] | None = None, note: str = ""
) -> Options:
    """The command line as `options`; a mistake, which the parser draws in a box, is one sentence.

    Args:
      arguments: None takes those of the program.
      note: added to what `--help` says first.

    Raises:
      ValueError: for what is no such option or value.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                options,
                args=arguments,
                default=default,
                description=f"{inspect.getdoc(options)}\n\n{note}".strip(),
                registry=_REGISTRY,
            )
    except SystemExit as stop:
        if stop.code:
            raise ValueError(_sentence(said.getvalue())) from None
        raise


_REGISTRY = tyro.constructors.ConstructorRegistry()


@_REGISTRY.struct_rule
def _documented_fields(info: Any) -> tyro.constructors.StructConstructorSpec | None:
    """Options of a configuration with an "Attributes" section: the fields that may be set.

    Left alone, the parser also takes, and then ignores, what is fixed (`init=False`).
    """
    cls = info.type
    explained = _attributes(cls) if isinstance(cls, type) else {}
    if not explained:
        return None
    hints = get_type_hints(cls)
    given = info.default if isinstance(info.default, cls) else cls()
    options = tuple(
        tyro.constructors.StructFieldSpec(
            name=option.name,
            type=hints[option.name],
            default=getattr(given, option.name),
            helptext=explained.get(option.name),
        )
        for option in dataclasses.fields(cls)
        if option.init
    )
    return tyro.constructors.StructConstructorSpec(instantiate=cls, fields=options)


def _attributes(cls: type) -> dict[str, str]:
    """What the docstring of a class, or of the one it derives from, says of each attribute."""
    docs = [inspect.cleandoc(base.__doc__ or "") for base in cls.__mro__]
    section = next((doc.split("Attributes:\n")[1] for doc in docs if "Attributes:\n" in doc), "")
    entries = re.findall(
        r"^  (\w[\w, ]*): (.*(?:\n    .*)*)", section.split("\n\n")[0], re.MULTILINE
    )
    return {name: " ".join(text.split()) for names, text in entries for name in names.split(", ")}


_KINDS = {
    "INT": "a whole number",
    "FLOAT": "a number",
    "[INT [INT ...]]": "whole numbers",
    "INT|{INT INT}": "one whole number or two",
    "{None}|INT": "a whole number or None",
    "{None}|FLOAT": "a number or None",
}


def _sentence(box: str) -> str:
    """What a box of the parser says, without its frame and advice that belongs to a screen."""
    lines = [line.strip("│╭╮╰╯─| ") for line in box.splitlines()]
    lines = [line for line in lines if not re.fullmatch("[-+]*", line)][1:]
    text = re.split(" ?For full helptext| ?Argument helptext", " ".join(lines))[0].strip()
    if text.startswith("Unrecognized options"):
        unknown = re.split(" Perhaps you meant| Arguments similar", text)[0]
        return f"{unknown}; --help lists all there are."
    value = re.search(r"(?:from|arguments:|base 10:|float:) (\[.*?\]|'.*?')", text)
    if value and "Argument helptext:" in lines:
        option, kind = lines[lines.index("Argument helptext:") + 1].split(" ", 1)
        given = value[1].strip("[]").replace("'", "").replace(",", "")
        return f"{option} takes {_KINDS.get(kind, kind)}, got {given}."
    # Both tasks have the same settings: say whose.
    text = re.sub("^Error parsing (source|target): ", r"\1: ", text)
    return re.sub(r"^Error parsing [\w.-]+: ", "", text)


def _presets(experiment: type[TransferConfig], arguments: list[str]) -> argparse.Namespace:
    """Preset and policy alone: they decide the defaults of the learner's options."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("preset", "policy"):
        parser.add_argument(f"--{name}", default=getattr(experiment, name))
    with contextlib.suppress(argparse.ArgumentError):
        return parser.parse_known_args(arguments)[0]
    return parser.parse_args([])
