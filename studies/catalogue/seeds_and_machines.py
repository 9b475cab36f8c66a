"""Seeds and machines: how far do the numbers that README.md quotes of data/synthetic lie apart?

Varied     seeds of the solve, ten of them; and the instructions that numerical libraries may use: those that every run has, all that
           this processor has, and those of processors without AVX2.
Measured   the numbers of `benchmarks.reference`, of the whole pipeline on data/synthetic.
"""

from __future__ import annotations

from studies.core.machine import Machine, hash_of_data
from studies.core.study import Claim, Scale, Setting, Study

MEASURES = (
    "materials.worst_roughness",
    "materials.worst_diffuse",
    "materials.worst_specular",
    "resynthesis.worst_psnr_linear_db",
    "relighting.mean.scalar_per_set.in_true_light.psnr_tonemapped_db",
    "light.mean.channel_per_photo.glossy.estimate.rmse",
)


def settings(scale: Scale) -> list[Setting]:
    """Instructions as they are with seeds of two runs, then others with the seeds of the first."""
    if scale.name == "quick":
        return [_setting(scale, "fixed", 0, 0, "as it is")]
    rows = (
        ("fixed", 0, "seeds 0 to 4"),
        ("fixed", 5, "seeds 5 to 9"),
        ("all", 0, "all instructions"),
        ("least", 0, "without AVX2"),
    )
    return [_setting(scale, instructions, first, x, label) for x, (instructions, first, label) in enumerate(rows)]


def _setting(scale: Scale, instructions: str, first: int, x: int, label: str) -> Setting:
    data = hash_of_data()
    return Setting(
        f"{instructions}-{first}", label, x, lambda seed: Machine(first + seed, instructions, data, scale.solve)
    )


def claims(scale: Scale) -> list[Claim]:
    """None: what is asked is how far numbers lie apart; the notes say it."""
    return []


STUDY = Study(
    name="seeds-and-machines",
    title="Seeds and machines",
    question="How far do the numbers that README.md quotes of data/synthetic lie apart?",
    paper="Nothing.",
    varied="seeds of the solve, and instructions",
    measures=MEASURES,
    settings=settings,
    claims=claims,
    kind="machine",
)
