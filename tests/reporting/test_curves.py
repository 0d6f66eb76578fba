import math
import sys
from itertools import pairwise

import matplotlib
import numpy as np
import pytest
from matplotlib.text import Text
from PIL import Image

from sumajax.reporting import append_rows, learning_curves, rows_of
from sumajax.reporting.curves import apart, arm_curves, spread

EPOCHS = {"source": 5, "transfer": 8, "scratch": 8}
SECONDS = {"source": 2.0, "transfer": 10.0, "scratch": 10.0}
BOUNDS = {"shortest paths": 10.38, "random": 198.5}


def run(seeds=3, arms=("source", "transfer", "scratch")):
    rows = []
    for arm in arms:
        epoch = np.arange(1, EPOCHS[arm] + 1)
        taken = 10 + 100.0 / epoch + np.arange(seeds)[:, None]
        values = {
            "env_steps": 20_000 * epoch,
            "seconds": SECONDS[arm] * epoch,
            "steps_taken": taken,
            "success": 1 - taken / 400,
        }
        rows += rows_of(arm, range(seeds), 1, values)
    return rows


AFTER = {"transfer": ["source"]}
LABELS = {
    "source": "source task",
    "transfer": "target, after transfer",
    "scratch": "target, from scratch",
}


def curves(metrics, *args, **options):
    return learning_curves(metrics, *args, **{"after": AFTER, "labels": LABELS, **options})


def lines(axes):
    return {line.get_label(): line for line in axes.get_lines() if line.get_label()[0] != "_"}


def test_lines_hold_the_data_and_transfer_starts_at_the_cost_of_its_source():
    steps, seconds = curves(run()).axes
    drawn = lines(steps)
    assert list(drawn) == ["source task", "target, after transfer", "target, from scratch"]
    epoch = np.arange(1, 9)
    np.testing.assert_allclose(drawn["target, from scratch"].get_ydata(), 11 + 100 / epoch)
    for axes, per_epoch, cost in ((steps, 20.0, 100.0), (seconds, 10.0, 10.0)):
        drawn = lines(axes)
        np.testing.assert_allclose(drawn["target, from scratch"].get_xdata(), per_epoch * epoch)
        np.testing.assert_allclose(
            drawn["target, after transfer"].get_xdata(), cost + per_epoch * epoch
        )
    assert steps.get_xlabel() == "environment steps (thousands)"
    assert seconds.get_xlabel() == "training time (seconds)"
    assert steps.get_ylabel() == "steps taken per episode"


@pytest.mark.parametrize(
    ("x", "largest", "label", "last"),
    [
        ("env_steps", 2_500_000, "environment steps (millions)", 2.5),
        ("seconds", 600, "training time (minutes)", 10.0),
        ("seconds", 36_000, "training time (hours)", 10.0),
    ],
)
def test_the_axis_is_in_units_that_give_short_numbers(x, largest, label, last):
    epoch = np.arange(1, 11)
    values = {"env_steps": epoch, "steps_taken": 100 / epoch}
    rows = rows_of("scratch", [0], 1, {**values, x: epoch * largest // 10})
    (axes,) = curves(rows, x=x).axes
    assert axes.get_xlabel() == label
    assert lines(axes)["target, from scratch"].get_xdata()[-1] == pytest.approx(last)


def test_middle_and_band_follow_the_number_of_seeds():
    values = np.array([[1.0, 2.0], [5.0, np.nan], [3.0, 4.0], [100.0, 6.0]])
    middle, low, high = spread(values)
    np.testing.assert_allclose(middle, [4, 4])
    np.testing.assert_allclose(low, [2.5, 3])
    np.testing.assert_allclose(high, [28.75, 5])
    middle, low, high = spread(values[:2])
    np.testing.assert_allclose([middle, low, high], [[3, 2], [1, 2], [5, 2]])


@pytest.mark.parametrize(
    ("seeds", "bands", "note"), [(1, 0, "one seed"), (2, 3, "both"), (3, 3, "quartiles")]
)
def test_the_spread_is_drawn_and_named(seeds, bands, note):
    figure = curves(run(seeds))
    assert len(figure.axes[0].collections) == bands
    assert note in figure.get_supxlabel()


def test_an_epoch_in_which_no_episode_ended_is_left_out():
    rows = run(1)
    for row in rows:
        if row["arm"] == "scratch" and row["epoch"] <= 2:
            row["steps_taken"] = math.nan
    assert len(arm_curves(rows, "env_steps", "steps_taken", AFTER)["scratch"].x) == 6
    for row in rows:
        row["steps_taken"] = math.nan
    with pytest.raises(ValueError, match="no steps_taken"):
        learning_curves(rows)


def test_arms_may_be_missing():
    figure = curves(run(arms=("source", "transfer")))
    assert list(lines(figure.axes[0])) == ["source task", "target, after transfer"]
    rows = run(arms=("transfer",))
    assert arm_curves(rows, "env_steps", "steps_taken", AFTER)["transfer"].x[0] == 20_000
    assert "starts at the cost" not in curves(rows).get_supxlabel()


def test_a_chain_of_any_length_adds_up_and_rivals_start_at_nothing():
    after = {"transfer": ["source"], "scratch": ["source", "transfer"]}
    found = arm_curves(run(), "env_steps", "steps_taken", after)
    assert [found[arm].x[0] for arm in EPOCHS] == [20_000, 120_000, 280_000]
    drawn = lines(learning_curves(run(), after=after).axes[0])
    styles = {name: line.get_linestyle() for name, line in drawn.items()}
    assert styles == {"source": "--", "transfer": "--", "scratch": "-"}
    assert len({line.get_color() for line in drawn.values()}) == 3


def test_reference_levels_are_lines_with_names_that_do_not_overlap():
    bounds = {**BOUNDS, "best published": 13.0, "published transfer, IC3Net": 13.5}
    figure = curves(run(), bounds=bounds)
    for axes in figure.axes:
        levels = [
            line.get_ydata()[0] for line in axes.get_lines() if len(set(line.get_ydata())) == 1
        ]
        assert levels == list(bounds.values())
    assert not figure.axes[0].texts
    figure.canvas.draw()
    texts = [Text.get_window_extent(text) for text in figure.axes[1].texts]  # without its line
    assert len(texts) == 4
    texts.sort(key=lambda box: box.y0)
    assert all(low.y1 <= high.y0 + 1 for low, high in pairwise(texts))
    assert max(box.x1 for box in texts) <= figure.bbox.x1
    written = " ".join(text.get_text().replace("\n", " ") for text in figure.axes[1].texts)
    assert "shortest paths 10.38" in written
    assert "random 198.5" in written
    assert apart({"a": 0.5, "b": 0.51, "c": 0.9}, dict.fromkeys("abc", 0.1)) == [
        ("a", 0.5),
        ("b", pytest.approx(0.6)),
        ("c", 0.9),
    ]


def test_the_y_axis_is_logarithmic_where_that_helps():
    assert curves(run(), bounds=BOUNDS).axes[0].get_yscale() == "log"
    assert curves(run(), bounds=BOUNDS, log_y=False).axes[0].get_yscale() == "linear"
    success = curves(run(), y="success").axes[0]
    assert success.get_yscale() == "linear"
    assert success.get_ylabel() == "success rate"


def test_the_png_has_its_size_and_no_global_figure_is_touched(tmp_path):
    settings = dict(matplotlib.rcParams)
    append_rows(tmp_path / "metrics.csv", run())
    learning_curves(tmp_path / "metrics.csv", tmp_path / "curves.png", title="PP, 5x5 to 10x10")
    learning_curves(tmp_path / "metrics.csv", tmp_path / "one.png", x="seconds", bounds=BOUNDS)
    with Image.open(tmp_path / "curves.png") as image:
        assert image.size == (1800, 780)
        assert np.asarray(image.convert("RGB")).min() < 50  # something is drawn
    with Image.open(tmp_path / "one.png") as image:
        assert image.size == (1200, 780)
    pyplot = sys.modules.get("matplotlib.pyplot")  # somebody else's, if at all
    assert pyplot is None or not pyplot.get_fignums()
    assert dict(matplotlib.rcParams) == settings
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "curves.png",
        "metrics.csv",
        "one.png",
    ]


def test_an_unknown_axis_is_refused():
    with pytest.raises(ValueError, match="env_steps, seconds"):
        curves(run(), x="epoch")
