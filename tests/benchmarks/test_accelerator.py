"""The accelerator benchmark runs whole on any device, and its files hold what it found."""

import csv
import json

import jax
import numpy as np
import pytest
from accelerator import Options, Trial, held_out_figures, main, matrix_rate, parsed, prepared
from accelerator import main_job as legs_of
from compiled_loops import loops_of

from sumajax.learning.parallel import Execution

EPISODES = 16


def small(tmp_path, job, **changes):
    return Options(
        tmp_path / "out", job, seconds=1e4, small=True, seeds=2, episodes=EPISODES, **changes
    )


@pytest.mark.slow  # a dozen programs are compiled
def test_the_table(tmp_path):
    main(small(tmp_path, "table"))
    written = json.loads((tmp_path / "out" / "accelerator.json").read_text())
    assert written["platform"] == jax.devices()[0].platform
    assert [row["case"]["seeds"] for row in written["rows"]] == [2, 2, 1]
    for row in written["rows"]:
        assert 0 < row["least"] <= row["env_steps_per_second"] <= row["most"]
        assert 10 < row["launches_per_step"] <= row["launches_per_update_step"]
    assert "failed" not in written
    lines = (tmp_path / "out" / "accelerator.md").read_text().splitlines()
    assert sum(line.startswith("| ic3net |") for line in lines) == 3


@pytest.mark.slow  # a dozen programs are compiled
def test_a_chain_hands_its_parameters_on(tmp_path):
    chain = {"sizes": (2, 4), "predators": (2, 2), "max_steps": (5, 5), "epochs": (1, 1)}
    wide = {"num_envs": 1000, "rollout_length": 20}
    still = {"learning_rate": 1e-12, "critic_rate": 1e-12}
    main(small(tmp_path, "chain", settings={**wide, **still}, **chain))
    out = tmp_path / "out"
    first, second = (np.load(out / f"stage{i}.npz") for i in ("1-2x2", "2-4x4"))
    for name in first:  # at such a rate nothing moves
        np.testing.assert_allclose(first[name], second[name], atol=1e-6)
        assert first[name].shape[0] == 2
    written = json.loads((out / "accelerator.json").read_text())
    for leg in written["legs"]:
        assert leg["epochs"] == 1
        for how in ("sampled", "greedy"):
            assert leg["before"][how] == leg["after"][how]
            assert len(leg["after"][how]["steps_taken_by_seed"]) == 2
    rows = list(csv.DictReader((out / "stage2-4x4.csv").open()))
    assert [(row["epoch"], row["seed"]) for row in rows] == [("1", "0"), ("1", "1")]


def test_held_out_figures_are_the_same_however_seeds_are_run(tmp_path):
    leg = legs_of(small(tmp_path, "main"))[0]
    figures = []
    for together in (False, True):
        ready = prepared(leg, [0, 1], Trial("", Execution(together)), EPISODES)
        figures.append(held_out_figures(ready, ready.states.params))
    assert figures[0] == figures[1]


def test_what_does_not_go_together():
    with pytest.raises(ValueError, match="as many --predators"):
        parsed(["--output", "x", "--job", "chain", "--sizes", "5", "10", "--predators", "3"])


def test_settings_are_read_as_numbers():
    asked = parsed(
        ["--output", "x", "--settings", "learning_rate=1e-3", "loss=hetnet", "--xla", "a=1"]
    )
    assert asked.settings == {"learning_rate": 1e-3, "loss": "hetnet"}
    assert asked.xla == {"a": 1}


def test_the_rate_of_a_product():
    assert matrix_rate("float32") > 1e8


def test_launches_are_counted_through_loops():
    def twice(x):
        return jax.lax.fori_loop(0, 3, lambda _, y: jax.lax.fori_loop(0, 5, inner, y) + 1, x)

    def inner(_, y):
        return jax.numpy.sort(y @ y)

    program = loops_of(jax.jit(twice).lower(jax.numpy.ones((4, 4))).compile().as_text())
    outer = program.inner[0]
    assert (outer.turns, outer.inner[0].turns, outer.inner[0].products) == (3, 5, 1)
    within = outer.inner[0].operations
    assert program.launches == program.operations + 3 * (outer.operations + 5 * within)
