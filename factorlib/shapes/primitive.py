"""Spheres, boxes and cylinders, with proportions fitted to outlines.

A sphere has no free proportion, a box has two, a cylinder (about y) one. They are factors of the axes, which
`shapes.proportions` fits to the outlines together with the poses of all photos. The fit starts from several shapes,
each placed on the `PHOTOS` photos that show most pixels. The shape of the largest overlap is kept.
"""

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
import trimesh
from jaxtyping import Float

from factorlib.align.search import SearchOptions, estimate_pose
from factorlib.align.target import make_target
from factorlib.geometry.raster import Caster
from factorlib.shapes.outline import Outline, Triangles
from factorlib.shapes.proportions import BOX, ROUND, fit_proportions

# initial factors of the axes
STARTS = {
    "box": ((1, 1, 1), (1, 0.5, 1), (1, 2, 1), (1, 0.25, 0.5), (1, 0.1, 1), (1, 0.2, 0.8)),
    "cylinder": ((1, 0.3, 1), (1, 1, 1), (1, 3, 1)),
}
FREE_FACTORS = {"box": BOX, "cylinder": ROUND}
PHOTOS = 6  # greatest number of photos used
STEPS = 20  # Gauss–Newton steps of factors and poses
RESOLUTION = 200  # pixels of the mask's longer side
SEARCH = SearchOptions(views=150, keep=(20, 8, 4, 2))


def primitive(
    kind: str, outlines: Sequence[Outline], report: Callable[[float], None] = lambda share: None
) -> Triangles:
    """Fit a primitive to outlines and return it at unit size.

    Args:
        kind: "ball", "box" or "cylinder".
        outlines: Outlines, at least one, each with some pixel of the object.
        report: Function of the share that is done.

    Returns:
        The mesh with its overlap.
    """
    outlines = sorted(outlines, key=lambda outline: -int((outline.part > 0).sum()))[:PHOTOS]
    targets = [make_target(outline.view, (1,), RESOLUTION) for outline in outlines]
    starts = STARTS.get(kind, ((1, 1, 1),))
    best: tuple[float, Float[np.ndarray, "3"]] = -1.0, np.ones(3)
    for done, start in enumerate(starts):
        report(done / len(starts))
        mesh = unit_shape(kind, np.array(start, float)).as_mesh()
        caster = Caster(mesh)
        states = [estimate_pose(caster, outline.view, SEARCH).state for outline in outlines]
        factors, score = fit_proportions(mesh, targets, states, STEPS, FREE_FACTORS.get(kind, np.zeros((3, 0))))
        if score > best[0]:
            best = score, factors * start
    return msgspec.structs.replace(unit_shape(kind, best[1]).of_size(1.0), overlap=best[0])


def unit_shape(kind: str, factors: Float[np.ndarray, "3"]) -> Triangles:
    """Return the unit shape of a kind, with its axes scaled by `factors`."""
    if kind == "ball":
        solid = trimesh.creation.icosphere(subdivisions=5)
    elif kind == "box":
        solid = trimesh.creation.box((1.0, 1.0, 1.0))
    else:
        solid = trimesh.creation.cylinder(radius=0.5, height=1.0, sections=128)
        solid.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    return Triangles(np.asarray(solid.vertices) * factors, np.asarray(solid.faces))
