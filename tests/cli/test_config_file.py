"""A run can be repeated from its config.json: the file's options, and the command line's on top."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from sumajax.cli import options as shared
from sumajax.cli.config_file import with_config_file
from sumajax.cli.transfer import PCPTransfer, PPTransfer
from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.learning import preset


def written(file, config):
    """As a run writes it."""
    options = json.loads(json.dumps(asdict(config), default=str))
    file.write_text(json.dumps({"options": options, "experiment": {}}))
    return file


def read(experiment, arguments):
    arguments = with_config_file(experiment, [str(argument) for argument in arguments])
    return shared.parse(experiment, experiment(), arguments)


RUNS = {
    "defaults": PPTransfer(),
    "every kind of value": PPTransfer(
        source=PredatorPrey(size=(4, 5), num_predators=2, reward_mode="cooperative"),
        target=PredatorPrey(size=(8, 10), num_predators=3),
        seeds=(3, 4),
        scratch=False,
        threshold=12.5,
        source_checkpoint=Path("/a/b"),
        devices=1,
        learner=preset("paper", "ic3net", detach_gap=None, max_grad_norm=0.5),
    ),
    "capture agents": PCPTransfer(
        source=PredatorCapturePrey(size=5, capture_vision=1), policy="ic3net"
    ),
}


@pytest.mark.parametrize("config", RUNS.values(), ids=RUNS)
def test_a_run_again(config, tmp_path):
    file = written(tmp_path / "config.json", config)
    assert read(type(config), ["--config", file]) == config


def test_what_is_given_beside_it_comes_on_top(tmp_path):
    file = written(tmp_path / "config.json", RUNS["every kind of value"])
    again = read(PPTransfer, ["--seeds", 7, "--config", file, "--scratch", "--learner.gamma", 0.5])
    learner = replace(RUNS["every kind of value"].learner, gamma=0.5)
    expected = replace(RUNS["every kind of value"], seeds=(7,), scratch=True, learner=learner)
    assert again == expected


def test_where_it_was_written_is_not_taken_over(tmp_path):
    file = written(tmp_path / "config.json", PPTransfer(output=tmp_path / "before"))
    assert read(PPTransfer, ["--config", file]).output is None


def test_without_a_file_nothing_changes():
    assert with_config_file(PPTransfer, ["--seeds", "1"]) == ["--seeds", "1"]


BAD = {
    "none there": ("{tmp}/none.json", None, "none.json cannot be read"),
    "no JSON": ("{tmp}/a.json", "{", "a.json is no config.json of a run"),
    "another JSON": ("{tmp}/a.json", "[1]", "a.json is no config.json of a run"),
    "no options": ("{tmp}/a.json", '{"options": 3}', "a.json is no config.json of a run"),
    "too long": ("{tmp}/a.json", " " * 2**21, "a.json is no config.json of a run"),
    "unknown option": ("{tmp}/a.json", '{"options": {"spam": 1}}', "Unrecognized options: --spam"),
    "wrong value": (
        "{tmp}/a.json",
        '{"options": {"source_epochs": "x"}}',
        "invalid literal",
    ),
    "refused value": (
        "{tmp}/a.json",
        '{"options": {"source_epochs": 0}}',
        "source-epochs must lie between 1 and",
    ),
    "another experiment": (
        "{tmp}/a.json",
        '{"options": {"source": {"num_capturers": 1}}}',
        "has source.num_capturers 1, which is always 0 in this experiment",
    ),
}


@pytest.mark.parametrize(("file", "text", "sentence"), BAD.values(), ids=BAD)
def test_a_mistake_gets_one_sentence(file, text, sentence, tmp_path, capsys):
    """Of ours, or what the parser says."""
    if text is not None:
        (tmp_path / "a.json").write_text(text)
    with pytest.raises((ValueError, SystemExit)) as stop:
        read(PPTransfer, ["--config", file.format(tmp=tmp_path)])
    assert sentence in str(stop.value) + " ".join(capsys.readouterr().err.split())


def test_a_relative_path_is_beside_the_file(tmp_path, monkeypatch):
    (tmp_path / "here" / "a" / "b").mkdir(parents=True)
    file = written(tmp_path / "here" / "config.json", PPTransfer(source_checkpoint=Path("a/b")))
    monkeypatch.chdir(tmp_path)
    expected = tmp_path / "here" / "a" / "b"
    assert read(PPTransfer, ["--config", file]).source_checkpoint == expected


def test_a_file_from_before_there_were_plans_anneals_as_it_did(tmp_path):
    old = PPTransfer(learner=preset("fast", anneal_epochs=0))
    file = written(tmp_path / "config.json", old)
    assert read(PPTransfer, ["--config", file]).learner.anneal_epochs == 0
    content = json.loads(file.read_text())
    del content["experiment"]
    file.write_text(json.dumps(content))
    assert read(PPTransfer, ["--config", file]).learner.anneal_epochs is None


def test_a_file_must_be_given():
    with pytest.raises(ValueError, match="config takes one file"):
        with_config_file(PPTransfer, ["--config"])
