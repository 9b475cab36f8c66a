"""Choice of the lights that surface and materials are estimated from, where photos show many.

A material's standard error falls as lights and views are added, and each further one counts less.  A light tells of a
material, seen from a side d of its mesh, by the share s = n / (n + `SATURATED`) of its n observations there: errors of
poses and of the light are common to all of them.  The selected lights maximise

    Σ_{m,d} log(1 + Σ_k s_kmd)                                                                                       (1)

by greedy selection, which reaches at least 1 − 1/e of the maximum (Nemhauser, Wolsey and Fisher 1978).  The lights of
all other photos are fitted one by one, given the materials (`factorlib.inference.held_out_photos`).
"""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.inference.surface.aligned_photo import AlignedPhoto
from factorlib.urm.observations import Observations

SATURATED = 100  # observations from one side that tell half of what any number tells
SIDES = fibonacci_sphere(12)  # about 60° apart
DIGITS = 9  # of (1); rounding errors must not decide between lights that tell the same
Counts = Counter[tuple[str, str, int]]  # number of observations by mesh, material and side


def count_by_side(photo: AlignedPhoto, observations: Observations) -> Counts:
    """Count the observations of a photo by mesh, material and the side of the mesh that faces the camera."""
    entries = photo.objects.objects
    rotations = np.array([photo.poses.objects[entry.name].rotation for entry in entries])
    number = np.zeros(len(observations), int) if observations.object is None else observations.object - 1
    toward_camera = np.einsum("nji,nj->ni", rotations[number], observations.view)  # in the mesh's frame
    side = (toward_camera @ SIDES.T).argmax(1)
    rows = zip(number.tolist(), observations.material.tolist(), side.tolist(), strict=True)
    return Counter((entries[k].mesh, observations.materials[m], d) for k, m, d in rows)


def select_lights(counts: Mapping[str, Counts], most: int) -> list[str]:
    """Return the names of at most `most` lights that tell most of the materials, sorted.

    Args:
        counts: Number of observations of each light.
        most: Number of lights to select.
    """
    keys = sorted(set().union(*counts.values()))
    shares = {light: np.array([n[key] / (n[key] + SATURATED) for key in keys]) for light, n in sorted(counts.items())}
    total = np.zeros(len(keys))
    selected: list[str] = []
    while len(selected) < min(most, len(shares)):
        gains = {light: round(float(np.log1p(total + share).sum()), DIGITS) for light, share in shares.items()}
        best = max((light for light in gains if light not in selected), key=gains.__getitem__)
        selected.append(best)
        total = total + shares[best]
    return sorted(selected)
