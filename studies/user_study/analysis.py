"""How often ours is preferred: by picture and over all, with standard errors.

By picture   share p of n participants, standard error √(p (1 − p) / n).
Over all     mean of the participants' own shares, standard error s / √n over participants: the answers of one person are no
             independent votes.  With one answer a participant this is the first formula but for n − 1 in place of n.
The paper    86.5 % ± 2.1, of 250 people, against SIRFS.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from studies.svg import COLOURS, dot, line, page, text
from studies.user_study.answers import Answers

PAPER, PAPER_ERROR = 0.865, 0.021
LEFT, RIGHT, ROW, TOP, WIDTH = 330, 30, 20, 64, 800
HEAD = ("picture", "participants", "for_ours", "share", "standard_error", "simulated")
OVERALL = "all pictures"


class Share(msgspec.Struct, frozen=True):
    """Of preference for ours.  for_ours: answers;  error: standard error, None where it takes more participants."""

    picture: str
    participants: int
    for_ours: int
    share: float
    error: float | None


class Analysis(msgspec.Struct, frozen=True):
    """Of one page's answers; simulated: empty for people's."""

    overall: Share
    pictures: list[Share]
    simulated: str


def analysed(found: Sequence[Answers]) -> Analysis:
    """Of at least one participant."""
    names = sorted({a.picture for answers in found for a in answers.answers})
    pictures = [
        _of_picture(name, [a.for_ours for answers in found for a in answers.answers if a.picture == name])
        for name in names
    ]
    own = [float(np.mean([a.for_ours for a in answers.answers])) for answers in found]
    error = float(np.std(own, ddof=1) / len(own) ** 0.5) if len(own) > 1 else None
    overall = Share(OVERALL, len(found), sum(s.for_ours for s in pictures), float(np.mean(own)), error)
    return Analysis(overall, pictures, found[0].simulated)


def _of_picture(name: str, votes: Sequence[bool]) -> Share:
    n, share = len(votes), float(np.mean(votes))
    return Share(name, n, sum(votes), share, (share * (1 - share) / n) ** 0.5 if n > 1 else None)


def label(found: Analysis) -> str:
    """What stands on all that is made of simulated answers; empty of people's."""
    return f"simulated: {found.simulated}" if found.simulated else ""


def csv_text(found: Analysis) -> str:
    """A line for each picture, the last one for all."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(HEAD)
    for s in (*found.pictures, found.overall):
        writer.writerow(
            [
                s.picture,
                s.participants,
                s.for_ours,
                f"{s.share:.4f}",
                "" if s.error is None else f"{s.error:.4f}",
                found.simulated,
            ]
        )
    return out.getvalue()


def paragraph(found: Analysis) -> str:
    """Markdown: the share, and the paper's beside it where people were asked."""
    s = found.overall
    people = "participant" if s.participants == 1 else "participants"
    share = f"Ours is preferred to the intrinsic decomposition in {percent(s)} of answers ({s.participants} {people}, {len(found.pictures)} pictures)."
    if found.simulated:
        return f"**{label(found)}** {share} No person was asked: nothing is to be set against the paper.\n"
    return f"{share} The paper: {100 * PAPER:.1f} % ± {100 * PAPER_ERROR:.1f} of 250 people, against SIRFS. {_against_the_paper(s)}\n"


def _against_the_paper(s: Share) -> str:
    if s.error is None:
        return "One participant has no standard error: no conclusion."
    distance = (s.share - PAPER) / np.hypot(s.error, PAPER_ERROR)
    alike = "No difference is shown" if abs(distance) < 1.96 else "The two differ"
    return f"{alike}: {distance:+.1f} standard errors of the difference."


def percent(s: Share) -> str:
    """
    >>> percent(Share("a", 250, 216, 0.865, 0.021))
    '86.5 % ± 2.1'
    """
    return f"{100 * s.share:.1f} %" + (f" ± {100 * s.error:.1f}" if s.error is not None else "")


def figure(found: Analysis) -> str:
    """SVG that stands alone: a row for each picture, the last one for all; the line at one half is chance."""
    rows = [*found.pictures, found.overall]
    height = TOP + ROW * len(rows) + 40
    base = height - 34

    def across(share: float) -> float:
        """Of a share, pixels."""
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    title = f"Preference for ours over the intrinsic decomposition: {percent(found.overall)}"
    parts = [
        text(20, 22, title, css="title"),
        text(20, 42, label(found) or f"{found.overall.participants} participants", css="small soft"),
    ]
    for share in (0, 0.25, 0.5, 0.75, 1):
        css = "axis" if share == 0.5 else "grid"
        parts += [
            line(across(share), TOP - 8, across(share), base, css),
            text(across(share), base + 18, f"{100 * share:g} %", "middle", "small soft"),
        ]
    for k, s in enumerate(rows):
        parts += _row(s, TOP + ROW * k + ROW / 2, across, COLOURS[1 if s.picture == OVERALL else 0])
    return page(WIDTH, height, parts)


def _row(s: Share, y: float, across: Callable[[float], float], colour: str) -> list[str]:
    low, high = (min(1.0, max(0.0, s.share + side * (s.error or 0.0))) for side in (-1, 1))
    bar = line(across(low), y, across(high), y, style=f"stroke: {colour}; stroke-width: 1.8")
    return [
        text(LEFT - 12, y + 4, s.picture, "end", "small"),
        *([bar] if s.error else []),
        dot(across(s.share), y, colour, radius=3.6),
    ]
