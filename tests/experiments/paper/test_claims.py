"""Verdicts by their rules."""

from experiments.paper.claims import FAILS, HOLDS, IN_PART, NOT_RUN, claims
from experiments.paper.published import EXPERIMENTS

from .rows import arms


class TestClaims:
    WHOLE = {
        "source": [[5] * 350] * 3,
        "source_plain": [[5] * 350] * 3,
        "transfer": [[20] * 139] * 3,
        "scratch": [[60] * 252] * 3,
    }

    def verdicts(self, name="pp-ic3net", **changed):
        rows = arms(name, **{**self.WHOLE, **changed})
        return {claim.name: claim.verdict for claim in claims(rows, "paper")}

    def test_all_of_one_row(self):
        found = self.verdicts()
        assert found["Q1, PP, IC3Net on the source: upsampling does no harm"] == HOLDS
        assert found["Q2, PP, IC3Net, 10x10 5P"] == HOLDS
        assert found["Up to 7.88x"] == NOT_RUN  # the other rows may be larger
        assert found["Scratch fails where transfer succeeds"] == NOT_RUN
        assert found["Q2, PP, MAGIC, 10x10 5P"] == NOT_RUN

    def test_a_smaller_ratio_holds_in_part_and_none_does_not(self):
        q2 = "Q2, PP, IC3Net, 10x10 5P"
        assert self.verdicts(scratch=[[40] * 252] * 3)[q2] == IN_PART
        assert self.verdicts(scratch=[[21] * 252] * 3)[q2] == FAILS
        assert self.verdicts(scratch=[[60] * 252] * 2)[q2] == IN_PART  # too few seeds
        assert self.verdicts(scratch=[[60] * 99] * 3)[q2] == IN_PART  # too short

    def test_an_arm_that_falls_back_is_told_of(self):
        jump = [100] * 120 + [30] * 12 + [100] * 120
        rows = arms("pp-ic3net", **{**self.WHOLE, "scratch": [jump] * 3})
        (reason,) = (c.reason for c in claims(rows, "paper") if c.name.startswith("Q2, PP, IC3Net"))
        assert "scratch fell back from 30 steps at 2.60 M to 100" in reason
        assert "transferred fell back" not in reason

    def test_upsampling_that_harms(self):
        q1 = "Q1, PP, IC3Net on the source: upsampling does no harm"
        assert self.verdicts(source=[[6] * 350] * 3)[q1] == FAILS

    def test_scratch_that_succeeds_too(self):
        epochs = EXPERIMENTS["pp-hetnet"].epochs
        transfer, name = [[20] * epochs["transfer"]] * 3, "Scratch fails where transfer succeeds"
        source = {"source": [[5] * 500] * 3, "transfer": transfer}
        failing = self.verdicts("pp-hetnet", **source, scratch=[[190] * epochs["scratch"]] * 3)
        assert failing[name] == IN_PART  # two rows are not run
        learning = self.verdicts("pp-hetnet", **source, scratch=[[25] * epochs["scratch"]] * 3)
        assert learning[name] == FAILS
