"""Label quality: how much do wrong normals and wrong labels cost?

Varied     noise on normals, |N(0, σ)| degrees, σ = 0 … 20; and the share of pixels, 0 … 20 %, whose label names another
           material of the same photo.  Sets of 3 × 3 (quick: 2 × 2).
Measured   materials and predictions.  Renderings are of the true normals; the solve gets the perturbed ones.
"""

from __future__ import annotations

from studies.core.study import Claim, Rise, Scale, Setting, Study

NORMALS = {"full": (1, 2, 5, 10, 20), "quick": (5, 20)}
LABELS = {"full": (2, 10, 20), "quick": (20,)}


def settings(scale: Scale) -> list[Setting]:
    """Unperturbed, then each perturbation by itself."""
    perturbations = [(f"normals-{d}deg", f"{d}°", {"normal_deg": float(d)}) for d in NORMALS[scale.name]]
    perturbations += [(f"labels-{p}pc", f"{p} %", {"wrong_labels": p / 100}) for p in LABELS[scale.name]]
    perturbed = [scale.setting(name, label, x, **how) for x, (name, label, how) in enumerate(perturbations, 1)]
    return [scale.setting(scale.square, "none", 0), *perturbed]


def claims(scale: Scale) -> list[Claim]:
    """Whether little noise raises the error and much does; whether the error saturates: it rises less per degree at the most noise."""
    none, degrees, shares = scale.square, NORMALS[scale.name], LABELS[scale.name]
    at = {0: none} | {d: f"normals-{d}deg" for d in degrees}
    *_, low, mid, most = at
    return [
        Claim(
            "entries",
            none,
            f"normals-{degrees[0]}deg",
            f"noise of {degrees[0]}° on normals raises the error",
            paper=False,
        ),
        Claim("entries", none, f"normals-{degrees[-1]}deg", f"noise of {degrees[-1]}° on normals raises the error"),
        Claim("entries", at[mid], at[most], f"{most}° is worse than {mid}°", paper=False),
        Claim(
            "entries",
            Rise(at[mid], at[most], most - mid),
            Rise(at[low], at[mid], mid - low),
            f"the error rises less per degree beyond {mid}°",
        ),
        Claim("entries", none, f"labels-{shares[0]}pc", f"{shares[0]} % of wrong labels raise the error", paper=False),
        Claim(
            "entries", none, f"labels-{shares[-1]}pc", f"{shares[-1]} % of wrong labels raise the error", paper=False
        ),
    ]


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
