"""The README's examples and those of docs/programs.md, as printed."""

import re
from pathlib import Path

from sumajax import checkpoint

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
NEEDS_A_RUN = "<!-- needs a finished run -->"
LONG = "<!-- trains for a minute -->"
LINES = 140


def test_its_example_is_the_one_of_the_first_page():
    """Which tests/test_docs.py runs."""
    block = re.compile(r"```python\n(.*?)```", re.DOTALL)
    assert block.findall(README) == block.findall((ROOT / "docs" / "index.md").read_text())


def test_the_examples_run(capsys, tmp_path, monkeypatch):
    """In order; what the first has trained stands for the run that the second one loads."""
    monkeypatch.chdir(tmp_path)
    shared: dict = {}
    page = (ROOT / "docs" / "programs.md").read_text()
    blocks = re.findall(rf"({NEEDS_A_RUN}\n|{LONG}\n)?```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 4
    for kind, code in blocks:
        if kind.startswith(LONG):
            code = code.replace("summary = run_experiment", "(lambda plan, _: plan.check())")
        if kind.startswith(NEEDS_A_RUN):
            (run,) = re.findall(r'load_agent\("(.*)"\)', code)
            about = checkpoint.describe(shared["env"], shared["policy"])
            checkpoint.save(Path(run) / "checkpoints" / "transfer", shared["state"], about)
        exec(compile(code, "programs.md", "exec"), shared)
    assert shared["metrics"].env_steps.tolist() == [20_000, 20_000]
    assert shared["output"].action.shape == (3,)
    assert shared["action"].shape == (3,)
    assert [stage.epochs for stage in shared["experiment"].stages] == [40, 80]
    assert shared["states"].agents.shape == (64, 5, 2)
    assert capsys.readouterr().out


def test_every_file_it_links_to_exists():
    for link in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / link).exists(), link


def test_a_newcomer_reads_it_to_the_end():
    assert len(README.splitlines()) <= LINES


def test_the_test_command_is_what_ci_runs():
    command = "pip install -e '.[dev]' && python -m pytest"
    assert command in README
    assert command in (ROOT / ".ci" / "run").read_text()
