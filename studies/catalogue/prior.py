"""Prior: what is the weight of the paper's prior on lights worth, and is natural light's worth more?"""

from __future__ import annotations

from studies.study import Claim, Scale, Setting, Study, own

WEIGHTS = {"full": (0.0, 0.1, 1.0, 10.0), "quick": (0.1,)}


def settings(scale: Scale) -> list[Setting]:
    """Return settings: weights of the paper's prior in its solver, then natural light's prior in the joint solver."""
    how = {"solver": "paper", "operator": "network"}
    return [
        *(
            scale.setting(f"paper-{w:g}".replace(".", "p"), f"paper {w:g}", solve=how | {"paper_prior": w})
            for w in WEIGHTS[scale.name]
        ),
        scale.setting("natural", "natural"),
    ]


STUDY = Study(
    name="prior",
    title="Prior on lights",
    question="What is the weight of the paper's prior on lights worth, and is natural light's worth more?",
    paper="As the weight grows from 0 to 10 the light's chromaticity falls; 0.1 is a good trade-off.",
    varied="weight of the paper's prior on tint, in its own solver; natural: natural light's",
    measures=(
        "chromaticity",
        "true_chromaticity",
        "entries",
        "new_light",
        "colour",
        "diffuse",
        "specular",
        "roughness",
        "tint",
    ),
    settings=settings,
    claims=(
        Claim("chromaticity", "paper-0p1", "paper-0", "lights are less coloured at 0.1 than at 0"),
        Claim("chromaticity", "paper-10", "paper-0", "lights are less coloured at 10 than at 0"),
        Claim("entries", "paper-0p1", "paper-0", "0.1 predicts better than 0"),
        Claim("entries", "paper-0p1", "paper-10", "0.1 predicts better than 10"),
        own("new_light", "paper-0p1", "paper-10", "materials are better at 0.1 than at 10"),
        own("entries", "natural", "paper-0p1", "natural light's prior predicts better than 0.1"),
        own("colour", "natural", "paper-0p1", "natural light's prior gives lights truer colours than 0.1"),
    ),
)
