"""Prior: what is the weight of the paper's prior on lights worth, and is natural light's worth more?"""

from __future__ import annotations

from studies.study import Claim, Scale, Setting, Study, own

WEIGHTS = {"full": (0.0, 0.001, 0.01, 0.1, 1.0, 10.0), "quick": (0.0, 0.1, 10.0)}
OF_THE_PAPER = {"full": (0.0, 0.1, 1.0, 10.0), "quick": (0.1,)}


def _name(weight: float) -> str:
    return f"{weight:g}".replace(".", "p")


def settings(scale: Scale) -> list[Setting]:
    """Weights of the one solver, of the other, then natural light."""
    lobes, paper = WEIGHTS[scale.name], OF_THE_PAPER[scale.name]
    how = {"solver": "paper", "operator": "network"}
    return [
        *(scale.setting(f"lobes-{_name(w)}", f"{w:g}", solve={"prior": w, "solver": "few_lobes"}) for w in lobes),
        *(scale.setting(f"paper-{_name(w)}", f"paper {w:g}", solve=how | {"paper_prior": w}) for w in paper),
        scale.setting("natural", "natural", solve={"solver": "bundle"}),
    ]


STUDY = Study(
    name="prior",
    title="Prior on lights",
    question="What is the weight of the paper's prior on lights worth, and is natural light's worth more?",
    paper="As the weight grows from 0 to 10 the light's chromaticity falls; 0.1 is a good trade-off.",
    varied="weight of the tint prior; natural: natural light's",
    measures=("chromaticity", "true_chromaticity", "entries", "new_light", "colour", "diffuse", "specular", "roughness", "tint"),
    settings=settings,
    claims=(
        Claim("chromaticity", "lobes-0p1", "lobes-0", "lights are less coloured at .1 than at 0"),
        Claim("chromaticity", "lobes-10", "lobes-0", "lights are less coloured at 10 than at 0"),
        Claim("entries", "lobes-0p1", "lobes-0", ".1 predicts better than 0"),
        Claim("entries", "lobes-0p1", "lobes-10", ".1 predicts better than 10"),
        own("new_light", "lobes-0p1", "lobes-10", "materials are better at .1 than at 10"),
        own("entries", "natural", "lobes-0p1", "natural light's prior predicts better than .1"),
        own("colour", "natural", "lobes-0p1", "natural light's prior gives lights truer colours than .1"),
        Claim("chromaticity", "paper-10", "paper-0", "in the paper's solver lights are less coloured at 10 than at 0"),
        Claim("entries", "paper-0p1", "paper-10", "in the paper's solver .1 predicts better than 10"),
    ),
)  # fmt: skip
