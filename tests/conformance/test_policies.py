"""Our policy cores against recorded steps of the original modules, every field of every file.

Left out on purpose, and nothing else: `a2c_*` files, which are about the learner's updates.
"""

from pathlib import Path

import numpy as np
import policy_data as data
import pytest

from sumajax.policies.layers import straight_through_bit

OF_THE_LEARNER = "a2c_"
OF_POLICIES = ("ic3net_", "magic_", "het_", "tarmac_", data.ALIVE)
PREFIXES = (*OF_POLICIES, OF_THE_LEARNER)
DRAWN = ("in.graph", "in.bits")
"""Fields that a core answers too; in a file without them nothing was drawn."""
TOLERANCE = {np.float64: 1e-9, np.float32: 1e-5}
RAW_META_TOLERANCE = 1e-4
"""float32 in `het_seq_*`, whose state nodes read raw numbers up to 500 (README section 3.3)."""


def case(path: Path):
    learner = pytest.mark.skipif(
        path.stem.startswith(OF_THE_LEARNER), reason="updates of the learner, not a policy core"
    )
    return pytest.param(path, id=path.stem, marks=learner)


each_recording = pytest.mark.parametrize("path", [case(path) for path in data.recordings()])
each_precision = pytest.mark.parametrize(
    "dtype", [np.float64, np.float32], ids=["float64", "float32"]
)


def test_there_are_recordings_of_every_policy():
    stems = [path.stem for path in data.recordings()]
    for prefix in OF_POLICIES:
        assert any(stem.startswith(prefix) for stem in stems), f"no {prefix}* in {data.directory()}"


@pytest.mark.parametrize("path", data.recordings(), ids=lambda path: path.stem)
def test_every_recording_is_of_a_known_kind(path):
    assert path.stem.startswith(PREFIXES), f"{path.name}: nothing here knows how to check it"


@each_precision
@each_recording
def test_every_recorded_result(path, dtype):
    expected, ours = data.expected(path), data.answer(path, dtype)
    raw_meta = dtype == np.float32 and path.stem.startswith("het_seq_")
    tolerance = RAW_META_TOLERANCE if raw_meta else TOLERANCE[dtype]
    assert expected
    assert not set(expected) - set(ours), "fields that nothing answers"
    for name, value in expected.items():
        assert ours[name].dtype == dtype, name
        np.testing.assert_allclose(ours[name], value, rtol=tolerance, atol=tolerance, err_msg=name)


@each_recording
def test_the_given_draws_were_used(path):
    """The core drew the recorded graphs and bits exactly, so the results above follow from them."""
    given = {name: y for name, y in data.load(path).items() if name.startswith(DRAWN)}
    ours = data.answer(path, np.float32) if given else {}
    for name, value in given.items():
        np.testing.assert_array_equal(ours[name], value, err_msg=name)


@each_recording
def test_draws_follow_from_logits_and_gumbel_noise(path):
    """One logistic number per bit, the difference of the two recorded Gumbel ones, is enough."""
    for logits, gumbel, bits in data.drawn_bits(data.load(path)):
        logistic = gumbel[..., 1] - gumbel[..., 0]
        np.testing.assert_array_equal(straight_through_bit(logits, logistic), bits)
