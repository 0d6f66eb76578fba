"""Settings that follow from the task."""

from dataclasses import replace

import pytest
from probes import Probe

from sumajax.environments import PredatorCapturePrey, PredatorPrey
from sumajax.learning import preset
from sumajax.learning.scaling import after_transfer, crossing, for_stage, share_of_reference
from sumajax.upsampling import StateUpsampled

TEN = PredatorPrey(size=10, num_predators=5, max_steps=200)
TWENTY = PredatorPrey(size=20, num_predators=10, max_steps=200)
FORTY = PredatorPrey(size=40, num_predators=20, max_steps=400)


class TestSize:
    @pytest.mark.parametrize(("env", "steps"), [(TEN, 20), (TWENTY, 40), (FORTY, 80)])
    def test_a_crossing_is_rows_and_columns(self, env, steps):
        assert crossing(env) == steps

    def test_upsampling_makes_no_grid_larger(self):
        assert crossing(StateUpsampled(TEN, 40)) == 20

    @pytest.mark.parametrize(("env", "share"), [(TEN, 1), (TWENTY, 1 / 4), (FORTY, 1 / 16)])
    def test_twice_the_side_and_twice_the_team_are_a_quarter(self, env, share):
        assert share_of_reference(env) == share

    def test_a_task_smaller_than_the_reference_is_as_it(self):
        assert share_of_reference(PredatorPrey(size=5, num_predators=3)) == 1

    def test_all_classes_count(self):
        env = PredatorCapturePrey(size=20, num_predators=6, num_capturers=4)
        assert share_of_reference(env) == 1 / 4


class TestHorizon:
    @pytest.mark.parametrize(("env", "gamma"), [(TEN, 0.95), (TWENTY, 0.975), (FORTY, 0.9875)])
    def test_a_critic_of_its_own_sees_as_far_as_the_grid(self, env, gamma):
        for transferred in (False, True):
            config = for_stage(preset("fast", critic="state"), env, 10, transferred=transferred)
            assert config.gamma == pytest.approx(gamma)
            again = for_stage(config, env, 10, transferred=transferred)
            assert again == config

    def test_a_longer_one_that_was_asked_for_stays(self):
        config = preset("fast", critic="state", gamma=0.99)
        assert for_stage(config, TWENTY, 10).gamma == 0.99

    @pytest.mark.parametrize("changes", [{}, {"critic": "state", "scale_by_size": False}])
    def test_otherwise_the_discount_is_that_of_the_preset(self, changes):
        config = preset("fast", **changes)
        assert for_stage(config, TWENTY, 10, transferred=True).gamma == 0.95
        assert for_stage(config, FORTY, 10).gamma == 0.95


class TestAfterTransfer:
    def test_on_the_reference_it_is_fast_with_the_critic_first(self):
        config = preset("fast")
        expected = replace(config, critic_epochs=3, scale_by_size=False)
        assert after_transfer(config, TEN) == expected

    def test_on_40x40(self):
        config = after_transfer(preset("fast").for_stage(100, transferred=True), FORTY)
        assert config.learning_rate == pytest.approx(7.5e-4 / 4)
        assert config.entropy_weight == pytest.approx(0.004 / 16)
        assert config.value_weight == pytest.approx(0.5 / 16)
        assert config.critic_epochs == 5
        assert config.critic == "state"
        assert config.gamma == pytest.approx(0.9875)

    def test_on_20x40_with_14_the_critic_is_shown_the_state_too(self):
        env = PredatorPrey(size=(20, 40), num_predators=14, max_steps=400)
        assert share_of_reference(env) == pytest.approx(0.126, abs=5e-4)
        assert after_transfer(preset("fast"), env).critic == "state"

    def test_up_to_20x20_the_critic_is_the_policys_own(self):
        config = after_transfer(preset("fast"), TWENTY)
        assert config.critic == "policy"
        assert config.gamma == 0.95

    def test_so_it_is_where_a_task_does_not_say_what_a_critic_is_shown(self):
        env = Probe(num_agents=5000)
        assert share_of_reference(env) < 1 / 16
        assert after_transfer(preset("fast"), env).critic == "policy"

    def test_twice_is_the_same_as_once(self):
        once = after_transfer(preset("fast"), FORTY)
        assert after_transfer(once, FORTY) == once

    def test_preset_paper_stays_as_it_was_published(self):
        config = preset("paper")
        assert after_transfer(config, FORTY) == config

    def test_more_environments_reach_so_many_step_limits_later(self):
        config = preset("fast", num_envs=200)
        assert after_transfer(config, TEN).critic_epochs == 10
