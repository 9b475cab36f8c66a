"""A case whose entries are objects: made bodies, each turned at random, seen by a camera, and perhaps thought to be elsewhere.

Materials are seven, the first five about those of `studies.core.case.NAMES`; lights are those of the sphere's worlds, and one more.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import msgspec

from studies.core.case import NAMES
from studies.core.entries import Entries

SEVEN = (*NAMES, "tile", "bronze")


class Perturbation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What of an object is not as the solve is led to believe.

    turned_deg:  about a random axis through its middle
    shifted:     in a random direction of the image, as a share of the mesh's diameter
    larger:      the mesh, as a share of its size
    triangles:   of the mesh that stands for it; None: all some 20,000
    """

    turned_deg: float = 0.0
    shifted: float = 0.0
    larger: float = 0.0
    triangles: int | None = None


class ObjectsCase(Entries, frozen=True, forbid_unknown_fields=True):
    """What one solve sees: an object for each entry.

    pixels:        most observations of an entry
    perturbation:  of every object alike, toward random sides
    robust:        whether the solve has its robust loss
    confidence:    whether the solve gets the confidence of each normal, as the stage `align` writes it
    refined:       whether every pose is first fitted to the outline of its mask by `factorlib.align.refine`, from the perturbed one
    start:         nothing, or the solution of all photos but the last (the stage's parameter `start`)
    solve:         parameters of the stage `solve` that differ from their defaults
    """

    names: ClassVar[tuple[str, ...]] = SEVEN

    pixels: int
    perturbation: Perturbation = Perturbation()
    robust: bool = True
    confidence: bool = True
    refined: bool = False
    start: Literal["nothing", "earlier"] = "nothing"
    solve: dict[str, Any] = msgspec.field(default_factory=dict)
