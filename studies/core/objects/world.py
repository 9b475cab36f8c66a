"""What a seed stands for: seven materials, and bodies without symmetry, turned at random, before a camera far away.

So far that rays are parallel to a third of a degree at most: radiance is of one view direction, by the quadrature that the spheres have
(`studies.core.world`).  Bodies are convex or not; neither shadows nor light between surfaces are rendered, so that what is measured
is what wrong geometry does and nothing else.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster
from factorlib.meshes.mesh import Mesh
from factorlib.results.materials import Reflectance
from factorlib.tracing.scene import Material
from studies.core import world
from studies.core.case import World
from studies.core.objects.case import SEVEN
from tests.scenes import shapes

FURTHER = (Material((0.34, 0.4, 0.5), (0.15, 0.15, 0.15), 0.45), Material((0.2, 0.13, 0.06), (0.5, 0.34, 0.14), 0.38))
BODIES = ("blob", "jug", "hook")
SIDE, FILL, FAR = (
    160,
    0.9,
    100.0,
)  # pixels of a picture; of it, the mesh's diameter; focal length over the picture's side


def materials_of(seed: int) -> dict[str, Reflectance]:
    """The materials of a world by name."""
    return world.materials_of(seed, dict(zip(SEVEN, (*world.ABOUT.values(), *FURTHER), strict=True)))


def with_one_light_more(worlds: World) -> World:
    """The lights of these worlds: the paper's Docksta set has six."""
    return World(worlds.seeds, worlds.lights + 1, worlds.rows, worlds.spp)


@cache
def body(name: str, triangles: int | None = None) -> Caster:
    """A body of one material, or a mesh of few triangles that stands for it."""
    parts = [(vertices, faces, 1) for vertices, faces, _ in shapes.SHAPES[name]()]
    if triangles is not None:
        total = sum(len(faces) for _, faces, _ in parts)
        parts = [shapes.decimated(part, max(round(triangles * len(part[1]) / total), 8)) for part in parts]
    return Caster(shapes.mesh_of(parts, name))


def body_of(material: int, light: int) -> str:
    """Which body an entry shows."""
    return BODIES[(material + light) % len(BODIES)]


CAMERA = Camera(SIDE, SIDE, FAR * SIDE, (SIDE / 2, SIDE / 2))


def pose_of(mesh: Mesh | Caster, rng: np.random.Generator) -> Pose:
    """Turned at random, its middle in the middle of the picture, which it fills."""
    rotation = Rotation.random(rng=rng).as_matrix()
    middle = np.array([0.0, 0.0, 2 * CAMERA.focal * mesh.radius / (FILL * SIDE)])
    return Pose(rotation, middle - rotation @ mesh.centre)
