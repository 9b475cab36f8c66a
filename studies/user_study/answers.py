"""What the page hands over, a file a participant, read and checked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from factorlib.errors import InputError
from factorlib.reading import read_text

FORMAT = 1
CURE = "give files as the page saved them (the button “Save answers (JSON)”), or leave this one out"
Side = Literal["left", "right"]


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
    page: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{16}$")]
    participant: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{16}$")]
    seed: Annotated[int, msgspec.Meta(ge=0, lt=2**32)]
    simulated: Annotated[str, msgspec.Meta(max_length=200)]
    asked: Annotated[int, msgspec.Meta(ge=1)]
    answers: list[Answer]


def read_answers(files: Sequence[Path]) -> list[Answers]:
    """One a participant.

    Raises InputError for no file, one that is not the page's, one that is cut short or changed, the same participant twice, files of
    different pages, and simulated answers beside people's.
    """
    if not files:
        raise InputError(
            "no file of answers is named", key="FILE", cure="name the files that participants saved: answers-*.json"
        )
    found = [(file, _read(file)) for file in files]
    known: dict[str, Path] = {}
    for file, answers in found:
        if answers.participant in known:
            raise InputError(
                f"the same participant as in {known[answers.participant]}",
                file=file,
                key="participant",
                cure="name each file once",
            )
        known[answers.participant] = file
    _all_alike(found, "page", "other pictures than in {}", "analyse the files of each page by themselves")
    _all_alike(
        found,
        "simulated",
        "who answered differs from {}",
        "analyse people's answers, and those of each simulation, by themselves",
    )
    return [answers for _, answers in found]


def _read(file: Path) -> Answers:
    try:
        found = msgspec.json.decode(read_text(file, "JSON"), type=Answers)
    except msgspec.DecodeError as error:  # also a ValidationError, which says the field
        raise InputError(f"not a file of answers: {error}", file=file, cure=CURE) from None
    if found.format != FORMAT:
        raise InputError(
            f"format {found.format} is not known", file=file, key="format", cure=f"this version reads format {FORMAT}"
        )
    if twice := _twice(answer.picture for answer in found.answers):
        raise InputError(f"two answers to '{twice}'", file=file, key="answers", cure=CURE)
    if len(found.answers) != found.asked:
        raise InputError(
            f"{len(found.answers)} answers to {found.asked} questions", file=file, key="answers", cure=CURE
        )
    return found


def _twice(names: Iterable[str]) -> str | None:
    known: set[str] = set()
    return next((name for name in names if name in known or known.add(name)), None)


def _all_alike(found: Sequence[tuple[Path, Answers]], field: str, what: str, cure: str) -> None:
    (first, kept), *others = found
    for file, answers in others:
        if getattr(answers, field) != getattr(kept, field):
            raise InputError(what.format(first), file=file, key=field, cure=cure)
