"""The README's examples, as printed."""

import re
from pathlib import Path

from sumajax import checkpoint

README = (Path(__file__).parents[1] / "README.md").read_text()
NEEDS_A_RUN = "<!-- needs a finished run -->"
LONG = "<!-- trains for a minute -->"


def test_the_examples_run(capsys, tmp_path, monkeypatch):
    """In order; what the first has trained stands for the run that the second one loads."""
    monkeypatch.chdir(tmp_path)
    shared: dict = {}
    blocks = re.findall(rf"({NEEDS_A_RUN}\n|{LONG}\n)?```python\n(.*?)```", README, re.DOTALL)
    assert len(blocks) == 4
    for kind, code in blocks:
        if kind.startswith(LONG):
            code = code.replace("summary = run_experiment", "(lambda plan, _: plan.check())")
        if kind.startswith(NEEDS_A_RUN):
            (run,) = re.findall(r'load_agent\("(.*)"\)', code)
            about = checkpoint.describe(shared["env"], shared["policy"])
            checkpoint.save(Path(run) / "checkpoints" / "transfer", shared["state"], about)
        exec(compile(code, "README.md", "exec"), shared)
    assert shared["metrics"].env_steps.tolist() == [20_000, 20_000]
    assert shared["output"].action.shape == (3,)
    assert shared["action"].shape == (3,)
    assert [stage.epochs for stage in shared["experiment"].stages] == [40, 80]
    assert shared["states"].agents.shape == (64, 5, 2)
    assert capsys.readouterr().out


def test_every_file_it_links_to_exists():
    root = Path(__file__).parents[1]
    for link in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (root / link).exists(), link


def test_the_test_command_is_what_ci_runs():
    command = "pip install -e '.[dev]' && python -m pytest"
    assert command in README
    assert command in (Path(__file__).parents[1] / ".ci" / "run").read_text()
