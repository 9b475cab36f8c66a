"""Balls, boxes and cylinders, their proportions fitted to outlines.

A ball has none.  A box has two, a cylinder (about y) one: the factors of its axes that `shapes.proportions` fits, with the poses of all
photos, to the outlines.  The descent begins from several shapes, each laid on the `PHOTOS` photos that show most; the shape that overlaps most is kept.
"""

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
import trimesh
from jaxtyping import Float

from factorlib.align.search import Search, find
from factorlib.align.target import target_of
from factorlib.geometry.raster import Caster
from factorlib.shapes.outline import Outline, Triangles
from factorlib.shapes.proportions import BOX, ROUND, Sighting, fitted

BEGUN = {
    "box": ((1, 1, 1), (1, 0.5, 1), (1, 2, 1), (1, 0.25, 0.5), (1, 0.1, 1), (1, 0.2, 0.8)),
    "cylinder": ((1, 0.3, 1), (1, 1, 1), (1, 3, 1)),
}
FREE_FACTORS = {"box": BOX, "cylinder": ROUND}
PHOTOS = 6
STEPS = 20
RESOLUTION = 200
SEARCH = Search(views=150, keep=(20, 8, 4, 2))


def primitive(
    kind: str, outlines: Sequence[Outline], report: Callable[[float], None] = lambda share: None
) -> Triangles:
    """The shape of unit size.  kind: ball, box or cylinder;  outlines: one at least, which all show some of it"""
    outlines = sorted(outlines, key=lambda one: -int((one.part > 0).sum()))[:PHOTOS]
    best: tuple[float, Float[np.ndarray, "3"]] = -1.0, np.ones(3)
    for done, begun in enumerate(starts := BEGUN.get(kind, ((1, 1, 1),))):
        report(done / len(starts))
        mesh = unit(kind, np.array(begun, float)).as_mesh()
        sightings = []
        for one in outlines:
            state = find(Caster(mesh), one.silhouette, one.camera, one.prior, SEARCH).state
            target = target_of(one.silhouette, (1,), RESOLUTION)
            sightings.append(Sighting(mesh, target, one.camera, one.prior, state))
        factors, _, score = fitted(sightings, STEPS, FREE_FACTORS.get(kind, np.zeros((3, 0))))
        if score > best[0]:
            best = score, factors * begun
    return msgspec.structs.replace(unit(kind, best[1]).of_size(1.0), overlap=best[0])


def unit(kind: str, factors: Float[np.ndarray, "3"]) -> Triangles:
    """A shape whose axes are as `factors`."""
    if kind == "ball":
        made = trimesh.creation.icosphere(subdivisions=5)
    elif kind == "box":
        made = trimesh.creation.box((1.0, 1.0, 1.0))
    else:
        made = trimesh.creation.cylinder(radius=0.5, height=1.0, sections=128)
        made.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    return Triangles(np.asarray(made.vertices) * factors, np.asarray(made.faces))
