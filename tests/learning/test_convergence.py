"""When a stage may end by itself."""

import numpy as np
import pytest

from sumajax.learning.convergence import GAIN, SUCCESS, WINDOW, has_converged

LEARNT = np.ones(2 * WINDOW)


def two_windows(before, last):
    return np.repeat([before, last], WINDOW)


class TestHasConverged:
    @pytest.mark.parametrize(("share", "done"), [(0.5, False), (1 - 2 * GAIN, False), (1.0, True)])
    def test_a_policy_that_saves_few_steps_is_done(self, share, done):
        assert has_converged(two_windows(20.0, share * 20.0), LEARNT) is done

    def test_a_policy_that_gets_worse_is_done(self):
        assert has_converged(two_windows(20.0, 25.0), LEARNT)

    def test_a_policy_that_has_not_learnt_is_not(self):
        """At the step limit all the time, it has yet to begin."""
        assert not has_converged(two_windows(200.0, 200.0), LEARNT * (SUCCESS - 0.01))

    def test_two_windows_are_needed(self):
        assert not has_converged(np.full(2 * WINDOW - 1, 20.0), LEARNT[1:])

    def test_all_seeds_have_to_be_done(self):
        done, learning = two_windows(20.0, 20.0), two_windows(20.0, 10.0)
        both = np.stack([LEARNT, LEARNT])
        assert has_converged(np.stack([done, done]), both)
        assert not has_converged(np.stack([done, learning]), both)

    def test_only_the_last_two_windows_count(self):
        steps = np.concatenate([np.linspace(200.0, 20.0, 50), two_windows(20.0, 20.0)])
        assert has_converged(steps, np.ones_like(steps))

    def test_an_epoch_without_an_episode_is_no_reason_to_stop(self):
        steps = two_windows(20.0, 20.0)
        steps[-3] = np.nan
        assert not has_converged(steps, LEARNT)

    def test_histories_of_different_length_are_refused(self):
        with pytest.raises(ValueError, match="differ"):
            has_converged(LEARNT, LEARNT[1:])
