"""Writes ci/requirements.txt and docs/licences.md from what is installed here.

    python ci/lock.py

The first holds the exact versions of everything `.[dev,docs]` pulls in; pip takes it as a
constraint, so CI builds what was tested. The second lists the licence that each of them declares.
"""

import tomllib
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PACKAGE, EXTRAS = "sumajax", ("dev", "docs")
UNSAFE = ("pip", "setuptools", "wheel")
"""Of the environment itself."""


def closure(name: str, extras: tuple[str, ...] = ()) -> dict[str, Distribution]:
    """Every installed package that `name` needs, by canonical name."""
    found: dict[str, Distribution] = {}
    waiting = [(name, extras)]
    seen = set()
    while waiting:
        name, extras = waiting.pop()
        key = canonicalize_name(name), frozenset(extras)
        if key in seen:
            continue
        seen.add(key)
        if name == PACKAGE:
            needs = own_requirements(extras)
        else:
            found[key[0]] = package = distribution(name)
            needs = [Requirement(line) for line in package.requires or ()]
        for needed in needs:
            marker = needed.marker
            if marker is None or any(marker.evaluate({"extra": e}) for e in ("", *extras)):
                waiting.append((needed.name, tuple(needed.extras)))
    return found


def own_requirements(extras: tuple[str, ...]) -> list[Requirement]:
    """Of pyproject.toml as it is now, whatever an earlier installation has noted."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [*project["dependencies"]]
    for extra in extras:
        lines += project["optional-dependencies"][extra]
    return [Requirement(line) for line in lines]


def licence(package: Distribution) -> str:
    """What a package says of itself: an expression, a trove classifier or the first line."""
    said = package.metadata
    if expression := said.get("License-Expression"):
        return expression
    classified = [c.split(" :: ")[-1] for c in said.get_all("Classifier") or () if "License" in c]
    text = (said.get("License") or "").strip()
    if text and "\n" not in text and len(text) < 60:
        return text
    return ", ".join(sorted(set(classified))) or "see its files"


def main() -> None:
    packages = closure(PACKAGE, EXTRAS)
    packages = {k: p for k, p in sorted(packages.items()) if k not in UNSAFE}
    lock = [f"{name}=={package.version}" for name, package in packages.items()]
    head = "# Exact versions that CI installs; made by ci/lock.py.\n"
    (ROOT / "ci" / "requirements.txt").write_text(head + "\n".join(lock) + "\n")
    rows = [f"| {name} | {p.version} | {licence(p)} |" for name, p in packages.items()]
    text = (
        "# Licences of what is installed with sumajax\n\n"
        "Everything that `pip install '.[dev,docs]'` brings, in the versions of\n"
        "`ci/requirements.txt`, with the licence that each declares; made by `python ci/lock.py`.\n"
        "None is contained in this repository, which is under the MIT licence.\n\n"
        "| package | version | licence |\n|---|---|---|\n"
    )
    (ROOT / "docs" / "licences.md").write_text(text + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
