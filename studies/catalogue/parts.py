"""Parts: what is each part of the model worth?

Clipping is taken away in two ways: values as they are, or their pixels left out.
"""

from __future__ import annotations

from typing import Any

from studies.study import Scale, Setting, Study, own

# label, what is off, of `CHANGES`, parameters of the stage
WITHOUT: dict[str, tuple[str, str, str, dict[str, Any]]] = {
    "as-it-is": ("as it is", "", "", {}),
    "shadows": ("no shadows", "shadows", "", {"self_shadowing": "off", "interreflection": "off"}),
    "bounce": ("no bounce", "bounces", "", {"interreflection": "off"}),
    "tone": ("no tone curve", "tone curves", "", {"tone": "off"}),
    "normals": ("all normals sure", "confidences of normals", "sure", {}),
    "clipped-as-data": ("clipped as data", "bounds for clipped values", "unclipped", {}),
    "clipped-left-out": ("clipped left out", "clipped pixels, as bounds,", "dropped", {}),
}
QUICK = ("as-it-is", "bounce", "clipped-left-out")


def settings(scale: Scale) -> list[Setting]:
    """Return the setting of the whole model, then one without each part."""
    cases = {
        n: {"change": WITHOUT[n][2], "solve": scale.solve | WITHOUT[n][3]} for n in (QUICK if scale.quick else WITHOUT)
    }
    return [Setting(n, WITHOUT[n][0], lambda seed, c=c: {"seed": seed, **c}) for n, c in cases.items()]


def sets(scale: Scale) -> dict[str, Any]:
    """Return the rendered sets of chairs, one a seed: so many shots of so many pixels.

    They are small, since a study is of many solves.
    """
    size = (2, 120, 90, 16, 32) if scale.quick else (4, 240, 180, 64, 64)
    return {"seeds": scale.seeds, **dict(zip(("shots", "width", "height", "spp", "light_rows"), size, strict=True))}


STUDY = Study(
    name="parts",
    title="What each part is worth",
    question="What is each part of the model worth?",
    paper="Nothing: the paper's model has none of these parts.",
    varied="what is switched off",
    measures=("diffuse", "specular", "glossy", "roughness", "mirror"),
    settings=settings,
    claims=tuple(
        own(m, "as-it-is", n, f"{WITHOUT[n][1]} {does}")
        for m, does in {"diffuse": "make k_d truer", "glossy": "make lights truer"}.items()
        for n in WITHOUT
        if n != "as-it-is"
    ),
    steps=("photos", "parts"),
    sets=sets,
)
