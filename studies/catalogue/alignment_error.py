"""Alignment error: how much do wrong poses and meshes cost, and what helps?

Treatments are there where a claim compares them.
"""

from __future__ import annotations

from studies.study import Claim, Scale, Setting, Study, full_matrix, own

PERTURBED = {  # label, fields of `Objects`, treatments
    "exact": ("exact", {}, ()),
    "turned-2": ("turned 2°", {"turned_deg": 2.0}, ()),
    "turned-5": ("turned 5°", {"turned_deg": 5.0}, ("outline", "even")),
    "turned-10": ("turned 10°", {"turned_deg": 10.0}, ()),
    "turned-20": ("turned 20°", {"turned_deg": 20.0}, ("outline",)),
    "shifted": ("shifted 5 %", {"shifted": 0.05}, ("outline",)),
    "larger": ("10 % larger", {"larger": 0.1}, ("outline",)),
    "coarse": ("of 100 triangles", {"triangles": 100}, ("even",)),
}
TREATMENTS = {"even": {"confidence": False}, "outline": {"refined": True}}
QUICK = ("exact", "turned-5", "turned-20")


def settings(scale: Scale) -> list[Setting]:
    """Return a setting for each perturbation, with its treatments beside it."""
    entries, made = full_matrix(scale.side, scale.side), []
    for name in QUICK if scale.quick else PERTURBED:
        label, how, beside = PERTURBED[name]
        made.append(scale.of_objects(name, label, entries, **how))
        made += [scale.of_objects(f"{name}-{t}", f"{label} {t}", entries, **how, **TREATMENTS[t]) for t in beside]
    return made


COSTLY = ("turned-5", "turned-20", "shifted", "larger", "coarse")
OUTLINE = ("turned-5", "turned-20", "larger")
EVEN = ("turned-5", "coarse")
STUDY = Study(
    name="alignment-error",
    title="Alignment error",
    question="How much do wrong poses and meshes cost, and what helps?",
    paper="Poses off by up to 20°, shifts, wrong scales and coarse meshes raise the error. "
    "(How much is not taken over from the paper.)",
    varied="what is wrong with every object, and what is done",
    measures=("entries", "new_light", "normals", "diffuse", "specular", "roughness", "glossy"),
    settings=settings,
    claims=(
        *(Claim("entries", "exact", p, f"“{PERTURBED[p][0]}” raises the error") for p in COSTLY),
        *(
            own("entries", f"{p}-outline", p, f"fitting the outline helps where objects are {PERTURBED[p][0]}")
            for p in OUTLINE
        ),
        *(
            own("entries", p, f"{p}-even", f"knowing how sure normals are helps where objects are {PERTURBED[p][0]}")
            for p in EVEN
        ),
    ),
    lights=1,
)
