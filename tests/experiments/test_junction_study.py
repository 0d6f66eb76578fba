"""The program on a toy scale: trains, keeps, makes its tables, and runs nothing twice."""

import json
from dataclasses import replace

import pytest

from experiments import studies as ground
from experiments import traffic_junction
from experiments.studies import read_csv
from experiments.traffic_junction import Options, Study, run, studies
from sumajax.environments import TrafficJunction
from sumajax.environments.wrapper import unwrapped
from sumajax.experiment import Stage
from sumajax.learning import LearnerConfig, config
from sumajax.upsampling import StateUpsampled

LEARNER = LearnerConfig(num_envs=100, rollout_length=20, scale_by_size=False)
SMALL = TrafficJunction("easy", num_cars=2, max_steps=10)
LARGE = TrafficJunction("medium", num_cars=3, max_steps=10)
TOY = Study(
    "toy",
    (
        Stage("easy", StateUpsampled(SMALL, 14), 1, None, LEARNER),
        Stage("medium", LARGE, 2, "easy", LEARNER),
    ),
    {"hidden": 8, "encoder": "linear", "talk_always": True},
)


@pytest.fixture
def options(monkeypatch, tmp_path):
    monkeypatch.setattr(traffic_junction, "studies", lambda part: [TOY])
    monkeypatch.setattr(traffic_junction, "EPISODES", 16)
    monkeypatch.setattr(config, "EPOCH_STEPS", 2_000)  # one update of the toy's
    runs = tmp_path / "runs"
    return Options(parts=("transfer",), seeds=(0, 1), output=tmp_path / "results", runs=runs)


def test_from_training_to_tables_and_nothing_twice(options, monkeypatch):
    run(options)
    held_out = read_csv(options.output / "held_out.csv")
    assert {(r["stage"], r["when"], r["env_steps"]) for r in held_out} == {
        ("easy", "end", 2_000),
        ("medium", "zero shot", 0),
        ("medium", "end", 4_000),
    }
    assert len(held_out) == 3 * 2 * 2  # by seed and way of choosing
    assert {row["episodes"] for row in held_out} == {16}
    assert all(0 <= row["success"] <= 1 and row["mean_delay"] >= 0 for row in held_out)
    curves = read_csv(options.output / "curves.csv")
    assert [r["epoch"] for r in curves if (r["stage"], r["seed"]) == ("medium", 1)] == [1, 2]
    (file,) = (options.output / "provenance").iterdir()
    known = json.loads(file.read_text())
    assert known["plan"]["stages"][0]["learner"]["num_envs"] == 100
    assert {"command", "commit", "versions", "machine"} <= set(known["sessions"][0])
    text = (options.output / "tables.md").read_text()
    assert "| toy | medium | zero shot | 0.0 | 0 1 |" in text

    def no_more(*args, **kwargs):
        raise AssertionError("nothing is left to do")

    monkeypatch.setattr(ground, "run_experiment", no_more)
    run(options)
    run(replace(options, rebuild=True))
    assert (options.output / "tables.md").read_text() == text
    assert read_csv(options.output / "held_out.csv") == held_out


def test_what_is_run_is_the_published_tasks_and_easy_at_mediums_size():
    for part in ("easy", "medium", "hard"):
        ((lessons, sharp),) = (study.stages for study in studies(part))
        assert lessons.env.last_arrival_rate == TrafficJunction(part).arrival_rate
        assert lessons.env.rises
        assert lessons.env.hold_up
        assert sharp.env == TrafficJunction(part)
        assert sharp.start == lessons.name
    blocks, corner = studies("transfer")
    assert [unwrapped(s.env).difficulty for s in blocks.stages] == ["easy", "medium", "medium"]
    assert {s.env.state_shape for s in (*blocks.stages, *corner.stages)} == {(2, 14, 14)}
    hard, _ = studies("transfer-hard")
    assert [unwrapped(s.env).size for s in hard.stages] == [9, 18, 18]
    assert {s.env.state_shape for s in hard.stages} == {(2, 18, 18)}
    assert blocks.stages[1].epochs == blocks.stages[2].epochs == corner.stages[1].epochs


def test_without_results_there_is_no_table(tmp_path):
    with pytest.raises(ValueError, match="holds no results; run a part first"):
        run(Options(output=tmp_path, rebuild=True))


def test_an_unknown_part_is_refused():
    with pytest.raises(ValueError, match="part 'expert' is unknown; choose one of easy, medium"):
        Options(parts=("expert",))
