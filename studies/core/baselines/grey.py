"""The grey ball: every material is the same grey Lambert, every light is even, of its photo's mean colour.

It knows the photos' mean colours and which pixels are of objects, nothing else: what does not beat it has recovered nothing.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from factorlib.results.materials import Reflectance
from studies.core.baselines.gauge import in_gauge
from studies.core.baselines.photos import Photos
from studies.core.baselines.prediction import Rendered

ALBEDO = 0.5
GREY = Reflectance((ALBEDO,) * 3, (0.0,) * 3, 1.0)
ROWS = 32  # of an even map


def grey(photos: Photos, truths: Mapping[str, Reflectance]) -> Rendered:
    """truths: for the gauge alone."""
    means = {
        li: np.mean([photos.radiance[entry].mean(axis=0) for entry in photos.radiance if entry[1] == li], axis=0)
        for li in photos.lights
    }
    lights = {li: np.broadcast_to(colour / ALBEDO, (ROWS, 2 * ROWS, 3)) for li, colour in means.items()}
    return Rendered(*in_gauge(dict.fromkeys(photos.materials, GREY), lights, truths), lambertian=True)
