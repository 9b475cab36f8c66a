"""Gauss-sphere coverage: what do flat-sided objects tell, and does the solve know?

Varied     how many faces an object shows, from one to a sphere; sets of 3 × 3 (quick: 2 × 2) in which all objects have as many.
Measured   errors of materials and predictions, beside the standard errors that the solve states.  Predictions are of
           whole spheres, so what no face ever showed counts.
"""

from __future__ import annotations

from studies.study import Claim, Guess, Scale, Setting, Study, own

FACES = {"full": (1, 2, 3, 5, 9, 20, 60), "quick": (1, 9)}


def settings(scale: Scale) -> list[Setting]:
    """From one face to a sphere."""
    few = [scale.setting(f"faces-{k}", str(k), facets=k) for k in FACES[scale.name]]
    return [*few, scale.setting(scale.square, "sphere")]


def claims(scale: Scale) -> list[Claim]:
    """Few faces against a guess that knows mean colours, a sphere against few faces, in error and in what is stated of it."""
    sphere, nine, one = scale.square, "faces-9", "faces-1"
    guess, stated = (
        "better than by a guess of mean colours",
        "the solve states a smaller error of roughness for a sphere",
    )
    return [
        Claim("new_light", nine, Guess(nine), f"materials of nine faces are predicted in every light {guess}"),
        Claim("entries", nine, Guess(nine), f"all entries are predicted from nine faces {guess}"),
        Claim("new_light", nine, one, "nine faces tell more of materials than one"),
        own("new_light", sphere, nine, "a sphere tells more than nine faces"),
        own("roughness", sphere, one, "roughness is known better of a sphere than of one face"),
        own("stated_roughness", sphere, one, f"{stated} than for one face"),
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
