"""The pages in docs/: their code runs, in the order it stands, and their links lead somewhere."""

import json
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from sumajax.cli import main, transfer
from sumajax.reporting.loggers import FIGURES

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [*sorted(DOCS.rglob("*.md")), ROOT / "CONTRIBUTING.md"]
CODE = ("sumajax", "experiments", "benchmarks", "tests")
CITATION = re.compile(r"(?<!'s )\b(docs/(?:reference/)?\w+\.md)(?:, ([A-Z][^).:;]*))?")
"""Of a page of this repository, and of a section in it."""


def test_start(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "index.md").read_text(), re.DOTALL)
    shared: dict = {}
    exec(compile(code, "index.md", "exec"), shared)
    assert shared["metrics"].env_steps.tolist() == [20_000]
    assert shared["zero_shot"].steps_taken.shape == (128,)
    assert capsys.readouterr().out


def test_extending(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shared: dict = {}
    for code in re.findall(r"```python\n(.*?)```", (DOCS / "extending.md").read_text(), re.DOTALL):
        exec(compile(code, "extending.md", "exec"), shared)
    assert shared["metrics"].env_steps.tolist() == [20_000] * 10
    assert shared["result"].success.mean() > 0.9  # measured: 1.0, a random policy 0.12
    calm, slower = (shared[name].steps_taken.mean() for name in ("result", "slower"))
    assert calm < slower < 12  # measured: 3.2 and 3.6
    assert shared["metrics"].success[-1] > 0.9  # the memoryless policy's, in training: 1.0
    assert capsys.readouterr().out.count("steps taken") == 2
    assert shared["summary"]["transfer"]["env_steps"] == 40_000
    assert shared["agent"].env == shared["Line"](12, max_steps=24)


def test_sweeps(monkeypatch, tmp_path):
    """The trial that W&B would start: every parameter is an option of the command."""
    monkeypatch.chdir(tmp_path)
    (sweep,) = re.findall(r"```yaml\n(.*?)```", (DOCS / "sweeps.md").read_text(), re.DOTALL)
    sweep = yaml.safe_load(sweep)
    assert sweep["command"][:2] == ["bash", "-c"]
    command = shlex.split(sweep["command"][2])
    trial = {
        name: values.get("values", [values.get("min")])[-1]
        for name, values in sweep["parameters"].items()
    }
    given = [f"--{name}={value}" for name, value in trial.items()]
    planned = {}
    monkeypatch.setattr(
        transfer,
        "run_experiment",
        lambda *plan: planned.update(zip(("plan", "directory", "where"), plan, strict=True)) or {},
    )
    assert command[-1] == "$@"
    main([*command[1:-1], *given])
    plan, where = planned["plan"], planned["where"]
    assert plan.policy == trial["policy"]
    learner = plan.stages[0].learner
    assert learner.learning_rate == trial["learner.learning-rate"]
    assert learner.entropy_weight == trial["learner.entropy-weight"]
    assert where.log == ("wandb",)
    stage, _, column = sweep["metric"]["name"].split("/")
    assert stage in [stage.name for stage in plan.stages]
    assert column in FIGURES


def test_jaxmarl(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "jaxmarl.md").read_text(), re.DOTALL)
    exec(compile(code, "jaxmarl.md", "exec"), {})
    assert capsys.readouterr().out == "(43,) False [False False False]\n"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links(page):
    text = page.read_text()
    for link, section in re.findall(r"\]\((?!https?:)([^)#\s]*)(?:#([^)]*))?\)", text):
        to = (page.parent / link) if link else page
        assert to.exists(), link
        if section and to.suffix == ".md":
            assert section in {anchor(name) for name in headings(to)}, f"{link}#{section}"
    for file in re.findall(r"`((?:sumajax|experiments|tests)/[\w/.]+)`", text):
        assert list(ROOT.glob(file.replace("NAME", "*"))), file


def test_every_page_of_the_site_is_in_its_navigation():
    """Strict builds of the site refuse one that is not."""
    hooks = runpy.run_path(str(DOCS / "hooks.py"))
    pages = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")}
    for folder, place in hooks["PLACES"].items():
        if place:
            found = [file for file in hooks["linked"](folder) if file.suffix == ".md"]
            pages |= {f"{place}/{file.relative_to(folder).as_posix()}" for file in found}

    def listed(entry: Any) -> set[str]:
        """Of a part of the navigation: a page, a list of parts, or a title with either."""
        if isinstance(entry, str):
            return {entry}
        parts = entry.values() if isinstance(entry, dict) else entry
        return set().union(*map(listed, parts))

    assert listed(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]) == pages


def test_pages_and_sections_that_code_cites():
    """As `docs/reference/learning.md, Gradients`: there is the page, and the section in it."""
    cited = set()
    for file in sorted(file for folder in CODE for file in (ROOT / folder).rglob("*.py")):
        text = re.sub(r"\s+(?:# )?", " ", file.read_text())
        cited |= {(file, *found) for found in CITATION.findall(text)}
    assert {place for _, place, _ in cited} >= {"docs/settings.md", "docs/reference/learning.md"}
    for file, place, section in cited:
        assert (ROOT / place).exists(), (file, place)
        names = headings(ROOT / place)
        assert not section or any(section.startswith(name) for name in names), (file, section)


def headings(page: Path) -> list[str]:
    without_code = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    return re.findall(r"^#+ (.*)$", without_code, re.MULTILINE)


def anchor(name: str) -> str:
    """The anchor of a section, as the site makes it."""
    return re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", name).strip().lower())


def test_figures_are_those_of_the_script(tmp_path):
    files = runpy.run_path(str(DOCS / "figures.py"))["main"](tmp_path)
    assert len(files) == 2
    for drawn in files:
        assert png_size(drawn) == png_size(DOCS / drawn.name)


def png_size(file: Path) -> bytes:
    """Width and height, as the header has them."""
    return file.read_bytes()[16:24]


@pytest.mark.slow
def test_the_tutorial_as_a_notebook(tmp_path):
    """Made and executed by the command of docs/tutorial.md, as CI does for the site."""
    for tool in ("jupytext", "nbconvert", "ipykernel"):
        pytest.importorskip(tool, reason="needs the extra docs")
    (tmp_path / "docs").symlink_to(DOCS)
    (command,) = re.findall(r"^python docs.*$", (DOCS / "tutorial.md").read_text(), re.M)
    words = [sys.executable, *shlex.split(command)[1:]]
    subprocess.run(words, cwd=tmp_path, check=True)
    cells = json.loads((tmp_path / "tutorial.ipynb").read_text())["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", ())]
    printed = "".join("".join(output.get("text", ())) for output in outputs)
    assert "actions of 8 teams of 5: (8, 5)" in printed
    shown = [output["data"] for output in outputs if output["output_type"] == "execute_result"]
    assert ["image/png" in data for data in shown] == [True, True], "pictures, no records of arrays"
    assert (next((tmp_path / "runs").glob("tutorial-*")) / "replay.gif").exists()
