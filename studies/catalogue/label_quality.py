"""Label quality: how much do wrong normals and wrong labels cost?"""

from __future__ import annotations

from studies.study import Claim, Scale, Setting, Study, own

NORMALS = {"full": (1, 2, 5, 10, 20), "quick": (5, 20)}
LABELS = {"full": (2, 10, 20), "quick": (20,)}


def settings(scale: Scale) -> list[Setting]:
    """Return the unperturbed setting, then one for each perturbation by itself."""
    return [
        scale.setting(f"{scale.side}x{scale.side}", "none"),
        *(scale.setting(f"normals-{d}deg", f"{d}°", normal_deg=float(d)) for d in NORMALS[scale.name]),
        *(scale.setting(f"labels-{p}pc", f"{p} %", wrong_labels=p / 100) for p in LABELS[scale.name]),
    ]


LATE, EARLY = ("rise", "normals-10deg", "normals-20deg", 10), ("rise", "normals-5deg", "normals-10deg", 5)
STUDY = Study(
    name="label-quality",
    title="Label quality",
    question="How much do wrong normals and wrong labels cost?",
    paper="Noise of about 1 % on normals does not matter; with more the error rises, and then saturates.",
    varied="noise on normals (σ, degrees), or share of wrong labels (%)",
    measures=("entries", "new_light", "diffuse", "specular", "roughness", "glossy", "stated_roughness"),
    settings=settings,
    claims=(
        own("entries", "3x3", "normals-1deg", "noise of 1° on normals raises the error"),
        Claim("entries", "3x3", "normals-20deg", "noise of 20° on normals raises the error"),
        own("entries", "normals-10deg", "normals-20deg", "20° is worse than 10°"),
        Claim("entries", LATE, EARLY, "the error rises less per degree beyond 10°"),
        own("entries", "3x3", "labels-2pc", "2 % of wrong labels raise the error"),
        own("entries", "3x3", "labels-20pc", "20 % of wrong labels raise the error"),
    ),
)
