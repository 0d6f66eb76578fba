"""Table II: means over passes, and whether the passes agree."""

import pytest

from experiments.paper.table2 import seconds_here, speed_note, table_2


def measured(arm, *seconds, experiment="pp-hetnet", preset="fast", error=0.01, load=0.25):
    """A pass per number; each preset on a machine of its own."""
    about = {"experiment": experiment, "arm": arm, "preset": preset, "machine": f"{preset} cores"}
    timed = {"epochs": 100, "standard_error": error, "load_before": load}
    return [{**about, **timed, "pass": i, "seconds": s} for i, s in enumerate(seconds, 1)]


def test_a_source_of_two_experiments_is_measured_once():
    timed = [
        *measured("source", 1.0, experiment="pcp-hetnet-2p1c"),
        *measured("scratch", 2.0, experiment="pcp-hetnet-3p2c"),
    ]
    found = seconds_here(timed)
    assert found["pcp-hetnet-3p2c", "fast"] == {"source": 1.0, "scratch": 2.0}
    assert found["pcp-hetnet-2p1c", "fast"] == {"source": 1.0}


def test_minutes_are_of_the_mean_over_the_passes():
    assert seconds_here(measured("scratch", 1.0, 3.0))["pp-hetnet", "fast"] == {"scratch": 2.0}


@pytest.mark.parametrize(
    ("seconds", "cell"),
    [
        ([0.5], "0.500 ± 0.010 (1162x as fast)"),
        ([0.495, 0.505], "0.500 ± 0.010 (1162x as fast)"),
        ([0.4, 0.6], "0.500 ± 0.100 (1162x as fast)"),
    ],
)
def test_the_error_is_the_larger_of_within_and_between_passes(seconds, cell):
    cells = [row["ours, fast (s)"] for row in table_2(measured("scratch", *seconds))]
    assert cell in cells


def test_whether_passes_agree_is_said_for_each_preset():
    rows = [
        *measured("scratch", 0.500, 0.525),
        *measured("transfer", 0.500, 0.600, load=0.499),
        *measured("source", 1.0, preset="paper"),
    ]
    note = speed_note(rows)
    assert "Preset `fast`, on fast cores: 100 epochs or more, the highest load" in note
    assert "load before a row 0.499; the passes of 1 of 2 rows agree" in note
    assert "the furthest differ by 20%. " in note
    assert note.endswith(
        "Preset `paper`, on paper cores: 100 epochs or more, the highest load before a row 0.250, "
        "one pass."
    )
    stopped = speed_note([*rows, *measured("source-plain", 1.0)])
    assert "the furthest differ by 20%; 1 of 3 have one pass alone." in stopped
    assert "Preset `paper` has not been measured yet" in speed_note(measured("scratch", 0.5))
    assert "has not been measured yet" in speed_note([])
