"""Agreement of masks with known cameras: a mask lies inside the visual hull of all others, and fills most of it.

A mask that shows more than the others' hull has background in it, or the others lack a part of the object.
"""

from collections.abc import Callable, Sequence

import numpy as np

from factorlib.align.silhouette import bounding_box
from factorlib.errors import InputError
from factorlib.shapes.hull import bounding_ball, hull_overlap, signed_distance
from factorlib.shapes.outline import Outline

SAMPLES = 40  # pixels a side, and depths of each pixel's ray
MARGIN = 1.2  # extent of the examined part of a photo, in those of its mask
FOCALS = (0.7, 5.0)  # range of focal lengths that are tried, in units of the photo's longer side
TRIALS = 12


def agreement(outlines: Sequence[Outline]) -> list[float]:
    """Return the IoU of each outline with the silhouette of the hull of all others.  All need poses.

    Raises:
        InputError: All photos see the object from the same side, or one has it behind its camera.
    """
    middle, radius = bounding_ball(outlines)
    overlaps = []
    for k, outline in enumerate(outlines):
        pose = outline.known_pose
        extent = MARGIN * bounding_box(outline.view.silhouette)[2] / 2
        places = outline.middle[:, None] + np.linspace(-extent, extent, SAMPLES)
        pixels = np.stack(np.meshgrid(*places), axis=-1).reshape(-1, 2)
        # points on the rays of the pixels, in the object's frame, and whether any of a ray is in the hull of the others
        depths = pose.apply(middle[None])[0, 2] + MARGIN * radius * np.linspace(-1, 1, SAMPLES)
        points = outline.camera.rays_through(pixels)[:, None] * depths[:, None]
        distance = signed_distance(
            [*outlines[:k], *outlines[k + 1 :]], ((points - pose.translation) @ pose.rotation).reshape(-1, 3)
        )
        hull = (distance.reshape(len(pixels), SAMPLES) > -MARGIN * radius / SAMPLES).any(axis=1)
        mask = outline.inner(pixels) > 0
        overlaps.append(float((hull & mask).sum() / max((hull | mask).sum(), 1)))
    return overlaps


def focal_length(
    outlines: Callable[[float], Sequence[Outline]], longest: int, report: Callable[[float], None] = lambda share: None
) -> float:
    """Return the focal length, common to all photos, at which a hull fills their masks best.

    Args:
        outlines: Outlines by focal length, pixels.
        longest: Longer side of the photos, pixels.
        report: Called with the completed share, from 0 to 1.
    """
    logs = np.log(longest * np.geomspace(*FOCALS, TRIALS))
    overlaps = []
    for k, log in enumerate(logs):
        report(k / TRIALS)
        overlaps.append(hull_overlap(outlines(float(np.exp(log)))))
    best = int(np.argmax(overlaps))
    if best in (0, TRIALS - 1):
        raise InputError(
            "a hull fills the masks at no focal length", cure="check that masks and cameras belong together"
        )
    # vertex of the parabola through the best trial and its neighbours
    square, slope, _ = np.polyfit(logs[best - 1 : best + 2], overlaps[best - 1 : best + 2], 2)
    return float(np.exp(-slope / (2 * square)))
