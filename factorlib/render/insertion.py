"""A further object in a photo: where it stands, and what the photo would show.

Let B be the photo, L₀ and L₁ the path-traced scene of objects and ground without and with the new object, α its coverage.  The ground
and the objects answer the change of light by

    s = L₁ / L₀     (1)

which is exact for a Lambertian surface of any texture, where the difference L₁ − L₀ (Debevec, "Rendering synthetic objects into real
scenes", 1998) needs the texture's own albedo.  With the new object's own radiance L₁ − (1 − α) s L₀,

    composite = (1 − α) s B + max(L₁ − (1 − α) s L₀, 0)     (2)

s under the object is that of the nearest pixel beside it.  L₀ and L₁ take the same random numbers, so s is exactly 1 where no path
meets the object: those pixels stay as they were.  A ground that reflects adds what it shows of the object: the change of its specular part alone.

The ground is a disc about the object, its diffuse reflectance that which makes L₀ look as the photo.  Beyond it nothing is known of what
the photo shows, and shadows fade out toward its rim.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, rotation_of_vector
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply import submesh
from factorlib.render.ground import Plane, height_over
from factorlib.render.photo_scene import ALL_BOUNCES, PhotoScene, Placed, light_entry, shapes
from factorlib.results.materials import Reflectance
from factorlib.tracing.scene import bsdf, rendered, rgb, rigid, sensor, shape, transform

RADIUS, FADE = 8.0, 0.5  # of the disc, in sizes of the object; share of it from which on shadows fade
FIT_SAMPLES = 16
GREY, DARKEST, BRIGHTEST = 0.3, 0.02, 0.85  # diffuse reflectance of the ground: where nothing tells it, and its bounds
GAP = 0.15  # between the objects, in heights of the new one
HAIR = 1e-4  # of a mesh's radius
GROUND = "ground"
NEW = "+"  # what the new object and its materials are called: no name in dataset.yaml has it

Picture = Float[np.ndarray, "h w 3"]


class Spot(msgspec.Struct, frozen=True):
    """Where a new object stands: in the world, on a plane."""

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
        (x, y), width = _pixel(scene.camera, point), scene.camera.width
        taken = [abs(_pixel(scene.camera, each.vertices.mean(axis=0))[0] - x) for each in others]
        return min([x, width - x, scene.camera.height - y, *taken])

    return Spot(plane, max(spots, key=room), height)


def spot_at(scene: PhotoScene, plane: Plane, neighbour: Placed, pixel: tuple[float, float], relative_height: float) -> Spot:
    """Where the photo's `pixel` shows the ground; InputError where it does not."""
    ray = scene.camera.rays_through(np.array([pixel])) @ YUP_FROM_CAMERA
    point = plane.hit(ray)[0]
    if not np.isfinite(point).all():
        raise InputError(f"pixel {pixel} shows no ground: it lies above the horizon", key="at", cure="name a pixel further down")
    return Spot(plane, point, relative_height * height_over(plane, neighbour))


def stood(name: str, mesh: Mesh, materials: tuple[str, ...], up: Float[np.ndarray, "3"], turn_deg: float, spot: Spot) -> Placed:
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


def ball(segments: int = 48) -> Mesh:
    """A sphere of radius 1 of one material."""
    sphere = trimesh.creation.uv_sphere(radius=1.0, count=[segments, 2 * segments])
    vertices = np.asarray(sphere.vertices, dtype=float)
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return Mesh(vertices, np.asarray(sphere.faces, np.int32), normals, np.ones(len(sphere.faces), np.int16))


class Inserted(msgspec.Struct, frozen=True):
    """composite: (2), linear;  coverage: α;  shadow: s of (1);  ground: the diffuse reflectance that was found for it"""

    composite: Picture
    coverage: Float[np.ndarray, "h w"]
    shadow: Picture
    ground: Float[np.ndarray, "3"]


def inserted(
    scene: PhotoScene,
    new: Placed,
    spot: Spot,
    photo: Picture,
    known: Bool[np.ndarray, "h w"],
    samples: int,
    *,
    diffuse: tuple[float, float, float] | None = None,
    gloss: Reflectance | None = None,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> Inserted:
    """The photo with the new object.

    photo: linear radiance, its tone curve undone;  known: pixels that an object of the scene covers (they do not show the ground)
    diffuse: of the ground, where it is known;  gloss: of a ground that reflects, its specular part

    Raises InputError where the new object is not seen.
    """
    total = 4 + (2 if gloss else 0)
    camera = sensor(scene.camera, rigid(YUP_FROM_CAMERA, np.zeros(3)), near=scene.near)
    fixed = {"light": light_entry(scene.light), **shapes(scene.objects, scene.materials)}
    more = shapes([new], scene.materials)
    disc = _disc_pixels(scene.camera, spot)
    if diffuse is None:
        diffuse = _ground_colour(fixed, camera, spot, photo, disc & ~known)
    report(1, total)
    ground = _ground(spot, Reflectance(tuple(diffuse), (0.0,) * 3, 1.0))
    without = rendered({**fixed, **ground}, camera, samples, 1, ALL_BOUNCES, hide_emitters=True)
    report(2, total)
    with_ = rendered({**fixed, **ground, **more}, camera, samples, 1, ALL_BOUNCES, hide_emitters=True)
    report(3, total)
    coverage = _coverage(scene, new, camera, samples)
    if not coverage.any():
        found = "the new object is not seen: it stands outside the picture, or something hides it"
        raise InputError(found, key="at", cure="say where it stands, `at: [x, y]`, or make it smaller")
    report(4, total)
    shadow = _shadow(without, with_, coverage, scene.camera, spot)
    own = np.maximum(with_ - (1 - coverage[..., None]) * shadow * without, 0) * (coverage > 0)[..., None]
    composite = (1 - coverage[..., None]) * shadow * photo + own
    if gloss is not None:
        polished = _ground(spot, gloss)
        before, after = (rendered({**fixed, **polished, **m}, camera, samples, 1, ALL_BOUNCES, hide_emitters=True) for m in ({}, more))
        mirrored = (after - before) * ((disc & ~known) * (1 - coverage) * _fading(scene.camera, spot))[..., None]
        composite = np.maximum(composite + mirrored, 0)
        report(total, total)
    return Inserted(composite, coverage, shadow, np.asarray(diffuse))


def _ground_colour(fixed: dict[str, Any], camera: dict[str, Any], spot: Spot, photo: Picture, where: Bool[np.ndarray, "h w"]) -> tuple[float, float, float]:
    """The diffuse reflectance that makes the ground look as in the photo: the median over what shows it."""
    lit = rendered({**fixed, **_ground(spot, Reflectance((GREY,) * 3, (0.0,) * 3, 1.0))}, camera, FIT_SAMPLES, 1, ALL_BOUNCES, hide_emitters=True)
    usable = where & (lit.min(axis=-1) > 0)
    if not usable.any():
        return (GREY,) * 3
    found = GREY * np.median(photo[usable] / lit[usable], axis=0)
    return tuple(float(c) for c in np.clip(found, DARKEST, BRIGHTEST))


def _ground(spot: Spot, material: Reflectance) -> dict[str, Any]:
    """A disc about the spot."""
    frame = np.eye(4)
    frame[:3, :3] = RADIUS * spot.height * _rotation_between(np.array([0.0, 0.0, 1.0]), spot.plane.normal)
    frame[:3, 3] = spot.point - 1e-4 * spot.height * spot.plane.normal
    return {GROUND: {"type": "disk", "to_world": transform(frame), "bsdf": bsdf(material)}}


def _coverage(scene: PhotoScene, new: Placed, camera: dict[str, Any], samples: int) -> Float[np.ndarray, "h w"]:
    """The new object shines with radiance 1, all else is black: what is seen is its share of each pixel."""
    glowing = {f"{new.name}_{label}_{side}": _emitter(new, label, side) for label in new.mesh.labels for side in range(1 + new.mesh.open)}
    black = shapes(scene.objects, scene.materials, black=[each.name for each in scene.objects])
    picture = rendered({**black, **glowing}, camera, samples, 1, 1)
    return np.clip(picture[..., 0], 0, 1)


def _emitter(new: Placed, label: int, side: int) -> Any:
    """Lights shine on the side of their normals alone: an open mesh has another, turned round and a hair behind."""
    part = submesh(new.mesh, label)
    if side:
        behind = part.vertices - HAIR * new.mesh.radius * part.normals
        part = Mesh(behind, part.faces[:, ::-1].copy(), -part.normals, part.face_label, True)
    return shape(part, {"type": "diffuse", "reflectance": rgb(0.0)}, new.world_from_object, {"type": "area", "radiance": rgb(1.0)})


def _shadow(without: Picture, with_: Picture, coverage: Float[np.ndarray, "h w"], camera: Camera, spot: Spot) -> Picture:
    """(1), that of the nearest pixel beside the object for those under it; 1 where nothing is lit, and toward the rim of the disc."""
    beside = coverage == 0
    with np.errstate(divide="ignore", invalid="ignore"):
        shadow = np.where(without > 0, with_ / without, 1.0)
    if beside.any():
        row, column = distance_transform_edt(~beside, return_distances=False, return_indices=True)
        shadow = shadow[row, column]
    return 1 + (shadow - 1) * _fading(camera, spot)[..., None]


def _fading(camera: Camera, spot: Spot) -> Float[np.ndarray, "h w"]:
    """1 near the spot, falling smoothly to 0 at the rim of the disc; 1 where the ground is not seen, as on the objects."""
    distance = np.linalg.norm(_ground_points(camera, spot) - spot.point, axis=-1) / (RADIUS * spot.height)
    t = np.clip((1 - np.nan_to_num(distance, nan=0.0)) / (1 - FADE), 0, 1)
    return t * t * (3 - 2 * t)


def _disc_pixels(camera: Camera, spot: Spot) -> Bool[np.ndarray, "h w"]:
    distance = np.linalg.norm(_ground_points(camera, spot) - spot.point, axis=-1)
    return np.nan_to_num(distance, nan=np.inf) < RADIUS * spot.height


def _ground_points(camera: Camera, spot: Spot) -> Float[np.ndarray, "h w 3"]:
    rays = camera.rays() @ YUP_FROM_CAMERA
    return spot.plane.hit(rays.reshape(-1, 3)).reshape(rays.shape)


def _pixel(camera: Camera, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2"]:
    return camera.project(point @ YUP_FROM_CAMERA)


def _rotation_between(first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest turn of one unit vector into another."""
    axis, cosine = np.cross(first, second), float(first @ second)
    if np.linalg.norm(axis) < 1e-9:
        if cosine > 0:
            return np.eye(3)
        other = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
        return rotation_of_vector(np.pi * other / np.linalg.norm(other))
    return rotation_of_vector(np.arctan2(np.linalg.norm(axis), cosine) * axis / np.linalg.norm(axis))
