"""What every command shares: options from dataclasses, devices, errors in one sentence."""

import argparse
import contextlib
import dataclasses
import inspect
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import jax
import tyro

from sumajax.reporting.output import unfailing_output

Options = TypeVar("Options")
GOES_ON = "stopped; the same command goes on from the last checkpoint."
CACHE = Path(".cache") / "sumajax" / "compiled"
"""Compiled programs, below the home directory; SUMAJAX_NO_CACHE=1 turns it off,
JAX_COMPILATION_CACHE_DIR moves it."""


@contextlib.contextmanager
def plain_errors(stopped: str = GOES_ON) -> Iterator[None]:
    """What a person can get wrong becomes one sentence on standard error and exit status 2.

    Args:
      stopped: what Ctrl-C says.
    """
    with unfailing_output():
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


def keep_compiled() -> None:
    """Keeps compiled programs for the next time; says so where that cannot be."""
    if os.environ.get("SUMAJAX_NO_CACHE") or os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    try:
        cache = Path.home() / CACHE
        cache.mkdir(parents=True, exist_ok=True)
        if not os.access(cache, os.W_OK):
            raise PermissionError(f"{cache} cannot be written")
    except (RuntimeError, OSError) as error:  # no home directory, or one that is not ours
        print(f"compiled programs are not kept ({error}).", file=sys.stderr)
        return
    jax.config.update("jax_compilation_cache_dir", str(cache))


def parse(
    options: type[Options],
    default: Options,
    arguments: list[str] | None = None,
    note: str = "",
    prog: str | None = None,
) -> Options:
    """The command line as `options`; a mistake is the parser's own text, and exit status 2.

    Args:
      arguments: None takes those of the program.
      note: added to what `--help` says first.
      prog: what the program is called there.
    """
    return tyro.cli(
        options,
        prog=prog,
        args=arguments,
        default=default,
        description=f"{inspect.getdoc(options)}\n\n{note}".strip(),
        registry=_REGISTRY,
    )


def chosen_preset(arguments: list[str], policy: str) -> tuple[str, str]:
    """Preset and policy alone: they decide the defaults of the learner's and policy's options."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--policy", default=policy)
    with contextlib.suppress(argparse.ArgumentError):
        chosen = parser.parse_known_args(arguments)[0]
        return chosen.preset, chosen.policy
    return "fast", policy


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
