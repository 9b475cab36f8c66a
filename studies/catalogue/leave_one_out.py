"""Leave one out: can a chair be predicted in a photo from everything else?

Data       data/eames, six photos of chairs, rendered and made hard as photographs are: poses are searched, meshes are not exact
Left out   one entry of the matrix, as in the paper: the pixels of one chair's shell in one photo.  Its material is then known from
           the other photos alone, and the photo's light and exposure from what is left of the photo: the wooden legs, and the second
           chair where there is one.  A photo of which nothing is left would tell nothing of its light
Varied     left out; observed (the same pixels took part in the solve: what the model can fit at best); flat (no model of light: the
           shell's mean colour in the other photos, in the brightness and tint that the legs have here)
Spread     the six photos (of a photo with two chairs, the mean of both): one set, so nothing is said of other sets

(quick: photos kitchen and hall alone, few lobes.)
"""

from __future__ import annotations

from typing import Any

import msgspec

from studies.study import Claim, Scale, Setting, Study, own

FOLDER = "data/eames"
SHELLS = {  # of the chairs, by photo
    "terrace": ("red", "white"),
    "kitchen": ("yellow",),
    "hall": ("black", "yellow"),
    "garden": ("white",),
    "office": ("red",),
    "patio": ("black",),
}
PHOTOS = {"full": tuple(SHELLS), "quick": ("kitchen", "hall")}
PREDICTIONS = ("left out", "observed", "flat")


class LeftOut(msgspec.Struct, frozen=True):
    """The shells of a photo that are predicted one at a time, and from what."""

    photo: str
    shells: tuple[str, ...]
    prediction: str


def case(photos: tuple[str, ...], number: int, prediction: str) -> LeftOut:
    """Of a photo by its number; a shell that no other photo shows is not asked for."""
    others = {shell for k, photo in enumerate(photos) if k != number for shell in SHELLS[photo]}
    return LeftOut(photos[number], tuple(s for s in SHELLS[photos[number]] if s in others), prediction)


def settings(scale: Scale) -> list[Setting]:
    """Ways to predict; what stands in a seed's place is the number of a photo."""
    photos = PHOTOS[scale.name]
    return [Setting(f"chair-{p.replace(' ', '-')}", p, lambda k, p=p: case(photos, k, p)) for p in PREDICTIONS]


def numbers(scale: Scale) -> tuple[int, ...]:
    """The numbers of the photos whose chairs are predicted; of a quick study the first alone."""
    return (0,) if scale.quick else tuple(range(len(SHELLS)))


def claims(scale: Scale) -> list[Claim]:
    """Better than without light; worse than with the chair."""
    left_out, observed, flat = (setting.name for setting in settings(scale))
    return [
        Claim("chair", left_out, flat, "a chair that was left out is predicted better than by a flat colour"),
        own("chair_scaled", left_out, flat, "the same with brightness and tint given"),
        own("chair", observed, left_out, "a chair that was observed is shown better than one that was left out"),
    ]


def by_photo(table: Any) -> list[str]:
    """Each photo's values, as a sentence: six photos are few, and one that is unlike the others decides a mean."""
    values = {row.label: row.cells["chair"].values for row in table.rows}
    photos = dict(enumerate(PHOTOS[table.scale]))
    each = (f"{photos[k]} {', '.join(f'{of[k]:.2g}' for of in values.values())}" for k in table.seeds)
    return [f"DSSIM of a chair, photo by photo ({', '.join(values)}): {'; '.join(each)}."]


STUDY = Study(
    name="leave-one-out",
    title="Leave one out",
    question="Can a chair be predicted in a photo from everything else?",
    paper="A chair of the eames photos that took no part in the solve can be predicted. (Its photos and numbers cannot be had.)",
    varied="where the chair is predicted from",
    measures=("chair", "chair_scaled"),
    settings=settings,
    claims=claims,
    steps=("sets", "photos", "whole", "leave_out", "chairs"),
    sets=lambda scale: {"folder": FOLDER, "photos": PHOTOS[scale.name], "solve": scale.solve},
    numbers=numbers,
    over="photos",
    notes=by_photo,
    pictures="studies.steps.chairs.shells_of_photos",
)
