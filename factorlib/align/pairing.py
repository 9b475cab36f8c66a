"""Which part of a mesh shows which label, by laying the mesh on the masks under every pairing.

In one sighting of an object every label that is seen is that of a part, and a part has one label or is not seen (HIDDEN).  A pairing costs the wrong pixels of the
best view under it, as a share of the mask's.  Over all sightings a label is that of one part (which differs from mesh to mesh, not from
photo to photo), so that sightings in which pairings look alike learn from those in which they do not.
"""

from collections.abc import Sequence
from itertools import product

import msgspec
import numpy as np

from factorlib.align.coarse import guesses_of
from factorlib.align.silhouette import Silhouette
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster
from factorlib.meshes.mesh import Mesh

VIEWS, ROLLS = 60, 18
SEEN = 0.02  # of an object's pixels: a label with fewer is a slip of the brush
MOST_PAIRINGS, MOST_ROLES = 24, 5000  # of a sighting, each of which takes .1 s;  of all labels
HIDDEN = 0
FOCAL = 1.2  # of a photo's longer side: a phone's; the outline changes little with it


class Paired(msgspec.Struct, frozen=True):
    """The label of each part in one sighting, the most likely first of all that it may have (HIDDEN among them), and by how many wrong pixels, as a share of a
    mask's, all sightings together prefer that label to the next."""

    labels: list[list[int]]
    margins: list[float]


def pair(mesh: Mesh, parts: int, sightings: Sequence[Silhouette]) -> list[Paired | None]:
    """Find for each sighting the labels of the parts; None where it tells nothing: more labels than parts, or too many pairings to try.

    mesh: labelled by part, from 1;  sightings: one object each, labelled as the masks are
    """
    costs = [_costs(mesh, parts, silhouette) for silhouette in sightings]
    labels = sorted({label for cost in costs for pairing in cost for label in pairing} - {HIDDEN})
    if parts ** len(labels) > MOST_ROLES:
        return [None] * len(costs)
    best = [{} for _ in costs]  # of each sighting: (part, its label) -> the least cost of all sightings
    for roles in product(range(parts), repeat=len(labels)):  # the part of each label
        role = dict(zip(labels, roles))
        agreeing = [{p: c for p, c in cost.items() if all(k == HIDDEN or p[role[k]] == k for k in p)} for cost in costs]
        if not all(own or not cost for own, cost in zip(agreeing, costs)):
            continue
        total = sum(min(own.values()) for own in agreeing if own)
        for known, own in zip(best, agreeing):
            for pairing, cost in own.items():
                for key in enumerate(pairing):
                    known[key] = min(known.get(key, np.inf), total - min(own.values()) + cost)
    found = []
    for known in best:
        ranked = [sorted((cost, label) for (p, label), cost in known.items() if p == part) for part in range(parts)]
        margins = [each[1][0] - each[0][0] if len(each) > 1 else np.inf for each in ranked if each]
        found.append(Paired([[label for _, label in each] for each in ranked], margins) if known else None)
    return found


def _costs(mesh: Mesh, parts: int, silhouette: Silhouette) -> dict[tuple[int, ...], float]:
    """The cost of each pairing (the label of every part) of one sighting."""
    counts = np.bincount(silhouette.label[silhouette.inside])
    seen = np.flatnonzero(counts > SEEN * counts.sum()).tolist()
    if not 0 < len(seen) <= parts or (len(seen) + 1) ** parts > MOST_ROLES:
        return {}
    pairings = [each for each in product([HIDDEN, *seen], repeat=parts) if set(each) >= set(seen)]
    if len(pairings) > MOST_PAIRINGS:
        return {}
    if len(pairings) == 1:
        return {pairings[0]: 0.0}
    height, width = silhouette.label.shape
    camera = Camera(width, height, FOCAL * max(height, width), (width / 2, height / 2))
    costs = {}
    for pairing in pairings:
        label = np.array([0, *(k or len(counts) for k in pairing)], np.int16)[mesh.face_label]
        caster = Caster(msgspec.structs.replace(mesh, face_label=label))
        costs[pairing] = min(guess.error for guess in guesses_of(caster, silhouette, camera, VIEWS, ROLLS)[0])
    return costs
