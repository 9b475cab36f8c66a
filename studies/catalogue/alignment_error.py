"""Alignment error: how much harm do wrong poses and meshes do, and what helps?

Varied     every object of a set is turned by 0 … 20° about a random axis, shifted in the image by a share of its diameter, its mesh too
           large, or of few triangles; sets of 3 × 3 (quick: 2 × 2) of bodies without symmetry.  For each harm:
           as it is      the solve as the project has it: robust loss, and normals that weigh as much as `align` is sure of them
           squares       least squares in place of the robust loss
           even          every normal as sure as any other
           outline       every pose first fitted to the outline of its mask, from where the harm left it, as `align` ends a search
Measured   materials and predictions, on whole spheres; and the median error of the normals that the solve is given.  Renderings are
           of the true normals, of pixels that both the object and what stands for it show.

Poses by shading (the stage `refine`) are not among them: `python -m benchmarks.refine` measures these.
"""

from __future__ import annotations

from typing import Any

from studies.core.objects.case import Harm
from studies.core.objects.setting import setting
from studies.core.study import Claim, Scale, Setting, Study, full_matrix

HARMS: dict[str, tuple[str, Harm]] = {
    "exact": ("exact", Harm()),
    "turned-2": ("turned 2°", Harm(turned_deg=2.0)),
    "turned-5": ("turned 5°", Harm(turned_deg=5.0)),
    "turned-10": ("turned 10°", Harm(turned_deg=10.0)),
    "turned-20": ("turned 20°", Harm(turned_deg=20.0)),
    "shifted": ("shifted 5 %", Harm(shifted=0.05)),
    "larger": ("10 % larger", Harm(larger=0.1)),
    "coarse": ("of 100 triangles", Harm(triangles=100)),
}
ARMS: dict[str, tuple[str, dict[str, Any]]] = {
    "as-it-is": ("", {}),
    "squares": (" squares", {"robust": False}),
    "even": (" even", {"confidence": False}),
    "outline": (" outline", {"refined": True}),
}
FIT, HEARD = ("as-it-is", "outline"), ("as-it-is", "squares", "even")
SHOWN = {
    "full": {"exact": HEARD, "turned-2": ("as-it-is",), "turned-5": tuple(ARMS), "turned-10": FIT, "turned-20": tuple(ARMS),
             "shifted": FIT, "larger": FIT, "coarse": HEARD},
    "quick": {"exact": ("as-it-is",), "turned-5": tuple(ARMS), "turned-20": FIT},
}  # fmt: skip


def settings(scale: Scale) -> list[Setting]:
    """Each harm, with each treatment beside it."""
    pairs = [(harm, arm) for harm, arms in SHOWN[scale.name].items() for arm in arms]
    return [_setting(scale, x, harm, arm) for x, (harm, arm) in enumerate(pairs)]


def _setting(scale: Scale, x: int, harm: str, arm: str) -> Setting:
    (of_harm, harmed), (of_arm, how) = HARMS[harm], ARMS[arm]
    return setting(scale, f"{harm}-{arm}", of_harm + of_arm, x, full_matrix(scale.side, scale.side), harm=harmed, **how)


def claims(scale: Scale) -> list[Claim]:
    """What does harm, and what helps against it; of settings that this scale has."""
    harmful = [_harmful(harm) for harm in ("turned-5", "turned-20", "shifted", "larger", "coarse")]
    refined = [_helps("outline", harm, "fitting the outline") for harm in ("turned-5", "turned-20", "larger")]
    robust = [_matters("squares", "turned-20", "the robust loss")]
    sure = [_matters("even", harm, "knowing how sure normals are") for harm in ("turned-5", "coarse")]
    known = {one.name for one in settings(scale)}
    return [claim for claim in (*harmful, *refined, *robust, *sure) if {claim.lower, claim.higher} <= known]


def _harmful(harm: str) -> Claim:
    return Claim("entries", "exact-as-it-is", f"{harm}-as-it-is", f"“{HARMS[harm][0]}” does harm")


def _helps(arm: str, harm: str, what: str) -> Claim:
    return Claim("entries", f"{harm}-{arm}", f"{harm}-as-it-is", f"{what} helps where objects are {HARMS[harm][0]}", paper=False)


def _matters(arm: str, harm: str, what: str) -> Claim:
    return Claim("entries", f"{harm}-as-it-is", f"{harm}-{arm}", f"{what} helps where objects are {HARMS[harm][0]}", paper=False)


STUDY = Study(
    name="alignment-error",
    title="Alignment error",
    question="How much harm do wrong poses and meshes do, and what helps?",
    paper="Poses off by up to 20°, shifts, wrong scales and coarse meshes do harm. (How much is not taken over from the paper.)",
    varied="what is wrong with every object, and what is done",
    measures=("entries", "new_light", "normals", "diffuse", "specular", "roughness", "glossy"),
    settings=settings,
    claims=claims,
    kind="objects",
)
