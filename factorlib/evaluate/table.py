"""How good the metrics of data/synthetic must be at worst, and how numbers in metrics.json are named: by dotted paths."""

from typing import Any

import msgspec


class Bound(msgspec.Struct, frozen=True):
    """A dotted path into metrics.json, "≤" or "≥", the limit, a unit, and a word on what it is."""

    path: str
    sense: str
    limit: float
    unit: str
    meaning: str

    def holds(self, value: float | None) -> bool:
        """Whether the value is there, and within the bound."""
        return value is not None and (value <= self.limit if self.sense == "≤" else value >= self.limit)


# A quarter beyond the worst of five trained networks × two seeds of the solve.
SPHERE, RMS = "light.mean.channel_per_photo.{}.estimate.rmse", "sphere, of the truth's RMS"
SYNTHETIC = (
    Bound("materials.worst_roughness", "≤", 0.040, "", "roughness, worst material"),
    Bound("materials.worst_diffuse", "≤", 0.055, "", "diffuse, worst material and channel, relative"),
    Bound("materials.worst_specular", "≤", 0.038, "", "specular, worst material and channel, relative"),
    Bound("resynthesis.worst_psnr_linear_db", "≥", 35.0, "dB", "re-synthesis, worst photo, no gauge, linear"),
    Bound("resynthesis.worst_psnr_tonemapped_db", "≥", 40.4, "dB", "re-synthesis, worst photo, no gauge, tone-mapped"),
    Bound("relighting.mean.scalar_per_set.in_true_light.psnr_tonemapped_db", "≥", 38.0, "dB", "relit balls, one scalar per set"),
    Bound(SPHERE.format("mirror"), "≤", 0.276, "", f"mirror {RMS}"),
    Bound(SPHERE.format("glossy"), "≤", 0.076, "", f"glossy {RMS}"),
    Bound(SPHERE.format("lambertian"), "≤", 0.005, "", f"Lambertian {RMS}"),
)  # fmt: skip


def value_at(metrics: Any, path: str) -> float | None:
    """What stands at a dotted path; None where there is nothing.

    >>> value_at({"a": {"b": [1.5]}}, "a.b.0"), value_at({"a": None}, "a.b")
    (1.5, None)
    """
    for key in path.split("."):
        try:
            metrics = metrics[int(key)] if isinstance(metrics, list) else metrics[key]
        except (LookupError, TypeError, ValueError):
            return None
    return metrics
