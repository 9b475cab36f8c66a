"""Prior: what is the weight of the paper's prior on lights worth, and is natural light's worth more?

Varied     the weight π of the paper's prior, the variance over channels of the light's summed lobes, 0 … 10: in this project's solver
           with lights of a few lobes (`prior`), and in the paper's (`paper_prior`); and the prior of natural light, which the default
           solver has.  The paper's solver has this project's operator, which is as exact as the paper's network and faster, so
           that solvers are compared and not operators.  Sets of 3 × 3 (quick: 2 × 2).
Measured   how coloured the lights are beside the true ones, what they and the materials predict, and their errors.
"""

from __future__ import annotations

from studies.core.study import Claim, Scale, Setting, Study

WEIGHTS = {"full": (0.0, 0.001, 0.01, 0.1, 1.0, 10.0), "quick": (0.0, 0.1, 10.0)}
OF_THE_PAPER = {"full": (0.0, 0.1, 1.0, 10.0), "quick": (0.1,)}


def settings(scale: Scale) -> list[Setting]:
    """Weights of the one solver, of the other, then natural light."""
    found = [(f"lobes-{i}", f"{w:g}", {"prior": w, "solver": "few_lobes"}) for i, w in enumerate(WEIGHTS[scale.name])]
    found += [
        (f"paper-{i}", f"paper {w:g}", {"solver": "paper", "operator": "network", "paper_prior": w})
        for i, w in enumerate(OF_THE_PAPER[scale.name])
    ]
    found += [("natural", "natural", {"solver": "bundle"})]
    return [scale.setting(name, label, x, solve=solve) for x, (name, label, solve) in enumerate(found)]


def claims(scale: Scale) -> list[Claim]:
    """What the weight does to colour and to error, then natural light against the paper's weight of .1."""
    names = {
        kind: {w: f"{kind}-{i}" for i, w in enumerate(of[scale.name])}
        for kind, of in (("lobes", WEIGHTS), ("paper", OF_THE_PAPER))
    }
    lobes, paper = names["lobes"], names["paper"]
    own = [
        Claim("chromaticity", lobes[0.1], lobes[0.0], "lights are less coloured at .1 than at 0"),
        Claim("chromaticity", lobes[10.0], lobes[0.0], "lights are less coloured at 10 than at 0"),
        Claim("entries", lobes[0.1], lobes[0.0], ".1 predicts better than 0"),
        Claim("entries", lobes[0.1], lobes[10.0], ".1 predicts better than 10"),
        Claim("new_light", lobes[0.1], lobes[10.0], "materials are better at .1 than at 10", paper=False),
        Claim("entries", "natural", lobes[0.1], "natural light's prior predicts better than .1", paper=False),
        Claim("colour", "natural", lobes[0.1], "natural light's prior gives lights truer colours than .1", paper=False),
    ]
    if 10.0 not in paper:
        return own
    return [
        *own,
        Claim(
            "chromaticity", paper[10.0], paper[0.0], "in the paper's solver lights are less coloured at 10 than at 0"
        ),
        Claim("entries", paper[0.1], paper[10.0], "in the paper's solver .1 predicts better than 10"),
    ]


STUDY = Study(
    name="prior",
    title="Prior on lights",
    question="What is the weight of the paper's prior on lights worth, and is natural light's worth more?",
    paper="As the weight grows from 0 to 10 the light's chromaticity falls; 0.1 is a good trade-off.",
    varied="weight of the tint prior; natural: natural light's",
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
    claims=claims,
    kind="prior",
)
