"""Exposures of photos that share a light, as their EXIF says them: where the solve starts from.

Two photos of one light differ by a factor, which the solve finds.  From a factor of 8 it may not find back; what the cameras
wrote, t·S/N², is right within rounding and what a camera's own rendering does.  So radiance is brought to the exposure of the
light's first photo by EXIF, and what is solved for is what EXIF leaves.
"""

from __future__ import annotations

import msgspec
import numpy as np

from factorlib.urm.observations import Observations


def relative_exposures(observations: Observations) -> dict[str, float]:
    """Of each photo that has observations, over the first one (by name) in its light; 1 unless all photos of the light say theirs."""
    known = dict(zip(observations.photos, observations.exposures))
    relative = {}
    for light in np.unique(observations.illumination):
        of_light = np.unique(observations.photo[observations.illumination == light])
        photos = sorted(observations.photos[k] for k in of_light)
        exposures = [known.get(photo) for photo in photos]
        first = exposures[0] if None not in exposures else None
        relative |= {photo: exposure / first if first else 1.0 for photo, exposure in zip(photos, exposures)}
    return relative


def at_one_exposure(observations: Observations, relative: dict[str, float]) -> Observations:
    """With the radiance of each photo over its relative exposure; unchanged where all are 1."""
    factors = np.array([relative.get(photo, 1.0) for photo in observations.photos])
    if (factors == 1).all():
        return observations
    return msgspec.structs.replace(observations, radiance=observations.radiance / factors[observations.photo][:, None])
