"""Compiled policy steps and tasks, written to files and read in a program that has no policy."""

import json
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from drawn import drawn_parameters
from jax import export
from refusals import refusal

from sumajax import PredatorPrey, StateUpsampled, TrafficJunction, make_policy
from sumajax.environments import PredatorCapturePrey
from sumajax.evaluation import Agent
from sumajax.keys import key_of

pytest.importorskip("flatbuffers", reason="jax.export writes with flatbuffers, not installed")

ENV = PredatorCapturePrey(size=3, num_predators=2, num_capturers=1, max_steps=6)
SEEN = StateUpsampled(PredatorPrey(size=2, num_predators=2, max_steps=6), size=4)
PAGE = Path(__file__).parents[1] / "docs" / "export.md"
TEAMS, STEPS = 4, 3
WITHOUT_THE_PACKAGE = """
import sys


class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("sumajax", "flax", "optax", "chex", "orbax"):
            raise ModuleNotFoundError(name)


sys.meta_path.insert(0, Absent())
"""
PLAYED = """
with np.load("seen.npz") as seen:
    found = {}
    for mode in ("sampled", "greedy"):
        for teams in (1, len(seen["view"])):
            carry = start(teams)
            for time in range(STEPS):
                key = jax.random.key(time)
                carry, actions, values = act(
                    carry, seen["state"][:teams], seen["view"][:teams], key, mode == "greedy"
                )
                found |= {f"{mode} {teams} {time} actions": actions}
                found |= {f"{mode} {teams} {time} values": values}
np.savez("found.npz", **found)
print(sorted({name.split(".")[0] for name in sys.modules} & {"jax", "sumajax", "flax"}))
"""


def agent_of(name, env, **settings):
    policy = make_policy(name, env, **settings)
    return Agent(env, policy, drawn_parameters(policy))


def seen_by(env, teams=TEAMS):
    """What so many teams see at the start of an episode."""
    keys = jax.random.split(key_of(1), teams)
    return jax.jit(jax.vmap(lambda key: env.observe(env.reset(key))))(keys)


@pytest.mark.parametrize(
    ("name", "env"), [("hetnet", ENV), ("ic3net", SEEN)], ids=["hetnet", "ic3net-upsampled"]
)
def test_an_agent_acts_in_a_program_without_the_package(name, env, tmp_path):
    """By the code of docs/export.md: actions and values are those of the agent."""
    agent, obs = agent_of(name, env), seen_by(env)
    agent.export(tmp_path / "team")
    np.savez(tmp_path / "seen.npz", state=obs.state, view=obs.view)
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[1]
    program = f"{WITHOUT_THE_PACKAGE}\n{code}\nSTEPS = {STEPS}\n{PLAYED}"
    ran = subprocess.run(
        [sys.executable, "-I", "-c", program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout == "['jax']\n"
    with np.load(tmp_path / "found.npz") as found:
        assert_it_is_what_the_agent_does(agent, obs, found)


def assert_it_is_what_the_agent_does(agent, obs, found):
    @jax.jit
    def played(carry, obs, key, greedy):
        noise = agent.policy.sample_noise(key, obs.view.shape[:1], greedy)
        value = agent.policy.apply_with(agent.params, carry, obs, noise)[1].value
        return *agent.act(carry, obs, key, greedy=greedy), value

    for mode in ("sampled", "greedy"):
        for teams in (1, TEAMS):
            few, carry = jax.tree.map(lambda x, n=teams: x[:n], obs), agent.initial_carry((teams,))
            for time in range(STEPS):
                key, greedy = jax.random.key(time), mode == "greedy"
                carry, action, value = played(carry, few, key, greedy)
                name = f"{mode} {teams} {time}"
                np.testing.assert_array_equal(found[f"{name} actions"], action)
                np.testing.assert_allclose(found[f"{name} values"], value, rtol=1e-4, atol=1e-5)
    drawn = [
        found[f"{mode} {TEAMS} {time} actions"]
        for mode in ("sampled", "greedy")
        for time in range(3)
    ]
    assert len(np.unique(np.stack(drawn))) > 1, "they could hardly differ"


@pytest.mark.parametrize("name", ["magic", "tarmac-ic3net", "hetnet-binary", "commnet"])
def test_every_kind_of_policy_can_be_exported(name, tmp_path):
    env = ENV if name.startswith("hetnet") else SEEN
    card = json.loads((agent_of(name, env).export(tmp_path / "team") / "card.json").read_text())
    assert card["policy"]["name"] == name


def test_it_is_for_a_card_as_well_as_for_processors(tmp_path):
    directory = agent_of("iric", SEEN, hidden=4).export(tmp_path / "team")
    exported = export.deserialize((directory / "step.bin").read_bytes())
    assert exported.platforms == ("cpu", "cuda")
    assert str(exported.in_avals[0].shape[0]) == "b"


def test_the_card_lists_every_input_and_output(tmp_path):
    directory = agent_of("ic3net", SEEN, hidden=4).export(tmp_path / "team")
    card = json.loads((directory / "card.json").read_text())
    inputs, outputs = card["inputs"], card["outputs"]
    assert inputs["carry"]["h"] == {"shape": ["b", 2, 4], "dtype": "float32"}
    assert inputs["observation"]["state"]["shape"] == ["b", 2, 1, 4, 4]
    assert inputs["observation"]["view"]["shape"] == ["b", 2, *SEEN.view_shape]
    assert inputs["key"]["shape"] == [2]
    assert outputs["carry"] == inputs["carry"]
    assert outputs["output"]["action"]["shape"] == ["b", 2]
    assert outputs["output"]["action"]["dtype"] == "int32"
    assert card["task"]["class"] == "StateUpsampled"
    assert card["versions"]["jax"] == jax.__version__
    with np.load(directory / "carry.npz") as first:
        assert {name: first[name].shape for name in first} == {
            name: tuple(entry["shape"][1:]) for name, entry in inputs["carry"].items()
        }


@pytest.mark.parametrize("fresh_memory", [False, True])
def test_a_team_that_comes_and_goes_is_told_who_is_there(fresh_memory, tmp_path):
    env = TrafficJunction(num_cars=3)
    agent = agent_of("ic3net", env, hidden=4, fresh_memory=fresh_memory)
    card = json.loads((agent.export(tmp_path / "team") / "card.json").read_text())
    more = {"alive", "entered"} if fresh_memory else {"alive"}
    assert set(card["inputs"]["observation"]) == {"state", "view"} | more
    assert card["inputs"]["observation"]["alive"]["shape"] == ["b", env.num_agents]
    obs = seen_by(env, teams=1)
    step = export.deserialize((tmp_path / "team" / "step.bin").read_bytes()).call
    first = agent.initial_carry((1,))
    carry = {"h": first.h + 1, "s": first.s + 1, "gate": first.gate}
    seen = {"state": obs.state, "view": obs.view, "alive": obs.alive, "entered": obs.alive}
    seen = {name: seen[name] for name in card["inputs"]["observation"]}
    obs, key = obs.replace(entered=obs.alive), jax.random.key(3)
    after, _ = step(carry, seen, jax.random.key_data(key), np.bool_(False))
    expected, _ = jax.jit(agent.act)(first.replace(h=carry["h"], s=carry["s"]), obs, key)
    for name in carry:
        np.testing.assert_allclose(after[name], getattr(expected, name), rtol=1e-4, atol=1e-6)


class TestRefusals:
    def test_nothing_is_replaced(self, tmp_path):
        (tmp_path / "team").mkdir()
        said = refusal(agent_of("iric", SEEN, hidden=4).export, tmp_path / "team")
        assert "exists" in said

    def test_a_place_that_cannot_be_written(self, tmp_path):
        (tmp_path / "file").touch()
        said = refusal(agent_of("iric", SEEN, hidden=4).export, tmp_path / "file" / "team")
        assert "cannot be written" in said

    def test_an_unknown_platform(self, tmp_path):
        agent = agent_of("iric", SEEN, hidden=4)
        said = refusal(agent.export, tmp_path / "team", platforms=["abacus"])
        assert "abacus" in said
        assert not (tmp_path / "team").exists()

    def test_without_flatbuffers(self, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "jax._src.export.serialization", None)
        monkeypatch.setitem(sys.modules, "flatbuffers", None)
        agent = agent_of("iric", SEEN, hidden=4)
        said = refusal(agent.export, tmp_path / "team")
        assert "pip install 'sumajax[export]'" in said


def read_back(function, *arguments):
    """`function` as it comes back from its serialised form."""
    written = export.export(jax.jit(function))(*arguments).serialize()
    return export.deserialize(written)


@pytest.mark.parametrize("name", ["ic3net", "magic", "hetnet-binary"])
def test_a_policy_step(name):
    """Carry, observation and output are the records they were."""
    policy = make_policy(name, ENV)
    params, carry = drawn_parameters(policy), policy.initial_carry()
    obs = jax.tree.map(lambda x: x[0], seen_by(ENV))
    noise = jax.jit(partial(policy.sample_noise, batch_shape=()))(key_of(2))
    again = read_back(policy.apply_with, params, carry, obs, noise)
    expected = jax.jit(policy.apply_with)(params, carry, obs, noise)
    found = again.call(params, carry, obs, noise)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), found, expected
    )


def test_a_step_of_the_task():
    state, actions = jax.jit(ENV.reset)(key_of(1)), np.zeros(ENV.num_agents, np.int32)
    found = read_back(ENV.step, state, actions).call(state, actions)
    jax.tree.map(np.testing.assert_array_equal, found, jax.jit(ENV.step)(state, actions))
