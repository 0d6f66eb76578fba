"""The paper's claims, each with a verdict that a stated rule takes from the kept numbers."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from experiments.paper.arms import SOURCE, SOURCE_PLAIN
from experiments.paper.published import EXPERIMENTS, LARGEST_RATIO, SOURCES
from experiments.paper.statistics import (
    BEST_EPOCHS,
    Comparison,
    Estimate,
    Row,
    comparison_of,
    curves_of,
    estimate,
    iqm,
    ratio_of,
)

HOLDS, IN_PART, FAILS, NOT_RUN = "holds", "holds in part", "does not hold", "not run yet"

MARGIN = 1.10
"""Up to so many times the steps taken two arms count as equal."""
SOLVED = 30.0
"""Steps taken that count as success on the target: the paper's transferred policies got there."""
AT_RANDOM = 0.9
"""Share of the step limit from which the paper's scratch row counts as a failure."""
FALLEN_BACK = 1.5
"""Times its best at which an arm's end is called a fall: a ratio at the hour then hangs on when."""
LEAST_SEEDS = 3

RULES = f"""\
* An interval is that of the interquartile mean over seeds (95%, bootstrap); "at the hour" is the
  mean over the epochs of the hour before the paper's fixed hour T, epochs converted by the paper's
  own seconds per epoch, the source's counted. Where a budget ends before T it is the last hour that
  both arms have, and the table says so.
* Q1 holds when the interval of steps taken with over without upsampling ends at or below
  {MARGIN:g}, holds in part when it contains {MARGIN:g}, and does not hold above; both are means
  over the last tenth of the epochs.
* Q2 of a row holds when the ratio scratch/transfer at the hour is at least the paper's and its
  interval lies above {MARGIN:g}, holds in part when only the interval lies above {MARGIN:g}, and
  does not hold otherwise.
* "Up to {LARGEST_RATIO:g}x": the same rule, for the row with the largest ratio; until all rows have
  been run only a row that reaches {LARGEST_RATIO:g} decides it.
* "Scratch fails where transfer succeeds" is about the rows in which the paper's scratch stayed at
  {AT_RANDOM:.0%} of the step limit or more and its transfer came near {SOLVED:g}. In a row it holds
  when every transferred seed and no seed from scratch came to {SOLVED:g} steps within its budget,
  in part when more transferred seeds did; over the rows it holds when it does in all, in part when
  it does in part in any.
* An arm "fell back" when the mean over its last tenth is over {FALLEN_BACK:g} times the least
  mean of {BEST_EPOCHS} epochs in a row; no verdict depends on it, but its ratio is worth little.
* Nothing more than "holds in part" is said with fewer than {LEAST_SEEDS} seeds, and, but for Q1,
  where the budget ends before the paper's hour: what scratch would have come to is not known then.
"""


@dataclass(frozen=True)
class Claim:
    """One line of the report."""

    name: str
    preset: str
    paper: str
    ours: str
    verdict: str
    reason: str


def claims(rows: Iterable[Row], preset: str) -> list[Claim]:
    """Every claim under one preset, in the paper's order."""
    rows = list(rows)
    compared = {name: comparison_of(rows, name, preset) for name in EXPERIMENTS}
    return [
        *(_source_unharmed(rows, name, preset) for name in SOURCES),
        *(_transfer_better(name, compared[name], preset) for name in EXPERIMENTS),
        _largest([c for c in compared.values() if c is not None], preset),
        _scratch_fails(compared, preset),
    ]


def _source_unharmed(rows: list[Row], name: str, preset: str) -> Claim:
    row = EXPERIMENTS[name]
    title = f"Q1, {row.source_title} on the source: upsampling does no harm"
    claim = Claim(title, preset, "similar (no figure given)", "", NOT_RUN, "")
    arms = [curves_of(rows, name, arm, preset) for arm in (SOURCE, SOURCE_PLAIN)]
    if any(arm is None for arm in arms):
        return claim
    lasts = [arm.last for arm in arms if arm is not None]
    found = estimate(ratio_of(iqm), *lasts)
    with_it, without = (estimate(iqm, last) for last in lasts)
    verdict = FAILS
    if _low(found) <= MARGIN:
        verdict = HOLDS if _high(found) <= MARGIN else IN_PART
    return replace(
        claim,
        ours=f"{said(found, 3)}x",
        verdict=_capped(verdict, found),
        reason=f"{said(with_it)} steps with upsampling, {said(without)} without.",
    )


def _transfer_better(name: str, compared: Comparison | None, preset: str) -> Claim:
    row = EXPERIMENTS[name]
    paper = f"{row.ratio:.2f}x at {row.hours:g} h ({row.scratch:g} -> {row.transfer:g})"
    claim = Claim(f"Q2, {row.title}", preset, paper, "", NOT_RUN, "")
    if compared is None:
        return claim
    found = estimate(ratio_of(iqm), *compared.final)
    scratch, transfer = (estimate(iqm, sample) for sample in compared.final)
    ours = f"{said(found)}x at {compared.hour:.3g} h ({said(scratch)} -> {said(transfer)})"
    verdict = _ratio_verdict(found, row.ratio, compared)
    return replace(claim, ours=ours, verdict=verdict, reason=_why(compared))


def _ratio_verdict(found: Estimate, paper: float, compared: Comparison) -> str:
    if _low(found) <= MARGIN:
        return FAILS
    verdict = HOLDS if found.value >= paper else IN_PART
    return _capped(verdict, found, compared)


def _why(compared: Comparison) -> str:
    """Where the advantage is, as far as the curves show it."""
    best, at = compared.largest(counted=False)
    text = f"Largest on the way: {best:.1f}x after {at / 1e6:.2f} M target steps"
    best, at = compared.largest(counted=True)
    if not math.isnan(best):
        text += f", {best:.1f}x at {at / 1e6:.2f} M when the source's steps count"
    arms = (("transferred", compared.transfer), ("scratch", compared.scratch))
    reached = [
        (words, f"{(arm.env_steps_to(SOLVED) < math.inf).sum()} of {len(arm.filled)}")
        for words, arm in arms
    ]
    text += f"; {SOLVED:g} steps reached by " + " and ".join(f"{n} {w} seeds" for w, n in reached)
    for words, arm in arms:
        best, at = arm.best
        if (end := float(iqm(arm.last))) > FALLEN_BACK * best:
            text += f"; {words} fell back from {best:.3g} steps at {at / 1e6:.2f} M to {end:.3g}"
    if not compared.at_the_papers_hour:
        text += f"; the budget ends at {compared.hour:.3g} of the paper's {compared.row.hours:g} h"
    return text + "."


def _largest(compared: list[Comparison], preset: str) -> Claim:
    claim = Claim(
        f"Up to {LARGEST_RATIO:g}x", preset, f"{LARGEST_RATIO:g}x (PCP 3P/2C)", "", NOT_RUN, ""
    )
    if not compared:
        return claim
    found = [(estimate(ratio_of(iqm), *c.final), c) for c in compared]
    best, where = max(found, key=lambda pair: pair[0].value)
    missing = len(EXPERIMENTS) - len(compared)
    verdict = _ratio_verdict(best, LARGEST_RATIO, where)
    if missing and best.value < LARGEST_RATIO:
        verdict = NOT_RUN
    return replace(
        claim,
        ours=f"{said(best)}x ({where.row.title})",
        verdict=verdict,
        reason=f"Of {len(compared)} rows" + (f"; {missing} not run yet." if missing else "."),
    )


def _scratch_fails(compared: dict[str, Comparison | None], preset: str) -> Claim:
    names = [
        name
        for name, row in EXPERIMENTS.items()
        if row.scratch >= AT_RANDOM * row.target.max_steps and row.transfer <= 1.1 * SOLVED
    ]
    title = "Scratch fails where transfer succeeds"
    paper = f"scratch at random level, transfer near {SOLVED:g} ({', '.join(names)})"
    known = [(name, c) for name in names if (c := compared[name]) is not None]
    if not known:
        return Claim(title, preset, paper, "", NOT_RUN, "")
    verdicts, counts = [], []
    for name, comparison in known:
        transferred, scratch = (
            arm.env_steps_to(SOLVED) < math.inf for arm in (comparison.transfer, comparison.scratch)
        )
        verdict = IN_PART if transferred.mean() > scratch.mean() else FAILS
        verdict = HOLDS if transferred.all() and not scratch.any() else verdict
        few = Estimate(0.0, seeds=min(len(transferred), len(scratch)))
        verdicts.append(_capped(verdict, few, comparison))
        counts.append(
            f"{name}: {transferred.sum()} of {len(transferred)} transferred, "
            f"{scratch.sum()} of {len(scratch)} from scratch"
        )
    verdict = HOLDS if all(v == HOLDS for v in verdicts) else IN_PART
    verdict = FAILS if all(v == FAILS for v in verdicts) else verdict
    missing = f"; rows not run yet: {len(names) - len(known)}" if len(known) < len(names) else ""
    if missing and verdict == HOLDS:
        verdict = IN_PART
    reason = f"Seeds that reached {SOLVED:g} steps within their budgets{missing}."
    return Claim(title, preset, paper, "; ".join(counts), verdict, reason)


def _capped(verdict: str, found: Estimate, compared: Comparison | None = None) -> str:
    """No `holds` from too few seeds or too short a budget."""
    short = compared is not None and not compared.at_the_papers_hour
    return IN_PART if verdict == HOLDS and (short or found.seeds < LEAST_SEEDS) else verdict


def _low(found: Estimate) -> float:
    return found.value if found.low is None else found.low


def _high(found: Estimate) -> float:
    return found.value if found.high is None else found.high


def said(found: Estimate, digits: int = 4) -> str:
    """A number with its interval, as a cell."""
    text = ("> " if found.at_least else "") + number(found.value, digits)
    if found.low is None or found.high is None or math.isnan(found.value):
        return text
    return f"{text} [{number(found.low, digits)}, {number(found.high, digits)}]"


def number(value: float, digits: int = 4) -> str:
    """`digits` digits; `never` and `-` for what is infinite and what is no number."""
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "never"
    if value >= 10_000:  # environment steps
        return f"{value / 1e6:.3g} M"
    return f"{value:#.{digits}g}".rstrip(".")
