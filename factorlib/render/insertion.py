"""A further object in a photo: where it stands, and what the photo would show.

Let B be the photo, L₀ and L₁ the path-traced scene of objects and ground without and with the new object, α its coverage.  The ground
and the objects answer the change of light by

    s = L₁ / L₀     (1)

which is exact for a Lambertian surface of any texture in the light of the scene, where the difference L₁ − L₀ (Debevec, "Rendering synthetic objects into real
scenes", 1998) needs the texture's own albedo.  With the new object's own radiance L₁ − (1 − α) s L₀,

    composite = (1 − α) s B + max(L₁ − (1 − α) s L₀, 0)     (2)

s under the object is that of the nearest pixel beside it.  L₀ and L₁ take the same random numbers, so s is exactly 1 where no path
meets the object: those pixels stay as they were.  A ground that reflects adds what it shows of the object, the change of its specular part
alone; s then also scales what the photo shows of that part, so such a ground is right only where it is mostly diffuse.

The ground is a disc about the object, its diffuse reflectance that which makes L₀ look as the photo.  Beyond it nothing is known of what
the photo shows, and shadows fade out toward its rim.
"""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.export.scene import ALL_BOUNCES
from factorlib.geometry.camera import Camera, rotation_of_vector
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply import submesh
from factorlib.render.ground import Plane, height_over
from factorlib.render.photo_scene import PhotoScene, Placed, light_entry, shapes
from factorlib.results.materials import Reflectance, vec3
from factorlib.tracing.scene import bsdf, rendered, rgb, rigid, sensor, shape, transform

RADIUS, FADE = 8.0, 0.5  # of the disc, in sizes of the object; share of it from which on shadows fade
FIT_SAMPLES = 16
GREY, DARKEST, BRIGHTEST = 0.3, 0.02, 0.85  # diffuse reflectance of the ground: where nothing tells it, and its bounds
GAP = 0.15  # between the objects, in heights of the new one
HAIR = 1e-4  # of an object's size: how far apart surfaces are that must not meet
GROUND, STEPS = "+ground", 5
NEW = "+"  # what the new object and its materials are called: no name in dataset.yaml has it

Picture = Float[np.ndarray, "h w 3"]


class Ground(msgspec.Struct, frozen=True):
    """The plane that things stand on.

    diffuse: its Lambertian reflectance, None where it is not known;  polish: the specular part of a ground that reflects
    """

    plane: Plane
    diffuse: tuple[float, float, float] | None = None
    polish: Reflectance | None = None


class Spot(msgspec.Struct, frozen=True):
    """Where a new object stands on the ground, in the world, and how high it is."""

    plane: Plane
    point: Float[np.ndarray, "3"]
    height: float


def spot_beside(scene: PhotoScene, plane: Plane, neighbour: Placed, relative_height: float, slenderness: float) -> Spot:
    """Beside an object, on the side with more room in the picture.

    relative_height: of the new object, to the neighbour's;  slenderness: its width over its height
    """
    height = relative_height * height_over(plane, neighbour)
    right = np.array([1.0, 0.0, 0.0]) - plane.normal[0] * plane.normal
    right /= np.linalg.norm(right)
    across = neighbour.vertices @ right
    foot = plane.onto(neighbour.vertices.mean(axis=0)[None])[0]
    foot = foot + ((across.min() + across.max()) / 2 - foot @ right) * right
    away = (np.ptp(across) / 2 + (slenderness / 2 + GAP) * height) * right
    spots = [foot + side * away for side in (1.0, -1.0)]
    others = [each for each in scene.objects if each is not neighbour]

    def room(point: Float[np.ndarray, "3"]) -> float:
        """Pixels to the picture's border, or to another object's middle, whichever is less."""
        (x, y), width = scene.camera.project(point @ YUP_FROM_CAMERA), scene.camera.width
        middles = [each.vertices.mean(axis=0) @ YUP_FROM_CAMERA for each in others]
        taken = [abs(scene.camera.project(middle)[0] - x) for middle in middles]
        return min([x, width - x, scene.camera.height - y, *taken])

    return Spot(plane, max(spots, key=room), height)


def spot_at(
    scene: PhotoScene, plane: Plane, neighbour: Placed, pixel: tuple[float, float], relative_height: float
) -> Spot:
    """Where the photo's `pixel` shows the ground; InputError where it does not."""
    ray = scene.camera.rays_through(np.array([pixel])) @ YUP_FROM_CAMERA
    point = plane.hit(ray)[0]
    if not np.isfinite(point).all():
        found = f"pixel {pixel} shows no ground: it lies above the horizon"
        raise InputError(found, key="at", cure="name a pixel further down")
    return Spot(plane, point, relative_height * height_over(plane, neighbour))


def stood(
    name: str, mesh: Mesh, materials: tuple[str, ...], up: Float[np.ndarray, "3"], turn_deg: float, spot: Spot
) -> Placed:
    """A mesh in its own frame, `up` upward there, stood on a spot."""
    toward = _rotation_between(up, spot.plane.normal)
    rotation = rotation_of_vector(np.radians(turn_deg) * spot.plane.normal) @ toward
    vertices = mesh.vertices @ rotation.T
    along = vertices @ spot.plane.normal
    scale = spot.height / np.ptp(along)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    foot = middle + (along.min() - middle @ spot.plane.normal) * spot.plane.normal
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * rotation, spot.point - scale * foot
    return Placed(name, mesh, materials, matrix)


class Inserted(msgspec.Struct, frozen=True):
    """composite: (2), linear;  coverage: α;  shadow: s of (1);  ground: the diffuse reflectance that was found for it"""

    composite: Picture
    coverage: Float[np.ndarray, "h w"]
    shadow: Picture
    ground: Float[np.ndarray, "3"]


def inserted(
    scene: PhotoScene,
    photo: Picture,
    covered: Bool[np.ndarray, "h w"],
    new: Placed,
    spot: Spot,
    ground: Ground,
    samples: int,
    report: Callable[[int], None] = lambda done: None,
) -> Inserted:
    """The photo of the scene with the new object.  Raises InputError where that is not seen.

    photo: linear radiance, its tone curve undone;  covered: pixels that show something else than the ground
    report: how many of STEPS are done
    """
    camera = sensor(scene.camera, rigid(YUP_FROM_CAMERA, np.zeros(3)), near=scene.near)
    there = {"light": light_entry(scene.light), **shapes(scene.objects, scene.materials)}
    more = shapes([new], scene.materials)

    def traced(entries: dict[str, Any], samples: int = samples) -> Picture:
        """With the same random numbers each time."""
        return rendered({**there, **entries}, camera, samples, 1, ALL_BOUNCES, hide_emitters=True)

    distance = _distance(scene.camera, spot)
    # 1 near the spot, falling smoothly to 0 at the rim of the disc; 1 above the horizon, where only objects are seen
    t = np.clip((1 - np.where(np.isinf(distance), 0, distance)) / (1 - FADE), 0, 1)
    near, shows_ground = (t * t * (3 - 2 * t))[..., None], (distance < 1) & ~covered
    coverage = _coverage(scene, new, camera, samples)
    if not coverage.any():
        found = "the new object is not seen: it stands outside the picture, or something hides it"
        raise InputError(found, key="at", cure="say where it stands, `at: [x, y]`, or make it smaller")
    report(1)
    diffuse = ground.diffuse
    if diffuse is None:
        grey = traced(_disc(spot, Reflectance((GREY,) * 3, (0.0,) * 3, 1.0)), FIT_SAMPLES)
        diffuse = _ground_colour(grey, photo, shows_ground)
    report(2)
    disc = _disc(spot, Reflectance(diffuse, (0.0,) * 3, 1.0))
    without = traced(disc)
    report(3)
    with_ = traced({**disc, **more})
    report(4)
    beside = (1 - coverage)[..., None]
    shadow = _shadow(without, with_, coverage, near)
    own = np.maximum(with_ - beside * shadow * without, 0) * (beside < 1)
    composite = beside * shadow * photo + own
    if ground.polish is not None:
        polished = _disc(spot, ground.polish)
        mirrored = traced({**polished, **more}) - traced(polished)
        composite = np.maximum(composite + mirrored * shows_ground[..., None] * beside * near, 0)
    report(STEPS)
    return Inserted(composite, coverage, shadow, np.asarray(diffuse))


def _ground_colour(lit: Picture, photo: Picture, shows_ground: Bool[np.ndarray, "h w"]) -> tuple[float, float, float]:
    """The diffuse reflectance that makes the ground look as in the photo: the median over what shows it.  lit: the scene on GREY ground"""
    usable = shows_ground & (lit.min(axis=-1) > 0)
    if not usable.any():
        return (GREY,) * 3
    found = GREY * np.median(photo[usable] / lit[usable], axis=0)
    return vec3(np.clip(found, DARKEST, BRIGHTEST))


def _disc(spot: Spot, material: Reflectance) -> dict[str, Any]:
    """The ground about the spot."""
    frame = np.eye(4)
    frame[:3, :3] = RADIUS * spot.height * _rotation_between(np.array([0.0, 0.0, 1.0]), spot.plane.normal)
    frame[:3, 3] = spot.point - HAIR * spot.height * spot.plane.normal
    return {GROUND: {"type": "disk", "to_world": transform(frame), "bsdf": bsdf(material)}}


def _coverage(scene: PhotoScene, new: Placed, camera: dict[str, Any], samples: int) -> Float[np.ndarray, "h w"]:
    """The new object shines with radiance 1, all else is black: what is seen is its share of each pixel."""
    sides = [(label, side) for label in new.mesh.labels for side in range(1 + new.mesh.open)]
    glowing = {f"{new.name}_{label}_{side}": _emitter(new, label, side) for label, side in sides}
    black = shapes(scene.objects, scene.materials, black=[each.name for each in scene.objects])
    picture = rendered({**black, **glowing}, camera, samples, 1, 1)
    return np.clip(picture[..., 0], 0, 1)


def _emitter(new: Placed, label: int, side: int) -> Any:
    """Lights shine on the side of their normals alone: an open mesh has another, turned round and a hair behind."""
    part = submesh(new.mesh, label)
    if side:
        behind = part.vertices - HAIR * new.mesh.radius * part.normals
        part = Mesh(behind, part.faces[:, ::-1].copy(), -part.normals, part.face_label, True)
    black, emitter = {"type": "diffuse", "reflectance": rgb(0.0)}, {"type": "area", "radiance": rgb(1.0)}
    return shape(part, black, new.world_from_object, emitter)


def _shadow(
    without: Picture, with_: Picture, coverage: Float[np.ndarray, "h w"], near: Float[np.ndarray, "h w 1"]
) -> Picture:
    """(1), that of the nearest pixel beside the object for those under it; 1 where nothing is lit, and toward the rim of the disc."""
    beside = coverage == 0
    with np.errstate(divide="ignore", invalid="ignore"):
        shadow = np.where(without > 0, with_ / without, 1.0)
    if beside.any():
        row, column = distance_transform_edt(~beside, return_distances=False, return_indices=True)
        shadow = shadow[row, column]
    return 1 + (shadow - 1) * near


def _distance(camera: Camera, spot: Spot) -> Float[np.ndarray, "h w"]:
    """Of the point of the ground behind each pixel from the spot, in radii of the disc; infinite above the horizon."""
    rays = camera.rays() @ YUP_FROM_CAMERA
    points = spot.plane.hit(rays.reshape(-1, 3)).reshape(rays.shape)
    return np.nan_to_num(np.linalg.norm(points - spot.point, axis=-1) / (RADIUS * spot.height), nan=np.inf)


def _rotation_between(first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest turn of one unit vector into another."""
    return Rotation.align_vectors(second[None], first[None])[0].as_matrix()
