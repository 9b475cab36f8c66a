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

from studies.core.objects.case import Perturbation
from studies.core.objects.setting import setting
from studies.core.study import Claim, Scale, Setting, Study, full_matrix

PERTURBATIONS: dict[str, tuple[str, Perturbation]] = {
    "exact": ("exact", Perturbation()),
    "turned-2": ("turned 2°", Perturbation(turned_deg=2.0)),
    "turned-5": ("turned 5°", Perturbation(turned_deg=5.0)),
    "turned-10": ("turned 10°", Perturbation(turned_deg=10.0)),
    "turned-20": ("turned 20°", Perturbation(turned_deg=20.0)),
    "shifted": ("shifted 5 %", Perturbation(shifted=0.05)),
    "larger": ("10 % larger", Perturbation(larger=0.1)),
    "coarse": ("of 100 triangles", Perturbation(triangles=100)),
}
ARMS: dict[str, tuple[str, dict[str, Any]]] = {
    "as-it-is": ("", {}),
    "squares": (" squares", {"robust": False}),
    "even": (" even", {"confidence": False}),
    "outline": (" outline", {"refined": True}),
}
ALONE, FIT = ("as-it-is",), ("as-it-is", "outline")
SHOWN = {
    "full": {"exact": ALONE, "turned-2": ALONE, "turned-5": (*FIT, "even"), "turned-10": ALONE, "turned-20": (*FIT, "squares"),
             "shifted": FIT, "larger": FIT, "coarse": ("as-it-is", "even")},
    "quick": {"exact": ALONE, "turned-5": tuple(ARMS), "turned-20": FIT},
}  # fmt: skip


def settings(scale: Scale) -> list[Setting]:
    """Each perturbation, with each treatment beside it."""
    pairs = [(perturbation, arm) for perturbation, arms in SHOWN[scale.name].items() for arm in arms]
    return [_setting(scale, x, perturbation, arm) for x, (perturbation, arm) in enumerate(pairs)]


def _setting(scale: Scale, x: int, perturbation: str, arm: str) -> Setting:
    (of_perturbation, perturbed), (of_arm, how) = PERTURBATIONS[perturbation], ARMS[arm]
    return setting(
        scale,
        f"{perturbation}-{arm}",
        of_perturbation + of_arm,
        x,
        full_matrix(scale.side, scale.side),
        perturbation=perturbed,
        **how,
    )


def claims(scale: Scale) -> list[Claim]:
    """What raises the error, and what helps against it; of settings that this scale has."""
    costly = [_costly(perturbation) for perturbation in ("turned-5", "turned-20", "shifted", "larger", "coarse")]
    refined = [
        _helps("outline", perturbation, "fitting the outline") for perturbation in ("turned-5", "turned-20", "larger")
    ]
    robust = [_matters("squares", "turned-20", "the robust loss")]
    sure = [_matters("even", perturbation, "knowing how sure normals are") for perturbation in ("turned-5", "coarse")]
    known = {one.name for one in settings(scale)}
    return [claim for claim in (*costly, *refined, *robust, *sure) if {claim.lower, claim.higher} <= known]


def _costly(perturbation: str) -> Claim:
    return Claim(
        "entries", "exact-as-it-is", f"{perturbation}-as-it-is", f"“{PERTURBATIONS[perturbation][0]}” raises the error"
    )


def _helps(arm: str, perturbation: str, what: str) -> Claim:
    return _better(f"{perturbation}-{arm}", f"{perturbation}-as-it-is", perturbation, what)


def _matters(arm: str, perturbation: str, what: str) -> Claim:
    return _better(f"{perturbation}-as-it-is", f"{perturbation}-{arm}", perturbation, what)


def _better(lower: str, higher: str, perturbation: str, what: str) -> Claim:
    return Claim(
        "entries", lower, higher, f"{what} helps where objects are {PERTURBATIONS[perturbation][0]}", paper=False
    )


STUDY = Study(
    name="alignment-error",
    title="Alignment error",
    question="How much do wrong poses and meshes cost, and what helps?",
    paper="Poses off by up to 20°, shifts, wrong scales and coarse meshes raise the error. (How much is not taken over from the paper.)",
    varied="what is wrong with every object, and what is done",
    measures=("entries", "new_light", "normals", "diffuse", "specular", "roughness", "glossy"),
    settings=settings,
    claims=claims,
    kind="objects",
)
