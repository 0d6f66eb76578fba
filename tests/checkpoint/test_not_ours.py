"""What others made is neither taken for ours nor touched."""

import os
import resource
import tempfile
from pathlib import Path

import numpy as np
from refusals import refusal
from saved_states import META, bits, listing, sealed, train_state

from sumajax import checkpoint
from sumajax.checkpoint import latest, load, save


class TestNotOurs:
    def test_missing_empty_and_foreign_directories(self, tmp_path):
        assert "is no directory" in refusal(load, tmp_path / "missing")
        assert "holds no checkpoint" in refusal(load, tmp_path)
        (tmp_path / "file").write_text("x")
        assert "is no directory" in refusal(load, tmp_path / "file")
        (tmp_path / "000001-step-1").symlink_to(tmp_path)
        assert "checkpoint.json is missing" in refusal(load, tmp_path)
        (tmp_path / "000001-step-1").unlink()
        (tmp_path / "000001-step-1").symlink_to("gone")
        assert "holds no checkpoint" in refusal(load, tmp_path)

    def test_another_programs_orbax_checkpoint(self, tmp_path):
        from orbax.checkpoint import v1 as ocp

        ocp.save(tmp_path / "theirs", {"params": np.ones(3)})
        before = listing(tmp_path)
        assert "holds no checkpoint of sumajax" in refusal(load, tmp_path / "theirs")
        assert "but one itself" in refusal(save, tmp_path / "theirs", train_state(), META)
        assert listing(tmp_path) == before

    def test_a_checkpoint_is_no_directory_of_checkpoints(self, damaged):
        before = listing(damaged)
        assert "but one itself" in refusal(save, latest(damaged), train_state(), META)
        assert listing(damaged) == before

    def test_nothing_foreign_is_touched(self, tmp_path):
        (tmp_path / "thesis.tex").write_text("years of work")
        (tmp_path / ".unfinished-symphony").mkdir()
        assert "cannot be written" in refusal(save, tmp_path / "thesis.tex", train_state(), META)
        for epoch in range(3):
            save(tmp_path, train_state(epoch), META, keep=1)
        names = [".unfinished-symphony", "000003-step-1", "thesis.tex"]
        assert sorted(os.listdir(tmp_path)) == names
        assert (tmp_path / "thesis.tex").read_text() == "years of work"

    def test_a_newer_format_is_refused_and_not_passed_over(self, damaged):
        sealed(latest(damaged), version=2)
        sentence = refusal(load, damaged)
        assert "format 2" in sentence
        assert "newer" in sentence

    def test_what_could_not_be_read_is_not_written(self, tmp_path):
        meta = {"notes": "x" * checkpoint.MAX_DESCRIPTION_BYTES}
        assert "shorten meta" in refusal(save, tmp_path / "c", {"w": np.ones(1)}, meta)
        assert os.listdir(tmp_path / "c") == []

    def test_another_format(self, damaged):
        sealed(latest(damaged), format="something else")
        assert "not of sumajax" in refusal(load, damaged)

    def test_directories_that_cannot_be_written_keep_what_they_have(self):
        """As an ordinary user, since root may write anywhere."""
        with tempfile.TemporaryDirectory() as place:
            directory = Path(place) / "checkpoints"
            save(directory, train_state(1), META)
            os.chmod(place, 0o755)
            for folder, _, names in os.walk(directory):
                os.chmod(folder, 0o555)
                for name in names:
                    os.chmod(Path(folder) / name, 0o444)
            before = listing(directory)
            user = os.geteuid()
            try:
                if user == 0:
                    os.seteuid(65534)
                sentence = refusal(save, directory, train_state(2), META)
                assert "Permission denied" in sentence
                assert str(directory) in sentence
                refusal(save, Path(place) / "new" if user == 0 else directory / "new", {}, META)
                assert bits(load(directory, train_state())[0]) == bits(train_state(1))
            finally:
                os.seteuid(user)
                for folder, _, _ in os.walk(directory):
                    os.chmod(folder, 0o755)
            assert listing(directory) == before

    def test_a_full_disk_keeps_what_was_there(self, tmp_path, capfd, caplog):
        """A limit on the size of files stands in for it: writing fails halfway, as there."""
        save(tmp_path / "c", train_state(1), META)
        before = listing(tmp_path)
        large = {"noise": np.random.default_rng(0).normal(size=2**17)}
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (2**18, hard))
            sentence = refusal(save, tmp_path / "c", large, META)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert "could not be written: File too large; free space" in sentence
        assert listing(tmp_path) == before
        noise = [record for record in caplog.records if record.levelname == "ERROR"]
        assert (capfd.readouterr(), noise) == (("", ""), []), "a traceback of Orbax's own"
        save(tmp_path / "c", large, META)
        assert bits(load(tmp_path / "c")[0]) == bits(large)
