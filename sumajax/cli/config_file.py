"""Options from the config.json that a run leaves, so that the run can be repeated from it.

The file becomes arguments of the command line, ahead of those that were given: the parser checks
both alike, and what is given by hand comes on top.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from sumajax import store

MAX_BYTES = 2**20
NOTE = (
    "--config FILE takes the options from the config.json of a run (all but where it was written); "
    "options beside it come on top."
)


def with_config_file(experiment: type, arguments: list[str]) -> list[str]:
    """`arguments` with those of `--config FILE` in its place, ahead of the others.

    Raises:
      ValueError: for a file that is not of a run, or of a run of another experiment.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--config", type=Path)
    try:
        chosen, rest = parser.parse_known_args(arguments)
    except argparse.ArgumentError:
        raise ValueError("config takes one file, the config.json of a run.") from None
    if chosen.config is None:
        return rest
    options = _read(chosen.config)
    options.pop("output", None)
    if options.get("source_checkpoint"):
        options["source_checkpoint"] = _beside(chosen.config, options["source_checkpoint"])
    return [*_arguments(options, experiment, chosen.config), *rest]


def _beside(file: Path, path: str) -> str:
    """A relative path in a file is one beside it; files of earlier versions meant the working
    directory. The name of a policy of the package is no path."""
    if store.is_named(path):
        return path
    beside = file.parent / path
    return str(beside if beside.exists() or not Path(path).exists() else path)


def _read(file: Path) -> dict[str, Any]:
    try:
        with open(file, "rb") as opened:
            text = opened.read(MAX_BYTES + 1)
        content = json.loads(text) if len(text) <= MAX_BYTES else {}
        options: Any = content["options"]
    except OSError as error:
        raise ValueError(f"{file} cannot be read ({error.strerror}).") from None
    except (ValueError, KeyError, TypeError, RecursionError):
        content, options = {}, None
    if not isinstance(options, dict):
        raise ValueError(f"{file} is no config.json of a run.")
    return _renewed(options) if "experiment" not in content else options


def _renewed(options: dict[str, Any]) -> dict[str, Any]:
    """Options of a run from before there was a plan: preset `fast` annealed over every stage."""
    learner = options.get("learner")
    if options.get("preset") == "fast" and isinstance(learner, dict):
        learner = {k: v for k, v in learner.items() if (k, v) != ("anneal_epochs", 0)}
        return {**options, "learner": learner}
    return options


def _arguments(options: dict[str, Any], cls: type, file: Path, prefix: str = "") -> Iterator[str]:
    """The options of `cls` as arguments; those its class fixes must have the fixed value."""
    types = get_type_hints(cls)
    fixed = {field.name: field.default for field in fields(cls) if not field.init}
    for name, value in options.items():
        if name in fixed:
            if value != fixed[name]:
                raise ValueError(
                    f"{file} has {prefix}{name} {value}, which is always {fixed[name]} in this "
                    "experiment; use the program that wrote it."
                )
            continue
        inner = types.get(name)
        if isinstance(value, dict) and isinstance(inner, type) and is_dataclass(inner):
            yield from _arguments(value, inner, file, f"{prefix}{name}.")
        elif isinstance(value, dict):
            for setting, given in value.items():
                yield from _option(f"{prefix}{name}.{setting}", given)
        else:
            yield from _option(f"{prefix}{name}", value)


def _option(name: str, value: Any) -> Iterator[str]:
    """One option as arguments."""
    option = f"--{name}".replace("_", "-")
    if isinstance(value, bool):
        *above, last = option.removeprefix("--").split(".")
        yield option if value else "--" + ".".join([*above, f"no-{last}"])
    else:
        yield option
        yield from map(str, value if isinstance(value, list) else [value])
