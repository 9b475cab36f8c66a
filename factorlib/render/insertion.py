"""Insertion of an object into a photo.

B is the photo.  L₀ and L₁ are the path-traced scene of objects and ground without and with the new object.  α is the
coverage of the new object.  The ground and the objects answer the change of light by the factor

    s = L₁ / L₀     (1)

The factor is exact for a Lambertian surface of any texture in the light of the scene.  The difference L₁ − L₀ (Debevec,
"Rendering synthetic objects into real scenes", 1998) would need the texture's albedo.  The new object's own radiance is
L₁ − (1 − α) s L₀, so

    composite = (1 − α) s B + max(L₁ − (1 − α) s L₀, 0)     (2)

Under the object, s is that of the nearest pixel beside it.  L₀ and L₁ use the same random numbers, so s is exactly 1 if
no path meets the object, and the pixel stays unchanged.

The photo's own shadow is compared with the predicted one on the ground near its objects.  The measure is the
correlation of log luminance of B with that of L₀ over these pixels.  On a plane in light from infinity, L₀ is
proportional to the share of irradiance that the objects leave.  Its null is the correlation of wrong predictions: those
of a constant light, which shape alone gives, and of the recovered light turned about the upright axis.  The shadow is
believed if no turned light predicts the photo as well, and if the constant one does worse by the standard deviation
over the turns, which is what a direction at random changes.

The ground is a disc about the object.  Its diffuse reflectance is the one at which L₀ matches the photo.  Shadows fade
out toward the rim of the disc, beyond which the geometry of the scene is unknown.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion, distance_transform_edt, median_filter

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.export.exported_scene import ALL_BOUNCES
from factorlib.geometry.camera import Camera
from factorlib.geometry.ground import Plane
from factorlib.meshes.mesh import without_paint
from factorlib.render.ground import disk, height_over, smooth_step
from factorlib.render.photo_scene import (
    CAMERA_POSE,
    PhotoScene,
    PlacedMesh,
    crop_camera,
    light_entries,
    rotate_light,
    shapes,
    visible_window,
)
from factorlib.render.placement import RADIUS, Spot
from factorlib.results.materials import Reflectance, vec3
from factorlib.tracing.scene import GUIDE_SAMPLES, denoise_picture, render_guides, render_scene, rgb, sensor

FADE = 0.5  # outer share of the disc's radius in which shadows fade
PREVIEW = 160  # columns of a preview, which tells the ground's colour and the reach of the new object
PREVIEW_SAMPLES = 64
LEAST_CHANGE = 0.01  # relative change of radiance that counts as reached: half a step of 8-bit sRGB
GREY = 0.3  # default diffuse reflectance of the ground
DARKEST = 0.02  # least diffuse reflectance of the ground
BRIGHTEST = 0.85  # largest diffuse reflectance of the ground
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # weights of linear Rec. 709
HAIR = 1e-4  # separation of surfaces that must not touch, in object sizes
NEAR = 2.0  # radius in which shadows are compared, in object heights
RIM = 2  # pixels beside the masks that the comparison of shadows leaves out
FEWEST = 100  # least number of pixels for a comparison of shadows
# Turns of the light whose predictions are the null, in degrees.  A direction that is off by less than half a step may
# still be believed.
TURNS = tuple(range(45, 360, 45))
GROUND = "+ground"
BLACK = Reflectance((0.0,) * 3, (0.0,) * 3, 1.0)
WHITE = Reflectance((1.0,) * 3, (0.0,) * 3, 1.0)
NEW = "+"  # prefix of the new object and its materials: no name in dataset.yaml has it

Picture = Float[np.ndarray, "h w 3"]


class GroundSurface(msgspec.Struct, frozen=True):
    """The plane that objects stand on, and its reflectance.

    Attributes:
        diffuse: Lambertian reflectance, None if it is unknown
        source: how the plane was decided, after "the ground is"
    """

    plane: Plane
    diffuse: tuple[float, float, float] | None = None
    source: str = "given"


class InsertionScene(msgspec.Struct, frozen=True, dict=True):
    """A photo's scene with the new object in place; its materials include the new object's.

    Every rendering of it has the same random numbers for the same seed.

    Attributes:
        ground: the ground under the new object
        requested: the requested place
        spot: the actual place
        moved: a sentence that says why the two differ, or an empty string
    """

    scene: PhotoScene
    ground: GroundSurface
    new: PlacedMesh
    requested: Spot
    spot: Spot
    moved: str

    @cached_property
    def ground_points(self) -> Float[np.ndarray, "h w 3"]:
        """The point of the ground that each pixel shows, in the world; NaN above the horizon."""
        rays = self.scene.camera.rays() @ YUP_FROM_CAMERA
        return self.spot.plane.hit(rays.reshape(-1, 3)).reshape(rays.shape)

    @cached_property
    def distance(self) -> Float[np.ndarray, "h w"]:
        """The distance of each pixel's point of the ground from the spot, in radii of the disc; infinite above it."""
        distance = np.linalg.norm(self.ground_points - self.spot.point, axis=-1) / (RADIUS * self.spot.height)
        return np.nan_to_num(distance, nan=np.inf)

    @cached_property
    def entries(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The photo's light and its objects, for Mitsuba."""
        scene = self.scene
        return light_entries(scene.light, scene.size), shapes(scene.objects, scene.materials)

    @property
    def fade(self) -> Float[np.ndarray, "h w 1"]:
        """The weight of the shadow: 1 near the spot and above the horizon, and smoothly 0 at the rim of the disc."""
        return smooth_step((1 - np.where(np.isinf(self.distance), 0, self.distance)) / (1 - FADE))[..., None]

    @property
    def preview_camera(self) -> tuple[Camera, tuple[slice, slice]]:
        """The camera of previews, and the rows and columns of the photo at the middles of its pixels."""
        camera = self.scene.camera
        pixel = max(1, camera.width // PREVIEW)
        height = camera.height // pixel
        width = camera.width // pixel
        middles = slice(pixel // 2, pixel * height, pixel), slice(pixel // 2, pixel * width, pixel)
        return camera.window(0, 0, pixel, width, height), middles

    def disc(self, material: Reflectance) -> dict[str, Any]:
        """Return the ground about the spot as a Mitsuba disk."""
        normal = self.spot.plane.normal
        centre = self.spot.point - HAIR * self.spot.height * normal
        return {GROUND: disk(centre, normal, RADIUS * self.spot.height, material)}

    def view(self, camera: Camera) -> dict[str, Any]:
        """Return a camera at the photo's place, for Mitsuba."""
        return sensor(camera, CAMERA_POSE, near_clip=self.scene.near_clip, alpha=True)

    def render(
        self, entries: dict[str, Any], camera: Camera, samples: int, seed: int, light: dict[str, Any] | None = None
    ) -> Float[np.ndarray, "h w 4"]:
        """Render the photo's objects with further entries.

        Args:
            entries: Mitsuba objects by name
            camera: a camera at the photo's place
            samples: samples per pixel
            seed: seed of the random numbers
            light: replaces the photo's light
        """
        photo_light, objects = self.entries
        scene = (light or photo_light) | objects | entries
        return render_scene(scene, self.view(camera), samples, seed, ALL_BOUNCES, hide_emitters=True)

    def guides(self, entries: dict[str, Any], camera: Camera, seed: int) -> Float[np.ndarray, "h w 10"]:
        """Render guides of the denoiser; arguments as for `render`."""
        return render_guides(self.entries[1] | entries, self.view(camera), GUIDE_SAMPLES, seed)

    def preview(self, entries: dict[str, Any], seed: int = 1, light: dict[str, Any] | None = None) -> Picture:
        """Render a preview of the photo's objects with further entries; arguments as for `render`."""
        return self.render(entries, self.preview_camera[0], PREVIEW_SAMPLES, seed, light)[..., :3]


class ShadowMatch(msgspec.Struct, frozen=True):
    """Correlation of log luminance between photo and prediction on the ground near the photo's objects.

    Attributes:
        correlation: for the recovered light; None if there are too few pixels
        constant_light: for a constant light, the prediction from shape alone; None if there are too few pixels
        pixels: the number of pixels compared
        turned_lights: for the recovered light turned about the upright axis by each of TURNS
    """

    correlation: float | None
    constant_light: float | None
    pixels: int
    turned_lights: list[float] = []

    @property
    def needed(self) -> float:
        """Correlation above which the shadow is believed: the best turned light's, and the constant one's and 1 σ."""
        assert self.constant_light is not None  # pixels were compared
        return max(*self.turned_lights, self.constant_light + float(np.std(self.turned_lights)))

    @property
    def doubtful(self) -> bool:
        """True if wrong lights predict the photo's shading of the ground as well."""
        return self.correlation is not None and self.correlation <= self.needed

    def __str__(self) -> str:
        if self.correlation is None:
            return (
                "Shadows were not compared: too little of the ground near the photo's objects is visible "
                f"({self.pixels} pixels)."
            )
        light = f"{self.correlation:.2f}"
        shape = f"{self.constant_light:.2f}"
        turned = f"{max(self.turned_lights):.2f}"
        words = (
            f"The photo's shading of the ground correlates with the predicted one by {light}; "
            f"with that of a constant light by {shape}, and with that of turned lights by {turned} at most."
        )
        return f"{words} So do not trust the shadow, which needed {self.needed:.2f}." if self.doubtful else words


class InsertionResult(msgspec.Struct, frozen=True):
    """A photo with the new object.

    Attributes:
        composite: (2), linear radiance; the photo itself outside the reach of the object
        coverage: α
        shadow: s of (1)
        ground: diffuse reflectance used for the ground
        without: preview of L₀
    """

    composite: Picture
    coverage: Float[np.ndarray, "h w"]
    shadow: Picture
    ground: Float[np.ndarray, "3"]
    without: Picture


def insert_object(
    insertion: InsertionScene, photo: Picture, covered: Bool[np.ndarray, "h w"], samples: int, seed: int = 1
) -> InsertionResult:
    """Return the photo with the new object.

    Args:
        insertion: the scene and the new object's place
        photo: linear radiance, with the tone curve undone
        covered: pixels that show something other than the ground
        samples: samples per pixel
        seed: seed of the random numbers, which all renderings share

    Raises:
        InputError: The new object is not visible.
    """
    new = shapes([insertion.new], insertion.scene.materials)
    shows_ground = (insertion.distance < 1) & ~covered
    diffuse = insertion.ground.diffuse or _ground_colour(insertion, photo, shows_ground, seed)
    disc = insertion.disc(Reflectance(diffuse, (0.0,) * 3, 1.0))
    pair = disc, disc | new
    previews = [insertion.preview(entries, seed) for entries in pair]
    window = _reach(insertion, previews)
    camera = crop_camera(insertion.scene.camera, *window)
    coverage = _coverage(insertion, camera, samples, seed)
    background = (1 - coverage)[..., None]
    fade = insertion.fade[window]
    guides = [insertion.guides(entries, camera, seed) for entries in pair]
    without, with_object = (insertion.render(entries, camera, samples, seed) for entries in pair)
    # (2)
    shadow = _shadow(without, with_object, guides[0], coverage, fade)
    gain = denoise_picture(with_object, guides[1])[..., :3] - background * shadow * without[..., :3]
    part = background * shadow * photo[window] + np.maximum(gain, 0) * (background < 1)
    whole = photo.copy(), np.zeros(covered.shape), np.ones_like(photo)
    result = InsertionResult(*whole, np.asarray(diffuse), previews[0])
    result.composite[window] = part
    result.coverage[window] = coverage
    result.shadow[window] = shadow
    return result


def _shadow(
    without: Float[np.ndarray, "h w 4"],
    with_object: Float[np.ndarray, "h w 4"],
    guides: Float[np.ndarray, "h w 10"],
    coverage: Float[np.ndarray, "h w"],
    fade: Float[np.ndarray, "h w 1"],
) -> Picture:
    """Return s of (1), denoised, but exactly 1 where no path meets the object.

    s is that of the nearest pixel beside the object for pixels under it and 1 for unlit pixels, and fades to 1 toward
    the rim of the disc.

    Args:
        without: rendering of the scene without the object
        with_object: rendering with it
        guides: guides of the denoiser, without it
        coverage: α
        fade: weight of the shadow
    """
    lit = without[..., :3]
    shadow = np.divide(with_object[..., :3], lit, out=np.ones_like(lit), where=lit > 0)
    uncovered = coverage == 0
    if uncovered.any():
        row, column = distance_transform_edt(~uncovered, return_distances=False, return_indices=True)
        shadow = shadow[row, column]
    shadow = 1 + (shadow - 1) * fade
    return np.where(shadow == 1, 1, denoise_picture(np.concatenate([shadow, np.ones_like(fade)], -1), guides)[..., :3])


def compare_shadow(
    insertion: InsertionScene, result: InsertionResult, photo: Picture, covered: Bool[np.ndarray, "h w"]
) -> ShadowMatch:
    """Compare the photo's own shadow with L₀, on the ground near its objects.

    Args:
        insertion: the scene and the new object's place
        result: its rendering
        photo: linear radiance, with the tone curve undone
        covered: pixels that show something other than the ground
    """
    plane = insertion.spot.plane
    near = [
        np.linalg.norm(insertion.ground_points - plane.onto(each.vertices.mean(axis=0)[None])[0], axis=-1)
        < NEAR * height_over(plane, each)
        for each in insertion.scene.objects
    ]
    shows_ground = binary_erosion((insertion.distance < 1) & ~covered & np.any(near, axis=0), iterations=RIM)
    disc = insertion.disc(Reflectance(vec3(result.ground), (0.0,) * 3, 1.0))
    constant = insertion.preview(disc, light={"light": {"type": "constant", "radiance": rgb(1.0)}})
    lights = (rotate_light(insertion.scene.light, float(angle)) for angle in TURNS)
    turned = [insertion.preview(disc, light=light_entries(light, insertion.scene.size)) for light in lights]
    _, middles = insertion.preview_camera
    return shadow_match(photo[middles], result.without, constant, turned, shows_ground[middles])


def _ground_colour(
    insertion: InsertionScene, photo: Picture, shows_ground: Bool[np.ndarray, "h w"], seed: int
) -> tuple[float, float, float]:
    """Return the diffuse reflectance at which the ground matches the photo: the median over its pixels."""
    lit = insertion.preview(insertion.disc(Reflectance((GREY,) * 3, (0.0,) * 3, 1.0)), seed)
    _, middles = insertion.preview_camera
    usable = shows_ground[middles] & (lit.min(axis=-1) > 0)
    if not usable.any():
        return (GREY,) * 3
    return vec3(np.clip(GREY * np.median(photo[middles][usable] / lit[usable], axis=0), DARKEST, BRIGHTEST))


def _reach(insertion: InsertionScene, previews: Sequence[Picture]) -> tuple[slice, slice]:
    """Return the rows and columns of the pixels that the new object or its shadow can reach.

    These are the object itself, and pixels of a preview most of whose neighbours change by more than LEAST_CHANGE.

    Args:
        insertion: the scene and the new object's place
        previews: previews without and with the object
    """
    camera, middles = insertion.preview_camera
    fade = insertion.fade[middles]
    first, second = previews
    changed = median_filter((np.abs(second - first) * fade > LEAST_CHANGE * first).any(axis=-1), 3)
    changed[visible_window(insertion.new.vertices, camera, CAMERA_POSE)] = True
    spans = [np.flatnonzero(changed.any(axis=axis))[[0, -1]].tolist() for axis in (1, 0)]
    pixel = middles[0].step
    rows, columns = (
        slice(max(0, pixel * (low - 1)), min(size, pixel * (high + 2)))
        for (low, high), size in zip(spans, insertion.distance.shape)
    )
    return rows, columns


def _coverage(insertion: InsertionScene, camera: Camera, samples: int, seed: int) -> Float[np.ndarray, "h w"]:
    """Render the albedo of the new object in white and all else in black, which is the object's share of each pixel."""
    mesh = insertion.new.mesh
    white = msgspec.structs.replace(insertion.new, mesh=without_paint(mesh, mesh.labels))
    black, bright = (dict.fromkeys(insertion.scene.materials, each) for each in (BLACK, WHITE))
    entries = shapes(insertion.scene.objects, black) | shapes([white], bright)
    coverage = render_guides(entries, insertion.view(camera), samples, seed)[..., 4].clip(0, 1)
    if not coverage.any():
        raise InputError(
            "the new object is invisible: it stands outside the picture, or other objects hide it",
            key="at",
            cure="name a visible place, `at: [x, y]`, or a smaller `size`",
        )
    return coverage


def shadow_match(
    photo: Picture, lit: Picture, constant: Picture, turned: Sequence[Picture], mask: Bool[np.ndarray, "h w"]
) -> ShadowMatch:
    """Return the correlation of the photo's shading of the ground with predictions of it.

    Args:
        photo: linear radiance
        lit: the ground with the photo's objects in the recovered light
        constant: the ground with the photo's objects in a constant light
        turned: the ground with the photo's objects in turned lights
        mask: pixels that show ground
    """
    luminances = [picture @ LUMINANCE for picture in (photo, lit, constant, *turned)]
    mask = mask & np.all([luminance > 0 for luminance in luminances], axis=0)
    logs = [np.log(luminance[mask]) for luminance in luminances]
    if mask.sum() < FEWEST or min(map(np.ptp, logs)) == 0:
        return ShadowMatch(None, None, int(mask.sum()))
    recovered, shape, *wrong = (float(np.corrcoef(logs[0], row)[0, 1]) for row in logs[1:])
    return ShadowMatch(recovered, shape, int(mask.sum()), wrong)
