"""Making a policy by name: what there is, and what is said about what there is not."""

import jax
import pytest

from sumajax.policies import POLICIES, make_policy

from .teams import NAMES, PREY_THREE


def test_every_published_policy_has_a_name():
    assert set(POLICIES) == {*NAMES, "commnet", "iric", "ic", "tarmac"}


def test_an_unknown_name_is_answered_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'dgn' is unknown; choose one of ic3net, .*magic"):
        make_policy("dgn", PREY_THREE)


def test_an_unknown_setting_is_answered_with_the_known_ones():
    with pytest.raises(
        ValueError, match=r"no setting 'layers'; it has encoder, fresh_memory, hidden, setting"
    ):
        make_policy("magic", PREY_THREE, layers=3)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("ic3net", {"encoder": "deep"}),
        ("magic", {"setting": "easy"}),
        ("hetnet", {"meta": "raw"}),
        ("tarmac", {"score_scale": "none"}),
    ],
)
def test_an_unknown_choice_is_answered_with_the_known_ones(name, settings):
    ((setting, value),) = settings.items()
    with pytest.raises(ValueError, match=f"{setting} '{value}' is unknown; choose one of"):
        make_policy(name, PREY_THREE, **settings)


def test_settings_that_make_a_variant_are_not_up_for_choice():
    with pytest.raises(ValueError, match="no setting 'bits'"):
        make_policy("hetnet-binary", PREY_THREE, bits=4)


def test_parameters_start_from_the_key_alone():
    policy = make_policy("ic3net", PREY_THREE, hidden=8)
    init = jax.jit(policy.init)
    one, same, other = (jax.tree.leaves(init(jax.random.key(seed))) for seed in (0, 0, 1))
    assert all((a == b).all() for a, b in zip(one, same, strict=True))
    assert not all((a == b).all() for a, b in zip(one, other, strict=True))
