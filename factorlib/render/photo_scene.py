"""Path-traced scenes of a photo's objects, camera and light, for the same view, another view, or another light.

World    The photo's camera frame turned y-up: x right, y up, z toward the viewer, camera at the origin.
Light    Infinitely far, given in the photo's camera axes (lobes) or as a lat-long map with its rotation to the world.
Upright  `up` of the scene: that of the dataset's world, in which cameras stand; without one, the camera's own y.
Picture  Linear radiance times coverage, and coverage; shown and written by `TracedPicture`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float, UInt8

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.export.exported_scene import ALL_BOUNCES
from factorlib.geometry.camera import Camera, rotation_of_vector
from factorlib.images.exr import write_exr
from factorlib.images.picture import exposure_of, picture, write_png
from factorlib.light.lobes import Lobes, lobe_energy
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply_stl_off import submesh
from factorlib.results.materials import Reflectance
from factorlib.tracing.scene import (
    NARROWEST,
    Matrix,
    envmap,
    envmap_of_nodes,
    mitsuba_map,
    painted_shape,
    render_denoised,
    render_scene,
    rgb,
    rigid,
    sensor,
    transform,
)

UP = np.array([0.0, 1.0, 0.0])
ACROSS = 640  # pixels across the objects of a cropped picture, where the photo has as many
NEAR = 1e-3  # near clipping distance, in distances of the objects
FAR = 3e3  # distance of suns, in sizes of the scene
LOBE_ROWS = 128  # rows of Mitsuba's map of lobes
MAP_ROWS = 1024  # rows of Mitsuba's map of a lat-long map

LIGHT_SAMPLES = 16  # samples per pixel of the light behind objects, which is smooth
MARGIN = 0.05  # border about the objects in a cropped picture, in longer sides of their box
CAMERA_POSE = rigid(YUP_FROM_CAMERA, np.zeros(3))  # the photo's camera in the world


class LightMap(msgspec.Struct, frozen=True):
    """A lat-long map of distant light, in the layout of `factorlib.conventions`.

    Attributes:
        radiance: linear Rec. 709
        world_from_map: rotation from the map's y-up frame to the world
    """

    radiance: Float[np.ndarray, "h w 3"]
    world_from_map: Float[np.ndarray, "3 3"] = np.eye(3)


DistantLight = Lobes | LightMap


class PlacedMesh(msgspec.Struct, frozen=True):
    """A mesh and its pose in the world.

    Attributes:
        materials: names by label, from 1
        world_from_object: a similarity
    """

    name: str
    mesh: Mesh
    materials: tuple[str, ...]
    world_from_object: Float[np.ndarray, "4 4"]

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The rotation of the similarity, without its scale."""
        rotation = self.world_from_object[:3, :3]
        return rotation / np.cbrt(np.linalg.det(rotation))

    @property
    def vertices(self) -> Float[np.ndarray, "v 3"]:
        """The vertices in the world frame."""
        return self.mesh.vertices @ self.world_from_object[:3, :3].T + self.world_from_object[:3, 3]


class PhotoScene(msgspec.Struct, frozen=True):
    """Camera, objects, light and materials of one photo.

    Attributes:
        max_depth: ALL_BOUNCES or DIRECT, as in the solve
        up: unit upright direction, in the world
    """

    camera: Camera
    objects: tuple[PlacedMesh, ...]
    light: DistantLight
    materials: Mapping[str, Reflectance]
    max_depth: int = ALL_BOUNCES
    up: Float[np.ndarray, "3"] = UP

    @property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """The vertices of all objects, in the world."""
        return np.concatenate([each.vertices for each in self.objects])

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """The centre of the bounding box of all objects."""
        points = self.points
        return (points.min(axis=0) + points.max(axis=0)) / 2

    @property
    def size(self) -> float:
        """The distance from the camera to the middle of the objects."""
        return float(np.linalg.norm(self.middle))

    @property
    def near_clip(self) -> float:
        """The near clipping distance of the camera."""
        return NEAR * self.size


def light_entries(light: DistantLight, size: float) -> dict[str, Any]:
    """Return the light as Mitsuba's `envmap`, with lobes too narrow for one as spheres far beyond the scene.

    `size` is the size of the scene, as in `PhotoScene.size`.
    """
    if not isinstance(light, Lobes):
        emitter = envmap(light.radiance, finer=max(1, MAP_ROWS // len(light.radiance)))
        return {"light": emitter | {"to_world": transform(rigid(light.world_from_map, np.zeros(3)))}}
    # lobes narrower than Mitsuba's lattice can hold become spheres far away
    narrow = light.sharpness * NARROWEST * (np.pi / (LOBE_ROWS - 1)) ** 2 > 1
    entries = {"light": envmap_of_nodes(mitsuba_map(light.take(~narrow), LOBE_ROWS, 2 * LOBE_ROWS))}
    few = light.take(narrow)
    far = FAR * size
    energies = few.weight * lobe_energy(few.sharpness)[:, None]
    radii = 2 / np.sqrt(few.sharpness)  # angular radius of a disc of the lobe's RMS width
    for k, (axis, radius, energy) in enumerate(zip(few.axis @ YUP_FROM_CAMERA, radii, energies, strict=True)):
        emitter = {"type": "area", "radiance": rgb(energy / (2 * np.pi * (1 - np.cos(radius))))}
        place = {"center": (far * axis).tolist(), "radius": float(far * np.sin(radius))}
        entries[f"sun {k}"] = {"type": "sphere", **place, "emitter": emitter}
    return entries


def shapes(objects: Sequence[PlacedMesh], materials: Mapping[str, Reflectance]) -> dict[str, Any]:
    """Return a Mitsuba shape for each material of each object."""
    entries = {}
    for each in objects:
        for label in each.mesh.labels:
            part = submesh(each.mesh, label)
            material = materials[each.materials[label - 1]]
            entries[f"{each.name}_{label}"] = painted_shape(part, material, each.world_from_object)
    return entries


def visible_window(
    points: Float[np.ndarray, "n 3"], camera: Camera, world_from_camera: Float[np.ndarray, "4 4"]
) -> tuple[slice, slice]:
    """Return the rows and columns that show the points, at least one of each; all if a point is behind the camera."""
    size = np.array([camera.width, camera.height])
    low, high = projected_box(points, camera, world_from_camera)
    low = np.clip(np.floor(low), 0, size - 1).astype(int)
    high = np.clip(np.ceil(high), low + 1, size).astype(int)
    columns, rows = (slice(*span) for span in np.stack([low, high], axis=1).tolist())
    return rows, columns


def projected_box(
    points: Float[np.ndarray, "n 3"], camera: Camera, world_from_camera: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the least and largest x and y of the points in pixels, also outside the picture.

    It is the whole picture if a point is behind the camera.
    """
    points = (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    if points[:, 2].min() <= 0:
        return np.zeros(2), np.array([camera.width, camera.height], float)
    pixels = camera.project(points)
    return pixels.min(axis=0), pixels.max(axis=0)


def crop_to_objects(
    scene: PhotoScene,
    across: int | None,
    finest: float,
    poses: Sequence[Float[np.ndarray, "4 4"]] = (CAMERA_POSE,),
    floor: Float[np.ndarray, "n 3"] | None = None,
) -> tuple[PhotoScene, list[float]]:
    """Return the scene with a camera that sees its objects alone, and that crop in pixels of the scene's camera.

    Args:
        scene: the scene
        across: pixels along the longer side of the objects' box; None: `ACROSS`, or fewer where `finest` has fewer
        finest: pixels of the photo's file per pixel of the scene's camera
        poses: poses of the camera, all of which get the same crop
        floor: points about the objects that the crop shows too, as far as the picture of the scene's camera does

    Returns:
        The scene, and the left, top, width and height of its picture.
    """
    boxes = np.array([projected_box(scene.points, scene.camera, pose) for pose in poses])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    longer = float((high - low).max())
    pixel = max(longer / ACROSS, 1 / finest) if across is None else longer / across
    low, high = low - MARGIN * longer, high + MARGIN * longer
    if floor is not None:
        size = np.array([scene.camera.width, scene.camera.height])
        boxes = np.array([projected_box(floor, scene.camera, pose) for pose in poses])
        low = np.minimum(low, boxes[:, 0].min(axis=0).clip(0, size))
        high = np.maximum(high, boxes[:, 1].max(axis=0).clip(0, size))
    width, height = np.ceil((high - low) / pixel).astype(int).tolist()
    left, top = low.tolist()
    camera = scene.camera.window(left, top, pixel, width, height)
    return msgspec.structs.replace(scene, camera=camera), [left, top, pixel * width, pixel * height]


def crop_camera(camera: Camera, rows: slice, columns: slice) -> Camera:
    """Return the camera of some rows and columns of the picture."""
    return camera.window(columns.start, rows.start, 1.0, columns.stop - columns.start, rows.stop - rows.start)


def traced_photo(
    scene: PhotoScene,
    samples: int,
    world_from_camera: Float[np.ndarray, "4 4"] = CAMERA_POSE,
    floor: Mapping[str, Any] = {},
) -> Float[np.ndarray, "h w 4"]:
    """Render the objects by path tracing, denoised; without a floor, only the pixels that can show them.

    Args:
        scene: the scene
        samples: samples per pixel
        world_from_camera: pose of the camera, in OpenCV's axes; by default the photo's own
        floor: further entries of the scene, for Mitsuba

    Returns:
        Linear radiance times coverage, and coverage: the share of a pixel that objects fill.
    """
    entries = {**light_entries(scene.light, scene.size), **shapes(scene.objects, scene.materials), **floor}
    window = visible_window(scene.points, scene.camera, world_from_camera)
    if floor:
        window = slice(0, scene.camera.height), slice(0, scene.camera.width)
    view = sensor(crop_camera(scene.camera, *window), world_from_camera, near_clip=scene.near_clip, alpha=True)
    picture = np.zeros((scene.camera.height, scene.camera.width, 4))
    picture[window] = render_denoised(entries, view, samples, 0, scene.max_depth)
    return picture


def before_light(
    picture: Float[np.ndarray, "h w 4"], scene: PhotoScene, world_from_camera: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "h w 4"]:
    """Return a picture of objects with the scene's light behind them."""
    view = sensor(scene.camera, world_from_camera, near_clip=scene.near_clip)
    light = render_scene(light_entries(scene.light, scene.size), view, LIGHT_SAMPLES, 0, 1)
    uncovered = 1 - picture[..., 3:]
    return np.concatenate([picture[..., :3] + uncovered * light, np.ones_like(uncovered)], axis=-1)


def resize_scene(scene: PhotoScene, width: int | None) -> PhotoScene:
    """Return the scene with a camera of another width in pixels and the same field of view."""
    if width is None:
        return scene
    pixel = scene.camera.width / width
    camera = scene.camera.window(0, 0, pixel, width, max(1, round(scene.camera.height / pixel)))
    return msgspec.structs.replace(scene, camera=camera)


class Orbit(msgspec.Struct, frozen=True):
    """A view from the photo's camera moved about the middle of the objects.

    Attributes:
        azimuth_deg: angle to the right, degrees
        elevation_deg: angle upward, degrees
        zoom: magnification, by a shorter distance
    """

    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    zoom: float = 1.0

    def world_from_camera(self, scene: PhotoScene, up: Float[np.ndarray, "3"] | None = None) -> Matrix:
        """Return the pose of the moved camera; `up` is the unit axis of the azimuth, by default the scene's."""
        up = scene.up if up is None else up
        middle = scene.middle
        right = np.cross(up, -middle)
        right /= np.linalg.norm(right)
        # rotation about the middle; the distance is divided by the zoom
        upward = rotation_of_vector(-np.radians(self.elevation_deg) * right)
        turn = rotation_of_vector(np.radians(self.azimuth_deg) * up) @ upward
        return rigid(turn @ YUP_FROM_CAMERA, middle - turn @ middle / self.zoom)


def rotate_light(light: DistantLight, angle_deg: float, up: Float[np.ndarray, "3"] = UP) -> DistantLight:
    """Return the light turned about an upright axis of the world: about +y, at 90° +z goes to +x."""
    turn = rotation_of_vector(np.radians(angle_deg) * up)
    if isinstance(light, Lobes):
        return light.rotate(YUP_FROM_CAMERA @ turn @ YUP_FROM_CAMERA)
    return msgspec.structs.replace(light, world_from_map=turn @ light.world_from_map)


Radiance = Float[np.ndarray, "h w 3"]
Tone = Callable[[Radiance], Radiance]


def identity_tone(radiance: Radiance) -> Radiance:
    """Return the radiance unchanged: the tone curve of a photo that has none."""
    return radiance


class TracedPicture(msgspec.Struct, frozen=True):
    """A path-traced picture.

    Attributes:
        pixels: linear Rec. 709 radiance times coverage, and coverage, the share of a pixel that is filled
        tone: tone curve of the photo
    """

    pixels: Float[np.ndarray, "h w 4"]
    tone: Tone = identity_tone

    @property
    def coverage(self) -> Float[np.ndarray, "h w 1"]:
        """The share of each pixel that is covered, in [0, 1]."""
        return np.clip(self.pixels[..., 3:], 0, 1)

    @property
    def display_radiance(self) -> Radiance:
        """The radiance after the tone curve, with coverage divided out."""
        share = self.pixels[..., 3:]
        return self.tone(self.pixels[..., :3] / np.where(share > 0, share, 1))

    @property
    def exposure(self) -> float:
        """The display exposure for the covered pixels."""
        return exposure_of(self.display_radiance, self.pixels[..., 3] > 0.5)

    def with_exposure(self, exposure: float | None = None) -> TracedPicture:
        """Return the picture times an exposure, by default its own, without a tone curve."""
        exposure = self.exposure if exposure is None else exposure
        return TracedPicture(self.pixels * np.array([exposure] * 3 + [1.0]))

    def composite_over(self, photo: Radiance) -> Radiance:
        """Composite the picture, after its tone curve, over a photo."""
        return (1 - self.coverage) * photo + self.coverage * self.display_radiance

    def rgba(self, exposure: float = 1.0) -> UInt8[np.ndarray, "h w 4"]:
        """Return 8-bit sRGB with coverage as alpha."""
        return np.concatenate(
            [picture(self.display_radiance, exposure), np.rint(255 * self.coverage).astype(np.uint8)], axis=-1
        )

    def to_exr(self, path: str | Path) -> None:
        """Write linear radiance times coverage, and coverage as channel A."""
        write_exr(path, {channel: self.pixels[..., k] for k, channel in enumerate("RGBA")})

    def to_png(self, path: str | Path, exposure: float = 1.0) -> None:
        """Write `rgba` as a PNG; exposure 1 is the photo's."""
        write_png(path, self.rgba(exposure))
