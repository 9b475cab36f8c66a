"""The error that a user can fix.

Anything wrong with a user's files or words is an `InputError`.  It states the fault, its place, and the cure.  Every
other exception is a defect of this project.
"""

import re
import unicodedata
from collections.abc import Iterable
from difflib import get_close_matches
from functools import partial
from os import PathLike
from pathlib import PurePath
from textwrap import shorten

MOST_LISTED = 30
MOST_ALIKE = 3  # files whose faults of one kind are listed one by one
MOST_COMPARED = 3000
NEAR = 0.8  # `difflib` ratio from which a word with another first letter is a suggestion


class InputError(ValueError):
    """A fault in a user's input that the user can fix.

    >>> print(InputError("unknown material 'rde'", file="dataset.yaml", key="photos[0]", cure="did you mean 'red'?"))
    dataset.yaml: photos[0]: unknown material 'rde'
      did you mean 'red'?
    """

    def __init__(
        self, fault: str, *, file: str | PathLike | None = None, key: str | None = None, cure: str | None = None
    ):
        self.fault = fault
        self.file = file
        self.key = key
        self.cure = cure
        super().__init__(fault)

    def __str__(self) -> str:
        location = "".join(f"{part}: " for part in (self.file, self.key) if part is not None)
        return f"{location}{self.fault}" + (f"\n  {self.cure}" if self.cure else "")

    def __reduce__(self) -> tuple:  # for pickling in a worker process
        return partial(InputError, self.fault, file=self.file, key=self.key, cure=self.cure), ()


class InputErrors(InputError):
    """Several faults of one input; file, key and cure are those of the first.

    A fault that many files have is stated once.
    """

    def __init__(self, faults: list[InputError]):
        self.faults = faults
        first = faults[0]
        super().__init__(first.fault, file=first.file, key=first.key, cure=first.cure)

    def __str__(self) -> str:
        lines = fault_lines(self.faults)
        more = len(lines) - MOST_LISTED
        texts = lines[:MOST_LISTED]
        return "\nerror: ".join([*texts, f"{more} more"] if more > 0 else texts)

    def __reduce__(self) -> tuple:
        return InputErrors, (self.faults,)


def fault_lines(faults: Iterable[InputError]) -> list[str]:
    """Format faults, each once; one that more than MOST_ALIKE files have but for numbers once for all of them.

    >>> print(*fault_lines(InputError(f"is of {n} bits", file=f"m/{n}.jpg", cure="save it again") for n in range(4)))
    m/0.jpg: is of 0 bits (and 3 more: 1.jpg, 2.jpg, 3.jpg)
      save it again
    """
    kinds: dict[tuple, dict[str, InputError]] = {}
    for fault in faults:
        kinds.setdefault((re.sub(r"\d+", "", fault.fault), fault.cure), {}).setdefault(str(fault), fault)
    lines = []
    for texts in kinds.values():
        first, *others = texts.values()
        files = {str(fault.file) for fault in texts.values()}
        if len(others) >= MOST_ALIKE and len(files) == len(texts):
            listed = shorten(", ".join(PurePath(str(fault.file)).name for fault in others), 80, placeholder=" …")
            words = f"{first.fault} (and {len(others)} more: {listed})"
            lines.append(str(InputError(words, file=first.file, key=first.key, cure=first.cure)))
        else:
            lines += texts
    return lines


def raise_all(faults: list[InputError]) -> None:
    """Raise the faults, if any, as one InputError."""
    if faults:
        raise faults[0] if len(faults) == 1 else InputErrors(faults)


def did_you_mean(word: str, known: Iterable[object]) -> str:
    """Return a cure that names the nearest of the `known` words, or all of them.

    The word itself is no suggestion, in any Unicode form. The same word in other case is the first one.

    >>> did_you_mean("soruce", ["source", "target"])
    "did you mean 'source'?"
    >>> did_you_mean("x", ["source", "target"])
    "known are: 'source', 'target'"
    >>> did_you_mean("Photo.JPG", ["Photo.png", "photo.jpg", "Photo.JPG"])
    "did you mean 'photo.jpg'?"
    """
    known = sorted(str(k) for k in known)
    given = unicodedata.normalize("NFC", word)
    word = word.strip("[]'\"")
    composed = unicodedata.normalize("NFC", word)
    compared = [k for k in known[:MOST_COMPARED] if unicodedata.normalize("NFC", k) != given]
    near = [k for k in compared if unicodedata.normalize("NFC", k).casefold() == composed.casefold()]
    near = near or get_close_matches(word, compared, 1, NEAR)
    near = near or get_close_matches(word, [k for k in compared if k[:1] == word[:1]], 1)
    more = f", … ({len(known)} in all)" if len(known) > MOST_LISTED else ""
    return f"did you mean {near[0]!r}?" if near else "known are: " + ", ".join(map(repr, known[:MOST_LISTED])) + more
