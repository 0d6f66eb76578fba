"""The pages in docs/: their code runs, in the order it stands, and their links lead somewhere."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


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


def test_jaxmarl(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "jaxmarl.md").read_text(), re.DOTALL)
    exec(compile(code, "jaxmarl.md", "exec"), {})
    assert capsys.readouterr().out == "(43,) False [False False False]\n"


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda page: page.name)
def test_links(page):
    for link in re.findall(r"\]\((?!http)([^)#]+)\)", page.read_text()):
        assert (DOCS / link).exists(), link
    for file in re.findall(r"`((?:sumajax|experiments|tests)/[\w/.]+)`", page.read_text()):
        assert (DOCS.parent / file).exists(), file
