"""What a person can get wrong on the command line: one sentence, status 2, nothing left behind."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from sumajax import checkpoint, cli
from sumajax.checkpoint.format import checksum
from sumajax.cli import options as shared
from sumajax.cli import transfer
from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.learning import LearnerConfig, make_learner
from sumajax.policies import make_policy
from sumajax.upsampling import StateUpsampled

UNSHARED = "do not spread over"
CLASS = "is unknown; choose one of"

TASKS = {
    "--target.size 12": "target size 12x12 is not a whole multiple of the source size 5x5",
    "--source.size 11": "target size 10x10 is not a whole multiple of the source size 11x11",
    "--target.size 4": "target size 4x4 is not a whole multiple of the source size 5x5; choose",
    "--source.size 2 3": "target size 10x10 is not a whole multiple of the source size 2x3",
    "--source.size 0": "source: size must be a positive int or (rows, columns), got 0.",
    "--target.size -5": "target: size must be a positive int or (rows, columns), got -5.",
    "--source.size 5.5": "Error parsing --source.size: no type matching INT|{INT INT} could",
    "--source.size 5,6": "could be instantiated from ['5,6']",
    "--source.size 5 5 5": "could be instantiated from ['5', '5', '5']",
    "--source.size 20000": "the 20000x20000 grid is too large; its sides have at most 16383 cells",
    "--source.vision 5": "vision 5 must be smaller than the sides of the 5x5 grid; use at most 4.",
    "--target.vision 10": "vision 10 must be smaller than the sides of the 10x10 grid",
    "--target.vision 2": "vision differs: 1 in the source stage, 2 in this stage; give both",
    "--source.vision -1": "source: vision must be at least 0, got -1.",
    "--source.num-predators 30": "30 agents and a prey need 31 distinct cells, but a 5x5 grid has",
    "--target.num-predators 100": "use fewer agents or a larger grid",
    "--source.num-predators 0": "the team is empty; give at least one predator",
    "--target.num-predators -1": "target: num_predators must be at least 0, got -1.",
    "--target.max-steps 0": "target: max_steps must be at least 1, got 0.",
    "--source.max-steps 2147483648": "max_steps must be at most 2147483647, got 2147483648.",
    "--source.reward-mode selfish": "invalid choice 'selfish' for argument '--source.reward-mode'",
    "--scale sum": "invalid choice 'sum' for argument '--scale'. Expected one of ('none', 'mass')",
    # A predator has nothing to capture: Predator-Prey has no such settings.
    "--source.num-capturers 1": "Unrecognized options: --source.num-capturers, 1",
    "--source.capture-vision 1": "Unrecognized options: --source.capture-vision, 1",
    "--target.capture-reward second": "Unrecognized options: --target.capture-reward, second",
}

CAPTURE_TASKS = {
    "--source.num-capturers -1": "source: num_capturers must be at least 0, got -1.",
    "--source.num-predators 0 --source.num-capturers 0": "the team is empty; give at least one",
    "--source.num-capturers 23": "25 agents and a prey need 26 distinct cells, but a 5x5 grid has",
    "--source.capture-vision 2": "capture_vision 2 must lie between 0 and vision 1, or be None",
    "--target.capture-vision -1": "capture_vision -1 must lie between 0 and vision 1",
    "--target.capture-vision far": "Error parsing --target.capture-vision: ",
    "--source.capture-reward third": "invalid choice 'third' for argument '--source.capture-rew",
}

RUNS = {
    "--policy telepathy": f"policy 'telepathy' {CLASS} ic3net, commnet",
    "--policy": "Missing value for argument '--policy'",
    "--preset slow": f"preset 'slow' {CLASS} fast, paper.",
    "--preset=slow --policy=telepathy": f"preset 'slow' {CLASS} fast, paper.",
    "--source-epochs -1": "source-epochs must lie between 1 and 100000, got -1.",
    "--source-epochs 0": "source-epochs must lie between 1 and 100000, got 0.",
    "--source-epochs 100001": "source-epochs must lie between 1 and 100000, got 100001.",
    "--source-epochs ten": "--source-epochs: invalid literal for int() with base 10: 'ten'",
    "--target-epochs -3": "target-epochs must lie between 0 and 100000, got -3.",
    "--target-epochs 1.5": "--target-epochs: invalid literal for int() with base 10: '1.5'",
    "--evaluate-every -1": "evaluate-every must lie between 0 and 100000, got -1.",
    "--seeds": "seeds must be distinct numbers from 0 to 2147483647, got [].",
    "--seeds 1 1": "seeds must be distinct numbers from 0 to 2147483647, got [1, 1].",
    "--seeds -1": "seeds must be distinct numbers from 0 to 2147483647, got [-1].",
    "--seeds 2147483648": "seeds must be distinct numbers from 0 to 2147483647, got [2147483648].",
    "--seeds one": "Could not find valid parse for arguments: ['one']",
    "--threshold 0": "threshold must be a number greater than 0, got 0.0.",
    "--threshold nan": "threshold must be a number greater than 0, got nan.",
    "--threshold inf": "threshold must be a number greater than 0, got inf.",
    "--devices 0": "devices must lie between 1 and 256, got 0.",
    "--devices 100000": "devices must lie between 1 and 256, got 100000.",
    "--devices 7": f"50 environments {UNSHARED} 7 devices; choose numbers that divide.",
    "--devices 4 --seeds 0 1 --learner.num-envs 25": f"25 environments {UNSHARED} 2 devices",
    "--spam 3": "Unrecognized options: --spam, 3",
    "--seed 1": "Unrecognized options: --seed, 1",
    "spam": "Unrecognized options: spam",
    "--scratch maybe": "Unrecognized options: maybe",
}

LEARNER = {
    "num-envs 64": "64 environments x 10 steps = 640 steps per update do not divide an epoch of",
    "num-envs 0": "num_envs must be a whole number of at least 1, got 0.",
    "num-envs -5": "num_envs must be a whole number of at least 1, got -5.",
    "num-envs 40000": "do not divide an epoch of 20000; 1000 environments or 2000 environments",
    "rollout-length 0": "rollout_length must be a whole number of at least 1, got 0.",
    "rollout-length 3": "150 steps per update do not divide an epoch of 20000; a rollout_length",
    "gamma 1.5": "gamma must lie between 0 and 1, got 1.5.",
    "gamma nan": "gamma must lie between 0 and 1, got nan.",
    "gae-lambda -0.1": "gae_lambda must lie between 0 and 1, got -0.1.",
    "team-reward 1.1": "team_reward must lie between 0 and 1, got 1.1.",
    "anneal-to 2": "anneal_to must lie between 0 and 1, got 2.0.",
    "value-weight -1": "value_weight must be a finite number of at least 0, got -1.0.",
    "value-weight inf": "value_weight must be a finite number of at least 0, got inf.",
    "policy-weight -1": "policy_weight must be a finite number of at least 0, got -1.0.",
    "entropy-weight nan": "entropy_weight must be a finite number of at least 0, got nan.",
    "learning-rate 0": "learning_rate must be a finite number greater than 0, got 0.0.",
    "learning-rate inf": "learning_rate must be a finite number greater than 0, got inf.",
    "learning-rate None": "could not convert string to float: 'None'",
    "max-grad-norm -1": "max_grad_norm must be a finite number greater than 0, got -1.0.",
    "max-grad-norm x": "Error parsing --learner.max-grad-norm: ",
    "warmup-epochs -1": "warmup_epochs must be a whole number of at least 0, got -1.",
    "anneal-epochs -2": "anneal_epochs must be a whole number of at least 0, got -2.",
    "detach-gap 0": "detach_gap must be a whole number of at least 1, got 0.",
    "optimiser sgd": "invalid choice 'sgd' for argument '--learner.optimiser'. Expected one of",
    "loss ppo": "invalid choice 'ppo' for argument '--learner.loss'. Expected one of",
    "advantages big": "invalid choice 'big' for argument '--learner.advantages'. Expected one of",
    "clip-per-env --learner.max-grad-norm None": "clip_per_env needs max_grad_norm, got None",
    "loss hetnet": "loss 'hetnet' needs whole_episodes=True, got False; preset 'paper' of policy",
    "spam 3": "Unrecognized options: --learner.spam, 3",
    "no-whole-episodes --preset paper --policy hetnet": "loss 'hetnet' needs whole_episodes=True",
    "team-reward 0.5 --preset paper --policy hetnet": "loss 'hetnet' needs team_reward=0.0, got 0.",
    "mask-inactive --preset paper --policy hetnet": "loss 'hetnet' needs mask_inactive=False, got",
}

SOURCES = {
    "missing": "missing is no directory; give a directory that sumajax saved to.",
    "foreign": "foreign holds no checkpoint of sumajax; give a directory that sumajax saved to.",
    "foreign/notes.txt": "notes.txt is no directory; give a directory that sumajax saved to.",
    "truncated": "has 0 bytes instead of",
    "without_description": "(its file checkpoint.json is missing); restore it from a copy",
    "newer": "is of checkpoint format 99 and this sumajax reads 1; use the sumajax it was",
    "undescribed": "does not say which task and policy it is of; save it with meta from describe",
    "policy": "policy differs: commnet in",
    "width": "policy setting hidden differs: 16 in",
    "vision": "vision differs: 2 in",
    "channels": "number of observation channels differs: 3 in",
    "grid": "the policy's grid differs: 5x5 in",
    "shape": "leaf params/params/core/action/bias is float32[1, 9] in",
    "weights": "in this program; use the policy, settings and seeds it was saved with",
    "no_params": "holds no params; give a checkpoint of a training run.",
    "seeds --seeds 0 1 2": "holds seeds [0, 1], this stage has [0, 1, 2]; give seeds that it holds",
    "good --carry-optimiser": "holds no opt_state; give a checkpoint of a training run.",
    "good --target-epochs 0": "source-checkpoint leaves the source stage out and target-epochs 0",
}
"""A directory of `sources`, and more options."""

OUTPUTS = {
    "foreign": "holds 'notes.txt', not a run; choose another --output.",
    "foreign/notes.txt": "cannot write to",
    "foreign/notes.txt/run": "cannot write to",
    "long": "cannot write to",
    "below/long": "cannot write to",
    "other": "other holds a run with seeds [7], not [0]; choose another --output, or the same",
    "garbled": "config.json is not readable; choose another --output.",
    "listed": "config.json is not readable; choose another --output.",
    "finished": "finished holds a finished run; choose another --output or remove it.",
}
"""A directory of `outputs`."""

JUNCTIONS = {
    "--target.size 12": "target size 12x12 is not a whole multiple of the source size 7x7",
    "--target.size 13": "size 13 of the medium junction must be even and at least 5",
    "--target.difficulty hard": "size 14 of the hard junction must be a multiple of 3, at least 9",
    "--source.difficulty huge": "invalid choice 'huge' for argument '--source.difficulty'",
    "--difficulties easy huge": "invalid choice 'huge' for argument '--difficulties'. Expected one",
    "--difficulties easy medium --sizes 7": "difficulties has 2 values and sizes 1; give as many",
    "--difficulties hard hard --sizes 9 18 --teams 5": "teams has 1 values and sizes 2; give as",
    "--difficulties easy hard hard --sizes 9 18 18": "sizes and teams say one stage twice: 9x9-5,",
    "--difficulties hard hard --sizes 9 10": "size 10 of the hard junction must be a multiple of 3",
    "--sizes 7x14 14": "a junction has equal sides, got 7x14; give one number.",
    "--source.num-cars 1": "source: num_cars must be at least 2, got 1.",
    "--source.arrival-rate 2": "source: arrival_rate is a chance between 0 and 1, got 2.0.",
    "--policy hetnet": "hetnet has no message for an agent that is not there, and agents of this",
    "--threshold 0": "threshold must be a number greater than 0, got 0.0.",
}

BAD: list[tuple[str, str, str]] = [
    *(("pp", options, sentence) for options, sentence in TASKS.items()),
    *(("pcp", options, sentence) for options, sentence in CAPTURE_TASKS.items()),
    *(("tj", options, sentence) for options, sentence in JUNCTIONS.items()),
    *(("pp", options, sentence) for options, sentence in RUNS.items()),
    *(("pp", f"--learner.{options}", sentence) for options, sentence in LEARNER.items()),
    *(("pp", f"--source-checkpoint @{name}", words) for name, words in SOURCES.items()),
    *(("pp", f"--devices 1 --output @{name}", sentence) for name, sentence in OUTPUTS.items()),
]

COMPILED: list[str] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **more: COMPILED.append(event) if "backend_compile" in event else None
)


@pytest.fixture(scope="module")
def there(tmp_path_factory):
    """Where `@name` of the tables is: source checkpoints and outputs of every bad kind."""
    directory = tmp_path_factory.mktemp("there")
    (directory / "foreign").mkdir()
    (directory / "foreign" / "notes.txt").write_text("mine")
    make_sources(directory)
    make_outputs(directory)
    return directory


def make_sources(directory: Path) -> None:
    env = StateUpsampled(PredatorPrey(size=5, num_predators=3), 10)
    wide = StateUpsampled(PredatorPrey(size=5, vision=2), 10)
    policy = make_policy("ic3net", env)
    state = jax.eval_shape(make_learner(env, policy, LearnerConfig()).init, jax.random.key(0))
    params = jax.tree.map(lambda leaf: np.zeros((1, *leaf.shape), leaf.dtype), state.params)
    few = {"params": {"w": np.zeros(1)}}
    odd = jax.tree_util.tree_map_with_path(
        lambda path, leaf: np.zeros((1, 9), leaf.dtype) if is_action_bias(path) else leaf, params
    )
    described = checkpoint.describe(env, policy)

    def save(name, state, meta):
        return checkpoint.save(directory / name, state, meta)

    def save_few(name, env, policy="ic3net", **settings):
        save(name, few, checkpoint.describe(env, make_policy(policy, env, **settings)))

    save("good", {"params": params}, described)
    save("shape", {"params": odd}, described)
    save("weights", few, described)
    save("no_params", {"weights": np.zeros(1)}, described)
    save("seeds", few, {**described, "seeds": [0, 1]})
    save("undescribed", few, {})
    save_few("policy", env, "commnet")
    save_few("width", env, hidden=16)
    save_few("vision", wide)
    save_few("channels", PredatorCapturePrey(size=10))
    save_few("grid", env.env)
    (save("without_description", few, described) / checkpoint.DESCRIPTION).unlink()
    truncated = save("truncated", few, described)
    max(truncated.rglob("*/d/*"), key=lambda file: file.stat().st_size).write_bytes(b"")
    newer = save("newer", few, described) / checkpoint.DESCRIPTION
    content = {**json.loads(newer.read_text()), "version": 99}
    del content["checksum"]
    newer.write_text(json.dumps({**content, "checksum": checksum(content)}))


def is_action_bias(path) -> bool:
    return jax.tree_util.keystr(path, simple=True, separator="/").endswith("action/bias")


def make_outputs(directory: Path) -> None:
    for name, config in (
        ("other", '{"options": {"seeds": [7]}}'),
        ("garbled", '{"options": '),
        ("listed", '{"options": 3}'),
        ("finished", '{"options": {}}'),
    ):
        (directory / name).mkdir()
        (directory / name / "config.json").write_text(config)
    (directory / "finished" / "summary.json").write_text("{}")


def files(directory: Path) -> dict[str, bytes | None]:
    return {str(p): p.read_bytes() if p.is_file() else None for p in directory.rglob("*")}


def command(options: str, there: Path) -> list[str]:
    return options.replace("@", f"{there}/").replace("long", "a" * 300).split()


def assert_refused(said: str, sentence: str) -> None:
    """One sentence of ours, or what the parser says in its box."""
    if said.startswith("error: "):
        (line,) = said.strip().splitlines()
        assert line.endswith(".")
    assert "Traceback" not in said
    assert sentence in " ".join(re.sub("[│╭╮╰╯─]", " ", said).split())


def test_the_table_is_long():
    assert len(BAD) > 60


@pytest.mark.parametrize(("domain", "options", "sentence"), BAD, ids=[row[1] for row in BAD])
def test_a_mistake_gets_one_sentence(
    domain, options, sentence, there, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(transfer, "keep_compiled", lambda: None)
    compiled, before = len(COMPILED), files(there)
    began = time.process_time()
    with pytest.raises(SystemExit) as stop:
        cli.main(["transfer", domain, *command(options, there)])
    assert time.process_time() - began < 10
    assert stop.value.code == 2
    said = capsys.readouterr()
    assert_refused(said.err, sentence)
    assert said.out == ""
    assert COMPILED[compiled:] == []
    assert list(tmp_path.iterdir()) == []
    assert files(there) == before


def test_the_program_itself_ends_with_status_2(there, tmp_path):
    """The same as a person sees it: a process, its status and what it prints."""
    program = Path(__file__).parents[2] / "experiments" / "pp_transfer.py"
    rows = {
        "--devices 7 --learner.num-envs 100": f"100 environments {UNSHARED} 7 devices",
        "--source-checkpoint @truncated": SOURCES["truncated"],
    }
    running = [
        subprocess.Popen(
            [sys.executable, str(program), *command(options, there)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
        )
        for options in rows
    ]
    for process, sentence in zip(running, rows.values(), strict=True):
        said, complained = process.communicate()
        assert process.returncode == 2
        assert said == ""
        assert_refused(complained, sentence)
    assert list(tmp_path.iterdir()) == []


def test_the_preset_decides_the_learners_defaults():
    given = ["--preset", "paper", "--policy", "magic"]
    assert shared.chosen_preset(given, "ic3net") == ("paper", "magic")
    assert shared.chosen_preset([], "hetnet") == ("fast", "hetnet")


def test_help_is_readable(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["transfer", "pp", "--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0
    options = "--policy --preset --seeds --source-epochs --target-epochs --output --no-scratch"
    for option in [*options.split(), "--source.size", "--target.num-predators", "--sizes"]:
        assert option in text
    assert "--policy-settings.hidden" in text
    assert "--source.num-capturers" not in text
    for explained in ("discount and trace decay", "step limit of an episode"):
        assert explained in text


@pytest.mark.parametrize("arguments", [[], ["transfer"], ["transfer", "chess"], ["spam"]])
def test_no_command_is_refused_with_those_there_are(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 2
    assert "sumajax transfer pp|pcp|tj" in capsys.readouterr().err


@pytest.mark.parametrize("home", ["none", "unwritable"])
def test_without_a_home_nothing_is_kept_and_the_run_goes_on(home, tmp_path):
    """No HOME and a user without a name, or one that cannot be written: one sentence."""
    program = (
        "import os, pathlib, sys; from sumajax.cli import options; "
        "pathlib.Path.home = lambda: (_ for _ in ()).throw(RuntimeError('no home directory')) "
        "if sys.argv[1] == 'none' else pathlib.Path('/proc/nowhere'); "
        "options.keep_compiled(); print('goes on')"
    )
    run = subprocess.run(
        [sys.executable, "-c", program, home], capture_output=True, text=True, check=True
    )
    assert run.stdout == "goes on\n"
    (line,) = run.stderr.strip().splitlines()
    assert line.startswith("compiled programs are not kept (")
