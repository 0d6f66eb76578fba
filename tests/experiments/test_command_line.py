"""What a person can get wrong on the command line: one sentence, status 2, nothing left behind."""

import sys

import command_line
import pytest
from pp_transfer import PPTransfer

BAD = {
    "size not a multiple": (["--target.size", "12"], "12x12 is not a whole multiple of the source"),
    "vision too large": (["--source.vision", "5"], "vision 5 must be smaller than the sides"),
    "vision differs": (["--target.vision", "2"], "vision differs: 1 in the source stage, 2"),
    "too many agents": (["--source.num-predators", "30"], "30 agents and a prey need 31 distinct"),
    "no agents": (["--source.num-predators", "0"], "the team is empty"),
    "negative epochs": (["--source-epochs", "-1"], "source-epochs must be at least 1, got -1"),
    "negative target epochs": (
        ["--target-epochs", "-3"],
        "target-epochs must be at least 0, got -3",
    ),
    "unknown policy": (["--policy", "nope"], "policy 'nope' is unknown; choose one of ic3net"),
    "unknown preset": (["--preset", "nope"], "preset 'nope' is unknown; choose one of fast, paper"),
    "unknown option": (["--spam", "3"], "Unrecognized options: --spam"),
    "not a number": (["--source-epochs", "ten"], "invalid literal for int() with base 10: 'ten'"),
    "equal seeds": (["--seeds", "1", "1"], "seeds must be distinct numbers from 0, got [1, 1]"),
    "no step limit": (["--target.max-steps", "0"], "max_steps must be at least 1, got 0"),
    "odd batch": (["--learner.num-envs", "64"], "do not divide an epoch of 20000"),
    "discount": (["--learner.gamma", "1.5"], "gamma must lie between 0 and 1, got 1.5"),
    "rate": (["--learner.learning-rate", "0"], "learning_rate must be greater than 0"),
    "no devices": (["--devices", "0"], "devices must be at least 1, got 0"),
    "missing checkpoint": (["--source-checkpoint", "{tmp}/none"], "{tmp}/none is no directory"),
    "foreign checkpoint": (["--source-checkpoint", "{tmp}/foreign"], "{tmp}/foreign"),
    "existing output": (["--output", "{tmp}/foreign"], "holds 'notes.txt', not a run"),
    "unwritable output": (["--output", "{tmp}/foreign/notes.txt/run"], "cannot write to"),
}


@pytest.mark.parametrize(("arguments", "sentence"), BAD.values(), ids=BAD)
def test_a_mistake_gets_one_sentence(arguments, sentence, tmp_path, monkeypatch, capsys):
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "notes.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command_line, "prepare_jax", lambda devices: None)
    arguments = [argument.format(tmp=tmp_path) for argument in arguments]
    monkeypatch.setattr(sys, "argv", ["pp_transfer.py", *arguments])
    with pytest.raises(SystemExit) as stop:
        command_line.main(PPTransfer)
    said = capsys.readouterr().err.strip().splitlines()
    assert stop.value.code == 2
    assert len(said) == 1
    assert said[0].startswith("error: ")
    assert sentence.format(tmp=tmp_path) in said[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["foreign"]
    assert (tmp_path / "foreign" / "notes.txt").read_text() == "mine"


def test_the_preset_decides_the_learners_defaults():
    chosen = command_line._presets(PPTransfer, ["--preset", "paper", "--policy", "magic"])
    assert (chosen.preset, chosen.policy) == ("paper", "magic")
    assert command_line._presets(PPTransfer, []).policy == "ic3net"


def test_help_is_readable(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["pp_transfer.py", "--help"])
    with pytest.raises(SystemExit) as stop:
        command_line.main(PPTransfer)
    text = capsys.readouterr().out
    assert stop.value.code == 0
    options = "--policy --preset --seeds --source-epochs --target-epochs --output --no-scratch"
    for option in [*options.split(), "--source.size", "--target.num-predators"]:
        assert option in text
