"""Parameters as a plain file of NumPy's, and back."""

import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refusal

from sumajax import PredatorPrey, load_npz, make_policy, save_npz
from sumajax.keys import key_of

ENV = PredatorPrey(size=3, num_predators=2, max_steps=6)


@pytest.fixture(scope="module")
def params():
    return jax.jit(make_policy("ic3net", ENV, hidden=4).init)(key_of(0))


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


def test_every_number_comes_back(params, tmp_path):
    file = save_npz(tmp_path / "p.npz", params)
    same(load_npz(file, params), params)
    same(load_npz(file), params)


def test_numbers_that_are_easily_lost_come_back(tmp_path):
    state = {
        "a": np.array([np.nan, np.inf, -0.0, np.float32(1e-45)], np.float32),
        "b": [np.array(2**63 - 1), np.zeros((0, 3), np.int8)],
        "c": np.array([True, False]),
        "file": np.arange(6.0).reshape(2, 3).T,  # in Fortran's order
    }
    back = load_npz(save_npz(tmp_path / "p.npz", state), state)
    same(back, state)
    assert np.signbit(back["a"][2])


def test_numpy_reads_it_by_name(params, tmp_path):
    with np.load(save_npz(tmp_path / "p.npz", params), allow_pickle=False) as found:
        assert "params/core/action/kernel" in found.files
        kernel = found["params/core/action/kernel"]
    np.testing.assert_array_equal(kernel, params["params"]["core"]["action"]["kernel"])


def test_the_same_numbers_are_the_same_file(params, tmp_path):
    first, second = (save_npz(tmp_path / name, params) for name in ("a.npz", "b.npz"))
    assert first.read_bytes() == second.read_bytes()


def test_an_abstract_tree_says_what_is_wanted(params, tmp_path):
    file = save_npz(tmp_path / "p.npz", params)
    policy = make_policy("ic3net", ENV, hidden=4)
    same(load_npz(file, jax.eval_shape(policy.init, key_of(0))), params)


def test_parameters_of_another_size_are_refused(params, tmp_path):
    file = save_npz(tmp_path / "p.npz", params)
    other = jax.eval_shape(make_policy("ic3net", ENV, hidden=8).init, key_of(0))
    said = refusal(load_npz, file, other)
    assert "float32[4" in said
    assert "float32[8" in said


@pytest.mark.parametrize(
    ("leaf", "what"),
    [
        (jnp.ones(2, jnp.bfloat16), "bfloat16[2]"),
        (jax.random.key(0), "key<fry>[]"),
        (np.array(["text"]), "<U4"),
        (np.array([None]), "object"),
    ],
    ids=["bfloat16", "key", "text", "object"],
)
def test_what_numpy_cannot_name_is_refused(leaf, what, tmp_path):
    assert what in refusal(save_npz, tmp_path / "p.npz", {"w": leaf})
    assert not list(tmp_path.iterdir())


def test_another_ending_is_refused(tmp_path):
    assert "p.bin must end in .npz" in refusal(save_npz, tmp_path / "p.bin", {"w": np.ones(2)})


def test_a_place_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").touch()
    said = refusal(save_npz, tmp_path / "file" / "p.npz", {"w": np.ones(2)})
    assert "cannot be written" in said


class TestOfFilesThatAreNoParameters:
    def test_missing(self, tmp_path):
        assert "does not exist" in refusal(load_npz, tmp_path / "p.npz")

    @pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"no zip at all"])
    def test_no_zip(self, content, tmp_path):
        (tmp_path / "p.npz").write_bytes(content)
        refusal(load_npz, tmp_path / "p.npz")

    def test_a_pickle_is_not_opened(self, tmp_path):
        np.savez(tmp_path / "p.npz", w=np.array([print], dtype=object))
        assert "damaged" in refusal(load_npz, tmp_path / "p.npz")

    def test_cut_or_altered_anywhere(self, params, tmp_path):
        content = save_npz(tmp_path / "whole.npz", params).read_bytes()
        file = tmp_path / "p.npz"
        for place in range(60, len(content), len(content) // 20):
            file.write_bytes(content[:place])
            refusal(load_npz, file)
        (kernel,) = [
            entry.header_offset
            for entry in zipfile.ZipFile(tmp_path / "whole.npz").infolist()
            if entry.filename.endswith("action/kernel.npy")
        ]
        altered = bytearray(content)
        altered[kernel + 120] ^= 1
        file.write_bytes(altered)
        refusal(load_npz, file)

    def test_a_member_that_is_no_array(self, tmp_path):
        with zipfile.ZipFile(tmp_path / "p.npz", "w") as archive:
            archive.writestr("read.me", "hello")
        assert "'read.me', which is no array" in refusal(load_npz, tmp_path / "p.npz")
