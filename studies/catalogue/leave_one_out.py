"""Leave one out: can a chair be predicted in a photo from everything else?"""

from __future__ import annotations

from typing import Any

import msgspec

from studies.study import Claim, Scale, Setting, Study, own

SHELLS = {  # of the chairs, by photo
    "terrace": ("red", "white"),
    "kitchen": ("yellow",),
    "hall": ("black", "yellow"),
    "garden": ("white",),
    "office": ("red",),
    "patio": ("black",),
}
PHOTOS = {"full": tuple(SHELLS), "quick": ("kitchen", "hall")}


class LeftOut(msgspec.Struct, frozen=True):
    """The shells of a photo that are predicted one at a time, and from what; solve: parameters of the stage."""

    photo: str
    shells: tuple[str, ...]
    prediction: str
    solve: dict[str, Any] = {}


def case(scale: Scale, number: int, prediction: str) -> LeftOut:
    """Return the case of a photo by its number; a shell that no other photo shows is not asked for."""
    photos = PHOTOS[scale.name]
    others = {shell for k, photo in enumerate(photos) if k != number for shell in SHELLS[photo]}
    return LeftOut(photos[number], tuple(s for s in SHELLS[photos[number]] if s in others), prediction, scale.solve)


def by_photo(table: Any) -> list[str]:
    """State each photo's values in a sentence: six photos are few, and one that is unlike the others decides a mean."""
    values = {row.label: row.cells["chair"].values for row in table.rows}
    photos = PHOTOS["quick" if table.quick else "full"]
    each = (f"{photos[k]} {', '.join(f'{of[k]:.2g}' for of in values.values())}" for k in table.seeds)
    return [f"DSSIM of a chair, photo by photo ({', '.join(values)}): {'; '.join(each)}."]


STUDY = Study(
    name="leave-one-out",
    title="Leave one out",
    question="Can a chair be predicted in a photo from everything else?",
    paper="A chair of the eames photos that took no part in the solve can be predicted. "
    "(Its photos and numbers cannot be had.)",
    varied="where the chair is predicted from",
    measures=("chair", "chair_scaled"),
    settings=lambda scale: [
        Setting(f"chair-{p.replace(' ', '-')}", p, lambda k, p=p: case(scale, k, p))
        for p in ("left out", "observed", "flat")
    ],
    claims=(
        Claim(
            "chair",
            "chair-left-out",
            "chair-flat",
            "a chair that was left out is predicted better than by a flat colour",
        ),
        own("chair_scaled", "chair-left-out", "chair-flat", "the same with brightness and tint given"),
        own(
            "chair",
            "chair-observed",
            "chair-left-out",
            "a chair that was observed is shown better than one that was left out",
        ),
    ),
    steps=("photos", "chairs"),
    sets=lambda scale: {"folder": "data/eames", "photos": PHOTOS[scale.name]},
    numbers=lambda scale: (0,) if scale.quick else tuple(range(len(SHELLS))),
    over="photos",
    notes=by_photo,
)
