"""Methods compared: predictions of a chair, other methods, weights of the prior, solvers, and parts of the model."""

from typing import Any

import msgspec

from studies.study import Claim, Comparison, Scale, Setting, Study, full_matrix, own

# ── leave one out ─────────────────────────────────────────────────────────────────────────────────────────────────────

SHELLS = {  # of the chairs, by photo
    "terrace": ("red", "white"),
    "kitchen": ("yellow",),
    "hall": ("black", "yellow"),
    "garden": ("white",),
    "office": ("red",),
    "patio": ("black",),
}
PHOTOS = {"full": tuple(SHELLS), "quick": ("kitchen", "hall")}


class LeftOut(msgspec.Struct, frozen=True):
    """The shells of a photo that are predicted one at a time, and from what; solve: parameters of the stage."""

    photo: str
    shells: tuple[str, ...]
    prediction: str
    solve: dict[str, Any] = {}


def leave_one_out_case(scale: Scale, number: int, prediction: str) -> LeftOut:
    """Return the case of a photo by its number; a shell that no other photo shows is not asked for."""
    photos = PHOTOS[scale.name]
    others = {shell for k, photo in enumerate(photos) if k != number for shell in SHELLS[photo]}
    return LeftOut(photos[number], tuple(s for s in SHELLS[photos[number]] if s in others), prediction, scale.solve)


def by_photo(table: Any) -> list[str]:
    """State each photo's values in a sentence: six photos are few, and one that is unlike the others decides a mean."""
    values = {row.label: row.cells["chair"].values for row in table.rows}
    photos = PHOTOS["quick" if table.quick else "full"]
    each = (f"{photos[k]} {', '.join(f'{of[k]:.2g}' for of in values.values())}" for k in table.seeds)
    return [f"DSSIM of a chair, photo by photo ({', '.join(values)}): {'; '.join(each)}."]


LEAVE_ONE_OUT = Study(
    name="leave-one-out",
    title="Leave one out",
    question="Can a chair be predicted in a photo from everything else?",
    paper="A chair of the eames photos that took no part in the solve can be predicted. "
    "(Its photos and numbers cannot be had.)",
    varied="where the chair is predicted from",
    measures=("chair", "chair_scaled"),
    settings=lambda scale: [
        Setting(f"chair-{p.replace(' ', '-')}", p, lambda k, p=p: leave_one_out_case(scale, k, p))
        for p in ("left out", "observed", "flat")
    ],
    claims=(
        Claim(
            "chair",
            "chair-left-out",
            "chair-flat",
            "a chair that was left out is predicted better than by a flat colour",
        ),
        own("chair_scaled", "chair-left-out", "chair-flat", "the same with brightness and tint given"),
        own(
            "chair",
            "chair-observed",
            "chair-left-out",
            "a chair that was observed is shown better than one that was left out",
        ),
    ),
    steps=("photos", "chairs"),
    sets=lambda scale: {"folder": "data/eames", "photos": PHOTOS[scale.name]},
    numbers=lambda scale: (0,) if scale.quick else tuple(range(len(SHELLS))),
    over="photos",
    notes=by_photo,
)


# ── comparison ────────────────────────────────────────────────────────────────────────────────────────────────────────

METHODS = {  # label; in sentences
    "ours": ("ours", ""),
    "mitsuba": ("Mitsuba", "Mitsuba"),
    "intrinsic": ("intrinsic", "the intrinsic decomposition"),
    "projective": ("projective", "projective texturing"),
    "grey": ("grey ball", "a grey ball"),
}
SIZES = {"full": (96, 48, 2000), "quick": (32, 16, 20)}  # pixels of photos; pixels and steps of Mitsuba's optimisation
ASKED = {"view": "new views", "light": "pictures in new light", "material": "pictures of new materials"}
PAPERS = (("view", "light"), ("intrinsic", "projective"))


def comparison_case(scale: Scale, seed: int, method: str) -> Comparison:
    """Return the case of `side` materials in as many lights, by a method."""
    size, pixels, steps = SIZES[scale.name]
    entries = tuple(full_matrix(scale.side, scale.side))
    return Comparison(seed, entries, size, scale.solve, method=method, pixels=pixels, steps=steps)


COMPARISON = Study(
    name="comparison",
    title="Comparison",
    question="Does a joint solve predict photos that were not taken better than other methods?",
    paper="The joint solve is nearer to the truth than projective texturing and than an intrinsic decomposition "
    "(SIRFS), averaged over photos.",
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
            f"{what} are predicted better than by {words}",
            kind in PAPERS[0] and m in PAPERS[1],
        )
        for kind, what in ASKED.items()
        for m, (_, words) in METHODS.items()
        if m != "ours" and (kind, m) != ("material", "projective")
    ),
    steps=("worlds", "answer", "compare"),
)


# ── prior ─────────────────────────────────────────────────────────────────────────────────────────────────────────────

WEIGHTS = {"full": (0.0, 0.1, 1.0, 10.0), "quick": (0.1,)}


def prior_settings(scale: Scale) -> list[Setting]:
    """Return settings: weights of the paper's prior in its solver, then natural light's prior in the joint solver."""
    how = {"solver": "paper", "operator": "network"}
    return [
        *(
            scale.setting(f"paper-{w:g}".replace(".", "p"), f"paper {w:g}", solve=how | {"paper_prior": w})
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
        own("new_light", "paper-0p1", "paper-10", "materials are better at 0.1 than at 10"),
        own("entries", "natural", "paper-0p1", "natural light's prior predicts better than 0.1"),
        own("colour", "natural", "paper-0p1", "natural light's prior gives lights truer colours than 0.1"),
    ),
)


# ── speed ─────────────────────────────────────────────────────────────────────────────────────────────────────────────

VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "default": ("as it is", {}),
    "cells-150": ("150 cells", {"cells": 150}),
    "splittings-0": ("no splitting", {"splittings": 0}),
    "cells-150-splittings-0": ("150 cells, no splitting", {"cells": 150, "splittings": 0}),
    "observations-300": ("300 observations", {"observations": 300}),
    "observations-4000": ("4000 observations", {"observations": 4000}),
    "closed-form": ("closed form", {"operator": "closed_form"}),
    "merge-0": ("not merged", {"merge_degrees": 0.0}),
    "merge-4": ("merged to 4°", {"merge_degrees": 4.0}),
    "paper": ("paper's solver", {"solver": "paper", "operator": "network"}),
    "paper-network": ("all the paper's", {"solver": "paper", "operator": "paper_network"}),
}
SPEED_QUICK = ("default", "closed-form", "merge-4", "paper")


def speed_settings(scale: Scale) -> list[Setting]:
    """Return all of `VARIANTS`; of a quick study, those of `QUICK`."""
    variants = {name: VARIANTS[name] for name in (SPEED_QUICK if scale.quick else VARIANTS)}
    return [scale.setting(name, label, full_matrix(2, 2), solve=how) for name, (label, how) in variants.items()]


SPEED = Study(
    name="speed",
    title="Speed against error",
    question="Which solver, operator and reduction is worth its time?",
    paper="Nothing: the paper has one solver.",
    varied="solver, operator, reduction",
    measures=("seconds", "entries", "new_light", "diffuse", "specular", "roughness"),
    settings=speed_settings,
    claims=(
        own("entries", "default", "paper", "this project's solver predicts better than the paper's"),
        own("seconds", "default", "paper", "it takes less time than the paper's"),
        own("seconds", "paper", "paper-network", "this project's operator makes the paper's solver faster"),
        own("entries", "default", "closed-form", "the network predicts better than the closed form"),
        own("entries", "default", "splittings-0", "splitting of cells predicts better"),
        own("entries", "default", "cells-150", "400 cells predict better than 150"),
        own("entries", "default", "observations-300", "1000 observations predict better than 300"),
        own("entries", "observations-4000", "default", "4000 observations predict better than 1000"),
        own("seconds", "default", "observations-4000", "1000 observations take less time than 4000"),
        own("entries", "merge-0", "default", "merging observations costs accuracy"),
        own("seconds", "default", "merge-0", "merging observations saves time"),
    ),
)


# ── parts ─────────────────────────────────────────────────────────────────────────────────────────────────────────────

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
PARTS_QUICK = ("as-it-is", "bounce", "clipped-left-out")


def parts_settings(scale: Scale) -> list[Setting]:
    """Return the setting of the whole model, then one without each part."""
    cases = {
        n: {"change": WITHOUT[n][2], "solve": scale.solve | WITHOUT[n][3]}
        for n in (PARTS_QUICK if scale.quick else WITHOUT)
    }
    return [Setting(n, WITHOUT[n][0], lambda seed, c=c: {"seed": seed, **c}) for n, c in cases.items()]


def parts_sets(scale: Scale) -> dict[str, Any]:
    """Return the rendered sets of chairs, one a seed: so many shots of so many pixels.

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
        own(m, "as-it-is", n, f"{WITHOUT[n][1]} {does}")
        for m, does in {"diffuse": "make k_d truer", "glossy": "make lights truer"}.items()
        for n in WITHOUT
        if n != "as-it-is"
    ),
    steps=("photos", "parts"),
    sets=parts_sets,
)
