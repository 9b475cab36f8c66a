"""What participants answered, read and checked, and how often ours is preferred: by picture and over all, with standard errors.

By picture   share p of n participants, standard error √(p (1 − p) / n).
Over all     mean of the participants' own shares, standard error s / √n over participants: the answers of one person are no
             independent votes.  With one answer a participant this is the first formula but for n − 1 in place of n.
The paper    86.5 % ± 2.1, of 250 people, against SIRFS.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from factorlib.errors import InputError
from factorlib.reading import read_text
from studies.figures import Mark, drawn

FORMAT = 1
CURE = "give files as the page saved them (the button “Save answers (JSON)”), or leave this one out"
PAPER, PAPER_ERROR = 0.865, 0.021
HEAD = ("picture", "participants", "for_ours", "share", "standard_error", "simulated")
Side = Literal["left", "right"]
Digits = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{16}$")]


class Answer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A question: its picture, on which side ours was, which side was chosen, after how many milliseconds."""

    picture: Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
    ours: Side
    chosen: Side
    milliseconds: Annotated[float, msgspec.Meta(ge=0)]

    @property
    def for_ours(self) -> bool:
        """Whether ours was chosen."""
        return self.chosen == self.ours


class Answers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All of a participant's.

    page: digest of the questions;  seed: of order and sides;  simulated: empty for a person, else who answered;  asked: questions of the page
    """

    format: int
    page: Digits
    participant: Digits
    seed: Annotated[int, msgspec.Meta(ge=0, lt=2**32)]
    simulated: Annotated[str, msgspec.Meta(max_length=200)]
    asked: Annotated[int, msgspec.Meta(ge=1)]
    answers: list[Answer]


def read_answers(files: Sequence[Path]) -> list[Answers]:
    """One a participant.

    Raises InputError for one that is not the page's, one that is cut short or changed, the same participant twice, files of
    different pages, and simulated answers beside people's.
    """
    read: list[Answers] = []
    for file in files:
        try:
            one = msgspec.json.decode(read_text(file, "JSON"), type=Answers)
        except msgspec.DecodeError as error:  # also a ValidationError, which says the field
            raise InputError(f"not a file of answers: {error}", file=file, cure=CURE) from None
        names, first = [answer.picture for answer in one.answers], [*read, one][0]
        for key, wrong, words, cure in (
            ("format", one.format != FORMAT, f"format {one.format} is not known", f"this version reads format {FORMAT}"),
            ("answers", len(set(names)) != len(names), "two answers to one picture", CURE),
            ("answers", len(names) != one.asked, f"{len(names)} answers to {one.asked} questions", CURE),
            ("participant", one.participant in {of.participant for of in read}, "the same participant as before", "name each file once"),
            ("page", one.page != first.page, f"other pictures than in {files[0]}", "analyse the files of each page by themselves"),
            ("simulated", one.simulated != first.simulated, f"who answered differs from {files[0]}",
             "analyse people's answers, and those of each simulation, by themselves"),
        ):  # fmt: skip
            if wrong:
                raise InputError(words, file=file, key=key, cure=cure)
        read.append(one)
    return read


class Share(msgspec.Struct, frozen=True):
    """Of preference for ours.  for_ours: answers;  error: standard error, None where it takes more participants."""

    picture: str
    participants: int
    for_ours: int
    share: float
    error: float | None

    def __str__(self) -> str:
        """
        >>> str(Share("a", 250, 216, 0.865, 0.021))
        '86.5 % ± 2.1'
        """
        return f"{100 * self.share:.1f} %" + (f" ± {100 * self.error:.1f}" if self.error is not None else "")


class Analysis(msgspec.Struct, frozen=True):
    """Of one page's answers; simulated: who answered, empty for people, and what stands on all that is made of them."""

    overall: Share
    pictures: list[Share]
    simulated: str


def analysed(everyone: Sequence[Answers]) -> Analysis:
    """Of at least one participant."""
    votes: dict[str, list[bool]] = {}
    for a in (a for answers in everyone for a in answers.answers):
        votes.setdefault(a.picture, []).append(a.for_ours)
    pictures = []
    for name, of in sorted(votes.items()):
        n, share = len(of), float(np.mean(of))
        pictures.append(Share(name, n, sum(of), share, (share * (1 - share) / n) ** 0.5 if n > 1 else None))
    own = [float(np.mean([a.for_ours for a in answers.answers])) for answers in everyone]
    error = float(np.std(own, ddof=1) / len(own) ** 0.5) if len(own) > 1 else None
    overall = Share("all pictures", len(own), sum(s.for_ours for s in pictures), float(np.mean(own)), error)
    return Analysis(overall, pictures, everyone[0].simulated)


def csv_text(analysis: Analysis) -> str:
    """A line for each picture, the last one for all."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(HEAD)
    for s in (*analysis.pictures, analysis.overall):
        error = "" if s.error is None else f"{s.error:.4f}"
        writer.writerow([s.picture, s.participants, s.for_ours, f"{s.share:.4f}", error, analysis.simulated])
    return out.getvalue()


def paragraph(analysis: Analysis) -> str:
    """Markdown: the share, and the paper's beside it where people were asked."""
    s, pictures = analysis.overall, len(analysis.pictures)
    people = f"{s.participants} participant{'s' * (s.participants != 1)}, {pictures} pictures"
    share = f"Ours is preferred to the intrinsic decomposition in {s} of answers ({people})."
    if analysis.simulated:
        nobody = "No person was asked: nothing is to be set against the paper."
        return f"**simulated: {analysis.simulated}** {share} {nobody}\n"
    against = "One participant has no standard error: no conclusion."
    if s.error is not None:
        distance = (s.share - PAPER) / np.hypot(s.error, PAPER_ERROR)
        alike = "No difference is shown" if abs(distance) < 1.96 else "The two differ"
        against = f"{alike}: {distance:+.1f} standard errors of the difference."
    return f"{share} The paper: {100 * PAPER:.1f} % ± {100 * PAPER_ERROR:.1f} of 250 people, against SIRFS. {against}\n"


def figure(analysis: Analysis) -> str:
    """SVG that stands alone: a row for each picture, the last one for all; the dashed line at one half is chance."""
    rows, title = [*analysis.pictures, analysis.overall], f"Preference for ours: {analysis.overall}"
    ends = [(None, None) if s.error is None else (s.share - s.error, s.share + s.error) for s in rows]
    marks = {k: Mark(s.share, *ends[k], null=0.5) for k, s in enumerate(rows)}
    head = f"simulated: {analysis.simulated}" if analysis.simulated else f"{analysis.overall.participants} participants"
    return drawn(title, [s.picture for s in rows], {head: marks}, form="{:.0%}")
