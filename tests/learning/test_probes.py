"""The real learner on tasks whose answer is known (probes.py): each asks one thing of it."""

from functools import cache

import numpy as np
import pytest
from probes import (
    ChooseOne,
    ConstantReward,
    Credit,
    LastStepReward,
    MatchState,
    MatchUnlistedState,
    MatchView,
    Probe,
    Remember,
    Tell,
    learn,
)

from sumajax.learning.rollout import Trajectory

GAMMA = 0.5
SMALL = {"num_envs": 10, "rollout_length": 5, "learning_rate": 2e-2, "gamma": GAMMA}
ALWAYS, CHANCE = 0.95, 0.5

ALONE = {
    "constant": ConstantReward(max_steps=2),
    "endless": ConstantReward(max_steps=2, terminates=False),
    "last step": LastStepReward(),
    "choose": ChooseOne(),
    "view": MatchView(),
    "state": MatchState(),
}
"""One agent each; learnt by independent controllers, in one program."""


@cache
def alone() -> dict[str, Trajectory]:
    played = learn(*ALONE.values(), policy="iric", updates=400, **SMALL)
    return dict(zip(ALONE, played, strict=True))


def values_by_step(trajectory: Trajectory, probe: Probe) -> np.ndarray:
    """(seeds, max_steps) mean value before each step of an episode."""
    steps = np.arange(1, probe.max_steps + 1)
    at = trajectory.steps_taken[..., None, None] == steps  # (seeds, T, E, 1, steps)
    weight = np.broadcast_to(at, (*trajectory.value.shape, len(steps)))
    summed = (weight * trajectory.value[..., None]).sum((1, 2, 3))
    return summed / weight.sum((1, 2, 3))


def earned(trajectory: Trajectory, agent: int = 0) -> np.ndarray:
    """(seeds,) mean reward of an agent over finished episodes."""
    reward = trajectory.episode_return[..., agent]
    return (reward * trajectory.last).sum((1, 2)) / trajectory.last.sum((1, 2))


@pytest.mark.parametrize(
    ("name", "values", "atol"),
    [
        ("constant", [1 + GAMMA, 1], 0.05),
        ("last step", [GAMMA, 1], 0.05),
        # Learnt from its own estimate, so it settles later than the others.
        ("endless", [1 / (1 - GAMMA)] * 2, 0.2),
    ],
)
def test_value(name, values, atol):
    """The discounted sum to come; past a step limit as if the task went on."""
    learnt = values_by_step(alone()[name], ALONE[name])
    np.testing.assert_allclose(learnt, [values] * 3, atol=atol)


@pytest.mark.parametrize("name", ["choose", "view", "state"])
def test_action(name):
    """One action is paid; which one the view or the state tells."""
    assert (earned(alone()[name]) > ALWAYS).all()


def test_action_by_a_state_too_large_to_list():
    """Without a state table the tensors themselves are encoded, step by step."""
    (played,) = learn(MatchUnlistedState(), policy="iric", updates=200, **SMALL)
    assert (earned(played) > ALWAYS).all()


def test_action_by_memory():
    """The view tells it at the first step only, two steps before it is paid.

    At twice the rate and half the updates one seed in ten still guesses: which one, rounding says.
    """
    settings = {**SMALL, "learning_rate": 1e-2}
    (played,) = learn(Remember(), policy="iric", updates=800, **settings)
    assert (earned(played) > ALWAYS).all()


@pytest.mark.parametrize(("policy", "deaf"), [("commnet", 0), ("ic3net", 2)])
def test_message(policy, deaf):
    """Agent 1 acts on what only agent 0 saw; with IC3Net both must have opened their gates.

    Of IC3Net's seeds one in sixty closes them before there is anything to hear (at the other
    probes' rate one in three), and never learns: which one, rounding says.
    """
    settings = {**SMALL, "num_envs": 50, "rollout_length": 4, "learning_rate": 3e-3}
    (played,) = learn(Tell(max_steps=2), policy=policy, updates=1_000, seeds=10, **settings)
    assert (earned(played) <= ALWAYS).sum() <= deaf


@cache
def independent_pair() -> list[Trajectory]:
    return learn(Tell(max_steps=2), Credit(), policy="iric", updates=300, **SMALL)


def test_no_message_without_a_channel():
    """Independent controllers cannot know the cue: agent 1 guesses."""
    chance = earned(independent_pair()[0])
    np.testing.assert_allclose(chance, CHANCE, atol=0.1)


def test_credit_to_each_agent():
    """Agent 0 is trained on its own reward: it takes 1 for itself."""
    assert (earned(independent_pair()[1]) > ALWAYS).all()


def test_credit_to_the_team():
    """On the mean of the team's rewards the other action is better: 2 for agent 1."""
    (played,) = learn(Credit(), policy="ic", updates=200, **SMALL)
    assert (earned(played, agent=1) > 2 * ALWAYS).all()


def test_the_published_procedure():
    """Preset `paper`: whole episodes, no discount, RMSprop."""
    probes = LastStepReward(), MatchView()
    small = {"num_envs": 10, "rollout_length": 4, "learning_rate": 2.5e-3}
    value, action = learn(*probes, policy="iric", updates=800, settings="paper", **small)
    np.testing.assert_allclose(values_by_step(value, probes[0]), 1, atol=0.1)
    assert (earned(action) > ALWAYS).all()
