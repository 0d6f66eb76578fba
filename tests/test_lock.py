"""The lock file of CI and the list of licences belong to the dependencies of pyproject.toml."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def locked():
    """Versions by name."""
    lines = (ROOT / "ci" / "requirements.txt").read_text().splitlines()
    return dict(line.split("==") for line in lines if not line.startswith("#"))


def required():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = [*project["dependencies"]]
    for extra in ("experiments", "export", "dev", "docs"):
        lines += extras[extra]
    return [needed for needed in map(Requirement, lines) if needed.name != "sumajax"]


def test_every_dependency_is_locked_at_a_version_it_allows(locked):
    for needed in required():
        assert needed.specifier.contains(locked[canonicalize_name(needed.name)]), needed


def test_every_licence_is_listed(locked):
    rows = re.findall(r"^\| ([\w.-]+) \| (\d[\w.]*) \| (.+) \|$", licences(), re.MULTILINE)
    assert {name: version for name, version, _ in rows} == locked
    assert not [row for row in rows if row[2] == "see its files"]


def licences():
    return (ROOT / "docs" / "licences.md").read_text()


def test_ci_uses_the_lock():
    assert 'PIP_CONSTRAINT="$PWD/ci/requirements.txt"' in (ROOT / ".ci" / "run").read_text()
