"""From the scores of all cases to a table and its conclusions, which stand only where seeds leave no doubt.

Interval    mean ± t · s / √n, Student's t of n − 1 degrees of freedom, s the standard deviation over n seeds: 95 %.
Difference  of two settings, seed by seed, because a seed shows the same materials in the same lights in both.  It is called shown
            where the interval of the mean difference excludes 0 at 95 % for all comparisons of a study together (Bonferroni:
            each at 1 − .05 / comparisons), over at least `LEAST_SEEDS`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Literal

import msgspec
import numpy as np
from scipy.stats import t as student

from studies.measured.tools import exact
from studies.study import Claim, Guess, Rise, Scale, Score, Side, Study, case_name, settings_of

# ── measures ─────────────────────────────────────────────────────────────────────────────────────────────────────────


class Measure(msgspec.Struct, frozen=True):
    """A measure's name in tables and on axes, and its unit, 1 for a ratio.  Lower is better where the name does not say otherwise."""

    label: str
    unit: str = "1"

    @property
    def head(self) -> str:
        """The label, and the unit where there is one.

        >>> MEASURES["peak"].head, MEASURES["roughness"].head
        ('largest memory of the process (GB)', 'error of roughness')
        """
        return self.label if self.unit == "1" else f"{self.label} ({self.unit})"

    @property
    def words(self) -> str:
        """The label as the subject of a sentence.

        >>> MEASURES["entries"].words, MEASURES["roughness"].words
        ('DSSIM of all entries', 'the error of roughness')
        """
        return self.label.replace("DSSIM, ", "DSSIM of ") if self.label.startswith("DSSIM") else f"the {self.label}"


OF_TRUTH, OF_RMS = "relative to the truth", "RMSE over the truth's RMS"
IN_GAUGE = {"": "", "_scaled": ", all scaled by one number", "_balanced": ", each channel scaled"}
MEASURES = {
    "entries": Measure("DSSIM, all entries"),
    "observed": Measure("DSSIM, observed entries"),
    "unobserved": Measure("DSSIM, unobserved entries"),
    "new_light": Measure("DSSIM, recovered materials, in every light"),
    "new_material": Measure("DSSIM, every material, in recovered lights"),
    "first_material": Measure("DSSIM, material 0 in every light"),
    "first_light": Measure("DSSIM, every material in light 0"),
    "diffuse": Measure("error of k_d", OF_TRUTH),
    "specular": Measure("error of k_s", OF_TRUTH),
    "roughness": Measure("error of roughness"),
    "mirror": Measure("error of a mirror sphere", OF_RMS),
    "glossy": Measure("error of a glossy sphere", OF_RMS),
    "lambertian": Measure("error of a Lambertian sphere", OF_RMS),
    "chair": Measure("DSSIM of a chair"),
    "chair_scaled": Measure("DSSIM of a chair, a factor per channel taken out"),
    "normals": Measure("median error of the normals given", "degrees"),
    "seconds": Measure("processor time of a solve", "s"),
    "stated_roughness": Measure("stated standard error of roughness"),
    "stated_reflectance": Measure("stated standard error of k_d and k_s", "relative to k_d + k_s"),
    **{
        f"novel_{kind}{gauge}": Measure(f"DSSIM, new {kind}{words}")
        for kind in ("view", "light", "material")
        for gauge, words in IN_GAUGE.items()
    },
    "processor": Measure("time of the processor", "s"),
    "chromaticity": Measure("chromaticity of the lights", "deviation over mean"),
    "true_chromaticity": Measure("chromaticity of the true lights", "deviation over mean"),
    "colour": Measure("angle of a mirror sphere's colour", "degrees"),
    "tint": Measure("tint of all reflectances", "deviation of the log over channels"),
    "seconds_an_entry": Measure("processor time of the solve, an entry", "s"),
    "peak": Measure("largest memory of the process", "GB"),
    "grown": Measure("memory beyond that before the solve", "GB"),
    "error_median": Measure("error of a reflection, median"),
    "error_p95": Measure("error of a reflection, 95th percentile"),
    "error_worst": Measure("error of a reflection, worst"),
    "rendering": Measure("DSSIM, a rendered sphere"),
    "microseconds": Measure("processor time an evaluation", "µs"),
    "unseen": Measure("error of unseen cells", "RMSE over the peak"),
    "kept_parts": Measure("parts that the solve took, of two"),
    "of_bound": Measure("solve: largest error over its bound"),
    "hard_k": Measure("solve: error of reflectances", OF_TRUTH),
    "hard_roughness": Measure("solve: error of roughness"),
    "hard_radiance": Measure("solve: error of re-synthesis", "relative"),
    "value_error": Measure("operator: worst error of values"),
    "gradient_rounding": Measure("operator: worst rounding of derivatives"),
    "not_finite": Measure("operator: a value is not finite"),
    "wrong_poses": Measure("align: wrong poses", "share"),
    "normal_error": Measure("align: error of normals, median", "degrees"),
    "undoubted": Measure("align: wrong without a doubt", "share"),
    "materials.worst_roughness": Measure("roughness, worst material"),
    "materials.worst_diffuse": Measure("diffuse, worst", OF_TRUTH),
    "materials.worst_specular": Measure("specular, worst", OF_TRUTH),
    "resynthesis.worst_psnr_linear_db": Measure("re-synthesis, worst photo, linear (higher is better)", "dB"),
    "relighting.mean.scalar_per_set.in_true_light.psnr_tonemapped_db": Measure("relit balls (higher is better)", "dB"),
    "light.mean.channel_per_photo.glossy.estimate.rmse": Measure("glossy sphere", OF_RMS),
}

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


class Spread(msgspec.Struct, frozen=True):
    """A mean over `seeds` seeds, their standard deviation, and the ends of the mean's interval; None of one seed."""

    mean: float
    seeds: int
    deviation: float | None = None
    low: float | None = None
    high: float | None = None


class Difference(msgspec.Struct, frozen=True):
    """The first setting minus the second over the seeds that both have, and what it shows of the first."""

    spread: Spread
    verdict: Literal["lower", "higher", "not shown", "too few seeds"]


def spread(values: Sequence[float], doubt: float = DOUBT) -> Spread:
    """The mean and its interval of 1 − doubt.

    >>> s = spread([1.0, 2.0, 3.0])
    >>> s.mean, s.deviation, round(s.high - s.mean, 3)
    (2.0, 1.0, 2.484)
    """
    n, mean = len(values), float(np.mean(values))
    if n < 2:
        return Spread(mean, n)
    deviation = float(np.std(values, ddof=1))
    half = float(student.ppf(1 - doubt / 2, n - 1)) * deviation / n**0.5
    return Spread(mean, n, deviation, mean - half, mean + half)


def difference(first: Mapping[int, float], second: Mapping[int, float], comparisons: int = 1) -> Difference:
    """Compare a measure by seed in two settings; comparisons: how many the study makes.  Raises ValueError where no seed has both.

    >>> better = {seed: 0.1 + 0.001 * seed for seed in range(5)}
    >>> difference(better, {seed: 0.2 for seed in range(5)}).verdict
    'lower'
    """
    seeds = sorted(first.keys() & second.keys())
    if not seeds:
        raise ValueError("no seed has both")
    apart = spread([first[seed] - second[seed] for seed in seeds], DOUBT / comparisons)
    if apart.seeds < LEAST_SEEDS:
        return Difference(apart, "too few seeds")
    if apart.low <= 0 <= apart.high:
        return Difference(apart, "not shown")
    return Difference(apart, "lower" if apart.mean < 0 else "higher")


# ── a study's table ──────────────────────────────────────────────────────────────────────────────────────────────────


class Cell(msgspec.Struct, frozen=True):
    """A measure in a setting: its spread, each seed's value, and what a guess scores, where there is one."""

    spread: Spread
    values: dict[int, float]
    nulls: dict[int, float] = {}

    @property
    def null(self) -> float | None:
        """The mean over seeds of what a guess scores."""
        return sum(self.nulls.values()) / len(self.nulls) if self.nulls else None

    def __str__(self) -> str:
        """The mean and the half width of its interval.

        >>> str(Cell(spread([0.1, 0.12]), {})), str(Cell(spread([0.1]), {}))
        ('.11 ± .13', '.1')
        """
        mean, high = exact(self.spread.mean, 3), self.spread.high
        return mean if high is None else f"{mean} ± {exact(high - self.spread.mean)}"


class Row(msgspec.Struct, frozen=True):
    """A setting: its cells by measure; a measure that it does not have is left out."""

    name: str
    label: str
    cells: dict[str, Cell]


class Outcome(msgspec.Struct, frozen=True):
    """A claim, what the seeds say of it, and that as a sentence."""

    claim: Claim
    difference: Difference
    answer: str
    sentence: str


class Conclusion(msgspec.Struct, frozen=True):
    """All of a study's table.json.

    label:    what stands beside everything that is shown of a quick study; empty of a full one
    pictures: captions of the PNG files in the study's folder pictures/, by file
    over:     what intervals are over;  notes: sentences that are no claims;  own_answer: to the paper, where it is not that of the claims
    """

    study: str
    title: str
    question: str
    paper: str
    varied: str
    scale: str
    label: str
    seeds: tuple[int, ...]
    measures: tuple[str, ...]
    rows: list[Row]
    claims: list[Outcome]
    over: str = "seeds"
    pictures: dict[str, str] = {}
    notes: list[str] = []
    own_answer: str = ""

    @property
    def sentences(self) -> list[str]:
        """What the seeds say of each claim, then the notes."""
        return [tested.sentence for tested in self.claims] + self.notes

    @property
    def answer(self) -> str:
        """Agrees where all claims of the paper are shown, in part where some are, disagrees where the opposite of one is."""
        answers = [tested.answer for tested in self.claims if tested.claim.paper]
        if self.label:
            return f"not tested ({self.label})"
        if self.own_answer or not answers:
            return self.own_answer or "the paper claims nothing that is tested here"
        if "disagrees" in answers:
            return "disagrees"
        shown = answers.count("agrees")
        part = f"agrees in part: {shown} of {len(answers)} claims are shown"
        return part if 0 < shown < len(answers) else answers[0]


def concluded(study: Study, scale: Scale, scores: Mapping[str, Score]) -> Conclusion:
    """The table of a study and what its claims come to; scores: by the names of its cases."""
    seeds, claims = study.numbers(scale), study.claims(scale)
    rows = [
        Row(s.name, s.label, _cells({n: scores[case_name(s.name, n)] for n in seeds})) for s in study.settings(scale)
    ]
    by_name = {row.name: row for row in rows}
    tested = [_outcome(claim, by_name, len(claims), study.over) for claim in claims if _testable(claim, by_name)]
    table = Conclusion(
        study.name, study.title, study.question, study.paper, study.varied, scale.name, NO_CONCLUSION if scale.quick else "",
        seeds, study.measures, rows, tested, study.over,
    )  # fmt: skip
    return msgspec.structs.replace(table, notes=study.notes(table), own_answer=study.answer(table))


def _cells(scores: Mapping[int, Score]) -> dict[str, Cell]:
    cells = {}
    for m in MEASURES:
        values = {seed: score.values[m] for seed, score in scores.items() if m in score.values}
        nulls = {seed: score.nulls[m] for seed, score in scores.items() if m in score.nulls}
        cells |= {m: Cell(spread(list(values.values())), values, nulls)} if values else {}
    return cells


def _testable(claim: Claim, rows: Mapping[str, Row]) -> bool:
    """Whether all settings have the measure, and its null where that is compared: small sets lack some."""
    have_it = all(name in rows and claim.measure in rows[name].cells for name in claim.settings)
    sides = (claim.lower, claim.higher)
    return have_it and claim.lower != claim.higher and all(_by_seed(side, claim.measure, rows) for side in sides)


def _by_seed(side: Side, measure: str, rows: Mapping[str, Row]) -> dict[int, float]:
    cells = [rows[name].cells[measure] for name in settings_of(side)]
    if not isinstance(side, Rise):
        return cells[0].nulls if isinstance(side, Guess) else cells[0].values
    start, end = (cell.values for cell in cells)
    return {seed: (end[seed] - value) / side.per for seed, value in start.items() if seed in end}


def _outcome(claim: Claim, rows: Mapping[str, Row], comparisons: int, over: str) -> Outcome:
    """What the seeds say of a claim, as a sentence too."""
    sides = (claim.lower, claim.higher)
    result = difference(*(_by_seed(side, claim.measure, rows) for side in sides), comparisons)
    labels = [" to ".join(f"“{rows[name].label}”" for name in settings_of(side)) for side in sides]
    first, second = ("a guess" if isinstance(s, Guess) else label for s, label in zip(sides, labels, strict=True))
    s, rise = result.spread, "the rise of " if isinstance(claim.lower, Rise) else ""
    if result.verdict == "too few seeds":
        words = f"not tested: {s.seeds} of at least {LEAST_SEEDS} {over} were run"
    else:
        said = {"lower": "shown", "higher": "the opposite is shown", "not shown": "no difference is shown"}
        words = f"{said[result.verdict]} ({rise}{MEASURES[claim.measure].words} in {first} against {second}: "
        words += f"{s.mean:+.2g}, {s.low:+.2g} to {s.high:+.2g} over {s.seeds} {over})"
    return Outcome(claim, result, ANSWERS[result.verdict], f"{claim.words}: {words}.")


def best(table: Conclusion, measure: str) -> str:
    """A sentence: the setting of the least mean, and those from which no difference is shown, all of them compared with it.

    The best was picked from what it is compared with, so that the sentence is weaker than a claim.
    """
    rows = [row for row in table.rows if measure in row.cells]
    least = min(rows, key=lambda row: row.cells[measure].spread.mean)
    others = [row for row in rows if row is not least]
    verdicts = {
        row.label: difference(least.cells[measure].values, row.cells[measure].values, len(others)).verdict
        for row in others
    }
    start = f"Least mean of {MEASURES[measure].label}: “{least.label}”"
    if "too few seeds" in verdicts.values():
        return f"{start}; of too few seeds to say whether any other is worse."
    alike = ", ".join(f"“{label}”" for label, verdict in verdicts.items() if verdict == "not shown")
    return f"{start}; not shown to be worse: {alike}." if alike else f"{start}; all others are shown to be worse."


# ── as text ──────────────────────────────────────────────────────────────────────────────────────────────────────────

HEAD = ("study", "scale", "setting", "label", "measure", "unit", "seeds", "mean", "deviation", "low_95", "high_95", "null_mean")  # fmt: skip


def csv_text(table: Conclusion) -> str:
    """A line for each setting and measure."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(HEAD)
    for row in table.rows:
        for measure, cell in row.cells.items():
            s = cell.spread
            numbers = ("" if v is None else f"{v:.6g}" for v in (s.mean, s.deviation, s.low, s.high, cell.null))
            unit = MEASURES[measure].unit
            writer.writerow([table.study, table.scale, row.name, row.label, measure, unit, s.seeds, *numbers])
    return out.getvalue()


def paragraph(table: Conclusion) -> str:
    """Markdown: the question, what the paper says, and what the seeds say of each claim."""
    label = f" *{table.label}.*" if table.label else ""
    start = f"**{table.title}.** {table.question}{label} The paper: {table.paper}"
    return "\n".join([start, "", *(f"- {sentence}" for sentence in table.sentences)]) + "\n"
