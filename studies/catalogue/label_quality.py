"""Label quality: how much do wrong normals and wrong labels cost?

Varied     noise on normals, |N(0, σ)| degrees, σ = 0 … 20; and the share of pixels, 0 … 20 %, whose label names another
           material of the same photo.  Sets of 3 × 3 (quick: 2 × 2).
Measured   materials and predictions.  Renderings are of the true normals; the solve gets the perturbed ones.
"""

from __future__ import annotations

from studies.study import Claim, Rise, Scale, Setting, Study, own

NORMALS = {"full": (1, 2, 5, 10, 20), "quick": (5, 20)}
LABELS = {"full": (2, 10, 20), "quick": (20,)}


def settings(scale: Scale) -> list[Setting]:
    """Unperturbed, then each perturbation by itself."""
    return [
        scale.setting(scale.square, "none"),
        *(scale.setting(f"normals-{d}deg", f"{d}°", normal_deg=float(d)) for d in NORMALS[scale.name]),
        *(scale.setting(f"labels-{p}pc", f"{p} %", wrong_labels=p / 100) for p in LABELS[scale.name]),
    ]


def claims(scale: Scale) -> list[Claim]:
    """Whether little noise raises the error and much does; whether the error saturates: it rises less per degree at the most noise."""
    none, degrees, shares = scale.square, NORMALS[scale.name], LABELS[scale.name]
    at = {0: none} | {d: f"normals-{d}deg" for d in degrees}
    *_, low, mid, most = at
    late, early = Rise(at[mid], at[most], most - mid), Rise(at[low], at[mid], mid - low)
    return [
        own("entries", none, at[degrees[0]], f"noise of {degrees[0]}° on normals raises the error"),
        Claim("entries", none, at[most], f"noise of {most}° on normals raises the error"),
        own("entries", at[mid], at[most], f"{most}° is worse than {mid}°"),
        Claim("entries", late, early, f"the error rises less per degree beyond {mid}°"),
        *(own("entries", none, f"labels-{p}pc", f"{p} % of wrong labels raise the error") for p in (shares[0], shares[-1])),
    ]  # fmt: skip


STUDY = Study(
    name="label-quality",
    title="Label quality",
    question="How much do wrong normals and wrong labels cost?",
    paper="Noise of about 1 % on normals does not matter; with more the error rises, and then saturates.",
    varied="noise on normals (σ, degrees), or share of wrong labels (%)",
    measures=("entries", "new_light", "diffuse", "specular", "roughness", "glossy", "stated_roughness"),
    settings=settings,
    claims=claims,
)
