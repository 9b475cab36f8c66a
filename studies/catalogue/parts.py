"""Parts: what is each part of the model worth?

Varied     one part is switched off: shadows (and with them bounces, which need them), bounces of light, how sure normals are, the
           robust loss, and clipping (clipped values taken as they are, or their pixels left out).  Lights are few lobes.
           Sets of chairs as data/eames, smaller and of other seeds.
Measured   a tenth of the sphere's width of mirror cells that no solve has seen, the same whatever is off; materials and lights against
           the truth.
What cannot be switched off: the gauge.
"""

from __future__ import annotations

from studies.core.part import PARTS, Part
from studies.core.study import Claim, Scale, Setting, Study

QUICK = ("as-it-is", "bounce", "robust")
WORTH = {
    "shadows": "shadows",
    "bounce": "bounces",
    "normals": "confidences of normals",
    "robust": "pseudo-Huber residuals",
}
FURTHER = {"clipped-as-data": "bounds for clipped values", "clipped-left-out": "clipped pixels, as bounds,"}
DO = {
    "unseen": "explain unseen observations better",
    "diffuse": "make k_d truer",
    "glossy": "make lights truer",
}  # measure -> what parts may do


def settings(scale: Scale) -> list[Setting]:
    """As it is, then without each part."""
    names = QUICK if scale.name == "quick" else tuple(PARTS)
    return [
        Setting(name, PARTS[name][0], x, lambda seed, name=name: Part(seed, name, scale.solve))
        for x, name in enumerate(names)
    ]


def claims(scale: Scale) -> list[Claim]:
    """Unseen cells, materials and lights with each part against without it."""
    parts = {name: words for name, words in (WORTH | FURTHER).items() if scale.name == "full" or name in QUICK}
    return [
        Claim(measure, "as-it-is", name, f"{words} {does}", paper=False)
        for measure, does in DO.items()
        for name, words in parts.items()
    ]


STUDY = Study(
    name="parts",
    title="What each part is worth",
    question="What is each part of the model worth?",
    paper="Nothing: the paper's model has none of these parts.",
    varied="what is switched off",
    measures=("unseen", "diffuse", "specular", "glossy", "roughness", "mirror"),
    settings=settings,
    claims=claims,
    kind="parts",
)
