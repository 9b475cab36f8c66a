"""A study's table as CSV, and its conclusions as a paragraph."""

from __future__ import annotations

import csv
import io

from studies.core.measures import MEASURES
from studies.core.table import Conclusion

HEAD = (
    "study",
    "scale",
    "setting",
    "label",
    "measure",
    "unit",
    "seeds",
    "mean",
    "deviation",
    "low_95",
    "high_95",
    "null_mean",
)


def csv_text(found: Conclusion) -> str:
    """A line for each setting and measure."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(HEAD)
    for row in found.rows:
        for measure, cell in row.cells.items():
            s = cell.spread
            numbers = [
                s.seeds,
                *("" if v is None else f"{v:.6g}" for v in (s.mean, s.deviation, s.low, s.high, cell.null)),
            ]
            writer.writerow([found.study, found.scale, row.name, row.label, measure, MEASURES[measure].unit, *numbers])
    return out.getvalue()


def paragraph(found: Conclusion) -> str:
    """Markdown: the question, what the paper says, and what the seeds say of each claim."""
    start = f"**{found.title}.** {found.question}" + (f" *{found.label}.*" if found.label else "")
    first = f"{start} The paper: {found.paper}"
    return "\n".join([first, "", *(f"- {sentence}" for sentence in sentences(found))]) + "\n"


def sentences(found: Conclusion) -> list[str]:
    """What the seeds say of each claim, then the notes."""
    return [tested.sentence for tested in found.claims] + found.notes


def answer_to_the_paper(found: Conclusion) -> str:
    """Agrees where all claims that are the paper's are shown, in part where some are, disagrees where the opposite of one is.

    Where none is shown, it says why.

    Studies without a claim of the paper's are said to have none.
    """
    answers = [tested.answer for tested in found.claims if tested.claim.paper]
    if found.label:
        return f"not tested ({found.label})"
    if found.answer:
        return found.answer
    if not answers:
        return "the paper claims nothing that is tested here"
    if "disagrees" in answers:
        return "disagrees"
    shown = answers.count("agrees")
    if 0 < shown < len(answers):
        return f"agrees in part: {shown} of {len(answers)} claims are shown"
    return answers[0]
