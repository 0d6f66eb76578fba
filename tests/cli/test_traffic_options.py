"""`sumajax transfer tj`: which junctions the options say, and what is refused."""

import pytest

from sumajax.cli import transfer
from sumajax.cli.domains import DOMAINS, with_size
from sumajax.cli.options import parse
from sumajax.environments import TrafficJunction
from sumajax.learning import preset
from sumajax.upsampling import StateUpsampled

EASY, MEDIUM, HARD = (TrafficJunction(difficulty) for difficulty in ("easy", "medium", "hard"))


def options(text="", policy="ic3net"):
    default = transfer.TJTransfer(
        learner=preset("fast", policy), policy_settings=transfer.settings_of(policy, DOMAINS["tj"])
    )
    return parse(transfer.TJTransfer, default, text.split())


def stages(text, curriculum=False):
    """By name, as evaluated: without a curriculum unless asked for."""
    text = text if curriculum else f"{text} --no-curriculum"
    return {stage.name: stage.env for stage in options(text).experiment().stages}


def test_easy_to_medium_unless_something_else_is_said():
    """Where the grids fit cell for cell: 7x7 with 5 cars to 14x14 with 10, and from scratch."""
    assert stages("") == {
        "source": StateUpsampled(EASY, 14),
        "transfer": MEDIUM,
        "scratch": MEDIUM,
    }
    assert stages("--difficulties easy medium") == stages("")
    assert options().directory.name == "tj_transfer-ic3net-fast"


@pytest.mark.parametrize("upsampling", ["corner", "none"])
def test_what_it_is_compared_with(upsampling):
    source = stages(f"--upsampling {upsampling} --encoder lab_gap")["source"]
    fill, size = ("corner", 14) if upsampling == "corner" else ("blocks", 7)
    assert source == StateUpsampled(EASY, size, fill=fill)


def test_a_chain_of_sizes_of_one_difficulty():
    hard = stages("--difficulties hard hard --sizes 9 18 --no-scratch")
    assert hard == {"source": StateUpsampled(TrafficJunction("hard", 9), 18), "transfer": HARD}
    cars = stages("--sizes 14 28 --teams 10 20 --max-steps 40 70 --no-scratch")
    large = TrafficJunction("medium", 28, 20, max_steps=70)
    assert cars == {"source": StateUpsampled(MEDIUM, 28), "transfer": large}


def test_what_is_not_said_is_published_for_the_difficulty():
    every = stages("--difficulties easy medium hard --sizes 9 18 18 --no-scratch")
    small = TrafficJunction("easy", 8)
    assert list(every) == ["9x9-5", "18x18-10", "18x18-20"]
    assert list(every.values()) == [
        StateUpsampled(small, 18),
        StateUpsampled(TrafficJunction("medium", 18), 18),
        HARD,
    ]
    assert [(task.max_steps, task.last_arrival_rate) for task in every.values()] == [
        (20, 0.3),
        (40, 0.2),
        (80, 0.05),
    ]


def test_a_stage_has_the_settings_of_the_task_of_its_difficulty():
    rising = "--source.arrival-rate 0.1 --source.final-arrival-rate 0.3 --source.rate-epochs 5 15"
    given = stages(f"--difficulties easy medium {rising} --target.arrival-rate 0.1")
    source = TrafficJunction(arrival_rate=0.1, final_arrival_rate=0.3, rate_epochs=(5, 15))
    assert given["source"] == StateUpsampled(source, 14)
    assert given["transfer"].arrival_rate == 0.1


def test_rates_rise_as_published_unless_they_are_not_to():
    """0.1 to 0.3 and 0.05 to 0.2, from an eighth to five eighths of a stage."""
    taught = stages("--source-epochs 80 --target-epochs 40", curriculum=True)
    easy = TrafficJunction(arrival_rate=0.1, final_arrival_rate=0.3, rate_epochs=(10, 50))
    rising = {"arrival_rate": 0.05, "final_arrival_rate": 0.2, "rate_epochs": (5, 25)}
    medium = TrafficJunction("medium", **rising)
    assert taught == {
        "source": StateUpsampled(easy, 14),
        "transfer": medium,
        "scratch": medium,
    }


def test_a_rate_that_was_given_to_rise_does_as_given():
    given = "--source.arrival-rate 0.05 --source.final-arrival-rate 0.1 --target.arrival-rate 0.04"
    taught = stages(given, curriculum=True)
    assert taught["source"].env.rate_epochs == (250, 1250)
    assert taught["source"].arrival_rate == 0.05
    assert not taught["transfer"].rises  # it is lower than where the published one begins


@pytest.mark.parametrize(
    ("policy", "always"),
    [("ic3net", True), ("tarmac-ic3net", True), ("commnet", None), ("magic", None)],
)
def test_gates_are_open_as_published(policy, always):
    assert options(policy=policy).policy_settings.get("talk_always") is always


def test_success_is_what_counts_as_solved():
    experiment = options("").experiment()
    assert experiment.threshold == 0.8
    assert experiment.name == "tj_transfer"


def test_a_junction_on_another_grid():
    """By the side of the grid, which easy's `size` is one less than."""
    assert with_size(EASY, (9, 9), {}) == TrafficJunction("easy", 8)
    assert with_size(HARD, (9, 9), {"num_cars": 7}, 30) == TrafficJunction("hard", 9, 7, 1, 30)
    with pytest.raises(ValueError, match="a junction has equal sides, got 7x14; give one number"):
        with_size(EASY, (7, 14), {})
