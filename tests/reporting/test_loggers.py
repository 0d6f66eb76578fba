"""TensorBoard and W&B: what is sent, what a missing library says; imported only when asked for."""

import importlib.util
import math
import subprocess
import sys
import types

import pytest

from sumajax.reporting.loggers import FIGURES, Loggers
from sumajax.reporting.metrics import rows_of


def rows(arm="source", first=1, epochs=2):
    steps = [20_000 * (first + i) for i in range(epochs)]
    values = {"env_steps": steps, "steps_taken": [9.5 - e for e in range(epochs)], "success": 0.5}
    return rows_of(arm, [0, 3], first, values)


class FakeWriter:
    """Stands for tensorboardX.SummaryWriter."""

    made: list = []

    def __init__(self, logdir, purge_step=None):
        self.logdir, self.purge_step, self.scalars, self.closed = logdir, purge_step, [], False
        FakeWriter.made.append(self)

    def add_scalar(self, *scalar):
        self.scalars.append(scalar)

    def flush(self):
        pass

    def close(self):
        self.closed = True


class FakeRun:
    """Stands for a W&B run."""

    def __init__(self, **options):
        self.options, self.logged, self.steps, self.finished = options, [], {}, False

    def define_metric(self, name, step_metric):
        self.steps[name] = step_metric

    def log(self, figures):
        self.logged.append(figures)

    def finish(self):
        self.finished = True


@pytest.fixture
def writers(monkeypatch):
    FakeWriter.made = []
    library = types.SimpleNamespace(SummaryWriter=FakeWriter)
    monkeypatch.setitem(sys.modules, "tensorboardX", library)
    return FakeWriter.made


@pytest.fixture
def runs(monkeypatch):
    made = []

    def init(**options):
        made.append(FakeRun(**options))
        return made[-1]

    monkeypatch.setitem(sys.modules, "wandb", types.SimpleNamespace(init=init))
    for name in ("WANDB_PROJECT", "WANDB_RUN_ID", "WANDB_SWEEP_ID"):
        monkeypatch.delenv(name, raising=False)
    return made


def test_tensorboard_gets_every_number_over_environment_steps(writers, tmp_path):
    with Loggers(["tensorboard"], tmp_path) as loggers:
        loggers.log(rows())
        loggers.log(rows("transfer", epochs=1))
    folders = [f"{arm}/seed_{seed}" for arm in ("source", "transfer") for seed in (0, 3)]
    assert [w.logdir for w in writers] == [str(tmp_path / "tensorboard" / f) for f in folders]
    assert writers[0].scalars == [
        ("steps_taken", 9.5, 20_000),
        ("success", 0.5, 20_000),
        ("steps_taken", 8.5, 40_000),
        ("success", 0.5, 40_000),
    ]
    assert all(writer.closed and writer.purge_step is None for writer in writers)


def test_tensorboard_forgets_what_lies_beyond_the_last_checkpoint(writers, tmp_path):
    with Loggers(["tensorboard"], tmp_path) as loggers:
        loggers.resume("source", 20_000)
        loggers.log(rows(first=2))
    assert [writer.purge_step for writer in writers] == [20_001, 20_001]


def test_wandb_is_one_run_that_goes_on(runs, tmp_path):
    for first in (1, 3):
        with Loggers(["wandb"], tmp_path, {"policy": "ic3net"}) as loggers:
            loggers.resume("source", 0)
            loggers.log(rows(first=first))
    assert runs[0].options["id"] == runs[1].options["id"]
    assert runs[0].options["project"] == "sumajax"
    assert runs[0].options["resume"] == "allow"
    assert runs[0].options["config"] == {"policy": "ic3net"}
    assert runs[0].logged[0] == {
        "source/env_steps": 20_000,
        "source/seed_0/steps_taken": 9.5,
        "source/seed_0/success": 0.5,
    }
    assert runs[0].steps == {
        "source/seed_0/*": "source/env_steps",
        "source/seed_3/*": "source/env_steps",
        "source/mean/*": "source/env_steps",
    }
    assert runs[0].finished


def test_wandb_leaves_a_sweeps_trial_its_name_and_project(runs, tmp_path, monkeypatch):
    """By which the sweep finds its figures; a run that a person names keeps the project."""
    monkeypatch.setenv("WANDB_RUN_ID", "trial")
    with Loggers(["wandb"], tmp_path):
        assert (runs[0].options["id"], runs[0].options["project"]) == (None, "sumajax")
    monkeypatch.setenv("WANDB_SWEEP_ID", "sweep")
    with Loggers(["wandb"], tmp_path):
        assert (runs[1].options["id"], runs[1].options["project"]) == (None, None)


def test_wandb_gets_the_mean_over_the_seeds_that_have_a_number(runs, tmp_path):
    """What a sweep goes by: one figure of an epoch, however many seeds are trained."""
    of_seeds = rows_of("source", [0, 3], 1, {"env_steps": [20_000, 40_000], "success": 0.5})
    of_seeds[0]["steps_taken"], of_seeds[1]["steps_taken"] = 8.0, 9.0
    of_seeds[2]["steps_taken"] = 7.0  # the other seed has stopped
    with Loggers(["wandb"], tmp_path) as loggers:
        loggers.log(of_seeds)
    assert [figures for figures in runs[0].logged if "source/mean/success" in figures] == [
        {"source/env_steps": 20_000, "source/mean/steps_taken": 8.5, "source/mean/success": 0.5},
        {"source/env_steps": 40_000, "source/mean/steps_taken": 7.0, "source/mean/success": 0.5},
    ]


def test_wandb_without_a_key_is_one_sentence(tmp_path, monkeypatch):
    """The library raises kinds of its own, at the start: nothing has been trained."""

    def init(**options):
        raise RuntimeError("api_key not configured (no-tty).\ncall wandb.login(key=[your_api_key])")

    monkeypatch.setitem(sys.modules, "wandb", types.SimpleNamespace(init=init))
    with pytest.raises(ValueError, match=r"starts no run \(api_key not configured") as raised:
        Loggers(["wandb"], tmp_path)
    said = str(raised.value)
    assert "\n" not in said
    assert all(mend in said for mend in ("wandb login", "WANDB_API_KEY", "WANDB_MODE=offline"))


def test_what_has_no_value_is_left_out(writers, tmp_path):
    empty = [{**row, "steps_taken": math.nan} for row in rows(epochs=1)]
    with Loggers(["tensorboard"], tmp_path) as loggers:
        loggers.log(empty)
    assert [name for name, *_ in writers[0].scalars] == ["success"]
    assert set(FIGURES) > {"steps_taken", "success"}


def test_none_at_all(tmp_path):
    with Loggers([], tmp_path) as loggers:
        loggers.resume("source", 0)
        loggers.log(rows())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "library"), [("tensorboard", "tensorboardX"), ("wandb", "wandb")])
def test_a_missing_library_is_named(name, library, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, library, raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=rf"needs {library}, which is not .*\[logging\]"):
        Loggers([name], tmp_path)
    assert not list(tmp_path.iterdir())


def test_an_unknown_logger(tmp_path):
    with pytest.raises(ValueError, match="logger 'paper' is unknown; choose of tensorboard, wandb"):
        Loggers(["paper"], tmp_path)


def test_nothing_is_imported_unasked():
    program = (
        "import sys, sumajax.reporting.loggers; "
        "print([m for m in ('tensorboardX', 'wandb') if m in sys.modules])"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert said.stdout.strip() == "[]", said.stderr


def test_the_real_tensorboard_library(tmp_path):
    pytest.importorskip("tensorboardX", reason="tensorboardX is not installed (extra `logging`)")
    with Loggers(["tensorboard"], tmp_path) as loggers:
        loggers.log(rows())
    files = sorted((tmp_path / "tensorboard").rglob("events*"))
    assert [file.parent.name for file in files] == ["seed_0", "seed_3"]
    assert all(b"steps_taken" in file.read_bytes() for file in files)
