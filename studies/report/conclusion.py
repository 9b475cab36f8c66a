"""From the scores of all cases to a table and its conclusions; a conclusion stands only where seeds leave no doubt."""

from __future__ import annotations

from collections.abc import Mapping

from studies.core.case import Score
from studies.core.measures import MEASURES
from studies.core.statistics import LEAST_SEEDS, difference, spread
from studies.core.study import Claim, Scale, Setting, Study, case_name
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
    rows = [_row(setting, scale, scores) for setting in study.settings(scale)]
    claims = study.claims(scale)
    known = {row.name: row for row in rows}
    tested = [tested_claim(claim, known[claim.lower], known[claim.higher], len(claims)) for claim in claims if _both(claim, known)]
    label = NO_CONCLUSION if scale.name == "quick" else ""
    return Conclusion(
        study.name, study.title, study.question, study.paper, study.varied, scale.name, label, scale.seeds, study.measures, rows, tested
    )


def _row(setting: Setting, scale: Scale, scores: Mapping[str, Score]) -> Row:
    of = {seed: scores[case_name(setting.name, seed)] for seed in scale.seeds}
    return Row(setting.name, setting.label, setting.x, {m: _cell(m, of) for m in MEASURES if any(m in s.values for s in of.values())})


def _cell(measure: str, of: Mapping[int, Score]) -> Cell:
    values = {seed: score.values[measure] for seed, score in of.items() if measure in score.values}
    nulls = [score.nulls[measure] for score in of.values() if measure in score.nulls]
    return Cell(spread(list(values.values())), values, sum(nulls) / len(nulls) if nulls else None)


def _both(claim: Claim, rows: Mapping[str, Row]) -> bool:
    """Whether both settings have the measure: small sets lack some."""
    return all(name in rows and claim.measure in rows[name].cells for name in (claim.lower, claim.higher)) and claim.lower != claim.higher


def tested_claim(claim: Claim, lower: Row, higher: Row, comparisons: int) -> Tested:
    """What the seeds say of `claim`, one of so many of the study."""
    found = difference(lower.cells[claim.measure].values, higher.cells[claim.measure].values, comparisons)
    return Tested(claim, found, ANSWERS[found.verdict], _sentence(claim, lower, higher, found))


def _sentence(claim: Claim, lower: Row, higher: Row, found: Difference) -> str:
    subject, difference_ = MEASURES[claim.measure].words, found.spread
    between = f"{subject} in “{lower.label}” against “{higher.label}”"
    if found.verdict == "too few seeds":
        return f"{claim.words}: not tested: {difference_.seeds} of at least {LEAST_SEEDS} seeds were run."
    numbers = f"{between}: {difference_.mean:+.2g}, {difference_.low:+.2g} to {difference_.high:+.2g} over {difference_.seeds} seeds"
    if found.verdict == "not shown":
        return f"{claim.words}: no difference is shown ({numbers})."
    said = "shown" if found.verdict == "lower" else "the opposite is shown"
    return f"{claim.words}: {said} ({numbers})."
