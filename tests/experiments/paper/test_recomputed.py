"""The figures of README.md and docs/, worked out once more from the kept rows.

Nothing of `experiments.paper` is used, and nothing of the package: rows are read with `csv`, and
the paper's own figures are typed here from its Tables I and II. A table is found by the mark above
it, `<!-- recomputed: NAME -->`; a sentence by its words.
"""

import csv
import math
import re
from collections import defaultdict
from functools import cache

import numpy as np
import pytest

from .rows import RESULTS

ROOT = RESULTS.parents[1]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    RESULTS / "scale" / "README.md",
]
FIGURES = {"collisions_per_car": 3, "mean_delay": 2, "cars_through": 1}  # digits
MARK = re.compile(r"<!-- recomputed: ([^>]*?) -->\n\|.*\n\|[-|]*\n((?:\|.*\n)+)")

EXPERIMENTS = ("pp-ic3net", "pp-magic", "pp-hetnet", "pcp-hetnet-2p1c", "pcp-hetnet-3p2c")
TITLES = {
    "Predator-Prey, 5, IC3Net": "pp-ic3net",
    "Predator-Prey, 5, MAGIC": "pp-magic",
    "Predator-Prey, 5, HetNet": "pp-hetnet",
    "Predator-Capture-Prey, 2 + 1, HetNet": "pcp-hetnet-2p1c",
    "Predator-Capture-Prey, 3 + 2, HetNet": "pcp-hetnet-3p2c",
}
# Seconds per epoch on the source, after transfer and from scratch (the paper's Table II).
SECONDS = {
    "pp-ic3net": (50.03, 132.62, 143.13),
    "pp-magic": (105.89, 256.24, 313.80),
    "pp-hetnet": (229.45, 439.49, 580.76),
    "pcp-hetnet-2p1c": (315.05, 791.37, 784.00),
    "pcp-hetnet-3p2c": (315.05, 846.94, 835.35),
}
HOURS = dict(zip(EXPERIMENTS, (10, 30, 100, 200, 350), strict=True))  # T of the paper's Table I
EPOCH = 0.02  # millions of environment steps, preset `fast`


def read(name):
    with open(RESULTS / f"{name}.csv", newline="") as file:
        return list(csv.DictReader(file))


@cache
def curves():
    """(preset, experiment, arm) -> (seeds, epochs) of steps taken, M steps and seconds."""
    found = defaultdict(lambda: defaultdict(list))
    for row in read("curves"):
        key = (row["preset"], row["experiment"], row["arm"])
        seconds = float(row["seconds"]) / int(row["seeds_at_once"])
        numbers = (float(row["steps_taken"]), int(row["env_steps"]) / 1e6, seconds)
        assert int(row["epoch"]) == len(found[key][row["seed"]]) + 1
        found[key][row["seed"]].append(numbers)
    return {
        key: tuple(np.array([seeds[s] for s in sorted(seeds)]).transpose(2, 0, 1))
        for key, seeds in found.items()
    }


@cache
def evaluations():
    """(preset, experiment, arm, mode) -> steps taken and success, each of all seeds."""
    found = defaultdict(list)
    for row in read("evaluations"):
        key = tuple(row[name] for name in ("preset", "experiment", "arm", "mode"))
        found[key].append((float(row["steps_taken"]), float(row["success"])))
    return {key: tuple(zip(*values, strict=True)) for key, values in found.items()}


def source_of(name):
    return "pcp-hetnet-2p1c" if name.startswith("pcp") else name


def steps_taken(name, arm, preset="fast"):
    return curves()[preset, name, arm][0]


def steps_had(name, arm):
    """Millions of environment steps at the end of each epoch, preset `paper`."""
    return curves()["paper", name, arm][1]


def epochs_to(name, arm, threshold=20, preset="fast"):
    """Of every seed; infinite for one that never came."""
    hits = [np.flatnonzero(seed <= threshold) for seed in steps_taken(name, arm, preset)]
    return np.array([hit[0] + 1 if len(hit) else math.inf for hit in hits])


def costs(name, threshold=20):
    """(scratch, transferred with its source) by accounting, of every seed, under preset `fast`."""
    here = {key: np.mean(seconds) for key, seconds in passes().items()}
    source = steps_taken(source_of(name), "source").shape[1]
    scratch, transfer = (
        epochs_to(name, "scratch", threshold),
        epochs_to(name, "transfer", threshold),
    )
    ours = (here[source_of(name), "source"], here[name, "transfer"], here[name, "scratch"])
    return {
        unit: (scratch * epoch[2], source * epoch[0] + transfer * epoch[1])
        for unit, epoch in (
            ("steps", (EPOCH,) * 3),
            ("hours", np.array(SECONDS[name]) / 3600),
            ("minutes", np.array(ours) / 60),
        )
    }


def passes_apart():
    """By how much the slower of two passes was slower, at most, as a share."""
    assert {len(seconds) for seconds in passes().values()} == {2}
    return max(max(seconds) / min(seconds) for seconds in passes().values()) - 1


def passes(preset="fast"):
    """Experiment and arm -> seconds an epoch of each pass."""
    found = defaultdict(list)
    for row in read("seconds_per_epoch"):
        if row["preset"] == preset:
            found[row["experiment"], row["arm"]].append(float(row["seconds"]))
    return found


def median(times):
    return np.sort(times)[len(times) // 2]


def number(value, digits):
    return "never" if math.isinf(value) else f"{value:.{digits}f}"


def of_times(times, digits=2):
    values = (median(times), min(times), max(times))
    return "{} ({}-{})".format(*(number(value, digits) for value in values))


def of_means(values, digits=1):
    return f"{np.mean(values):.{digits}f} ({min(values):.{digits}f}-{max(values):.{digits}f})"


def never(times):
    return f"{np.isinf(times).sum()} of {len(times)}"


# The tables, a row by its first cell.


def main(title):
    name = TITLES[title]
    scratch, transfer = epochs_to(name, "scratch"), epochs_to(name, "transfer")
    cost = costs(name)
    ends = [evaluations()["fast", name, arm, "sampled"][0] for arm in ("scratch", "transfer")]
    return [
        f"{never(scratch)}, {never(transfer)}",
        of_times(scratch * EPOCH),
        of_times(transfer * EPOCH),
        of_times(cost["steps"][1]),
        " → ".join(of_times(times, 1) for times in cost["hours"]),
        " → ".join(of_times(times) for times in cost["minutes"]),
        " → ".join(map(of_means, ends)),
    ]


STARTED = tuple(f"transfer-published-start{variant}" for variant in ("", "-corner", "-encoder"))
ABLATED = {
    "transferred, as in the paper": ("transfer", "zero-shot"),
    "from scratch": ("scratch", None),
    "(a) source state in a corner of the large one, zeros around": "corner",
    "(b) an upsampled cell's values sum to one": "mass",
    "(c) all but the state encoder carried over": "encoder",
    "(d) the optimiser's memory too": "optimiser",
    "(e) source trained for half its steps": "50",
    "(e) for a quarter": "25",
    "(f) encoder `lab_gap`, upsampled": "lab-gap",
    "(f) the same, source not upsampled": "lab-gap-native",
    "(f) the same from scratch": ("scratch-lab-gap", None),
    "(g) encoders' initial weights as the originals'": "published-start",
    "(g) the same, source state in a corner": "published-start-corner",
    "(g) the same, all but the state encoder carried over": "published-start-encoder",
    "(g) the same from scratch": ("scratch-published-start", None),
}


def ablated(name, words):
    """Of an ablation's row: its arm, and that of its zero shot."""
    arms = ABLATED[words]
    arm, zero_shot = (f"transfer-{arms}", f"zero-shot-{arms}") if isinstance(arms, str) else arms
    if name == "pp-hetnet" and arm in ("transfer", "scratch"):
        return f"{arm}-brief", zero_shot and f"{zero_shot}-brief"
    return arm, zero_shot


def last_tenth(taken):
    return taken[:, -(taken.shape[1] // 10) :].mean(1)


def ablations(name):
    def row(words):
        arm, zero_shot = ablated(name, words)
        taken, times = steps_taken(name, arm), epochs_to(name, arm) * EPOCH
        looks = evaluations()["fast", name, zero_shot, "sampled"][0] if zero_shot else ()
        return [
            f"{len(taken)}",
            of_means(looks) if looks else "-",
            of_means(taken.mean(1)),
            of_times(times),
            never(times),
            of_means(last_tenth(taken)),
        ]

    return row


BY_PAPER = {
    "this package's encoder, transferred": ("source", "transfer"),
    "the same from scratch": (None, "scratch"),
    "encoder `lab_gap`, transferred": ("source-lab-gap", "transfer-lab-gap"),
    "`lab_gap` from scratch": (None, "scratch-lab-gap"),
    "encoders started as published, transferred": (
        "source-published-start",
        "transfer-published-start",
    ),
    "as published, transferred, source state in a corner": (
        "source-published-start-corner",
        "transfer-published-start-corner",
    ),
    "as published, from scratch": (None, "scratch-published-start"),
}


def by_paper(words):
    """Of HetNet under preset `paper`."""
    source, arm = BY_PAPER[words]
    taken = steps_taken("pp-hetnet", arm, "paper")
    looked = evaluations()["paper", "pp-hetnet", arm, "sampled"]
    zero_shot = arm.replace("transfer", "zero-shot")
    looks = evaluations()["paper", "pp-hetnet", zero_shot, "sampled"][0] if source else ()
    learnt = last_tenth(steps_taken("pp-hetnet", source, "paper")) if source else ()
    return [
        f"{len(taken)}",
        *(of_means(values) if len(values) else "-" for values in (learnt, looks)),
        never(epochs_to("pp-hetnet", arm, 30, "paper")),
        of_means(last_tenth(taken)),
        of_means(looked[1], 3),
    ]


def short_source(epochs):
    """Means of ten epochs, of scratch at as many steps as the transferred arm has had."""
    epochs = int(epochs)
    taken, steps, _ = curves()["paper", "pp-ic3net", "transfer-25"]
    other, other_steps, _ = curves()["paper", "pp-ic3net", "scratch"]
    source = curves()["paper", "pp-ic3net", "source-25"][1][:, -1].mean()
    alone = steps.mean(0)[epochs - 1]

    def scratch(at):
        had = (other_steps.mean(0) <= at + 1e-9).sum()
        return of_means(other[:, had - 10 : had].mean(1))

    return [
        of_means(taken[:, epochs - 10 : epochs].mean(1)),
        f"{alone:.2f}",
        scratch(alone),
        f"{alone + source:.2f}",
        scratch(alone + source),
    ]


ARMS = {"zero shot": "zero-shot", "transferred": "transfer", "from scratch": "scratch"}


def evaluated(name):
    def row(words, budget):
        arm = ARMS.get(words, "source")
        whole = steps_taken(name, "transfer").shape[1] * EPOCH
        if arm in ("transfer", "scratch") and budget != f"{whole:.1f} M":
            arm += "-brief"
        return evaluated_cells(name, arm)

    return row


def capture(words, _):
    task, _, arm = words.removeprefix("10x10, ").partition(": ")
    name = {"2P/1C": "pcp-hetnet-2p1c", "3P/2C": "pcp-hetnet-3p2c"}.get(task, "pcp-hetnet-2p1c")
    return evaluated_cells(name, ARMS.get(arm, "source"))


def evaluated_cells(name, arm):
    cells = []
    for mode in ("sampled", "greedy"):
        taken, success = evaluations()["fast", name, arm, mode]
        cells += [of_means(taken), f"{np.mean(success):.3f}"]
    steps = 0.0
    if not arm.startswith("zero-shot"):
        steps = steps_taken(name, arm).shape[1] * EPOCH
    return [f"{steps:.1f} M" if steps else "0", *cells]


CHAINS = {
    ("10x10", None): "pp10-hetnet",
    ("20x20", None): "pp20-hetnet",
    ("40x40", None): "pp40-hetnet",
    ("20x20", " and 4 capture agents"): "pcp20-hetnet",
}


def larger_grid(title):
    """Of a chain: its stage on such a grid, at the task's limit or the one named, and scratch."""
    grid, capturers, limit = re.match(
        r"(\d+x\d+), \d+ predators( and \d+ capture agents)?, limit (\d+)", title
    ).groups()
    chain = CHAINS[grid, capturers]
    scratch = f"{chain}-scratch"
    stage = kept("stages", experiment=chain, stage=grid)
    ((task, trained, bound),) = {(r["task"], r["env_steps"], r["bound"]) for r in stage}
    seeds = [len(stage), len(kept("stages", experiment=scratch))]

    def mean(experiment, name, when, mode):
        return played(experiment, name, task, limit, when, mode)

    return [
        ", ".join(map(str, filter(None, seeds))),
        f"{int(trained) / 1e6:.1f} M",
        mean(chain, grid, "zero shot", "sampled"),
        mean(chain, grid, "end", "sampled"),
        mean(chain, grid, "end", "greedy"),
        mean(scratch, "scratch", "end", "sampled"),
        f"{float(bound):.1f}",
    ]


def played(experiment, stage, task, limit, when, mode):
    """Mean steps taken over seeds (least and greatest seed; success)."""
    rows = kept("held_out", experiment=experiment, stage=stage, task=task, limit=limit)
    assert {row["episodes"] for row in rows} <= {"1024"}
    rows = [row for row in rows if (row["when"], row["mode"]) == (when, mode)]
    steps = [float(row["steps_taken"]) for row in rows]
    if not steps:
        return "-"
    success = np.mean([float(row["success"]) for row in rows])
    between = f"{min(steps):.1f}-{max(steps):.1f}; " if len(steps) > 1 else ""
    return f"{np.mean(steps):.1f} ({between}{success:.3f})"


def on_20x20(title):
    """Of the experiment named: what ends on 20x20 with 10, and its cost to 2 x shortest paths."""
    experiment = re.search(r"`([\w-]+)`", title)[1]
    task, limit = "20x20 10P", "200"
    rows = kept("stages", experiment=experiment, task=task)
    (stage,) = {row["stage"] for row in rows}
    costs = [cost_to_twice(row, limit) for row in rows]
    return [
        str(len(rows)),
        played(experiment, stage, task, limit, "zero shot", "sampled"),
        played(experiment, stage, task, "80", "end", "sampled"),
        played(experiment, stage, task, limit, "end", "sampled"),
        first_there([steps / 1e6 for steps, _ in costs], ".2f"),
        first_there([seconds for _, seconds in costs], ".0f"),
    ]


def cost_to_twice(row, limit):
    """(environment steps, CPU seconds), the sources counted, of the first held-out figure there."""
    place = {name: row[name] for name in ("experiment", "stage", "seed")}
    before = [
        stage
        for stage in kept("stages", experiment=row["experiment"], seed=row["seed"])
        if stage["stage"] in row["after"].split()
    ]
    own = kept("held_out", **place, task=row["task"], limit=limit, mode="sampled")
    whens = {point["when"]: point["steps_taken"] for point in own}
    way = [
        (p["env_steps"], p["cpu_seconds"], p["steps_taken"]) for p in kept("evaluations", **place)
    ]
    if "zero shot" in whens:
        way.insert(0, (0, 0, whens["zero shot"]))
    way.append((row["env_steps"], row["cpu_seconds"], whens["end"]))
    for steps, seconds, taken in way:
        if float(taken) <= 2 * float(row["bound"]):
            sources = [(int(s["env_steps"]), float(s["cpu_seconds"])) for s in before]
            return tuple(np.sum([(int(steps), float(seconds)), *sources], axis=0))
    return math.inf, math.inf


def first_there(costs, form):
    """Mean (least-greatest), or how many were there."""
    if math.inf in costs:
        arrived = sum(map(math.isfinite, costs))
        return "never" if not arrived else f"{arrived} of {len(costs)}"
    if len(costs) == 1:
        return f"{costs[0]:{form}}"
    return f"{np.mean(costs):{form}} ({min(costs):{form}}-{max(costs):{form}})"


def kept(file, **cells):
    """Rows of the study of larger grids that have these cells."""
    return [row for row in read(f"scale/{file}") if cells.items() <= row.items()]


LESSONS = {f"{difficulty}-sharp": difficulty for difficulty in ("easy", "medium", "hard")}


def junction(title):
    """Of a stage's end: steps with its lessons, success and the domain's own figures."""
    experiment, stage = re.search(r"`([\w-]+)/([\w-]+)`", title).groups()
    ends = [
        row
        for row in read("traffic_junction/held_out")
        if (row["experiment"], row["when"]) == (experiment, "end")
    ]
    assert {row["episodes"] for row in ends} == {"1024"}

    def of(stage, mode, column):
        place = (stage, mode)
        return [float(r[column]) for r in ends if (r["stage"], r["mode"]) == place]

    steps = [of(name, "sampled", "env_steps")[0] for name in (stage, LESSONS.get(stage)) if name]

    def shown(mode, column, digits):
        values = of(stage, mode, column)
        return of_means(values, digits) if len(values) > 1 else f"{values[0]:.{digits}f}"

    figures = [shown("sampled", name, digits) for name, digits in FIGURES.items()]
    return [
        f"{len(of(stage, 'sampled', 'success'))}",
        f"{sum(steps) / 1e6:.2f} M",
        *(shown(mode, "success", 3) for mode in ("sampled", "greedy")),
        *figures,
    ]


TABLES = {
    "main": main,
    "ablations pp-ic3net": ablations("pp-ic3net"),
    "ablations pp-hetnet": ablations("pp-hetnet"),
    "by the paper's procedure": by_paper,
    "short source": short_source,
    "evaluations pp-ic3net": evaluated("pp-ic3net"),
    "evaluations pp-magic": evaluated("pp-magic"),
    "evaluations pp-hetnet": evaluated("pp-hetnet"),
    "evaluations pcp": capture,
    "larger grids": larger_grid,
    "to 20x20": on_20x20,
    "rivals": on_20x20,
    "large teams": on_20x20,
    "traffic junction": junction,
}


def tables(text):
    """Name -> the cells of each row."""
    return {
        name: [[cell.strip() for cell in line[1:-1].split("|")] for line in body.splitlines()]
        for name, body in MARK.findall(text)
    }


def differences(name, rows):
    """What a table says that the kept rows do not."""
    found = []
    for first, *cells in rows:
        by_budget = name.startswith("evaluations")
        right = TABLES[name](first, cells[0]) if by_budget else TABLES[name](first)
        found += [
            (first, said, ours) for said, ours in zip(cells, right, strict=True) if said != ours
        ]
    return found


def marked():
    return {name: rows for page in PAGES for name, rows in tables(page.read_text()).items()}


def test_every_table_is_found():
    """With the rows that it is to have."""
    assert {name: len(rows) for name, rows in marked().items()} == {
        "main": 5,
        "ablations pp-ic3net": 15,
        "ablations pp-hetnet": 15,
        "by the paper's procedure": 7,
        "short source": 3,
        "evaluations pp-ic3net": 4,
        "evaluations pp-magic": 4,
        "evaluations pp-hetnet": 6,
        "evaluations pcp": 7,
        "larger grids": 5,
        "to 20x20": 4,
        "rivals": 11,
        "large teams": 6,
        "traffic junction": 13,
    }


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_what_the_kept_rows_say(name):
    assert differences(name, marked()[name]) == []


@pytest.mark.parametrize("name", TABLES)
def test_a_figure_that_is_altered_is_found(name):
    """In any cell with a figure; what names a row is not one."""
    for i, row in enumerate(marked()[name]):
        for j, cell in enumerate(row[1:], start=1):
            digits = list(re.finditer(r"\d", cell))
            if not digits or (name.startswith("evaluations") and j == 1):
                continue
            last = digits[-1].start()
            altered = cell[:last] + str((int(cell[last]) + 1) % 10) + cell[last + 1 :]
            rows = [list(r) for r in marked()[name]]
            rows[i][j] = altered
            assert differences(name, rows), (row[0], cell, altered)


def by_rows(of):
    """A number of every experiment, least and greatest."""
    values = [of(name) for name in EXPERIMENTS]
    return min(values), max(values)


def ratio(name, unit):
    scratch, transfer = (median(times) for times in costs(name)[unit])
    return scratch / transfer


def apart(name, unit):
    scratch, transfer = costs(name)[unit]
    return max(transfer) < min(scratch) or max(scratch) < min(transfer)


def sentences_of_the_readme():
    of_seeds = [curves()["paper", name, "scratch"][2][:, -1] / 60 for name in EXPERIMENTS]
    minutes = min(map(min, of_seeds)), max(map(max, of_seeds))
    quiet = [
        np.mean(passes("paper")[name, "scratch"])
        / 60
        * steps_taken(name, "scratch", "paper").shape[1]
        for name in EXPERIMENTS
    ]
    levels = [row for row in read("references") if row["task"] == "target"]
    random, paths = (
        [float(row[column]) for row in levels]
        for column in ("random_steps_taken", "shortest_paths")
    )
    alone = by_rows(
        lambda name: median(epochs_to(name, "scratch")) / median(epochs_to(name, "transfer"))
    )
    ends = {
        name: [
            np.mean(evaluations()["fast", name, a, "sampled"][0]) for a in ("scratch", "transfer")
        ]
        for name in EXPERIMENTS[:3]
    }
    apart_at_the_end = math.ceil(10 * max(abs(a - b) for a, b in ends.values())) / 10
    pp, pcp = ([ratio(n, "steps") for n in part] for part in (EXPERIMENTS[:3], EXPERIMENTS[3:]))
    assert f"{min(pcp):.1f}" == f"{max(pcp):.1f}" == "1.3"
    assert not any(apart(name, "steps") for name in EXPERIMENTS[3:])
    assert [apart(name, "hours") for name in EXPERIMENTS] == [False, False, True, True, True]
    hours, here = (by_rows(lambda name, u=unit: ratio(name, u)) for unit in ("hours", "minutes"))
    came = [np.isfinite(epochs_to(name, "scratch", 30)) for name in EXPERIMENTS[1:]]
    brief = {
        arm: int(np.isfinite(epochs_to("pp-hetnet", arm, 30)).sum())
        for arm in ("scratch-brief", "scratch-published-start", *STARTED)
    }
    assert brief == {"scratch-brief": 4, "scratch-published-start": 0, **dict.fromkeys(STARTED, 3)}
    upsampled, corner, _ = (epochs_to("pp-hetnet", arm, 30) for arm in STARTED)
    assert max(upsampled) < min(corner)
    tasks = LESSONS.values()
    driven = [junction(f"`{task}/{task}-sharp`")[2].split()[0] for task in tasks]
    late = np.isinf([epochs_to(name, "scratch") for name in EXPERIMENTS[3:]])
    assert late.sum() == 1
    ahead = []
    for name in EXPERIMENTS:
        scratch, transfer = (
            evaluations()["fast", name, arm, "sampled"][0] for arm in ("scratch", "transfer")
        )
        ahead.append(max(transfer) < min(scratch))
    assert ahead == [True, True, False, False, True]
    budgets = [steps_taken(name, "scratch").shape[1] * EPOCH for name in EXPERIMENTS]
    source = {steps_taken(source_of(name), "source").shape for name in EXPERIMENTS}
    assert source == {(5, 50)}
    assert len({f"{budget:.1f}" for budget in budgets[2:]}) == 1
    faint = [
        last_tenth(steps_taken("pp-hetnet", arm, "paper"))
        for arm in ("scratch-published-start", *STARTED[:2])
    ]
    assert [len(seeds) for seeds in faint] == [3, 3, 3]
    ours = ("pp-hetnet", "pcp-hetnet-3p2c", "pp-ic3net")
    more = [times_the_epochs(name) for name in ours]
    _, *ic3net = at_the_hour("pp-ic3net", "paper")
    assert max(ic3net[0]) < min(ic3net[1])
    source = steps_had("pp-ic3net", "source")[:, -1]
    assert source.min() > steps_had("pp-ic3net", "scratch")[:, -1].max()
    return [
        f"{min(HOURS.values())} to {max(HOURS.values())} hours on four processes, took "
        f"{minutes[0]:.0f} to {minutes[1]:.0f} minutes a seed here on two shared cores "
        f"({min(quiet):.0f} to {max(quiet):.0f} alone)",
        f"{50 * EPOCH:.1f} M environment steps on 5x5, then {budgets[0]:.1f} M (IC3Net), "
        f"{budgets[1]:.1f} M (MAGIC) or {budgets[2]:.1f} M (HetNet) on 10x10",
        f"A random team takes {min(random):.0f} to {max(random):.0f}, shortest paths "
        f"{min(paths):.1f} to {max(paths):.1f}",
        f"in {alone[0]:.1f} to {alone[1]:.0f} times fewer environment steps",
        f"within {apart_at_the_end:.1f} steps of each other on Predator-Prey",
        f"scratch needs {min(pp):.2f} to {max(pp):.2f} times the environment steps, on "
        f"Predator-Capture-Prey {pcp[0]:.1f} times (ranges overlap)",
        f"Scratch takes {hours[0]:.1f} to {hours[1]:.1f} times as many of the paper's hours",
        f"{here[0]:.2f} to {here[1]:.1f} times the minutes here (timed twice, at most "
        f"{100 * passes_apart():.0f}% apart)",
        f"{np.sum(came)} of {np.size(came)} such seeds come to 30 steps",
        f"Of 5 runs of 1.2 M steps (HetNet, Predator-Prey) {brief['scratch-brief']} do",
        f"({', '.join(tasks)}: success {', '.join(driven)}, three seeds",
        f"with {min(more):.1f} to {max(more):.1f} times the epochs",
        f"HetNet {by_procedure('pp-hetnet')}; {at_equal_steps('pp-hetnet')} (the paper 189.7 and "
        f"27.1). Predator-Capture-Prey 3 + 2 {by_procedure('pcp-hetnet-3p2c')}; "
        f"{at_equal_steps('pcp-hetnet-3p2c')} (199.9 and 25.3). IC3Net "
        f"{by_procedure('pp-ic3net')} (55.6 and 20.7)",
        f"weights end at {faint[0].mean():.0f} from scratch, {faint[1].mean():.0f} transferred and "
        f"{faint[2].mean():.0f} without upsampling",
        *sentences_of_larger_grids(),
    ]


def sentences_of_larger_grids():
    cost = {
        name: on_20x20(f"`{name}`")[-2:] + on_20x20(f"`{name}`")[:1]
        for name in ("pp20-hetnet", "short-hetnet", "brief-hetnet", "pp20-hetnet-scratch")
    }
    assert cost["brief-hetnet"] == ["never", "never", "3"]
    steps, seconds = (
        {name: figures[i].split()[0] for name, figures in cost.items()} for i in range(2)
    )
    bound = 2 * float(kept("stages", task="20x20 10P")[0]["bound"])
    chain, short, _, scratch = cost
    return [
        f"To {bound:.0f} steps at limit 200 (128 starts), sources in, a chain takes {steps[chain]} "
        f"M steps and {seconds[chain]} CPU seconds, with sources of 0.5 M each {steps[short]} M "
        f"and {seconds[short]}, of 0.3 M it never comes; scratch takes {steps[scratch]} M and "
        f"{seconds[scratch]}",
    ]


def times_the_epochs(name):
    """That the transferred arm has had with its source, of scratch's, at the paper's hour."""
    source = steps_had(source_of(name), "source").shape[1]
    seconds, hour = SECONDS[name], HOURS[name] * 3600
    on_target = (hour - source * seconds[0]) // seconds[1]
    return (source + on_target) / (hour // seconds[2])


def at_equal_steps(name):
    """From scratch and transferred, preset `paper`, means of ten epochs before the largest number
    of environment steps that both have, the source's in.
    """
    source = steps_had(source_of(name), "source")[:, -1].mean()
    had = {arm: steps_had(name, arm).mean(0) for arm in ("scratch", "transfer")}
    had["transfer"] = had["transfer"] + source
    at = min(steps[-1] for steps in had.values())
    window = 10 * had["scratch"][-1] / len(had["scratch"])
    taken = []
    for arm, steps in had.items():
        inside = (steps > at - window + 1e-9) & (steps <= at + 1e-9)
        taken.append(steps_taken(name, arm, "paper")[:, inside].mean())
    return "{:.1f} and {:.1f}".format(*taken)


def by_procedure(name):
    """From scratch and transferred at the paper's hour, preset `paper`, of three seeds each."""
    _, *arms = at_the_hour(name, "paper")
    assert [len(arm) for arm in arms] == [3, 3]
    return " and ".join(map(of_means, arms))


def test_the_words_of_the_page_of_verdicts():
    page = plain((ROOT / "docs" / "verdicts.md").read_text())

    def pairs(scratch, transfer):
        apart = np.divide.outer(scratch, transfer)
        return f"{apart.min():.1f} to {apart.max():.1f}"

    _, *pp = at_the_hour("pp-hetnet", "paper")
    _, *pcp = at_the_hour("pcp-hetnet-3p2c", "paper")
    scratch, transfer = pcp
    (interval,) = (
        [float(row[end]) for end in ("low", "high")]
        for row in read("statistics")
        if (row["preset"], row["experiment"], row["of"])
        == ("paper", "pcp-hetnet-3p2c", "scratch/transfer")
        and row["quantity"] == "steps taken at equal cost, source in: the paper's hours"
    )
    budgets = steps_had("pp-hetnet", "scratch")[:, -1]
    had, came = steps_had("pp-hetnet", "transfer"), epochs_to("pp-hetnet", "transfer", 30, "paper")
    source = steps_had("pp-hetnet", "source")[:, -1].mean()
    sooner = [source + seed[int(epoch) - 1] for seed, epoch in zip(had, came, strict=True)]
    for words in (
        f"transferred seeds come after {min(sooner):.1f} to {max(sooner):.1f} M steps, scratch's "
        f"budgets end at {min(budgets):.1f} to {max(budgets):.1f} M",
        f"at the paper's hour all pairs of seeds are {pairs(*pp)} times apart",
        f"Predator-Capture-Prey with 3 + 2 agents holds in part too, {pairs(*pcp)}",
        f"({transfer.mean():.1f} and 25.3 steps)",
        f"comes to {min(scratch):.0f} to {max(scratch):.0f} steps here",
        f"interval, {interval[0]:.2f} to {interval[1]:.0f}, tells nothing",
    ):
        assert words in page, words


def sentences_of_the_ablations():
    def way(name, words):
        return f"{steps_taken(name, ablated(name, words)[0]).mean():.1f}"

    def zero_shot(name, words):
        return f"{np.mean(evaluations()['fast', name, ablated(name, words)[1], 'sampled'][0]):.0f}"

    def whole(name, words, source):
        return f"{median(epochs_to(name, ablated(name, words)[0])) * EPOCH + source:.2f} M"

    first, scratch, corner, *_, quarter, pooled, native, _ = list(ABLATED)[:-4]
    started, in_a_corner, no_encoder, started_scratch = list(ABLATED)[-4:]
    ic3, het = "pp-ic3net", "pp-hetnet"

    def overlap(name, words, other, of=lambda taken: taken.mean(1)):
        one, two = (of(steps_taken(name, ablated(name, w)[0])) for w in (words, other))
        return max(one) >= min(two) and max(two) >= min(one)

    assert [overlap(name, corner, first) for name in (ic3, het)] == [True, False]
    assert [overlap(name, pooled, native) for name in (ic3, het)] == [False, False]
    assert [overlap(name, in_a_corner, started) for name in (ic3, het)] == [True, False]
    assert [overlap(name, no_encoder, started) for name in (ic3, het)] == [False, False]
    for name in (ic3, het):
        end = last_tenth(steps_taken(name, ablated(name, first)[0])).mean()
        for words in ABLATED:
            arm = ablated(name, words)[0]
            if arm.startswith("transfer") and "lab-gap" not in arm:
                assert last_tenth(steps_taken(name, arm)).mean() <= 1.1 * end
        short = 12 + epochs_to(name, ablated(name, quarter)[0])
        assert max(short) >= min(epochs_to(name, ablated(name, scratch)[0]))
    assert np.isinf(epochs_to(het, "scratch-lab-gap", 30)).all()
    faint = steps_taken(het, ablated(het, started_scratch)[0])
    assert np.isinf(epochs_to(het, ablated(het, started_scratch)[0])).all()
    assert faint.min() > 150  # of a limit of 200

    def ends_at(name, words, digits=0):
        return f"{last_tenth(steps_taken(name, ablated(name, words)[0])).mean():.{digits}f}"

    def to_20(name, words):
        return median(epochs_to(name, ablated(name, words)[0])) * EPOCH

    later = to_20(ic3, started_scratch) - to_20(ic3, scratch)
    assert to_20(het, in_a_corner) == to_20(het, no_encoder)
    late = np.concatenate(
        [last_tenth(steps_taken(het, ablated(het, w)[0])) for w in (in_a_corner, no_encoder)]
    )
    upsampled, cornered = (last_tenth(steps_taken(het, arm, "paper")) for arm in STARTED[:2])
    assert min(cornered) <= max(upsampled)
    published = steps_taken(het, "scratch-published-start", "paper")
    had = steps_had(het, "scratch-published-start")[:, -1].mean()
    assert published.shape == (3, 620)
    assert published.min() > 150  # of a limit of 200
    (level,) = (
        row for row in read("references") if (row["experiment"], row["task"]) == (het, "target")
    )
    for arm in (arms for _, arms in list(BY_PAPER.values())[2:] if arms.startswith("transfer")):
        taken = steps_taken(het, arm, "paper")
        assert np.isinf(epochs_to(het, arm, 30, "paper")).all()
        assert last_tenth(taken).max() < last_tenth(published).min() / 2
    return [
        f"a policy starts the target at {zero_shot(ic3, corner)} (IC3Net) and "
        f"{zero_shot(het, corner)} steps (HetNet) where an upsampled one starts at "
        f"{zero_shot(ic3, first)} and {zero_shot(het, first)}",
        f"The mean on the way is {way(ic3, corner)} against {way(ic3, first)} for IC3Net, whose "
        f"ranges overlap, and {way(het, corner)} against {way(het, first)} for HetNet, whose do "
        f"not; from scratch it is {way(ic3, scratch)} and {way(het, scratch)}",
        f"({ends_at(het, started_scratch)} at the end; with this package's initial weights it "
        f"comes to {ends_at(het, scratch)})",
        f"at 20 steps after {to_20(het, started):.2f} M, it ends at {ends_at(het, started, 1)}",
        f"HetNet is at 20 steps after {to_20(het, in_a_corner):.2f} M without upsampling too",
        f"all six seeds end at {late.min():.1f} to {late.max():.1f}",
        f"({way(ic3, started)} against {way(ic3, in_a_corner)} steps on the way, ranges overlap)",
        f"by the encoder ({way(ic3, no_encoder)}, ranges apart)",
        f"IC3Net does learn from scratch, {later:.1f} M steps later than with our weights",
        f"({zero_shot(ic3, pooled)} against {zero_shot(ic3, native)} and {zero_shot(het, pooled)} "
        f"against {zero_shot(het, native)} steps)",
        f"gains too, {way(ic3, pooled)} against {way(ic3, native)} (IC3Net) and "
        f"{way(het, pooled)} against {way(het, native)} (HetNet), ranges apart",
        *(
            f"{whole(name, quarter, 12 * EPOCH)} against {whole(name, first, 50 * EPOCH)}{middle}"
            f"{whole(name, scratch, 0)}{end}"
            for name, middle, end in (
                (ic3, " after a whole source and ", " from scratch (IC3Net)"),
                (het, " and ", " (HetNet)"),
            )
        ),
        f"with the source's {curves()['paper', ic3, 'source-25'][1][:, -1].mean():.1f} M counted",
        f"after the whole budget ({had:.1f} M steps) three seeds are at "
        f"{of_means(last_tenth(published))} steps, a random team at "
        f"{float(level['random_steps_taken']):.0f}, the paper's one run at 189.7",
        f"Without upsampling a transfer ends at {cornered.mean():.1f} where it ends at "
        f"{upsampled.mean():.1f} with it, and their ranges overlap",
        f"slow and uneven ({last_tenth(steps_taken(het, 'scratch-lab-gap', 'paper')).mean():.1f}), "
        "transferred all seeds are alike "
        f"({last_tenth(steps_taken(het, 'transfer-lab-gap', 'paper')).mean():.1f})",
    ]


def plain(text):
    return re.sub(r"\s+", " ", text)


@pytest.mark.parametrize(
    ("page", "sentences"),
    [("README.md", sentences_of_the_readme), ("docs/ablations.md", sentences_of_the_ablations)],
)
def test_a_sentence_is_what_the_kept_rows_say(page, sentences):
    text = plain((ROOT / page).read_text())
    for sentence in sentences():
        assert sentence in text, sentence


ELSEWHERE = "35.6 (TarMAC with IC3Net, second-hand)"


def test_the_readme_has_no_other_figure():
    """Of its results: each number with a decimal stands in a table or a sentence above."""
    text = MARK.sub("", (ROOT / "README.md").read_text())
    for section in ("What it reaches", "Larger grids"):
        results = plain(text.partition(f"## {section}\n")[2].partition("\n## ")[0])
        for sentence in (*sentences_of_the_readme(), ELSEWHERE):
            results = results.replace(sentence, "")
        assert len(results) > 300
        assert re.findall(r"\d+\.\d+|\d+ of \d+|\d+ (?:hours|minutes)", results) == []


# The report's own tables.


def at_the_hour(name, preset):
    """The hour that is compared, and both arms in the hour before it."""
    source, transfer, scratch = (
        steps_taken(source_of(name) if arm == "source" else name, arm, preset)
        for arm in ("source", "transfer", "scratch")
    )
    seconds = np.array(SECONDS[name]) / 3600
    ends = seconds[2] * np.arange(1, scratch.shape[1] + 1)
    later = source.shape[1] * seconds[0] + seconds[1] * np.arange(1, transfer.shape[1] + 1)
    hour = float(HOURS[name])
    for cost, epoch in ((ends, seconds[2]), (later, seconds[1])):
        if cost[-1] + epoch <= HOURS[name]:
            hour = min(hour, cost[-1])

    def mean(taken, cost):
        return taken[:, (cost > hour - 1 + 1e-9) & (cost <= hour + 1e-9)].mean(1)

    return hour, mean(scratch, ends), mean(transfer, later)


def four(value):
    return f"{value:#.4g}".rstrip(".")


def of_seeds(sample):
    if len(sample) == 1:
        return four(sample[0])
    return f"{four(sample.mean())} ({four(sample.min())}-{four(sample.max())})"


def test_table_1_of_the_report():
    rows = read("table1")
    assert len(rows) == 10
    names = [name for name in EXPERIMENTS for _ in range(2)]
    for name, row in zip(names, rows, strict=True):
        hour, scratch, transfer = at_the_hour(name, row["preset"])
        assert row["at (h)"] == f"{hour:.3g}"
        assert row["scratch"] == of_seeds(scratch)
        assert row["transfer"] == of_seeds(transfer)
        value, *interval = re.findall(r"[\d.]+", row["ratio"])
        assert value == four(scratch.mean() / transfer.mean())
        reached = [
            np.isfinite(epochs_to(name, arm, 30, row["preset"])) for arm in ("scratch", "transfer")
        ]
        of_one_kind = all(r.all() or not r.any() for r in reached)
        assert bool(interval) == (of_one_kind and min(len(scratch), len(transfer)) >= 3)
        if interval:
            logs = [np.log(sample) for sample in (scratch, transfer)]
            error = math.sqrt(sum(log.var(ddof=1) / len(log) for log in logs))
            # Student's 97.5% with two and with four degrees of freedom, from a table.
            half = {3: 4.302653, 5: 2.776445}[len(scratch)] * error
            middle = logs[0].mean() - logs[1].mean()
            expected = [four(math.exp(middle + side * half)) for side in (-1, 1)]
            assert [four(float(end)) for end in interval] == expected
