"""Table of a study and its conclusions from the scores of all cases, drawn only where seeds leave no doubt.

Interval    mean ± t · s / √n, Student's t of n − 1 degrees of freedom, s the standard deviation over n seeds: 95 %.
Difference  of two settings, seed by seed, because a seed shows the same materials in the same lights in both.  It is
            called shown where the interval of the mean difference excludes 0 at 95 % for all comparisons of a study
            together (Bonferroni: each at 1 − .05 / comparisons), over at least `LEAST_SEEDS`.
"""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from scipy.stats import t as student

from studies.measured.tools import format_number, markdown_table
from studies.study import Claim, Scale, Score, Side, Study, case_name, settings_of

# ── measures ─────────────────────────────────────────────────────────────────────────────────────────────────────────

IN_GAUGE = {"": "", "_scaled": ", all scaled by one number", "_balanced": ", each channel scaled"}
MEASURES = {  # label, and the unit where there is one; lower is better where the label does not say otherwise
    "entries": "DSSIM, all entries",
    "observed": "DSSIM, observed entries",
    "unobserved": "DSSIM, unobserved entries",
    "new_light": "DSSIM, recovered materials, in every light",
    "first_material": "DSSIM, material 0 in every light",
    "first_light": "DSSIM, every material in light 0",
    "diffuse": "error of k_d|relative to the truth",
    "specular": "error of k_s|relative to the truth",
    "roughness": "error of roughness",
    "mirror": "error of a mirror sphere|RMSE over the truth's RMS",
    "glossy": "error of a glossy sphere|RMSE over the truth's RMS",
    "lambertian": "error of a Lambertian sphere|RMSE over the truth's RMS",
    "normals": "median error of the normals given|degrees",
    "seconds": "processor time of a solve|s",
    "stated_roughness": "stated standard error of roughness",
    "stated_reflectance": "stated standard error of k_d and k_s|relative to k_d + k_s",
    **{
        f"novel_{kind}{gauge}": f"DSSIM, new {kind}{words}"
        for kind in ("view", "light", "material")
        for gauge, words in IN_GAUGE.items()
    },
    "processor": "time of the processor|s",
    "chromaticity": "chromaticity of the lights|deviation over mean",
    "true_chromaticity": "chromaticity of the true lights|deviation over mean",
    "colour": "angle of a mirror sphere's colour|degrees",
    "tint": "tint of all reflectances|deviation of the log over channels",
}


def label(measure: str) -> str:
    """Return the name of a measure, without its unit."""
    return MEASURES[measure].partition("|")[0]


def head(measure: str) -> str:
    """Return the heading of a measure in tables and axes: its name and unit.

    >>> head("seconds"), head("roughness")
    ('processor time of a solve (s)', 'error of roughness')
    """
    words, _, unit = MEASURES[measure].partition("|")
    return f"{words} ({unit})" if unit else words


# ── numbers over seeds ───────────────────────────────────────────────────────────────────────────────────────────────

LEAST_SEEDS = 5
DOUBT = 0.05
NO_CONCLUSION = "quick: one seed, smallest sets: no conclusion"
ANSWERS = {
    "lower": "agrees",
    "higher": "disagrees",
    "not shown": "no difference is shown",
    "too few seeds": "not tested: too few seeds",
}
HEADS = {"agrees": "Shown", "disagrees": "The opposite is shown", "no difference is shown": "No difference is shown"}


class Spread(msgspec.Struct, frozen=True):
    """A mean over `seeds` seeds, their standard deviation, and the ends of the mean's interval; None of one seed."""

    mean: float
    seeds: int
    deviation: float | None = None
    low: float | None = None
    high: float | None = None


def spread(values: Sequence[float], doubt: float = DOUBT) -> Spread:
    """Return the mean and its interval of 1 − doubt.

    >>> s = spread([1.0, 2.0, 3.0])
    >>> s.mean, s.deviation, round(s.high - s.mean, 3)
    (2.0, 1.0, 2.484)
    """
    n = len(values)
    mean = float(np.mean(values))
    if n < 2:
        return Spread(mean, n)
    deviation = float(np.std(values, ddof=1))
    half = float(student.ppf(1 - doubt / 2, n - 1)) * deviation / n**0.5
    return Spread(mean, n, deviation, mean - half, mean + half)


def difference(first: Mapping[int, float], second: Mapping[int, float], comparisons: int = 1) -> tuple[Spread, str]:
    """Return the mean difference, first setting minus second, over their common seeds, and the verdict on it.

    The verdict on the first setting is `lower`, `higher`, `not shown` or `too few seeds`.
    comparisons: how many the study makes.  Raises ValueError if no seed has both.

    >>> better = {seed: 0.1 + 0.001 * seed for seed in range(5)}
    >>> difference(better, {seed: 0.2 for seed in range(5)})[1]
    'lower'
    """
    seeds = sorted(first.keys() & second.keys())
    if not seeds:
        raise ValueError("no seed has both")
    apart = spread([first[seed] - second[seed] for seed in seeds], DOUBT / comparisons)
    if apart.seeds < LEAST_SEEDS:
        return apart, "too few seeds"
    if apart.low <= 0 <= apart.high:
        return apart, "not shown"
    return apart, "lower" if apart.mean < 0 else "higher"


# ── a study's table ──────────────────────────────────────────────────────────────────────────────────────────────────


class Cell(msgspec.Struct, frozen=True):
    """A measure in a setting: its spread, each seed's value, and what a guess scores, where there is one."""

    spread: Spread
    values: dict[int, float]
    nulls: dict[int, float] = {}

    def __str__(self) -> str:
        """Return the mean and the half width of its interval.

        >>> str(Cell(spread([0.1, 0.12]), {})), str(Cell(spread([0.1]), {}))
        ('0.11 ± 0.13', '0.1')
        """
        mean = format_number(self.spread.mean, 3)
        high = self.spread.high
        return mean if high is None else f"{mean} ± {format_number(high - self.spread.mean)}"


class Row(msgspec.Struct, frozen=True):
    """A setting: its cells by measure; a measure that it does not have is left out."""

    name: str
    label: str
    cells: dict[str, Cell]


class ClaimOutcome(msgspec.Struct, frozen=True):
    """Verdict of the seeds on a claim, and its sentence.

    difference: between its two sides;  paper: True where the paper makes it
    """

    answer: str
    sentence: str
    difference: Spread
    paper: bool


class Conclusion(msgspec.Struct, frozen=True):
    """Content of a study's table.json.

    quick: caveat that stands beside everything of a quick study; empty for a full one
    """

    study: str
    title: str
    question: str
    paper: str
    varied: str
    quick: str
    seeds: tuple[int, ...]
    measures: tuple[str, ...]
    rows: list[Row]
    claims: list[ClaimOutcome] = []

    @property
    def answer(self) -> str:
        """Answer to the paper: agrees, agrees in part, or disagrees.

        It agrees where all claims of the paper are shown, and in part where some are.
        It disagrees where the opposite of one is shown.
        """
        answers = [outcome.answer for outcome in self.claims if outcome.paper]
        if self.quick:
            return f"not tested ({self.quick})"
        if not answers:
            return "the paper claims nothing that is tested here"
        agreeing = answers.count("agrees")
        if "disagrees" in answers or not 0 < agreeing < len(answers):
            return "disagrees" if "disagrees" in answers else answers[0]
        return f"agrees in part: {agreeing} of {len(answers)} claims {'is' if agreeing == 1 else 'are'} shown"


def conclude(study: Study, scale: Scale, scores: Mapping[str, Score]) -> Conclusion:
    """Return the table of a study and the outcomes of its claims; scores: by the names of its cases."""
    rows = {}
    for setting in study.settings(scale):
        by_seed = {seed: scores[case_name(setting.name, seed)] for seed in scale.seeds}
        cells = {}
        for m in MEASURES:
            values = {seed: score.values[m] for seed, score in by_seed.items() if m in score.values}
            nulls = {seed: score.nulls[m] for seed, score in by_seed.items() if m in score.nulls}
            cells |= {m: Cell(spread(list(values.values())), values, nulls)} if values else {}
        rows[setting.name] = Row(setting.name, setting.label, cells)
    outcomes = [] if scale.quick else [_outcome(claim, rows, len(study.claims)) for claim in study.claims]
    head = (study.name, study.title, study.question, study.paper, study.varied, NO_CONCLUSION if scale.quick else "")
    return Conclusion(*head, scale.seeds, study.measures, list(rows.values()), outcomes)


def _by_seed(side: Side, measure: str, rows: Mapping[str, Row]) -> dict[int, float]:
    first, *last = (rows[name].cells[measure] for name in settings_of(side))
    if isinstance(side, str) or side[0] == "guess":
        return first.values if isinstance(side, str) else first.nulls
    return {seed: (last[0].values[seed] - value) / side[3] for seed, value in first.values.items()}


def _outcome(claim: Claim, rows: Mapping[str, Row], comparisons: int) -> ClaimOutcome:
    """Judge a claim by the seeds, and put the outcome in a sentence."""
    sides = (claim.lower, claim.higher)
    s, verdict = difference(*(_by_seed(side, claim.measure, rows) for side in sides), comparisons)
    labels = [" to ".join(f"“{rows[name].label}”" for name in settings_of(side)) for side in sides]
    first, second = ("a guess" if side[0] == "guess" else words for side, words in zip(sides, labels, strict=True))
    if verdict == "too few seeds":
        words = f"not tested: {s.seeds} of at least {LEAST_SEEDS} seeds were run"
    else:
        name, rise = label(claim.measure), "the rise of " if claim.lower[0] == "rise" else ""
        subject = name.replace("DSSIM, ", "DSSIM of ") if name.startswith("DSSIM") else f"the {name}"
        words = f"{HEADS[ANSWERS[verdict]].lower()} ({rise}{subject} in {first} against {second}: "
        words += f"{s.mean:+.2g}, {s.low:+.2g} to {s.high:+.2g} over {s.seeds} seeds)"
    return ClaimOutcome(ANSWERS[verdict], f"{claim.words}: {words}.", s, claim.paper)


# ── as text ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def paragraph(table: Conclusion) -> str:
    """Write the question, the paper's answer, the outcome of each claim, and the table, as Markdown."""
    quick = f" *{table.quick}.*" if table.quick else ""
    start = f"**{table.title}.** {table.question}{quick} The paper: {table.paper}"
    lines = [start, "", *(f"- {outcome.sentence}" for outcome in table.claims), "", numbers(table, len(table.measures))]
    return "\n".join(lines) + "\n"


def numbers(table: Conclusion, most: int) -> str:
    """Return a Markdown table of the first `most` measures of a study."""
    measures = table.measures[:most]
    rows = [[row.label, *(str(row.cells.get(m, "–")) for m in measures)] for row in table.rows]
    return markdown_table([table.varied, *map(head, measures)], rows)


def claims(table: Conclusion) -> str:
    """Return a line for each answer that seeds give, with the claims that have it."""
    by_answer: dict[str, list[str]] = {}
    for claim in table.claims:
        by_answer.setdefault(HEADS.get(claim.answer, claim.answer), []).append(claim.sentence.partition(": ")[0])
    return "\n".join(f"- **{answer}**: {'; '.join(sentences)}." for answer, sentences in by_answer.items())
