"""The unit of work of the comparison: a method, and the photos that it sees.  Cases of equal seeds see equal photos."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import msgspec

from studies.core.case import NAMES
from studies.core.entries import Entries

Method = Literal["projective", "intrinsic", "grey", "mitsuba", "ours"]


class Joint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How large Mitsuba's optimisation is.

    pixels: across its pictures;  steps: at most, where it is not flat before
    """

    pixels: int
    steps: int


class Comparison(Entries, frozen=True, forbid_unknown_fields=True):
    """What a method sees, and which method.

    size:   pixels across a photo of one object, as its camera sees it and as it is predicted
    solve:  parameters of the stage `solve` that differ from their defaults
    """

    names: ClassVar[tuple[str, ...]] = NAMES

    method: Method
    size: int
    joint: Joint
    solve: dict[str, Any] = msgspec.field(default_factory=dict)


class Asked(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A photo that was not taken: what kind of prediction it asks for, of which material in which light, from where.

    photo: the light of the photo that shows the material, or None where no photo does
    """

    kind: str
    material: str
    light: int
    view: str
    photo: int | None

    @property
    def name(self) -> str:
        """Of its picture's file."""
        return f"{self.kind}-{self.material}-light{self.light}-{self.view}"


class ShownShot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a method's picture of it scores; dssim: nothing scaled."""

    asked: Asked
    dssim: float


def photo_name(material: str, light: int) -> str:
    """Of a photo's file."""
    return f"photo-{material}-light{light}"
