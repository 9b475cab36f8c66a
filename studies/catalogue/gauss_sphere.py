"""Gauss-sphere coverage: what do flat-sided objects tell, and does the solve know?

Varied     how many faces an object shows, from one to a sphere; sets of 3 × 3 (quick: 2 × 2) in which all objects have as many.
Measured   errors of materials and predictions, beside the standard errors that the solve states.  Predictions are of
           whole spheres, so what no face ever showed counts.
"""

from __future__ import annotations

from studies.core.study import Claim, Guess, Scale, Setting, Study

FACES = {"full": (1, 2, 3, 5, 9, 20, 60), "quick": (1, 9)}


def settings(scale: Scale) -> list[Setting]:
    """From one face to a sphere."""
    faces = FACES[scale.name]
    few = [scale.setting(f"faces-{k}", str(k), x, facets=k) for x, k in enumerate(faces)]
    return [*few, scale.setting(scale.square, "sphere", len(faces))]


def claims(scale: Scale) -> list[Claim]:
    """Few faces against a guess that knows mean colours, a sphere against few faces, in error and in what is stated of it."""
    sphere = scale.square
    nine = "faces-9"
    return [
        Claim(
            "new_light",
            nine,
            Guess(nine),
            "materials of nine faces are predicted in every light better than by a guess of mean colours",
        ),
        Claim(
            "entries",
            nine,
            Guess(nine),
            "all entries are predicted from nine faces better than by a guess of mean colours",
        ),
        Claim("new_light", nine, "faces-1", "nine faces tell more of materials than one"),
        Claim("new_light", sphere, nine, "a sphere tells more than nine faces", paper=False),
        Claim("roughness", sphere, "faces-1", "roughness is known better of a sphere than of one face", paper=False),
        Claim(
            "stated_roughness",
            sphere,
            "faces-1",
            "the solve states a smaller error of roughness for a sphere than for one face",
            paper=False,
        ),
    ]


STUDY = Study(
    name="gauss-sphere",
    title="Gauss-sphere coverage",
    question="What do flat-sided objects tell, and does the solve know?",
    paper="Objects with flat sides, which cover little of the Gauss sphere, can still be reconstructed.",
    varied="faces that an object shows",
    measures=("new_light", "entries", "roughness", "stated_roughness", "diffuse", "specular", "stated_reflectance"),
    settings=settings,
    claims=claims,
)
