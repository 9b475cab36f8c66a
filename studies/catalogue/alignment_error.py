"""Alignment error: how much do wrong poses and meshes cost, and what helps?

Varied     every object of a set is turned by 0 … 20° about a random axis, shifted in the image by a share of its diameter, its mesh too
           large, or of few triangles; sets of 3 × 3 (quick: 2 × 2) of bodies without symmetry.  Treatments, each where a claim compares it:
           as it is      the solve as the project has it: robust loss, and normals that weigh as much as `align` is sure of them
           squares       least squares in place of the robust loss
           even          every normal as sure as any other
           outline       every pose first fitted to the outline of its mask, from the perturbed pose, as `align` ends a search
Measured   materials and predictions, on whole spheres; and the median error of the normals that the solve is given.  Renderings are
           of the true normals, of pixels that both the object and what stands for it show.

Poses by shading (the stage `refine`) are not among them: `make results ONLY=refine` measures these.
"""

from __future__ import annotations

from typing import Any

from studies.study import Claim, Scale, Setting, Study, full_matrix, own

PERTURBATIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "exact": ("exact", {}),
    "turned-2": ("turned 2°", {"turned_deg": 2.0}),
    "turned-5": ("turned 5°", {"turned_deg": 5.0}),
    "turned-10": ("turned 10°", {"turned_deg": 10.0}),
    "turned-20": ("turned 20°", {"turned_deg": 20.0}),
    "shifted": ("shifted 5 %", {"shifted": 0.05}),
    "larger": ("10 % larger", {"larger": 0.1}),
    "coarse": ("of 100 triangles", {"triangles": 100}),
}
AS_IT_IS = "as-it-is"
TREATMENTS: dict[str, tuple[str, dict[str, Any]]] = {
    AS_IT_IS: ("", {}),
    "squares": (" squares", {"robust": False}),
    "even": (" even", {"confidence": False}),
    "outline": (" outline", {"refined": True}),
}
BESIDE = {  # treatments beside `AS_IT_IS`
    "full": {"exact": (), "turned-2": (), "turned-5": ("outline", "even"), "turned-10": (), "turned-20": ("outline", "squares"),
             "shifted": ("outline",), "larger": ("outline",), "coarse": ("even",)},
    "quick": {"exact": (), "turned-5": ("squares", "even", "outline"), "turned-20": ("outline",)},
}  # fmt: skip


def settings(scale: Scale) -> list[Setting]:
    """Each perturbation, with its treatments beside it."""
    entries = full_matrix(scale.side, scale.side)
    pairs = [(p, t) for p, beside in BESIDE[scale.name].items() for t in (AS_IT_IS, *beside)]
    labels = {(p, t): PERTURBATIONS[p][0] + TREATMENTS[t][0] for p, t in pairs}
    how = {(p, t): PERTURBATIONS[p][1] | TREATMENTS[t][1] for p, t in pairs}
    return [scale.of_objects(f"{p}-{t}", labels[p, t], entries, **how[p, t]) for p, t in pairs]


def claims(scale: Scale) -> list[Claim]:
    """What raises the error, and what helps against it; of settings that this scale has."""
    words = {p: PERTURBATIONS[p][0] for p in ("turned-5", "turned-20", "shifted", "larger", "coarse")}
    costly = [
        Claim("entries", f"exact-{AS_IT_IS}", f"{p}-{AS_IT_IS}", f"“{w}” raises the error") for p, w in words.items()
    ]
    helps = [  # of a treatment that is better than `AS_IT_IS`; of one that does without what helps
        *((f"{p}-outline", f"{p}-{AS_IT_IS}", p, "fitting the outline") for p in ("turned-5", "turned-20", "larger")),
        (f"turned-20-{AS_IT_IS}", "turned-20-squares", "turned-20", "the robust loss"),
        *((f"{p}-{AS_IT_IS}", f"{p}-even", p, "knowing how sure normals are") for p in ("turned-5", "coarse")),
    ]
    every = [*costly, *(own("entries", a, b, f"{what} helps where objects are {words[p]}") for a, b, p, what in helps)]
    names = {setting.name for setting in settings(scale)}
    return [claim for claim in every if set(claim.settings) <= names]


STUDY = Study(
    name="alignment-error",
    title="Alignment error",
    question="How much do wrong poses and meshes cost, and what helps?",
    paper="Poses off by up to 20°, shifts, wrong scales and coarse meshes raise the error. (How much is not taken over from the paper.)",
    varied="what is wrong with every object, and what is done",
    measures=("entries", "new_light", "normals", "diffuse", "specular", "roughness", "glossy"),
    settings=settings,
    claims=claims,
    lights=1,
    pictures="studies.steps.score.spheres_by_setting",
)
