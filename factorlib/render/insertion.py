"""Insertion of an object into a photo.

B is the photo.  L₀ and L₁ are the path-traced scene of objects and ground without and with the new object.  α is the
coverage of the new object.  The ground and the objects answer the change of light by the factor

    s = L₁ / L₀     (1)

The factor is exact for a Lambertian surface of any texture in the light of the scene.  The difference L₁ − L₀ (Debevec,
"Rendering synthetic objects into real scenes", 1998) would need the texture's albedo.  The new object's own radiance is
L₁ − (1 − α) s L₀, so

    composite = (1 − α) s B + max(L₁ − (1 − α) s L₀, 0)     (2)

Under the object, s is that of the nearest pixel beside it.  L₀ and L₁ use the same random numbers, so s is exactly 1 if
no path meets the object, and the pixel stays unchanged.  A reflective ground adds the change of its specular part
alone, which is the object's reflection.  s then also scales the specular part that the photo shows.  The composite is
therefore right only for a ground that is mostly diffuse.

The photo's own shadow is compared with the predicted one on the ground near its objects.  The measure is the
correlation of log luminance of B with that of L₀ over these pixels.  On a plane in light from infinity, L₀ is
proportional to the share of irradiance that the objects leave.

The ground is a disc about the object.  Its diffuse reflectance is the one at which L₀ matches the photo.  Shadows fade
out toward the rim of the disc, beyond which the geometry of the scene is unknown.
"""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion, distance_transform_edt

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.export.exported_scene import ALL_BOUNCES
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply_stl_off import submesh
from factorlib.render.ground import Plane, height_over
from factorlib.render.photo_scene import PhotoScene, PlacedMesh, light_entries, shapes
from factorlib.render.placement import RADIUS, Spot, disk
from factorlib.results.materials import Reflectance, vec3
from factorlib.tracing.denoise import denoised
from factorlib.tracing.scene import Channels, rendered, rgb, rigid, sensor, shape

FADE = 0.5  # outer share of the disc's radius in which shadows fade
FIT_SAMPLES = 16
GREY = 0.3  # default diffuse reflectance of the ground
DARKEST = 0.02  # least diffuse reflectance of the ground
BRIGHTEST = 0.85  # largest diffuse reflectance of the ground
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # weights of linear Rec. 709
HAIR = 1e-4  # separation of surfaces that must not touch, in object sizes
NEAR = 2.0  # radius in which shadows are compared, in object heights
RIM = 2  # pixels beside the masks that the comparison of shadows leaves out
FEWEST = 100  # least number of pixels for a comparison of shadows
# Least correlation at which the predicted shadow is trusted.  On data/eames four photos have 0.40 to 0.91, and two 0.14
# and 0.09.
BELIEVED = 0.3
GROUND = "+ground"
STEPS = 4
NEW = "+"  # prefix of the new object and its materials: no name in dataset.yaml has it

Picture = Float[np.ndarray, "h w 3"]


class GroundSurface(msgspec.Struct, frozen=True):
    """The plane that objects stand on, and its reflectance.

    Attributes:
        diffuse: Lambertian reflectance, None if it is unknown
        polish: specular part of a reflective ground
    """

    plane: Plane
    diffuse: tuple[float, float, float] | None = None
    polish: Reflectance | None = None


class InsertionScene(msgspec.Struct, frozen=True):
    """A photo's scene with the new object in place; its materials include the new object's.

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

    @property
    def ground_points(self) -> Float[np.ndarray, "h w 3"]:
        """The point of the ground that each pixel shows, in the world; NaN above the horizon."""
        rays = self.scene.camera.rays() @ YUP_FROM_CAMERA
        return self.spot.plane.hit(rays.reshape(-1, 3)).reshape(rays.shape)

    @property
    def distance(self) -> Float[np.ndarray, "h w"]:
        """The distance of each pixel's point of the ground from the spot, in radii of the disc; infinite above it."""
        distance = np.linalg.norm(self.ground_points - self.spot.point, axis=-1) / (RADIUS * self.spot.height)
        return np.nan_to_num(distance, nan=np.inf)


class ShadowMatch(msgspec.Struct, frozen=True):
    """Correlation of log luminance between photo and prediction on the ground near the photo's objects.

    Attributes:
        correlation: for the recovered light; None if there are too few pixels
        constant_light: for a constant light, the prediction from shape alone; None if there are too few pixels
        pixels: the number of pixels compared
    """

    correlation: float | None
    constant_light: float | None
    pixels: int

    def __str__(self) -> str:
        if self.correlation is None:
            return (
                "Shadows were not compared: too little of the ground near the photo's objects is visible "
                f"({self.pixels} pixels)."
            )
        light = f"{self.correlation:.2f}"
        shape = f"{self.constant_light:.2f}"
        words = (
            f"The photo's shading of the ground correlates with the predicted one by {light}; "
            f"with that of a constant light by {shape}."
        )
        return words if self.correlation >= BELIEVED else f"{words} So do not trust the shadow."


class InsertionResult(msgspec.Struct, frozen=True):
    """A photo with the new object.

    Attributes:
        composite: (2), linear radiance
        coverage: α
        shadow: s of (1)
        ground: diffuse reflectance used for the ground
        without: L₀
    """

    composite: Picture
    coverage: Float[np.ndarray, "h w"]
    shadow: Picture
    ground: Float[np.ndarray, "3"]
    without: Picture


class InsertionRenderer:
    """Renderer of the scene of an insertion, with the same random numbers for every rendering."""

    def __init__(self, insertion: InsertionScene, samples: int, seed: int = 1):
        scene = insertion.scene
        self.camera = sensor(scene.camera, rigid(YUP_FROM_CAMERA, np.zeros(3)), near=scene.near)
        self.light = light_entries(scene.light, scene.size)
        self.objects = shapes(scene.objects, scene.materials)
        self.denoise = scene.denoise
        self.samples = samples
        self.seed = seed

    def radiance(
        self,
        entries: dict[str, Any],
        samples: int | None = None,
        light: dict[str, Any] | None = None,
        guides: bool = False,
    ) -> Float[np.ndarray, "h w c"]:
        """Render the photo's objects with further entries.

        Args:
            entries: Mitsuba objects by name
            samples: replaces the samples per pixel
            light: replaces the photo's light
            guides: add the guides of the denoiser
        """
        whole = (light or self.light) | self.objects | entries
        channels = Channels(hide_emitters=True, guides=guides)
        return rendered(whole, self.camera, samples or self.samples, self.seed, ALL_BOUNCES, channels)


def inserted(
    insertion: InsertionScene,
    photo: Picture,
    covered: Bool[np.ndarray, "h w"],
    samples: int,
    report: Callable[[int], None] = lambda done: None,
    seed: int = 1,
) -> InsertionResult:
    """Return the photo with the new object.

    Args:
        insertion: the scene and the new object's place
        photo: linear radiance, with the tone curve undone
        covered: pixels that show something other than the ground
        samples: samples per pixel
        report: receives the number of steps done, of STEPS
        seed: seed of the random numbers, which all renderings share

    Raises:
        InputError: The new object is not visible.
    """
    spot = insertion.spot
    renderer = InsertionRenderer(insertion, samples, seed)
    new = shapes([insertion.new], insertion.scene.materials)
    coverage = _coverage(insertion.scene, insertion.new, renderer.camera, samples)
    if not coverage.any():
        fault = "the new object is invisible: it stands outside the picture, or other objects hide it"
        raise InputError(fault, key="at", cure="name a visible place, `at: [x, y]`, or a smaller `size`")
    report(1)
    shows_ground = (insertion.distance < 1) & ~covered
    diffuse = insertion.ground.diffuse or _ground_colour(renderer, spot, photo, shows_ground)
    report(2)
    fade = _fade(insertion.distance)
    beside = (1 - coverage)[..., None]
    disc = _disc(spot, Reflectance(diffuse, (0.0,) * 3, 1.0))
    without, with_, shadow = _lighting(renderer, disc, new, coverage, fade)
    report(3)
    # (2)
    composite = beside * shadow * photo + np.maximum(with_ - beside * shadow * without, 0) * (beside < 1)
    # change of the ground's specular part: the object's reflection in it
    if insertion.ground.polish is not None:
        polished = _disc(spot, insertion.ground.polish)
        mirrored = renderer.radiance(polished | new) - renderer.radiance(polished)
        composite = np.maximum(composite + mirrored * shows_ground[..., None] * beside * fade, 0)
    report(STEPS)
    return InsertionResult(composite, coverage, shadow, np.asarray(diffuse), without)


def _lighting(
    renderer: InsertionRenderer,
    disc: dict[str, Any],
    new: dict[str, Any],
    coverage: Float[np.ndarray, "h w"],
    fade: Float[np.ndarray, "h w 1"],
) -> tuple[Picture, Picture, Picture]:
    """Return L₀ and L₁, the scene without and with the new object, and s of (1)."""
    without, guides_without = np.split(renderer.radiance(disc, guides=renderer.denoise), [3], axis=-1)
    with_, guides_with = np.split(renderer.radiance(disc | new, guides=renderer.denoise), [3], axis=-1)
    shadow = _shadow(without, with_, coverage, fade)
    if renderer.denoise:  # not the photo, nor pixels whose paths miss the object
        clean, with_ = (
            denoised(np.concatenate([noisy, np.ones_like(fade), guides], axis=-1))[..., :3]
            for noisy, guides in ((shadow, guides_without), (with_, guides_with))
        )
        shadow = np.where(shadow == 1, 1, clean)
    return without, with_, shadow


def compared_shadow(
    insertion: InsertionScene, result: InsertionResult, photo: Picture, covered: Bool[np.ndarray, "h w"], samples: int
) -> ShadowMatch:
    """Compare the photo's own shadow with L₀, on the ground near its objects.

    Args:
        insertion: the scene and the new object's place
        result: its rendering
        photo: linear radiance, with the tone curve undone
        covered: pixels that show something other than the ground
        samples: samples per pixel of the rendering
    """
    plane = insertion.spot.plane
    points = insertion.ground_points
    near = [
        np.linalg.norm(points - plane.onto(each.vertices.mean(axis=0)[None])[0], axis=-1)
        < NEAR * height_over(plane, each)
        for each in insertion.scene.objects
    ]
    shows_ground = (insertion.distance < 1) & ~covered & np.any(near, axis=0)
    disc = _disc(insertion.spot, Reflectance(vec3(result.ground), (0.0,) * 3, 1.0))
    sky = {"light": {"type": "constant", "radiance": rgb(1.0)}}
    constant = InsertionRenderer(insertion, samples).radiance(disc, light=sky)
    return shadow_match(photo, result.without, constant, binary_erosion(shows_ground, iterations=RIM))


def _fade(distance: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 1"]:
    """Return a weight that falls smoothly from 1 near the spot to 0 at the rim of the disc.

    It is 1 above the horizon, where only objects are visible.
    """
    t = np.clip((1 - np.where(np.isinf(distance), 0, distance)) / (1 - FADE), 0, 1)
    return (t * t * (3 - 2 * t))[..., None]


def _ground_colour(
    renderer: InsertionRenderer, spot: Spot, photo: Picture, shows_ground: Bool[np.ndarray, "h w"]
) -> tuple[float, float, float]:
    """Return the diffuse reflectance at which the ground matches the photo: the median over its pixels."""
    lit = renderer.radiance(_disc(spot, Reflectance((GREY,) * 3, (0.0,) * 3, 1.0)), FIT_SAMPLES)
    usable = shows_ground & (lit.min(axis=-1) > 0)
    if not usable.any():
        return (GREY,) * 3
    return vec3(np.clip(GREY * np.median(photo[usable] / lit[usable], axis=0), DARKEST, BRIGHTEST))


def _disc(spot: Spot, material: Reflectance) -> dict[str, Any]:
    """Return the ground about the spot as a Mitsuba disk."""
    normal = spot.plane.normal
    return {GROUND: disk(spot.point - HAIR * spot.height * normal, normal, RADIUS * spot.height, material)}


def _coverage(scene: PhotoScene, new: PlacedMesh, camera: dict[str, Any], samples: int) -> Float[np.ndarray, "h w"]:
    """Render the new object with radiance 1 and all else black, so that a pixel is the object's share of it."""
    sides = [(label, side) for label in new.mesh.labels for side in range(1 + new.mesh.open)]
    glowing = {f"{new.name}_{label}_{side}": _emitter(new, label, side) for label, side in sides}
    black = shapes(scene.objects, scene.materials, black=[each.name for each in scene.objects])
    picture = rendered(black | glowing, camera, samples, 1, 1)
    return np.clip(picture[..., 0], 0, 1)


def _emitter(new: PlacedMesh, label: int, side: int) -> Any:
    """Return one side of the new object's part as an area light.

    Area lights emit on the side of their normals alone.  An open mesh gets a second light, flipped and slightly behind.
    """
    part = submesh(new.mesh, label)
    if side:
        behind = part.vertices - HAIR * new.mesh.radius * part.normals
        part = Mesh(behind, part.faces[:, ::-1].copy(), -part.normals, part.face_label, True)
    black = {"type": "diffuse", "reflectance": rgb(0.0)}
    emitter = {"type": "area", "radiance": rgb(1.0)}
    return shape(part, black, new.world_from_object, emitter)


def _shadow(
    without: Picture, with_: Picture, coverage: Float[np.ndarray, "h w"], fade: Float[np.ndarray, "h w 1"]
) -> Picture:
    """Return s of (1), taken from the nearest pixel beside the object for pixels under it.

    s is 1 for unlit pixels and fades to 1 toward the rim of the disc.
    """
    beside = coverage == 0
    with np.errstate(divide="ignore", invalid="ignore"):
        shadow = np.where(without > 0, with_ / without, 1.0)
    if beside.any():
        row, column = distance_transform_edt(~beside, return_distances=False, return_indices=True)
        shadow = shadow[row, column]
    return 1 + (shadow - 1) * fade


def shadow_match(photo: Picture, lit: Picture, constant: Picture, mask: Bool[np.ndarray, "h w"]) -> ShadowMatch:
    """Return the correlation of the photo's shading of the ground with two predictions of it.

    Args:
        photo: linear radiance
        lit: the ground with the photo's objects in the recovered light
        constant: the ground with the photo's objects in a constant light
        mask: pixels that show ground
    """
    luminances = [picture @ LUMINANCE for picture in (photo, lit, constant)]
    mask = mask & np.all([luminance > 0 for luminance in luminances], axis=0)
    logs = [np.log(luminance[mask]) for luminance in luminances]
    if mask.sum() < FEWEST or min(map(np.ptp, logs)) == 0:
        return ShadowMatch(None, None, int(mask.sum()))
    recovered, shape = (float(np.corrcoef(logs[0], other)[0, 1]) for other in logs[1:])
    return ShadowMatch(recovered, shape, int(mask.sum()))
