"""Methods compared: other methods, weights of the prior, solvers, and parts of the model."""

from typing import Any

from studies.study import Claim, Comparison, Scale, Setting, Study, full_matrix, project_claim

# ── comparison ────────────────────────────────────────────────────────────────────────────────────────────────────────

METHODS = {  # label; in sentences
    "ours": ("ours", ""),
    "projective": ("projective", "projective texturing"),
    "grey": ("grey ball", "a grey ball"),
}
SIZES = {"full": 96, "quick": 32}  # pixels of photos
PREDICTIONS = {"view": "new views", "light": "pictures in new light", "material": "pictures of new materials"}


WHOLE = {"splittings": 3}  # the solve as it is by default, where studies leave out its splittings


def comparison_case(scale: Scale, seed: int, method: str) -> Comparison:
    """Return the case of `side` materials in as many lights, by a method."""
    entries = tuple(full_matrix(scale.side, scale.side))
    return Comparison(seed, entries, SIZES[scale.name], scale.solve if scale.quick else WHOLE, method=method)


COMPARISON = Study(
    name="comparison",
    title="Comparison",
    question="Does a joint solve predict photos that were not taken better than other methods?",
    paper="The joint solve is nearer to the truth than projective texturing, averaged over photos. "
    "(The paper's intrinsic decomposition, SIRFS, is not compared.)",
    varied="method",
    measures=(
        "novel_view",
        "novel_light",
        "novel_material",
        "processor",
        "novel_view_balanced",
        "novel_light_balanced",
        "novel_material_balanced",
        "diffuse",
        "specular",
        "roughness",
        "mirror",
        "glossy",
        "lambertian",
    ),
    settings=lambda scale: [
        Setting(m, label, lambda seed, m=m: comparison_case(scale, seed, m)) for m, (label, _) in METHODS.items()
    ],
    claims=tuple(
        Claim(
            f"novel_{kind}",
            "ours",
            m,
            f"{pictures} are predicted better than by {words}",
            m == "projective",
        )
        for kind, pictures in PREDICTIONS.items()
        for m, (_, words) in METHODS.items()
        if m != "ours" and (kind, m) != ("material", "projective")
    ),
    steps=("worlds", "solve", "compare"),
)


# ── prior ─────────────────────────────────────────────────────────────────────────────────────────────────────────────

WEIGHTS = {"full": (0.0, 0.1, 1.0, 10.0), "quick": (0.1,)}


def prior_settings(scale: Scale) -> list[Setting]:
    """Return settings: weights of the paper's prior in its solver, then natural light's prior in the joint solver."""
    parameters = {"solver": "paper", "operator": "network"}
    return [
        *(
            scale.setting(f"paper-{w:g}".replace(".", "p"), f"paper {w:g}", solve=parameters | {"paper_prior": w})
            for w in WEIGHTS[scale.name]
        ),
        scale.setting("natural", "natural"),
    ]


PRIOR = Study(
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
    settings=prior_settings,
    claims=(
        Claim("chromaticity", "paper-0p1", "paper-0", "lights are less coloured at 0.1 than at 0"),
        Claim("chromaticity", "paper-10", "paper-0", "lights are less coloured at 10 than at 0"),
        Claim("entries", "paper-0p1", "paper-0", "0.1 predicts better than 0"),
        Claim("entries", "paper-0p1", "paper-10", "0.1 predicts better than 10"),
        project_claim("new_light", "paper-0p1", "paper-10", "materials are better at 0.1 than at 10"),
        project_claim("entries", "natural", "paper-0p1", "natural light's prior predicts better than 0.1"),
        project_claim("colour", "natural", "paper-0p1", "natural light's prior gives lights truer colours than 0.1"),
    ),
)


# ── speed ─────────────────────────────────────────────────────────────────────────────────────────────────────────────

VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "default": ("as it is", {}),
    "splittings-1": ("one splitting", {"splittings": 1}),
    "splittings-0": ("no splitting", {"splittings": 0}),
    "cells-150": ("150 cells", {"cells": 150}),
    "cells-150-splittings-0": ("150 cells, no splitting", {"cells": 150, "splittings": 0}),
    "observations-300": ("300 observations", {"observations": 300}),
    "observations-4000": ("4000 observations", {"observations": 4000}),
    "paper": ("paper's solver", {"solver": "paper", "operator": "network"}),
}
SPEED_QUICK = ("splittings-0", "paper")


def speed_settings(scale: Scale) -> list[Setting]:
    """Return a setting for each of `VARIANTS`; for a quick study, those of `SPEED_QUICK`."""
    variants = {name: VARIANTS[name] for name in (SPEED_QUICK if scale.quick else VARIANTS)}
    whole = {} if scale.quick else WHOLE
    return [
        scale.setting(f"speed-{name}", label, full_matrix(2, 2), solve=whole | parameters)
        for name, (label, parameters) in variants.items()
    ]


SPEED = Study(
    name="speed",
    title="Speed against error",
    question="Which solver, operator and reduction is worth its time?",
    paper="Nothing: the paper has one solver.",
    varied="solver, operator, reduction",
    measures=("seconds", "entries", "new_light", "diffuse", "specular", "roughness"),
    settings=speed_settings,
    claims=(
        project_claim(
            "entries", "speed-default", "speed-paper", "this project's solver predicts better than the paper's"
        ),
        project_claim("entries", "speed-splittings-0", "speed-paper", "it does so without splitting"),
        project_claim("seconds", "speed-paper", "speed-splittings-0", "the paper's takes less time"),
        project_claim("entries", "speed-default", "speed-splittings-0", "splitting of cells predicts better"),
        project_claim("entries", "speed-default", "speed-splittings-1", "three splittings predict better than one"),
        project_claim("entries", "speed-default", "speed-cells-150", "400 cells predict better than 150"),
        project_claim(
            "entries", "speed-default", "speed-observations-300", "1000 observations predict better than 300"
        ),
        project_claim(
            "entries", "speed-observations-4000", "speed-default", "4000 observations predict better than 1000"
        ),
    ),
)


# ── parts ─────────────────────────────────────────────────────────────────────────────────────────────────────────────

# label, what is off, of `studies.steps.parts.CHANGES`, parameters of the stage
WITHOUT: dict[str, tuple[str, str, str, dict[str, Any]]] = {
    "as-it-is": ("as it is", "", "", {}),
    "shadows": ("no shadows", "shadows", "", {"self_shadowing": "off", "interreflection": "off"}),
    "bounce": ("no bounce", "bounces", "", {"interreflection": "off"}),
    "distance": ("lights at infinity", "distances of lights", "", {"distance": "off"}),
    "normals": ("all normals sure", "confidences of normals", "sure", {}),
    "clipped-left-out": ("clipped left out", "clipped pixels, as bounds,", "dropped", {}),
    "splitting": ("with splitting of cells", "", "", {"splittings": 3}),
}
PARTS_QUICK = ("as-it-is", "bounce", "clipped-left-out")


def parts_settings(scale: Scale) -> list[Setting]:
    """Return the setting of the model without splitting, then one without each part, then one with splitting."""
    cases = {
        n: {"change": WITHOUT[n][2], "solve": scale.solve | WITHOUT[n][3]}
        for n in (PARTS_QUICK if scale.quick else WITHOUT)
    }
    return [Setting(n, WITHOUT[n][0], lambda seed, c=c: {"seed": seed, **c}) for n, c in cases.items()]


def parts_sets(scale: Scale) -> dict[str, Any]:
    """Return the rendered sets of chairs, one for each seed, with numbers of shots and pixels by scale.

    They are small, since a study is of many solves.
    """
    size = (2, 120, 90, 16, 32) if scale.quick else (4, 240, 180, 64, 64)
    return {"seeds": scale.seeds, **dict(zip(("shots", "width", "height", "spp", "light_rows"), size, strict=True))}


PARTS = Study(
    name="parts",
    title="What each part is worth",
    question="What is each part of the model worth?",
    paper="Nothing: the paper's model has none of these parts.",
    varied="what is switched off",
    measures=("diffuse", "specular", "glossy", "roughness", "mirror"),
    settings=parts_settings,
    claims=tuple(
        project_claim(m, "as-it-is", n, f"{WITHOUT[n][1]} {does}")
        for m, does in {"diffuse": "make k_d truer", "glossy": "make lights truer"}.items()
        for n in WITHOUT
        if n not in ("as-it-is", "splitting")
    )
    + (
        project_claim("diffuse", "splitting", "as-it-is", "splitting of cells makes k_d truer"),
        project_claim("glossy", "splitting", "as-it-is", "splitting of cells makes lights truer"),
    ),
    steps=("rendered_sets", "parts"),
    sets=parts_sets,
)
