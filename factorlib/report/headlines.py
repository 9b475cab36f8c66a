"""The few numbers at the top of the page and of comparisons, each beside what it is compared with, and what it means."""

from __future__ import annotations

import msgspec

from factorlib.report.template import number, percent
from factorlib.results.metrics import Metrics


class Headline(msgspec.Struct, frozen=True):
    """A number in words; beside: what it is compared with; meaning: a sentence for who does not know the measure."""

    label: str
    value: str
    unit: str
    beside: str
    meaning: str


def headlines(metrics: Metrics) -> list[Headline]:
    """Re-synthesis where a pixel counts; materials and relighting where there is a truth."""
    rows, materials = [], metrics.materials
    if metrics.resynthesis.mean:
        score, flat = metrics.resynthesis.mean["none"].estimate, metrics.resynthesis.mean["none"].null
        rows += [
            Headline(
                "Re-synthesis, PSNR", number(score.psnr_tonemapped_db, 1), "dB",
                f"flat colours score {number(flat.psnr_tonemapped_db, 1)} dB",
                "How close the recovered materials in the recovered light come to the photos: mean over photos, nothing "
                "rescaled, after the tone map. Higher is better.",
            ),
            Headline(
                "Re-synthesis, DSSIM", number(score.dssim, 4), "", f"flat colours score {number(flat.dssim, 4)}",
                "Structural difference, 0 to 1. Lower is better.",
            ),
        ]  # fmt: skip
    if materials:
        worst, grey = number(materials.worst_roughness, 3), number(materials.null_mean_roughness, 3)
        rows += [
            Headline(
                "Roughness error", number(materials.mean_roughness, 3), "", f"worst {worst}; grey ball {grey}",
                "Mean absolute difference from the true roughness, which lies in 0 to 1.",
            ),
            Headline(
                "Diffuse colour error", percent(materials.mean_diffuse), "",
                f"specular {percent(materials.mean_specular)}; grey ball {percent(materials.null_mean_diffuse)}",
                "Mean relative error, after the one factor per channel that no photo can settle.",
            ),
        ]  # fmt: skip
    if metrics.relighting:
        mean = metrics.relighting.mean["scalar_per_set"]
        psnr = {kind: number(error.psnr_tonemapped_db, 1) for kind, error in mean.items()}
        beside = f"grey ball {psnr['null_grey']} dB, mean colour {psnr['null_mean_colour']} dB"
        meaning = (
            "Balls of the recovered materials in the true lights against true balls, one factor for the whole set."
        )
        rows.append(Headline("Relighting, PSNR", psnr["in_true_light"], "dB", beside, meaning))
    return rows
