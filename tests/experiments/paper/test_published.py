"""The paper's figures, and the budgets that follow from them."""

from experiments.paper.published import EXPERIMENTS, SOURCES


def test_budgets_are_those_of_the_specification():
    target = {n: (r.epochs["scratch"], r.epochs["transfer"]) for n, r in EXPERIMENTS.items()}
    assert target == {
        "pp-ic3net": (252, 139),
        "pp-magic": (344, 178),
        "pp-hetnet": (620, 558),
        "pcp-hetnet-2p1c": (918, 631),
        "pcp-hetnet-3p2c": (1508, 1227),
    }
    assert [EXPERIMENTS[n].pretraining for n in SOURCES] == [350, 590, 500, 700]


def test_ratios_are_those_of_the_paper():
    assert [r.ratio for r in EXPERIMENTS.values()] == [2.68, 2.76, 6.99, 6.11, 7.88]
