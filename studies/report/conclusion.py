"""From the scores of all cases to a table and its conclusions; a conclusion stands only where seeds leave no doubt."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from studies.core.case import Score
from studies.core.measures import MEASURES
from studies.core.statistics import LEAST_SEEDS, difference, spread
from studies.core.study import Claim, Guess, Rise, Scale, Setting, Side, Study, case_name, settings_of
from studies.core.table import Cell, Conclusion, Difference, Row, Tested

NO_CONCLUSION = "quick: one seed, smallest sets: no conclusion"
ANSWERS = {
    "lower": "agrees",
    "higher": "disagrees",
    "not shown": "no difference is shown",
    "too few seeds": "not tested: too few seeds",
}


def concluded(study: Study, scale: Scale, scores: Mapping[str, Score]) -> Conclusion:
    """scores: by the cases' names."""
    seeds = study.seeds_of(scale)
    rows = [_row(setting, seeds, scores) for setting in study.settings(scale)]
    claims = study.claims(scale)
    known = {row.name: row for row in rows}
    tested = [tested_claim(claim, known, Testing(len(claims), study.over)) for claim in claims if _both(claim, known)]
    label = NO_CONCLUSION if scale.name == "quick" else ""
    return Conclusion(
        study.name, study.title, study.question, study.paper, study.varied, scale.name, label, seeds, study.measures, rows, tested,
        over=study.over,
    )  # fmt: skip


class Testing(NamedTuple):
    """How many comparisons the study makes, and what its intervals are over."""

    comparisons: int
    over: str = "seeds"


def _row(setting: Setting, seeds: tuple[int, ...], scores: Mapping[str, Score]) -> Row:
    of = {seed: scores[case_name(setting.name, seed)] for seed in seeds}
    return Row(
        setting.name,
        setting.label,
        setting.x,
        {m: _cell(m, of) for m in MEASURES if any(m in s.values for s in of.values())},
    )


def _cell(measure: str, of: Mapping[int, Score]) -> Cell:
    values = {seed: score.values[measure] for seed, score in of.items() if measure in score.values}
    nulls = {seed: score.nulls[measure] for seed, score in of.items() if measure in score.nulls}
    return Cell(spread(list(values.values())), values, nulls)


def _both(claim: Claim, rows: Mapping[str, Row]) -> bool:
    """Whether all settings have the measure, and its null where that is compared: small sets lack some."""
    there = (
        all(name in rows and claim.measure in rows[name].cells for name in claim.settings)
        and claim.lower != claim.higher
    )
    return there and all(_by_seed(side, claim.measure, rows) for side in (claim.lower, claim.higher))


def _by_seed(side: Side, measure: str, rows: Mapping[str, Row]) -> dict[int, float]:
    first, *last = (rows[name].cells[measure] for name in settings_of(side))
    if isinstance(side, Guess):
        return first.nulls
    return (
        {
            seed: (last[0].values[seed] - value) / side.per
            for seed, value in first.values.items()
            if seed in last[0].values
        }
        if last
        else first.values
    )


def _label(side: Side, rows: Mapping[str, Row]) -> str:
    return "a guess" if isinstance(side, Guess) else " to ".join(f"“{rows[name].label}”" for name in settings_of(side))


def tested_claim(claim: Claim, rows: Mapping[str, Row], testing: Testing) -> Tested:
    """What the seeds say of `claim`."""
    found = difference(
        *(_by_seed(side, claim.measure, rows) for side in (claim.lower, claim.higher)), testing.comparisons
    )
    return Tested(claim, found, ANSWERS[found.verdict], _sentence(claim, rows, found, testing.over))


def _sentence(claim: Claim, rows: Mapping[str, Row], found: Difference, over: str) -> str:
    rise = "the rise of " if isinstance(claim.lower, Rise) else ""
    subject, difference_ = rise + MEASURES[claim.measure].words, found.spread
    between = f"{subject} in {_label(claim.lower, rows)} against {_label(claim.higher, rows)}"
    if found.verdict == "too few seeds":
        return f"{claim.words}: not tested: {difference_.seeds} of at least {LEAST_SEEDS} {over} were run."
    numbers = f"{between}: {difference_.mean:+.2g}, {difference_.low:+.2g} to {difference_.high:+.2g} over {difference_.seeds} {over}"
    if found.verdict == "not shown":
        return f"{claim.words}: no difference is shown ({numbers})."
    said = "shown" if found.verdict == "lower" else "the opposite is shown"
    return f"{claim.words}: {said} ({numbers})."
