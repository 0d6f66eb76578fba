"""NumPy's and JAX's numbers, as sweep tools hand them out, are the numbers they are everywhere."""

import json
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sumajax import checkpoint
from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.learning import LearnerConfig, make_learner, preset
from sumajax.plain import plain
from sumajax.policies import POLICIES, make_policy
from sumajax.upsampling import StateUpsampled


def same(value, expected):
    """Equal, and of the same type all the way down."""
    assert type(value) is type(expected)
    assert value == expected
    if isinstance(value, (tuple, list)):
        for pair in zip(value, expected, strict=True):
            same(*pair)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.int64(5), 5),
        (np.uint8(5), 5),
        (np.float32(0.5), 0.5),
        (np.float64(0.1), 0.1),
        (np.float16(2.0), 2.0),
        (jnp.bfloat16(1.5), 1.5),
        (np.bool_(True), True),
        (np.str_("fast"), "fast"),
        (np.array(5), 5),
        (np.array(False), False),
        (np.array("text"), "text"),
        (jnp.int32(3), 3),
        (jnp.float32(0.25), 0.25),
        ((np.int64(1), [np.float32(2), "x"]), (1, [2.0, "x"])),
        ({np.str_("a"): {"b": np.bool_(False)}}, {"a": {"b": False}}),
        (Fraction(1, 2), 0.5),
        (True, True),
        (None, None),
        (7, 7),
    ],
)
def test_values(value, expected):
    same(plain(value), expected)


def test_what_is_no_number_stays_what_it_is():
    key, table = jax.random.key(0), np.arange(6)
    for value in (key, table, object, PredatorPrey(3), {1, 2}, np.array([None])):
        assert plain(value) is value
    jax.jit(lambda x: plain(x))(1.0)  # a traced value has no number yet


INTS = [np.int64, np.uint8, np.array, jnp.int32]
TASKS = [
    (PredatorPrey, {"size": 5, "num_predators": 2, "vision": 1, "max_steps": 20}),
    (
        PredatorCapturePrey,
        {"size": 6, "num_predators": 2, "num_capturers": 1, "vision": 2, "capture_vision": 1},
    ),
]


@pytest.mark.parametrize("kind", INTS)
@pytest.mark.parametrize(("task", "fields"), TASKS)
def test_tasks(task, fields, kind):
    ours = task(**{name: kind(value) for name, value in fields.items()})
    theirs = task(**fields)
    assert (ours, hash(ours), repr(ours)) == (theirs, hash(theirs), repr(theirs))
    wide = StateUpsampled(ours, kind(30), scale=np.str_("mass"))
    assert repr(wide) == repr(StateUpsampled(theirs, 30, scale="mass"))
    assert StateUpsampled(ours, np.array([30, 60])).size == (30, 60)
    assert task(size=(kind(7), 8), reward_mode=np.str_("cooperative")).size == (7, 8)


def test_what_was_refused_still_is():
    for size in (np.float64(5), np.bool_(True), np.array([1, 2, 3]), np.array(5.0), np.str_("5")):
        with pytest.raises(ValueError, match="size"):
            PredatorPrey(size)
    with pytest.raises(ValueError, match="max_steps"):
        PredatorPrey(max_steps=np.float32(80))
    with pytest.raises(ValueError, match="num_envs"):
        LearnerConfig(num_envs=np.bool_(True))
    with pytest.raises(ValueError, match="clip_per_env"):
        LearnerConfig(clip_per_env=np.int64(1))
    with pytest.raises(ValueError, match="hidden must be at least 1"):
        make_policy("ic3net", PredatorPrey(3), hidden=np.int64(0))


@pytest.mark.parametrize("name", POLICIES)
def test_policies(name):
    env = PredatorPrey(5)
    settings = {"encoder": np.str_("flat")}
    if "hidden" in POLICIES[name][0].__dataclass_fields__:
        settings["hidden"] = np.int64(16)
    ours, theirs = (make_policy(name, env, **given) for given in (settings, plain(settings)))
    assert (ours, hash(ours), repr(ours)) == (theirs, hash(theirs), repr(theirs))
    for setting, value in settings.items():
        same(getattr(ours.module, setting), plain(value))


def test_learner():
    given = {
        "num_envs": np.int64(100),
        "rollout_length": np.array(20),
        "learning_rate": np.float32(2**-10),
        "gamma": np.float64(0.9),
        "max_grad_norm": jnp.float32(0.5),
        "mask_inactive": np.bool_(False),
        "advantages": np.str_("raw"),
    }
    ours, theirs = preset("fast", **given), preset("fast", **plain(given))
    assert (ours, hash(ours), repr(ours)) == (theirs, hash(theirs), repr(theirs))
    json.dumps(vars(ours))


def test_what_was_trained_with_them_is_saved_and_read(tmp_path):
    env = StateUpsampled(PredatorPrey(np.int64(3), max_steps=np.int32(10)), np.int64(6))
    policy = make_policy("ic3net", env, hidden=np.int64(8))
    learner = make_learner(env, policy, preset("fast", num_envs=np.int64(10)))
    state = learner.init(jax.random.key(np.uint32(1)))
    meta = checkpoint.describe(
        env,
        policy,
        seeds=np.arange(2),
        epoch=np.int64(3),
        rate=np.float32(0.5),
        done=np.bool_(True),
        preset=np.str_("fast"),
        inner={"sizes": (np.int64(5), np.array(6)), "rates": np.ones((1, 2), np.float32)},
    )
    path = checkpoint.save(tmp_path, state, meta, step=np.int64(7), keep=np.int64(2))
    assert path.name == "000001-step-7"
    assert checkpoint.save(tmp_path, state, meta).name == "000002-step-3"
    read = checkpoint.read_meta(tmp_path)
    assert checkpoint.rebuild(read) == (env, policy)
    assert (read["seeds"], read["epoch"], read["rate"], read["done"]) == ([0, 1], 3, 0.5, True)
    assert read["inner"] == {"sizes": [5, 6], "rates": [[1.0, 1.0]]}
    checkpoint.load(tmp_path, state)
