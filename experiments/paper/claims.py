"""The paper's claims, each with a verdict that a stated rule takes from the kept numbers."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from experiments.paper.arms import SOURCE, SOURCE_PLAIN
from experiments.paper.published import EXPERIMENTS, LARGEST_RATIO, SOURCES
from experiments.paper.statistics import (
    LEAST_SEEDS,
    SOLVED,
    WINDOW_EPOCHS,
    Accounting,
    Comparison,
    Curves,
    Ratio,
    Row,
    Sample,
    Spread,
    comparison_of,
    curves_of,
    mean_of,
    median_of,
    pairs,
    ratio_of_means,
)

HOLDS, IN_PART, FAILS, OPEN = "holds", "holds in part", "does not hold", "open"
NOT_RUN = "not run yet"

MARGIN = 1.10
"""Up to so many times the steps taken two runs count as equal, and an arm as settled."""
AT_RANDOM = 0.9
"""Share of the step limit from which the paper's scratch row counts as a failure."""
FALLEN_BACK = 1.5
"""Times its best at which an arm's end is called a fall: a ratio at the hour then hangs on when."""
SOURCE_SOLVED = 10.0
"""Steps taken on the small task that count as solved: about twice the shortest paths."""
FEW_HOURS = 10.0
"""Of the paper's hours, that its "few hours after transfer" are read as at most."""
LONG_HOURS = 400.0
"""In which the paper's PCP runs from scratch came to no high performance."""
CAPTURE = ("pcp-hetnet-2p1c", "pcp-hetnet-3p2c")

RULES = f"""\
* Everything is a mean over seeds with the least and the greatest seed; times are medians. Nothing
  is concluded from fewer than {LEAST_SEEDS} seeds in an arm: such a line is "{OPEN}".
* Two arms are compared by **all pairs** of a run of the one with a run of the other. "More" is said
  when every pair lies on the same side of {MARGIN:g}; by chance alone that happens to arms that do
  not differ in 2 of 252 draws of five and five seeds for either side, and in 2 of 20 of three and
  three: three seeds are weak evidence.
* Budgets are in the table below. Where one ends before the paper's fixed hour T, its end stands for
  T if both arms have settled: no seed's mean over the last tenth of its epochs is more than
  {MARGIN:g} times off the tenth before. While a seed still moves the line is "{OPEN}", whichever
  way it points. Under preset `fast` the learning rate falls to the budget's end, which settles an
  arm too.
* Q1 holds when every pair upsampled/not upsampled lies at or below {MARGIN:g}, does not when every
  pair lies above; else it is open. (Means over the last tenth of the epochs.)
* Q2 of a row: the paper ran each arm once, so it can bear a direction, and a size up to what
  single runs scatter. It holds when every pair scratch/transfer at T lies above {MARGIN:g} and one
  comes to the paper's ratio (with more pairs one does so more easily); in part when every pair lies
  above {MARGIN:g} and none comes to it; it does not hold when every pair lies at or below
  {MARGIN:g}; else it is open.
* "Up to {LARGEST_RATIO:g}x": the rule of Q2 for the row with the largest ratio of all five, once
  all have {LEAST_SEEDS} seeds; one that comes to {LARGEST_RATIO:g} decides it before.
* "Scratch does not come to {SOLVED:g} steps where transfer does", in the rows in which the paper's
  scratch stayed at {AT_RANDOM:.0%} of the step limit or more and its transfer came near {SOLVED:g}:
  holds when every transferred seed and no seed from scratch came there by T, in part when up to
  half of those from scratch did as well. It does not hold when more than half of the seeds from
  scratch came (who has come, has: no budget is too short for that), or when by T more than half of
  the transferred ones did not.
* "Scratch makes no progress", in every row in which the paper's scratch stayed at
  {AT_RANDOM:.0%} of the step limit or more: holds when every seed is there too over the last tenth
  of a budget that goes to T, does not hold when no seed is; else it is open.
* A time is shorter when it is for every pair. Who never came within a budget took longer than that
  budget: such a pair counts for the one that came if it came within the other's budget. One left
  undecided leaves the line "{OPEN}".
* Over several rows a claim has the verdict that all have, or it is said how many have which.
* An arm "fell back" when the mean over its last tenth is over {FALLEN_BACK:g} times the least
  mean of {WINDOW_EPOCHS} epochs in a row; no verdict depends on it, but its ratio is worth little.
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
    known = {name: c for name, c in compared.items() if c is not None}
    return [
        *(_source_unharmed(rows, name, preset) for name in SOURCES),
        _longer_on_the_source(rows, preset),
        _sources_converged(rows, preset),
        *(_transfer_better(name, compared[name], preset) for name in EXPERIMENTS),
        _largest(list(known.values()), preset),
        _sooner(known, preset),
        _with_less_experience(known, preset),
        _scratch_fails(known, preset),
        _makes_no_progress(known, preset),
        _no_high_performance(known, preset),
        _within_hours(known, preset),
    ]


def _source_unharmed(rows: list[Row], name: str, preset: str) -> Claim:
    title = f"Q1, {EXPERIMENTS[name].source_title} on the source: upsampling does no harm"
    claim = Claim(title, preset, "similar (no figure given)", "", NOT_RUN, "")
    arms = [curves_of(rows, name, arm, preset) for arm in (SOURCE, SOURCE_PLAIN)]
    upsampled, plain = arms
    if upsampled is None or plain is None:
        return claim
    verdict = OPEN
    if _enough(upsampled, plain) and _settled(upsampled, plain):
        verdict = _sides(pairs(upsampled.last, plain.last), low=HOLDS, high=FAILS)
    ratio = ratio_of_means(upsampled.last, plain.last)
    reason = (
        f"{spread(mean_of(upsampled.last))} steps with upsampling, "
        f"{spread(mean_of(plain.last))} without; {_pairs(upsampled.last, plain.last)}"
    )
    return replace(
        claim, ours=f"{said(ratio, 3)}x", verdict=verdict, reason=reason + _why_open(arms)
    )


def _longer_on_the_source(rows: list[Row], preset: str) -> Claim:
    name = "pp-hetnet"
    title = "HetNet takes longer to converge on the PP source under upsampling"
    claim = Claim(title, preset, "said of Figure 2a", "", NOT_RUN, "")
    upsampled, plain = (curves_of(rows, name, arm, preset) for arm in (SOURCE, SOURCE_PLAIN))
    if upsampled is None or plain is None:
        return claim
    steps = [arm.env_steps_to(SOURCE_SOLVED) for arm in (upsampled, plain)]
    hours = [arm.cost_to(SOURCE_SOLVED, arm.hours) for arm in (upsampled, plain)]
    with_upsampling, without = (
        _Times(sample, np.full(len(sample), arm.hours[-1]))
        for sample, arm in zip(hours, (upsampled, plain), strict=True)
    )
    verdict = _sooner_than(without, with_upsampling, yes=HOLDS, no=FAILS)
    ours = " h, ".join(spread(median_of(sample), 3) for sample in hours) + " h"
    reason = (
        f"The paper's hours to {SOURCE_SOLVED:g} steps, with upsampling and without; in M "
        f"environment steps {' and '.join(spread(median_of(sample), 3) for sample in steps)}."
    )
    return replace(
        claim, ours=ours, verdict=verdict if _enough(upsampled, plain) else OPEN, reason=reason
    )


def _sources_converged(rows: list[Row], preset: str) -> Claim:
    title = "The policy has converged on the source when it is transferred"
    claim = Claim(title, preset, "condition of the method", "", NOT_RUN, "")
    found = {name: curves_of(rows, name, SOURCE, preset) for name in SOURCES}
    known = {name: arm for name, arm in found.items() if arm is not None}
    if not known:
        return claim
    verdicts = {
        name: (HOLDS if _settled(arm) else FAILS) if _enough(arm) else OPEN
        for name, arm in known.items()
    }
    ours = "; ".join(
        f"{name}: {spread(mean_of(arm.last))} after {len(arm.epochs)} epochs, "
        f"{'settled' if _settled(arm) else 'still moving'}, {_seeds(arm)}"
        for name, arm in known.items()
    )
    reason = f"Rows: {_rows(verdicts)}. Moving: over {MARGIN:g} times from a tenth to the next."
    return replace(claim, ours=ours, verdict=_over(verdicts), reason=reason)


def _transfer_better(name: str, compared: Comparison | None, preset: str) -> Claim:
    row = EXPERIMENTS[name]
    paper = f"{row.ratio:.2f}x at {row.hours:g} h ({row.scratch:g} -> {row.transfer:g})"
    claim = Claim(f"Q2, {row.title}", preset, paper, "", NOT_RUN, "")
    if compared is None:
        return claim
    found = compared.equal(compared.papers_hours)
    if found.transfer is None:
        return replace(claim, verdict=OPEN, reason="The budgets end before the source's hours do.")
    ratio = ratio_of_means(found.scratch, found.transfer, compared.of_one_kind)
    ours = (
        f"{said(ratio)}x at {compared.hour:.3g} h "
        f"({spread(mean_of(found.scratch))} -> {spread(mean_of(found.transfer))})"
    )
    verdict = _ratio_verdict(compared, row.ratio)
    reason = f"{_pairs(found.scratch, found.transfer)[:-1]}; {_why(compared)}"
    return replace(claim, ours=ours, verdict=verdict, reason=reason)


def _ratio_verdict(compared: Comparison, paper: float) -> str:
    found = compared.equal(compared.papers_hours)
    if found.transfer is None or not _decides(compared):
        return OPEN
    ratios = pairs(found.scratch, found.transfer)
    return _sides(ratios, low=FAILS, high=HOLDS if ratios.max() >= paper else IN_PART)


def _decides(compared: Comparison) -> bool:
    """Whether there are seeds enough, and the budget is one from which something follows."""
    arms = (compared.scratch, compared.transfer)
    return _enough(*arms) and (compared.at_the_papers_hour or _settled(*arms))


def _why(compared: Comparison) -> str:
    """Who came, who fell back, and how far the budget goes."""
    arms = (("transferred", compared.transfer), ("scratch", compared.scratch))
    text = f"{SOLVED:g} steps reached by " + " and ".join(
        f"{arm.came_to(SOLVED)} of {len(arm.filled)} {words} seeds" for words, arm in arms
    )
    for words, arm in arms:
        best, at = arm.best
        if (end := float(arm.last.mean())) > FALLEN_BACK * best:
            text += f"; {words} fell back from {best:.3g} steps at {at / 1e6:.2f} M to {end:.3g}"
    if not compared.at_the_papers_hour:
        text += f"; the budget ends at {compared.hour:.3g} of the paper's {compared.row.hours:g} h"
        moving = not _settled(compared.scratch, compared.transfer)
        text += f", {'with seeds still moving' if moving else 'all seeds settled'}"
    return text + _few(*(arm for _, arm in arms)) + "."


def _largest(compared: list[Comparison], preset: str) -> Claim:
    title, paper = f"Up to {LARGEST_RATIO:g}x", f"{LARGEST_RATIO:g}x (PCP 3P/2C)"
    claim = Claim(title, preset, paper, "", NOT_RUN, "")
    found = []
    for comparison in compared:
        equal = comparison.equal(comparison.papers_hours)
        if equal.transfer is not None:
            ratio = ratio_of_means(equal.scratch, equal.transfer, comparison.of_one_kind)
            found.append((ratio, comparison))
    if not found:
        return claim
    best, where = max(found, key=lambda pair: pair[0].value)
    verdict = _ratio_verdict(where, LARGEST_RATIO)
    decided = sum(_decides(comparison) for _, comparison in found)
    if decided < len(EXPERIMENTS) and verdict != HOLDS:
        verdict = OPEN
    return replace(
        claim,
        ours=f"{said(best)}x ({where.row.title})",
        verdict=verdict,
        reason=f"{decided} of {len(EXPERIMENTS)} rows have seeds and budgets that decide.",
    )


def _sooner(known: Mapping[str, Comparison], preset: str) -> Claim:
    return _times_claim(
        f"Less aggregate time to a target performance ({SOLVED:g} steps), source in",
        "all five rows, by its hours",
        known,
        preset,
        lambda compared: compared.papers_hours,
        "The paper's hours",
    )


def _with_less_experience(known: Mapping[str, Comparison], preset: str) -> Claim:
    return _times_claim(
        f"Less training experience to a target performance ({SOLVED:g} steps), source in",
        "said in the conclusion",
        known,
        preset,
        lambda compared: compared.env_steps,
        "M environment steps",
    )


def _times_claim(
    title: str,
    paper: str,
    known: Mapping[str, Comparison],
    preset: str,
    accounting: Callable[[Comparison], Accounting],
    unit: str,
) -> Claim:
    """Of every row: transfer came there before scratch did."""
    if not known:
        return Claim(title, preset, paper, "", NOT_RUN, "")
    verdicts, parts = {}, []
    for name, compared in known.items():
        by = accounting(compared)
        scratch, transfer = compared.times_to(SOLVED, by)
        verdicts[name] = OPEN
        if _enough(compared.scratch, compared.transfer):
            transferred = _Times(transfer, by.transfer[:, -1])
            from_scratch = _Times(scratch, by.scratch[:, -1])
            verdicts[name] = _sooner_than(transferred, from_scratch, yes=HOLDS, no=FAILS)
        parts.append(f"{name}: {spread(median_of(scratch), 3)} -> {spread(median_of(transfer), 3)}")
    reason = f"{unit}, scratch -> transfer. Rows: {_rows(verdicts)}."
    return Claim(title, preset, paper, "; ".join(parts), _over(verdicts), reason)


def _scratch_fails(known: Mapping[str, Comparison], preset: str) -> Claim:
    names = [name for name in _at_random() if EXPERIMENTS[name].transfer <= 1.1 * SOLVED]
    title = f"Scratch does not come to {SOLVED:g} steps where transfer does"
    paper = f"scratch at random level, transfer near {SOLVED:g} ({', '.join(names)})"
    found = {name: known[name] for name in names if name in known}
    ours = "; ".join(f"{name}: {_came(compared)}" for name, compared in found.items())
    words = f"Seeds that reached {SOLVED:g} steps within their budgets."
    return _by_rows(Claim(title, preset, paper, ours, NOT_RUN, words), names, found, _failing)


def _makes_no_progress(known: Mapping[str, Comparison], preset: str) -> Claim:
    title, names = "Scratch makes no progress", _at_random()
    paper = f"said in the conclusion; at random level ({', '.join(names)})"
    found = {name: known[name] for name in names if name in known}
    ours = "; ".join(
        f"{name}: {spread(mean_of(compared.scratch.last))} of {compared.scratch.step_limit}"
        for name, compared in found.items()
    )
    words = "Steps taken over the last tenth of the budget, of the limit."
    return _by_rows(Claim(title, preset, paper, ours, NOT_RUN, words), names, found, _still)


def _at_random() -> list[str]:
    """Rows of Table I in which the paper's scratch stayed near the step limit."""
    return [
        name for name, row in EXPERIMENTS.items() if row.scratch >= AT_RANDOM * row.target.max_steps
    ]


def _by_rows(
    claim: Claim,
    names: Iterable[str],
    found: Mapping[str, Comparison],
    verdict: Callable[[Comparison], str],
) -> Claim:
    """The claim with the verdict over all rows it is about, those that are not run too."""
    if not found:
        return replace(claim, reason="")
    verdicts = {name: verdict(found[name]) if name in found else NOT_RUN for name in names}
    reason = f"{claim.reason} Rows: {_rows(verdicts)}."
    return replace(claim, verdict=_over(verdicts), reason=reason)


def _failing(compared: Comparison) -> str:
    scratch, transfer = (arm.came_to(SOLVED) for arm in (compared.scratch, compared.transfer))
    seeds = len(compared.transfer.filled)
    if not _enough(compared.scratch, compared.transfer):
        return OPEN
    if 2 * scratch > len(compared.scratch.filled):
        return FAILS
    if not _decides(compared):
        return OPEN
    if transfer < seeds:
        return FAILS if 2 * transfer < seeds else OPEN
    return IN_PART if scratch else HOLDS


def _still(compared: Comparison) -> str:
    scratch = compared.scratch
    if not _enough(scratch):
        return OPEN
    at_random = scratch.last >= AT_RANDOM * scratch.step_limit
    if at_random.all():
        whole = scratch.hours[-1] + scratch.hours[0] > compared.row.hours  # T lies in an epoch
        return HOLDS if whole else OPEN
    return OPEN if at_random.any() else FAILS


def _came(compared: Comparison) -> str:
    arms = (("transferred", compared.transfer), ("from scratch", compared.scratch))
    return ", ".join(f"{arm.came_to(SOLVED)} of {len(arm.filled)} {words}" for words, arm in arms)


def _no_high_performance(known: Mapping[str, Comparison], preset: str) -> Claim:
    title = f"PCP from scratch: no high performance in over {LONG_HOURS:g} hours"
    paper = "none of its two runs"
    arms = {name: known[name].scratch for name in CAPTURE if name in known}
    if not arms:
        return Claim(title, preset, paper, "", NOT_RUN, "")
    verdicts, parts = {}, []
    for name, arm in arms.items():
        hours, came = arm.cost_to(SOLVED, arm.hours), arm.came_to(SOLVED)
        verdicts[name] = OPEN
        if _enough(arm):
            verdicts[name] = FAILS if 2 * came > len(hours) else OPEN
            if arm.hours[-1] >= LONG_HOURS and not came:
                verdicts[name] = HOLDS
        parts.append(
            f"{name}: {came} of {len(hours)} came to {SOLVED:g}, after "
            f"{spread(median_of(hours), 3)} h of {arm.hours[-1]:.3g}; at the end "
            f"{spread(mean_of(arm.last))} steps"
        )
    reason = f"The paper's hours. Rows: {_rows(verdicts)}."
    return Claim(title, preset, paper, "; ".join(parts), _over(verdicts), reason)


def _within_hours(known: Mapping[str, Comparison], preset: str) -> Claim:
    title = "PCP: high performance within a few hours after transfer"
    paper = "said of Figure 2d"
    arms = {name: known[name].transfer for name in CAPTURE if name in known}
    if not arms:
        return Claim(title, preset, paper, "", NOT_RUN, "")
    verdicts, parts, limit = {}, [], np.array([FEW_HOURS])
    for name, arm in arms.items():
        hours = arm.cost_to(SOLVED, arm.hours)
        few, taken = _Times(limit, limit), _Times(hours, arm.hours[-1:])
        verdicts[name] = _sooner_than(few, taken, yes=FAILS, no=HOLDS) if _enough(arm) else OPEN
        parts.append(f"{name}: {spread(median_of(hours), 3)} h, {_seeds(arm)}")
    reason = (
        f"The paper's hours on the target to {SOLVED:g} steps; few are at most {FEW_HOURS:g}. "
        f"Rows: {_rows(verdicts)}."
    )
    return Claim(title, preset, paper, "; ".join(parts), _over(verdicts), reason)


def _sides(ratios: np.ndarray, low: str, high: str, margin: float = MARGIN) -> str:
    """`high` when every ratio lies above the margin, `low` when none does, else open."""
    above = ratios > margin
    return high if above.all() else OPEN if above.any() else low


@dataclass(frozen=True)
class _Times:
    """Of an arm's seeds until something is reached.

    Attributes:
      taken: (S,) infinite for a seed that never came.
      budget: (S,) that each had.
    """

    taken: Sample
    budget: Sample

    @property
    def known(self) -> Sample:
        """(S,) up to where it is known that a seed had not come, or when it did."""
        return np.minimum(self.taken, self.budget)


def _sooner_than(first: _Times, second: _Times, yes: str, no: str) -> str:
    """`yes` if every seed of the first came before every one of the second, `no` if none did.

    Open too while a seed that never came may yet have come before the other, or after it.
    """
    one, other = first.taken[:, None], second.taken[None, :]
    came_first = (one <= second.known) & (one < other)
    came_later = other <= first.known[:, None]
    return yes if came_first.all() else no if came_later.all() else OPEN


def _enough(*arms: Curves) -> bool:
    return min(len(arm.filled) for arm in arms) >= LEAST_SEEDS


def _settled(*arms: Curves) -> bool:
    """Whether no seed of the arms still moves."""
    return all(((arm.moves <= MARGIN) & (arm.moves >= 1 / MARGIN)).all() for arm in arms)


def _over(verdicts: Mapping[str, str]) -> str:
    """Of several rows together: what all have, or how many have which."""
    counts = Counter(verdicts.values())
    if len(counts) == 1:
        return next(iter(counts))
    return ", ".join(f"{verdict} in {many}" for verdict, many in counts.items())


def _rows(verdicts: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {verdict}" for name, verdict in verdicts.items())


def _pairs(first: Sample, second: Sample) -> str:
    ratios = pairs(first, second)
    if len(ratios) == 1:
        return f"one pair, {number(float(ratios[0]), 3)}."
    return f"pairs {number(ratios.min(), 3)} to {number(ratios.max(), 3)}."


def _few(*arms: Curves) -> str:
    seeds = min(len(arm.filled) for arm in arms)
    if seeds >= LEAST_SEEDS:
        return ""
    return f"; {_seeds(min(arms, key=lambda arm: len(arm.filled)))} of an arm, no evidence"


def _seeds(arm: Curves) -> str:
    many = len(arm.filled)
    return f"{many} seed{'s' if many > 1 else ''}"


def _why_open(arms: Iterable[Curves | None]) -> str:
    known = [arm for arm in arms if arm is not None]
    text = _few(*known).removeprefix("; ")
    if not _settled(*known):
        text += "; " * bool(text) + "still moving"
    return f" {text[0].upper()}{text[1:]}." if text else ""


def said(found: Ratio, digits: int = 4) -> str:
    """A ratio with its interval, as a cell."""
    text = ("> " if found.at_least else "") + number(found.value, digits)
    if found.low is None or found.high is None or math.isnan(found.value):
        return text
    return f"{text} [{number(found.low, digits)}, {number(found.high, digits)}]"


def spread(found: Spread, digits: int = 4) -> str:
    """A number over seeds with their range, as a cell."""
    text = number(found.value, digits)
    if found.seeds == 1:
        return text
    return f"{text} ({number(found.least, digits)}-{number(found.most, digits)})"


def number(value: float, digits: int = 4) -> str:
    """`digits` digits; `never` and `-` for what is infinite and what is no number."""
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "never"
    return f"{value:#.{digits}g}".rstrip(".")
