"""Tasks and policies described, compared and rebuilt."""

import dataclasses
import importlib.metadata
import json
from typing import Any

import jax
import numpy as np
import pytest
from refusals import refusal

import sumajax
from sumajax.description import check_compatible, describe, rebuild, versions
from sumajax.environments import PredatorCapturePrey, PredatorPrey, TrafficJunction
from sumajax.policies import POLICIES, Policy, TeamSpec, make_policy
from sumajax.policies.ic3net import IC3Net
from sumajax.upsampling import StateUpsampled

ENVS = [
    PredatorPrey(size=5, num_predators=3, vision=1, max_steps=80, reward_mode="cooperative"),
    PredatorPrey(size=(4, 6), vision=0),
    TrafficJunction("medium", final_arrival_rate=0.3, rate_epochs=(2, 5)),
    PredatorCapturePrey(size=6, num_capturers=2, vision=2, capture_vision=1),
    StateUpsampled(PredatorPrey(size=5), size=10, scale="mass"),
    StateUpsampled(StateUpsampled(PredatorPrey(size=(2, 3)), size=(4, 6)), size=(8, 12)),
]


@pytest.mark.parametrize("env", ENVS, ids=repr)
def test_task_and_policy_are_rebuilt_from_plain_json(env):
    policy = make_policy("ic3net", env, hidden=32)
    meta = json.loads(json.dumps(describe(env, policy, preset="fast", epoch=3)))
    assert rebuild(meta) == (env, policy)
    assert (meta["preset"], meta["epoch"]) == ("fast", 3)
    assert meta["versions"]["jax"] == jax.__version__
    check_compatible(meta, env, policy)


@pytest.mark.parametrize("name", POLICIES)
def test_every_policy_is_rebuilt(name):
    policy = make_policy(name, ENVS[0])
    meta = json.loads(json.dumps(describe(ENVS[0], policy)))
    assert rebuild(meta) == (ENVS[0], policy)
    check_compatible(meta, ENVS[0], policy)


@pytest.mark.parametrize(
    ("target", "name", "settings", "words"),
    [
        (PredatorPrey(10), "commnet", {}, ["policy", "ic3net", "commnet"]),
        (PredatorPrey(10), "ic3net", {"hidden": 64}, ["hidden", "128", "64"]),
        (PredatorPrey(10, vision=2), "ic3net", {}, ["vision", "1 in runs/x", "2 in this"]),
        (PredatorCapturePrey(10), "ic3net", {}, ["observation channels", "2 in", "3 in"]),
        (PredatorPrey(20), "ic3net", {}, ["grid", "10x10", "20x20", "StateUpsampled"]),
    ],
)
def test_what_differs_between_stages_is_named_with_both_values(target, name, settings, words):
    source = StateUpsampled(PredatorPrey(5), 10)
    meta = describe(source, make_policy("ic3net", source))
    policy = make_policy(name, target, **settings)
    sentence = refusal(check_compatible, meta, target, policy, "runs/x")
    assert all(word in sentence for word in [*words, "runs/x"]), sentence


def test_an_encoder_that_pools_fits_any_grid():
    small, large = PredatorPrey(5), PredatorPrey(10)
    policies = [make_policy("ic3net", env, encoder="lab_gap") for env in (small, large)]
    check_compatible(describe(small, policies[0]), large, policies[1])


def test_number_of_actions():
    env = PredatorPrey(10)
    policy = make_policy("ic3net", env)
    meta = {**describe(env, policy), "num_actions": 6}
    sentence = refusal(check_compatible, meta, env, policy)
    assert "number of actions differs: 6 in the checkpoint, 5 in this stage" in sentence


def test_settings_of_another_version():
    env = PredatorPrey(10)
    policy = make_policy("ic3net", env)
    meta = describe(env, policy)
    del meta["policy"]["settings"]["comm_passes"]  # there was no such setting then
    check_compatible(meta, env, policy)
    meta["policy"]["settings"]["heads"] = 4
    assert "heads differs: 4" in refusal(check_compatible, meta, env, policy)


def test_a_description_of_nothing():
    env = PredatorPrey(10)
    for meta in ({}, {"policy": None}, {"policy": {"name": "ic3net", "settings": {}}}):
        refusal(check_compatible, meta, env, make_policy("ic3net", env), "runs/x")
        refusal(rebuild, meta)


def test_a_policy_of_your_own_is_described_and_not_taken_for_one_of_ours():
    env = PredatorPrey(5)
    mine = Policy("ic3net", Mine(TeamSpec.of(env)))
    meta = json.loads(json.dumps(describe(env, mine)))
    assert meta["policy"]["settings"]["activation"].endswith("relu")
    assert "0x" not in json.dumps(meta)
    assert "load_params" in refusal(rebuild, meta)
    check_compatible(meta, env, mine)


@dataclasses.dataclass(frozen=True)
class Wind:
    strength: Any
    gusts: tuple[float, ...] = (0.5, 1.0)


@dataclasses.dataclass(frozen=True)
class Windy(PredatorPrey):
    """A domain of one's own, with settings of its own."""

    wind: Any = None
    rates: Any = None
    table: Any = None
    rule: Any = jax.nn.relu


class Mine(IC3Net):
    activation: Any = jax.nn.relu
    wind: Any = None


def test_a_task_of_your_own_is_described_in_plain_words_and_compared():
    wind = Wind(np.float32(0.5))
    table = np.zeros((100, 100), np.int8)
    env = Windy(5, wind=wind, rates={"a": np.int64(3)}, table=table)
    policy = Policy("mine", Mine(TeamSpec.of(env), wind=wind))
    meta = json.loads(json.dumps(describe(env, policy)))
    assert meta == json.loads(json.dumps(describe(env, policy)))
    assert meta["task"]["class"].endswith("test_description.Windy")
    fields = meta["task"]["fields"]
    gusty = {"strength": 0.5, "gusts": [0.5, 1.0]}
    assert fields["wind"]["class"].endswith("test_description.Wind")
    assert fields["wind"]["fields"] == gusty
    assert fields["rates"] == {"a": 3}
    assert (fields["table"]["shape"], fields["table"]["dtype"]) == ([100, 100], "int8")
    assert fields["rule"].endswith("relu")
    assert meta["policy"]["settings"]["wind"]["fields"] == gusty
    assert "0x" not in json.dumps(meta)

    for unknown in (meta, {**meta, "task": describe(ENVS[0], policy)["task"]}):
        sentence = refusal(rebuild, unknown)
        assert "pass env=... and policy=... to load_agent" in sentence
    check_compatible(meta, env, policy)
    other = Policy("mine", Mine(TeamSpec.of(env), wind=Wind(0.75)))
    sentence = refusal(check_compatible, meta, env, other, "runs/x", here="what you gave")
    assert "policy setting wind differs" in sentence
    assert "in what you gave" in sentence


def test_a_task_that_is_no_dataclass_is_known_by_its_name():
    class Plain:
        def __getattr__(self, name: str) -> Any:
            return getattr(ENVS[0], name)

    meta = describe(Plain(), make_policy("ic3net", ENVS[0]))
    assert meta["task"]["class"].endswith("Plain")
    assert "load_agent" in refusal(rebuild, meta)


def test_versions_of_a_package_that_is_not_installed(monkeypatch):
    """A clone on the path has no distribution metadata."""

    def version(name: str) -> str:
        if name in ("sumajax", "optax"):
            raise importlib.metadata.PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(importlib.metadata, "version", version)
    found = versions()
    assert (found["sumajax"], found["optax"]) == (sumajax.__version__, "unknown")
    assert {"python", "jax", "flax", "optax", "orbax-checkpoint", "numpy"} <= found.keys()
    env = ENVS[0]
    assert describe(env, make_policy("ic3net", env))["versions"] == found


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (["task", "class"], "os.system", "os.system"),
        (["task", "class"], ["PredatorPrey"], "PredatorPrey"),
        (["task", "fields"], {"env": {"class": "PredatorPrey", "fields": {}}}, "usable"),
        (["task", "fields", "size"], -5, "size"),
        (["task", "fields", "size"], 10**9, "size"),
        (["task", "fields", "size"], [10_000, 10_000], "10000x10000"),
        (["task", "fields", "num_predators"], "three", "num_predators"),
        (["task", "fields", "colour"], "red", "colour"),
        (["policy", "name"], "telepathy", "telepathy"),
        (["policy", "module"], "os.system", "ic3net"),
        (["policy", "settings", "hidden"], "large", "hidden"),
        (["policy", "settings", "hidden"], 10**12, "hidden"),
        (["policy", "settings", "encoder"], "eval", "eval"),
        (["policy", "settings", "gated"], 1, "gated"),
        (["policy", "settings", "parent"], None, "parent"),
        (["policy", "settings"], [], "usable"),
        (["policy"], "ic3net", "usable"),
        (["task"], None, "usable"),
    ],
)
def test_descriptions_that_are_not_built(place, value, words):
    env = PredatorPrey(5)
    meta = json.loads(json.dumps(describe(env, make_policy("ic3net", env))))
    *above, last = place
    inner = meta
    for name in above:
        inner = inner[name]
    inner[last] = value
    assert words in refusal(rebuild, meta)


def test_a_task_within_a_task_without_end():
    env = PredatorPrey(5)
    meta = describe(env, make_policy("ic3net", env))
    for _ in range(50):
        fields = {"env": meta["task"], "size": 5, "scale": "none"}
        meta["task"] = {"class": "StateUpsampled", "fields": fields}
    refusal(rebuild, meta)
