"""Comparison: does a joint solve predict photos that were not taken better than other methods?"""

from __future__ import annotations

from studies.study import Claim, Comparison, Scale, Setting, Study, full_matrix

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


def case(scale: Scale, seed: int, method: str) -> Comparison:
    """Return the case of `side` materials in as many lights, by a method."""
    size, pixels, steps = SIZES[scale.name]
    entries = tuple(full_matrix(scale.side, scale.side))
    return Comparison(seed, entries, size, scale.solve, method=method, pixels=pixels, steps=steps)


STUDY = Study(
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
        Setting(m, label, lambda seed, m=m: case(scale, seed, m)) for m, (label, _) in METHODS.items()
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
