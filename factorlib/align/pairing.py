"""Pairing of mesh parts with labels of masks, by laying the mesh on the masks under every pairing.

In one observation of an object every visible label belongs to a part, and a part has one label or is not visible
(HIDDEN). The cost of a pairing is the number of wrong pixels of its best view, as a share of the mask's. Over all
observations a label belongs to one part, which differs from mesh to mesh, not from photo to photo. So observations in
which several pairings look alike are decided by the others.
"""

from collections.abc import Sequence
from itertools import product

import msgspec
import numpy as np

from factorlib.align.coarse import match_templates
from factorlib.align.silhouette import ObjectView, Silhouette
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster
from factorlib.meshes.mesh import Mesh

VIEWS = 60  # directions of view per pairing
ROLLS = 18  # rotations of the photo per view
LEAST_SHARE = 0.02  # share of an object's pixels: a label with fewer is a slip of the brush
MOST_PAIRINGS = 24  # pairings of one observation; each takes 0.1 s
MOST_ROLES = 5000  # assignments of all labels to parts
HIDDEN = 0  # label of a part that is not visible
FOCAL = 1.2  # focal length of a phone in units of the photo's longer side; the outline changes little with it


class PartLabels(msgspec.Struct, frozen=True):
    """Labels of each part in one observation, and the margins of the decision.

    labels    every label that a part may have, HIDDEN among them, most likely first
    margins   cost over all observations of the second label less that of the first, as a share of a mask's pixels
    """

    labels: list[list[int]]
    margins: list[float]


def match_parts(mesh: Mesh, parts: int, silhouettes: Sequence[Silhouette]) -> list[PartLabels | None]:
    """Find the labels of the parts in each observation.

    Args:
        mesh: The mesh, labelled by part, from 1.
        parts: Number of parts.
        silhouettes: Masks of one object each, labelled as the masks are.

    Returns:
        Labels for each observation; None where it has more labels than parts, or where there are too many pairings to
        try.
    """
    costs = [_costs(mesh, parts, silhouette) for silhouette in silhouettes]
    labels = sorted({label for cost in costs for pairing in cost for label in pairing} - {HIDDEN})
    if parts ** len(labels) > MOST_ROLES:
        return [None] * len(costs)
    # for each observation: (part, its label) -> least total cost over all observations
    best: list[dict[tuple[int, int], float]] = [{} for _ in costs]
    # for every assignment of labels to parts: the least total cost, for each pairing of each observation that agrees
    for roles in product(range(parts), repeat=len(labels)):
        role = dict(zip(labels, roles))
        agreeing = [{p: c for p, c in cost.items() if all(k == HIDDEN or p[role[k]] == k for k in p)} for cost in costs]
        if not all(allowed or not cost for allowed, cost in zip(agreeing, costs)):
            continue
        total = sum(min(allowed.values()) for allowed in agreeing if allowed)
        for least, allowed in zip(best, agreeing):
            for pairing, cost in allowed.items():
                for key in enumerate(pairing):
                    least[key] = min(least.get(key, np.inf), total - min(allowed.values()) + cost)
    # rank the labels of each part by cost
    results = []
    for least in best:
        ranked = [sorted((cost, label) for (p, label), cost in least.items() if p == part) for part in range(parts)]
        margins = [each[1][0] - each[0][0] if len(each) > 1 else np.inf for each in ranked if each]
        results.append(PartLabels([[label for _, label in each] for each in ranked], margins) if least else None)
    return results


def _costs(mesh: Mesh, parts: int, silhouette: Silhouette) -> dict[tuple[int, ...], float]:
    """Return the cost of each pairing (a tuple with the label of every part) of one observation."""
    counts = np.bincount(silhouette.label[silhouette.inside])
    visible = np.flatnonzero(counts > LEAST_SHARE * counts.sum()).tolist()
    if not 0 < len(visible) <= parts or (len(visible) + 1) ** parts > MOST_ROLES:
        return {}
    pairings = [each for each in product([HIDDEN, *visible], repeat=parts) if set(each) >= set(visible)]
    if len(pairings) > MOST_PAIRINGS:
        return {}
    if len(pairings) == 1:
        return {pairings[0]: 0.0}
    height, width = silhouette.label.shape
    view = ObjectView(silhouette, Camera(width, height, FOCAL * max(height, width), (width / 2, height / 2)))
    costs = {}
    for pairing in pairings:
        label = np.array([0, *(k or len(counts) for k in pairing)], np.int16)[mesh.face_label]
        caster = Caster(msgspec.structs.replace(mesh, face_label=label))
        costs[pairing] = min(match.error for match in match_templates(caster, view, VIEWS, ROLLS)[0])
    return costs
