"""Parts: what is each part of the model worth?

Varied     one part is switched off: shadows (and with them bounces, which need them), bounces of light, how sure normals are, the
           robust loss, and clipping (clipped values taken as they are, or their pixels left out).  Lights are few lobes.
           Sets of chairs as data/eames, smaller and of other seeds.
Measured   a tenth of the sphere's width of mirror cells that no solve has seen, the same whatever is off; materials and lights against
           the truth.
What cannot be switched off: the gauge.
"""

from __future__ import annotations

from typing import Any

from studies.study import Scale, Setting, Study, own

WITHOUT: dict[str, tuple[str, str, dict[str, Any]]] = {  # label, what is off, options of the solver of few lobes
    "as-it-is": ("as it is", "", {}),
    "shadows": ("no shadows", "shadows", {"shadows": False, "bounces": False}),
    "bounce": ("no bounce", "bounces", {"bounces": False}),
    "normals": ("all normals sure", "confidences of normals", {"seen": "sure"}),
    "robust": ("squares", "pseudo-Huber residuals", {"robust_scale": 1e6}),
    "clipped-as-data": ("clipped as data", "bounds for clipped values", {"seen": "unclipped"}),
    "clipped-left-out": ("clipped left out", "clipped pixels, as bounds,", {"seen": "dropped"}),
}
QUICK = ("as-it-is", "bounce", "robust")
DO = {"unseen": "explain unseen observations better", "diffuse": "make k_d truer", "glossy": "make lights truer"}


def settings(scale: Scale) -> list[Setting]:
    """As it is, then without each part."""
    names = QUICK if scale.quick else tuple(WITHOUT)
    hows = {name: {**scale.solve, **WITHOUT[name][2]} for name in names}
    return [Setting(n, WITHOUT[n][0], lambda seed, n=n: {"seed": seed, "solve": hows[n]}) for n in names]


def sets(scale: Scale) -> dict[str, Any]:
    """The rendered sets of chairs, one a seed: so many shots of so many pixels; small ones, since a study is of many solves."""
    size = (2, 120, 90, 16, 32) if scale.quick else (4, 240, 180, 64, 64)
    return {"seeds": scale.seeds, **dict(zip(("shots", "width", "height", "spp", "light_rows"), size, strict=True))}


STUDY = Study(
    name="parts",
    title="What each part is worth",
    question="What is each part of the model worth?",
    paper="Nothing: the paper's model has none of these parts.",
    varied="what is switched off",
    measures=("unseen", "diffuse", "specular", "glossy", "roughness", "mirror"),
    settings=settings,
    claims=tuple(
        own(m, "as-it-is", n, f"{WITHOUT[n][1]} {does}") for m, does in DO.items() for n in WITHOUT if n != "as-it-is"
    ),
    steps=("photos", "parts"),
    sets=sets,
)
