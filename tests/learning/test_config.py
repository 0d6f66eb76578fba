"""Settings of the learner: the presets of docs/settings.md, and what is refused."""

import re
from dataclasses import asdict

import pytest

from sumajax.learning import EPOCH_STEPS, LearnerConfig, preset
from sumajax.learning.config import PRESETS
from sumajax.policies import POLICIES

PUBLISHED = {
    # docs/settings.md: the programs' arguments, and the paper's four processes (VII-C)
    "num_envs": 4,
    "rollout_length": 500,
    "whole_episodes": True,
    "gamma": 1.0,
    "gae_lambda": 1.0,
    "bootstrap_timeouts": False,
    "team_reward": 0.0,
    "advantages": "raw",
    "mask_inactive": False,
    "alive_mask": "after",
    "loss": "actor_critic",
    "value_weight": 0.01,
    "policy_weight": 1.0,
    "entropy_weight": 0.0,
    "optimiser": "rmsprop",
    "learning_rate": 1e-3,
    "transfer_rate": 1.0,
    "scale_by_size": False,
    "scale_rewards": False,
    "critic_epochs": 0,
    "max_grad_norm": None,
    "clip_per_env": False,
    "warmup_epochs": 0,
    "anneal_epochs": 0,
    "detach_gap": 10,
}

HETNET = {
    # docs/settings.md: the arguments of HetNet's program
    "gae_lambda": 0.95,
    "loss": "hetnet",
    "value_weight": 1.0,
    "policy_weight": 50.0,
    "learning_rate": 1e-4,
    "max_grad_norm": 0.75,
    "clip_per_env": True,
    "detach_gap": 5,
}

DIFFERENT = {
    "ic3net": {},
    "iric": {},
    "commnet": {"team_reward": 1.0},
    "ic": {"team_reward": 1.0},
    "magic": {"value_weight": 0.015},
    "tarmac": {"team_reward": 1.0},
    "tarmac-ic3net": {},
    "hetnet": HETNET,
    "hetnet-binary": HETNET,
}


@pytest.mark.parametrize("policy", POLICIES)
def test_preset_paper(policy):
    settings = asdict(preset("paper", policy))
    expected = PUBLISHED | DIFFERENT[policy]
    assert {name: settings[name] for name in expected} == expected


def test_an_epoch_of_the_paper_is_ten_updates():
    assert EPOCH_STEPS == 20_000
    assert preset("paper").updates_per_epoch == 10


@pytest.mark.parametrize("policy", POLICIES)
def test_preset_fast_differs_only_in_the_reward(policy):
    """CommNet, IC and TarMAC without a gate are trained on the team's mean, IRIC on its own."""
    of_team = {"commnet": 1.0, "ic": 1.0, "tarmac": 1.0, "iric": 0.0}
    team = of_team.get(policy, LearnerConfig().team_reward)
    assert preset("fast", policy) == LearnerConfig(team_reward=team)


def test_changes_come_last():
    assert preset("paper", "hetnet", learning_rate=1e-2).learning_rate == 1e-2


def test_updates_of_an_epoch():
    assert LearnerConfig(num_envs=40, rollout_length=25).updates_per_epoch == 20


HETNET_LOSS = asdict(preset("paper", "hetnet"))

REFUSED = [
    ({"num_envs": 0}, "num_envs must be a whole number of at least 1, got 0."),
    ({"num_envs": 2.0}, "num_envs must be a whole number of at least 1, got 2.0."),
    ({"num_envs": True}, "num_envs must be a whole number of at least 1, got True."),
    ({"rollout_length": -5}, "rollout_length must be a whole number of at least 1, got -5."),
    ({"warmup_epochs": -1}, "warmup_epochs must be a whole number of at least 0, got -1."),
    ({"anneal_epochs": 1.5}, "anneal_epochs must be a whole number of at least 0, got 1.5."),
    ({"detach_gap": 0}, "detach_gap must be a whole number of at least 1, got 0."),
    ({"detach_gap": 2.5}, "detach_gap must be a whole number of at least 1, got 2.5."),
    ({"gamma": 1.1}, "gamma must lie between 0 and 1, got 1.1."),
    ({"gamma": float("nan")}, "gamma must lie between 0 and 1, got nan."),
    ({"gae_lambda": -0.1}, "gae_lambda must lie between 0 and 1, got -0.1."),
    ({"team_reward": 2.0}, "team_reward must lie between 0 and 1, got 2.0."),
    ({"anneal_to": -1.0}, "anneal_to must lie between 0 and 1, got -1.0."),
    ({"value_weight": -1.0}, "value_weight must be a finite number of at least 0, got -1.0."),
    ({"policy_weight": -1.0}, "policy_weight must be a finite number of at least 0, got -1.0."),
    ({"entropy_weight": -0.01}, "entropy_weight must be a finite number of at least 0, got -0.01."),
    ({"learning_rate": 0.0}, "learning_rate must be a finite number greater than 0, got 0.0."),
    ({"transfer_rate": 0.0}, "transfer_rate must be a finite number greater than 0, got 0.0."),
    ({"learning_rate": None}, "learning_rate must be a finite number greater than 0, got None."),
    ({"learning_rate": 1e999}, "learning_rate must be a finite number greater than 0, got inf."),
    ({"value_weight": 1e999}, "value_weight must be a finite number of at least 0, got inf."),
    ({"gamma": "high"}, "gamma must lie between 0 and 1, got 'high'."),
    ({"team_reward": True}, "team_reward must lie between 0 and 1, got True."),
    ({"whole_episodes": "yes"}, "whole_episodes must be True or False, got 'yes'."),
    (
        {"clip_per_env": True, "max_grad_norm": None},
        "clip_per_env needs max_grad_norm, got None; give the norm to clip at.",
    ),
    ({"max_grad_norm": -0.5}, "max_grad_norm must be a finite number greater than 0, got -0.5."),
    ({"optimiser": "sgd"}, "optimiser 'sgd' is unknown; choose one of adam, rmsprop."),
    ({"loss": "ppo"}, "loss 'ppo' is unknown; choose one of actor_critic, hetnet."),
    (
        {"num_envs": 30, "rollout_length": 20},
        "30 environments x 20 steps = 600 steps per update do not divide an epoch of 20000; "
        "20 environments or 25 environments would.",
    ),
    (
        {"num_envs": 7, "rollout_length": 3},
        "7 environments x 3 steps = 21 steps per update do not divide an epoch of 20000; "
        "a rollout_length of 20 with 50 environments would.",
    ),
    (
        HETNET_LOSS | {"whole_episodes": False},
        "loss 'hetnet' needs whole_episodes=True, got False; "
        "preset 'paper' of policy 'hetnet' has all it needs.",
    ),
    (
        HETNET_LOSS | {"team_reward": 0.5},
        "loss 'hetnet' needs team_reward=0.0, got 0.5; "
        "preset 'paper' of policy 'hetnet' has all it needs.",
    ),
]


@pytest.mark.parametrize(("settings", "sentence"), REFUSED, ids=lambda x: str(x)[-40:])
def test_refused_in_one_sentence(settings, sentence):
    with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
        LearnerConfig(**settings)


def test_what_none_turns_off():
    assert LearnerConfig(max_grad_norm=None, detach_gap=None).detach_gap is None


def test_unknown_preset():
    with pytest.raises(ValueError, match=r"preset 'quick' is unknown; choose one of fast, paper\."):
        preset("quick")


def test_unknown_setting():
    with pytest.raises(
        ValueError, match=r"the learner has no setting 'lr'; it has .*learning_rate"
    ):
        preset("fast", lr=1e-3)


def test_an_unpublished_policy_has_no_preset_paper():
    """Else it would quietly be given the settings of `fast`."""
    with pytest.raises(ValueError, match="nothing was published about policy 'mine'"):
        preset("paper", "mine")
    assert preset("fast", "mine") == LearnerConfig()


def test_a_preset_for_every_policy():
    assert set(PRESETS["paper"]) == set(POLICIES)
