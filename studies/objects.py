"""Cases of objects: bodies without symmetry, each turned at random before a camera far away.

The solve may be given another pose or mesh than the true one.

The camera is so far that rays are parallel to a third of a degree at most: radiance is of one view direction, by the
quadrature that spheres have.  Neither shadows nor light between surfaces are rendered, so that wrong geometry is the
only source of errors.

Pixels     covered by both the true body and the one of the perturbed pose and mesh, as the stage `urm` takes them
Noise      of each pixel by itself: a perturbation does not change it
Normals    of the given mesh at the given pose: perturbed, or fitted to the outline from there
"""

from collections.abc import Mapping
from functools import cache

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from factorlib.align.refine import pose_state, refine
from factorlib.align.reliability import confidence
from factorlib.align.silhouette import ObjectView, Silhouette, make_target
from factorlib.conventions import FRONT, YUP_FROM_CAMERA
from factorlib.evaluate.ball import OctahedralLight, ball
from factorlib.geometry.camera import Camera, Pose, rotation_of_vector
from factorlib.geometry.raster import Caster, rasterise
from factorlib.meshes.mesh import scale_mesh
from factorlib.results.materials import Reflectance
from factorlib.scenes import bodies
from factorlib.scenes.joint_problems import observations_from_front
from factorlib.urm.observations import Observations, concatenate
from studies.spheres import GRAZING
from studies.study import Case, Objects, light_name

BODIES = ("blob", "jug", "hook")
SIDE = 160  # pixels of a picture
FILL = 0.9  # share of it that the mesh's diameter takes
FAR = 100.0  # focal length over the picture's side
CAMERA = Camera(SIDE, SIDE, FAR * SIDE, (SIDE / 2, SIDE / 2))


@cache
def body(name: str, triangles: int | None = None) -> Caster:
    """Return a body of one material, or a mesh of few triangles that stands for it."""
    parts = [(vertices, faces, 1) for vertices, faces, _ in bodies.SHAPES[name]()]
    if triangles is not None:
        total = sum(len(faces) for _, faces, _ in parts)
        parts = [bodies.decimate(part, max(round(triangles * len(part[1]) / total), 8)) for part in parts]
    return Caster(bodies.mesh_from_parts(parts, name))


def observe_objects(
    case: Case, materials: Mapping[str, Reflectance], lights: Mapping[int, OctahedralLight]
) -> tuple[dict[str, Observations], float]:
    """Return one photo a light, by name, and the mean error of the given normals, degrees.

    An entry's row y is its number in the photo.  The error of an entry is the median angle to the true normals.
    """
    table = list(materials.values())
    photos = {}
    errors = []
    for li in case.lights:
        parts = [_entry(case, m, li, table[m], lights[li]) for m, light in case.entries if light == li]
        y = np.repeat(np.arange(len(parts)), [len(part) for part, _ in parts])
        photos[light_name(li)] = msgspec.structs.replace(concatenate([part for part, _ in parts]), y=y)
        errors += [error for _, error in parts]
    return photos, float(np.mean(errors))


def _entry(case: Case, m: int, li: int, material: Reflectance, light: OctahedralLight) -> tuple[Observations, float]:
    rng = np.random.default_rng([14, case.seed, m, li])
    name = BODIES[(m + li) % len(BODIES)]
    # the body's middle in the middle of the picture, which it fills
    true_mesh = body(name)
    rotation = Rotation.random(rng=rng).as_matrix()
    middle = np.array([0.0, 0.0, 2 * CAMERA.focal * true_mesh.radius / (FILL * SIDE)])
    true_pose = Pose(rotation, middle - rotation @ true_mesh.centre)
    true_maps = rasterise(true_mesh, CAMERA, true_pose)
    # the mesh, the pose and the confidence that the solve gets
    mesh, pose = perturb_pose(name, true_pose, case.objects, rng)
    outline = Silhouette(true_maps.label.astype(np.int16))
    maps = rasterise(mesh, CAMERA, fit_outline(mesh, pose, outline) if case.objects.refined else pose)
    weights = confidence(maps, outline)
    covered = (true_maps.label > 0) & (maps.label > 0) & (weights > 0) & (maps.normal @ FRONT > GRAZING)
    pixels = np.sort(rng.permutation(np.flatnonzero(covered.reshape(-1)))[: case.objects.pixels])
    true, normals = (each.normal.reshape(-1, 3)[pixels] for each in (true_maps, maps))
    noise = np.random.default_rng([13, case.seed, li, m, 0]).standard_normal((maps.label.size, 3))[pixels]
    radiance = ball(light, material, true @ YUP_FROM_CAMERA.T) * (1 + case.noise * noise)
    labels = np.full(len(pixels), case.materials.index(m))
    weight = weights.reshape(-1)[pixels]
    columns = {"x": pixels, "y": np.zeros(len(pixels), int), "weight": weight, "confidence": weight}
    names = tuple(case.material_names)
    photo = observations_from_front(normals, radiance, labels, names, light_name(li), **columns)
    return photo, angle_deg(true, normals)


def perturb_pose(name: str, truth: Pose, errors: Objects, rng: np.random.Generator) -> tuple[Caster, Pose]:
    """Return the mesh and the pose that stand for a body whose true pose is `truth`."""
    true_mesh = body(name)
    mesh = body(name, errors.triangles)
    if errors.larger:
        mesh = Caster(scale_mesh(mesh.mesh, (1 + errors.larger,) * 3))
    axis, side = (v / np.linalg.norm(v) for v in (rng.normal(size=3), np.append(rng.normal(size=2), 0.0)))
    rotation = rotation_of_vector(np.radians(errors.turned_deg) * axis) @ truth.rotation
    middle = truth.rotation @ true_mesh.centre + truth.translation + errors.shifted * 2 * true_mesh.radius * side
    return mesh, Pose(rotation, middle - rotation @ (true_mesh.centre * (1 + errors.larger)))


def fit_outline(mesh: Caster, pose: Pose, outline: Silhouette) -> Pose:
    """Return the pose nearby whose contours lie on those of the mask, as the stage `align` ends a search."""
    target = make_target(ObjectView(outline, CAMERA), mesh.mesh.labels, 200, 0.1)
    return refine(mesh, target, pose_state(pose, CAMERA, mesh), 12).state.pose(mesh)


def angle_deg(first: Float[np.ndarray, "n 3"], second: Float[np.ndarray, "n 3"]) -> float:
    """Return the median angle between unit vectors, degrees; 180 of none."""
    cosine = np.clip(np.sum(first * second, axis=1), -1, 1)
    return float(np.degrees(np.median(np.arccos(cosine)))) if len(cosine) else 180.0
