"""The program: what is missing is run, what was stopped goes on, what is kept stays."""

import json
import re
import sys
from dataclasses import replace

import pytest

from experiments.paper import parts, program, speed
from experiments.paper.arms import SOURCE, TRANSFER
from experiments.paper.parts import Budget, Part
from experiments.paper.program import Provenance, run
from experiments.paper.results import Results
from experiments.paper.speed import PASSES, QUIET_LOAD, seconds_per_epoch, wait_until_quiet
from sumajax import checkpoint, reporting
from sumajax.reporting import append_rows, rows_of
from sumajax.transfer import StoppedError

from .conftest import small_experiment_of


def pretend(experiment, directory, where):
    """Leaves what a finished run leaves, without training."""
    (stage,) = experiment.stages
    (directory / "checkpoints" / stage.name).mkdir(parents=True)
    plan = {"seeds": experiment.seeds, "preset": experiment.preset}
    (directory / "config.json").write_text(json.dumps({"experiment": plan}))
    steps = [20_000 * epoch for epoch in range(1, stage.epochs + 1)]
    values = {"env_steps": steps, "seconds": 1.0, "steps_taken": 9.5, "success": 1.0}
    append_rows(directory / "metrics.csv", rows_of(stage.name, experiment.seeds, 1, values))
    (directory / "summary.json").write_text("{}")


def test_only_what_is_missing_is_run(tiny, monkeypatch):
    ran = []
    monkeypatch.setattr(parts, "ABLATED", ("pp-ic3net",))

    def run_experiment(experiment, directory, where):
        ran.append(str(directory.relative_to(tiny.runs / "fast" / "pp-ic3net")))
        if len(ran) == 2:
            raise KeyboardInterrupt
        pretend(experiment, directory, where)

    monkeypatch.setattr(program, "run_experiment", run_experiment)
    monkeypatch.setattr(checkpoint, "latest", lambda directory: directory)
    with pytest.raises(KeyboardInterrupt):
        run(tiny)
    run(tiny)
    assert ran == ["source/seeds-0", *["transfer/seeds-0"] * 2, "scratch/seeds-0"]
    for file in (tiny.output / "provenance").glob("*.json"):
        assert json.loads(file.read_text())["experiment"] == {"seeds": [0], "preset": "fast"}
    run(replace(tiny, seeds=(0, 1, 2)))
    assert ran[4:] == [f"{arm}/seeds-1-2" for arm in ("source", "transfer", "scratch")]
    run(replace(tiny, seeds=(0, 1, 2), experiments=("optimiser",)))
    assert ran[7:] == ["transfer-optimiser/seeds-0", "transfer-optimiser/seeds-1-2"]
    with pytest.raises(ValueError, match=r"holds 1 epochs of pp-ic3net source, .* not 2; choose"):
        run(replace(tiny, source_epochs=2))


def test_a_part_without_a_seed_left_is_told_of_and_the_others_go_on(tiny, monkeypatch, capsys):
    def run_experiment(experiment, directory, where):
        if experiment.stages[0].start is not None:
            raise StoppedError("no seed of the transfer stage is left.")
        pretend(experiment, directory, where)

    monkeypatch.setattr(program, "run_experiment", run_experiment)
    monkeypatch.setattr(checkpoint, "latest", lambda directory: directory)
    run(tiny)
    assert "pp-ic3net transfer: no seed of the transfer stage" in capsys.readouterr().out
    assert {r["arm"] for r in Results.read(tiny.output).rows["curves"]} == {"source", "scratch"}
    (file,) = (tiny.output / "provenance").glob("fast-pp-ic3net-transfer-*.json")
    assert "no seed" in json.loads(file.read_text())["sessions"][-1]["stopped"]


def test_what_has_no_source_to_go_on_from_is_told_of(tiny, monkeypatch, capsys):
    def run_experiment(experiment, directory, where):
        if experiment.stages[0].name == "source":
            raise StoppedError("no seed of the source stage is left.")
        pretend(experiment, directory, where)

    monkeypatch.setattr(program, "run_experiment", run_experiment)
    run(tiny)
    told = "pp-ic3net transfer: not run with seeds 0, of which pp-ic3net source has no checkpoint."
    assert told in capsys.readouterr().out
    assert {r["arm"] for r in Results.read(tiny.output).rows["curves"]} == {"scratch"}


@pytest.mark.slow
def test_a_part_that_was_stopped_goes_on_and_its_rows_are_kept(tiny, monkeypatch):
    """Stopped as a kill between a chunk's rows and its checkpoint would."""
    chosen = [Part("pp-ic3net", SOURCE), Part("pp-ic3net", TRANSFER)]
    monkeypatch.setattr(program, "parts_of", lambda *_: chosen)
    advance = reporting.Progress.advance

    def stop_in_transfer(self, arm, *news):
        advance(self, arm, *news)
        if arm == "transfer":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(reporting.Progress, "advance", stop_in_transfer)
        with pytest.raises(KeyboardInterrupt):
            run(tiny)
    assert [row["arm"] for row in Results.read(tiny.output).rows["curves"]] == ["source"]
    run(tiny)
    kept = Results.read(tiny.output)
    rows = [(row["arm"], row["seed"], row["epoch"]) for row in kept.rows["curves"]]
    assert rows == [("source", 0, 1), ("transfer", 0, 1)]
    assert {row["arm"] for row in kept.rows["evaluations"]} == {"source", "transfer", "zero-shot"}
    assert {row["task"] for row in kept.rows["references"]} == {"source", "target"}
    (file,) = (tiny.output / "provenance").glob("fast-pp-ic3net-transfer-*.json")
    told = json.loads(file.read_text())
    assert len(told["sessions"]) == 2
    assert {"command", "commit", "versions", "machine"} <= set(told["sessions"][0])
    (stage,) = told["experiment"]["stages"]
    assert stage["task"]["fields"]["size"] == 6
    assert list(stage["start"]) == ["checkpoint"]


def test_seeds_that_are_added_are_run_alone_beside_what_was_begun(tiny, tmp_path, monkeypatch):
    sources = [((0, 1), tmp_path / "a"), ((2,), tmp_path / "b")]
    monkeypatch.setattr(program, "checkpoints_of", lambda *_: sources)
    monkeypatch.setattr(program, "_begun", lambda *_: [(1,)])
    part = Part("pp-ic3net", TRANSFER)
    found = program.groups(part, {0, 1, 2}, tiny, Results.read(tmp_path))
    assert found == [((1,), tmp_path / "a"), ((0,), tmp_path / "a"), ((2,), tmp_path / "b")]


MISTAKES = {
    "--experiments pong": "invalid choice 'pong' for argument '--experiments'",
    "--experiments q1 q1": "experiments must be distinct names of pp-ic3net, ",
    "--seeds 1 1": "seeds must be distinct numbers from 0 to 2147483647, got [1, 1].",
    "--preset slow": "invalid choice 'slow' for argument '--preset'",
    "--epochs-scale 0": "epochs-scale must lie between 0 and 100, got 0.0.",
    "--source-epochs 0": "source-epochs must lie between 1 and 100000, got 0.",
    "--devices 0": "devices must lie between 1 and 256, got 0.",
    "--rebuild": "holds no results; run experiments or import runs.",
    "--rebuild --measure-speed": "rebuild and measure-speed do different things; give one of them.",
    "--import-runs missing": "missing is no run of pp_transfer.py or pcp_transfer.py; give its",
    "--spam": "Unrecognized options: --spam",
}


@pytest.mark.parametrize(("options", "sentence"), MISTAKES.items())
def test_a_mistake_gets_one_sentence(options, sentence, tmp_path, monkeypatch, capsys):
    """Ours, or what the parser says in its box."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(program, "keep_compiled", lambda: None)
    command = ["experiments.paper", *options.split(), "--output", "results"]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as stop:
        program.main()
    assert stop.value.code == 2
    said = capsys.readouterr().err
    if said.startswith("error: "):
        (line,) = said.strip().splitlines()
        assert line.endswith(".")
    assert "Traceback" not in said
    assert sentence in " ".join(re.sub("[│╭╮╰╯─]", " ", said).split())


def test_checkpoints_are_found_in_imported_runs(tiny, tmp_path, monkeypatch):
    source = tmp_path / "imported" / "checkpoints" / "source"
    source.mkdir(parents=True)
    part = Part("pp-ic3net", SOURCE)
    Provenance.of([part], "fast", (0,), tmp_path / "imported").write(tiny.output, {})
    monkeypatch.setattr(checkpoint, "latest", lambda directory: directory)
    found = program.checkpoints_of(part, tiny, Results.read(tiny.output))
    assert found == [((0,), source)]


def test_speed_is_measured_from_a_source_with_a_seed_that_it_holds(tiny, tmp_path, monkeypatch):
    ours = tmp_path / "ours" / "checkpoints" / "source"
    sources = [((3, 4), ours), ((0, 1, 2), tmp_path / "others")]
    monkeypatch.setattr(program, "checkpoints_of", lambda *_: sources)
    seen = {}

    def timed(experiment, directory, devices, epochs):
        (stage,) = experiment.stages
        seen[stage.name] = (experiment.seeds, stage.start)
        return {"epochs": epochs, "seconds": 1.0, "standard_error": 0.1, "load_before": 0.0}

    monkeypatch.setattr(program, "seconds_per_epoch", timed)
    monkeypatch.setattr(program, "wait_until_quiet", lambda: True)
    program.measure(replace(tiny, measure_speed=True), Results.read(tiny.output))
    assert seen == {"source": ((0,), None), "transfer": ((3,), ours), "scratch": ((0,), None)}


def test_only_the_papers_own_arms_are_measured(tiny, monkeypatch):
    seen = []
    timed = {"epochs": 1, "seconds": 1.0, "standard_error": 0.1, "load_before": 0.0}
    monkeypatch.setattr(parts, "ABLATED", ("pp-ic3net",))
    monkeypatch.setattr(
        program,
        "seconds_per_epoch",
        lambda experiment, *_: seen.append(experiment.name) or timed,
    )
    monkeypatch.setattr(program, "wait_until_quiet", lambda: True)
    program.measure(replace(tiny, experiments=("mass",)), Results.read(tiny.output))
    assert seen == ["pp-ic3net source", "pp-ic3net scratch"] * PASSES


def test_every_pass_is_kept_and_an_unquiet_machine_told_of(tiny, monkeypatch, capsys):
    monkeypatch.setattr(program, "wait_until_quiet", lambda: False)
    timed = {"epochs": 1, "seconds": 1.0, "standard_error": 0.1, "load_before": 3.0}
    monkeypatch.setattr(program, "seconds_per_epoch", lambda *_: timed)
    program.measure(replace(tiny, experiments=("pp-ic3net",)), Results.read(tiny.output))
    rows = Results.read(tiny.output).rows["seconds_per_epoch"]
    found = [(row["arm"], row["pass"], row["load_before"]) for row in rows]
    assert found == [
        ("scratch", 1, 3.0),
        ("scratch", 2, 3.0),
        ("source", 1, 3.0),
        ("source", 2, 3.0),
    ]
    assert "pp-ic3net scratch: the machine is not quiet" in capsys.readouterr().out


def test_a_row_waits_until_the_machine_is_quiet(monkeypatch):
    loads = [(2.0,), (QUIET_LOAD,), (QUIET_LOAD / 2,)]
    slept = []
    monkeypatch.setattr(speed.os, "getloadavg", lambda: loads[min(len(slept), len(loads) - 1)])
    monkeypatch.setattr(speed.time, "sleep", slept.append)
    assert wait_until_quiet()
    assert len(slept) == 2


def test_but_not_for_ever(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(speed.os, "getloadavg", lambda: (2.0,))
    monkeypatch.setattr(speed.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(speed.time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    assert not wait_until_quiet()
    assert now[0] >= speed.PATIENCE_SECONDS


@pytest.mark.slow
def test_an_epoch_is_timed(tiny, tmp_path):
    experiment = small_experiment_of(Part("pp-ic3net", SOURCE), Budget("fast"), (0,), None)
    timed = seconds_per_epoch(experiment, tmp_path / "run", devices=1, epochs=2)
    assert timed["epochs"] == 2
    assert timed["seconds"] > 0
    assert timed["standard_error"] >= 0
    assert not (tmp_path / "run").exists()
