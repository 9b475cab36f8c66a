"""Gauss-sphere coverage: what do flat-sided objects tell, and does the solve know?"""

from __future__ import annotations

from studies.study import Claim, Scale, Setting, Study, own

FACES = {"full": (1, 2, 3, 5, 9, 20, 60), "quick": (1, 9)}
GUESS = ("guess", "faces-9")


def settings(scale: Scale) -> list[Setting]:
    """Return settings from one face to a sphere."""
    few = [scale.setting(f"faces-{k}", str(k), facets=k) for k in FACES[scale.name]]
    return [*few, scale.setting(f"{scale.side}x{scale.side}", "sphere")]


STUDY = Study(
    name="gauss-sphere",
    title="Gauss-sphere coverage",
    question="What do flat-sided objects tell, and does the solve know?",
    paper="Objects with flat sides, which cover little of the Gauss sphere, can still be reconstructed.",
    varied="faces that an object shows",
    measures=("new_light", "entries", "roughness", "stated_roughness", "diffuse", "specular", "stated_reflectance"),
    settings=settings,
    claims=(
        Claim(
            "new_light",
            "faces-9",
            GUESS,
            "materials of nine faces are predicted in every light better than by a guess of mean colours",
        ),
        Claim(
            "entries",
            "faces-9",
            GUESS,
            "all entries are predicted from nine faces better than by a guess of mean colours",
        ),
        Claim("new_light", "faces-9", "faces-1", "nine faces tell more of materials than one"),
        own("new_light", "3x3", "faces-9", "a sphere tells more than nine faces"),
        own("roughness", "3x3", "faces-1", "roughness is known better of a sphere than of one face"),
        own(
            "stated_roughness",
            "3x3",
            "faces-1",
            "the solve states a smaller error of roughness for a sphere than for one face",
        ),
    ),
)
