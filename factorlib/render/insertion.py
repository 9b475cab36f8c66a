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

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion, distance_transform_edt

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.export.exported_scene import ALL_BOUNCES
from factorlib.geometry.ground import Plane
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply_stl_off import submesh
from factorlib.render.ground import disk, height_over, smooth_step
from factorlib.render.photo_scene import PhotoScene, PlacedMesh, light_entries, shapes
from factorlib.render.placement import RADIUS, Spot
from factorlib.results.materials import Reflectance, vec3
from factorlib.tracing.scene import Channels, denoise_picture, render_scene, rgb, rigid, sensor, shape

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
BLACK = Reflectance((0.0,) * 3, (0.0,) * 3, 1.0)
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
    def sensor(self) -> dict[str, Any]:
        """The photo's camera, for Mitsuba."""
        return sensor(self.scene.camera, rigid(YUP_FROM_CAMERA, np.zeros(3)), near_clip=self.scene.near_clip)

    def disc(self, material: Reflectance) -> dict[str, Any]:
        """Return the ground about the spot as a Mitsuba disk."""
        normal = self.spot.plane.normal
        centre = self.spot.point - HAIR * self.spot.height * normal
        return {GROUND: disk(centre, normal, RADIUS * self.spot.height, material)}

    def radiance(
        self,
        entries: dict[str, Any],
        samples: int,
        seed: int = 1,
        light: dict[str, Any] | None = None,
        guides: bool = False,
    ) -> Float[np.ndarray, "h w c"]:
        """Render the photo's objects with further entries.

        Args:
            entries: Mitsuba objects by name
            samples: samples per pixel
            seed: seed of the random numbers
            light: replaces the photo's light
            guides: add the guides of the denoiser
        """
        photo_light, objects = self.entries
        channels = Channels(hide_emitters=True, guides=guides)
        return render_scene(
            (light or photo_light) | objects | entries, self.sensor, samples, seed, ALL_BOUNCES, channels
        )


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

    @property
    def doubtful(self) -> bool:
        """True if the photo's ground contradicts the predicted shadow."""
        return self.correlation is not None and self.correlation < BELIEVED

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
        return f"{words} So do not trust the shadow." if self.doubtful else words


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


def insert_object(
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
    new = shapes([insertion.new], insertion.scene.materials)
    coverage = _coverage(insertion, samples)
    report(1)
    shows_ground = (insertion.distance < 1) & ~covered
    diffuse = insertion.ground.diffuse or _ground_colour(insertion, photo, shows_ground, seed)
    report(2)
    # weight that falls smoothly from 1 near the spot, and above the horizon, to 0 at the rim of the disc
    fade = smooth_step((1 - np.where(np.isinf(insertion.distance), 0, insertion.distance)) / (1 - FADE))[..., None]
    background = (1 - coverage)[..., None]
    disc = insertion.disc(Reflectance(diffuse, (0.0,) * 3, 1.0))
    rendering = partial(insertion.radiance, samples=samples, seed=seed)
    without, with_object, shadow = _lighting(
        [rendering(e, guides=insertion.scene.denoise) for e in (disc, disc | new)], coverage, fade
    )
    report(3)
    # (2)
    gain = np.maximum(with_object - background * shadow * without, 0) * (background < 1)
    composite = background * shadow * photo + gain
    # change of the ground's specular part: the object's reflection in it
    if insertion.ground.polish is not None:
        polished = insertion.disc(insertion.ground.polish)
        mirrored = rendering(polished | new) - rendering(polished)
        composite = np.maximum(composite + mirrored * shows_ground[..., None] * background * fade, 0)
    report(STEPS)
    return InsertionResult(composite, coverage, shadow, np.asarray(diffuse), without)


def _lighting(
    renderings: Sequence[Float[np.ndarray, "h w c"]],
    coverage: Float[np.ndarray, "h w"],
    fade: Float[np.ndarray, "h w 1"],
) -> tuple[Picture, Picture, Picture]:
    """Return L₀ and L₁, denoised if the renderings have guides, and s of (1).

    s is that of the nearest pixel beside the object for pixels under it and 1 for unlit pixels, and fades to 1 toward
    the rim of the disc.

    Args:
        renderings: the scene without and with the new object
        coverage: α
        fade: weight of the shadow
    """
    (without, guides_without), (with_object, guides_with) = (np.split(each, [3], axis=-1) for each in renderings)
    with np.errstate(divide="ignore", invalid="ignore"):
        shadow = np.where(without > 0, with_object / without, 1.0)
    uncovered = coverage == 0
    if uncovered.any():
        row, column = distance_transform_edt(~uncovered, return_distances=False, return_indices=True)
        shadow = shadow[row, column]
    shadow = 1 + (shadow - 1) * fade
    if guides_with.size:  # not the photo, nor pixels whose paths miss the object
        clean, with_object = (
            denoise_picture(np.concatenate([noisy, np.ones_like(fade), guides], axis=-1))[..., :3]
            for noisy, guides in ((shadow, guides_without), (with_object, guides_with))
        )
        shadow = np.where(shadow == 1, 1, clean)
    return without, with_object, shadow


def compare_shadow(
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
    near = [
        np.linalg.norm(insertion.ground_points - plane.onto(each.vertices.mean(axis=0)[None])[0], axis=-1)
        < NEAR * height_over(plane, each)
        for each in insertion.scene.objects
    ]
    shows_ground = (insertion.distance < 1) & ~covered & np.any(near, axis=0)
    disc = insertion.disc(Reflectance(vec3(result.ground), (0.0,) * 3, 1.0))
    sky = {"light": {"type": "constant", "radiance": rgb(1.0)}}
    constant = insertion.radiance(disc, samples, light=sky)
    return shadow_match(photo, result.without, constant, binary_erosion(shows_ground, iterations=RIM))


def _ground_colour(
    insertion: InsertionScene, photo: Picture, shows_ground: Bool[np.ndarray, "h w"], seed: int
) -> tuple[float, float, float]:
    """Return the diffuse reflectance at which the ground matches the photo: the median over its pixels."""
    lit = insertion.radiance(insertion.disc(Reflectance((GREY,) * 3, (0.0,) * 3, 1.0)), FIT_SAMPLES, seed)
    usable = shows_ground & (lit.min(axis=-1) > 0)
    if not usable.any():
        return (GREY,) * 3
    return vec3(np.clip(GREY * np.median(photo[usable] / lit[usable], axis=0), DARKEST, BRIGHTEST))


def _coverage(insertion: InsertionScene, samples: int) -> Float[np.ndarray, "h w"]:
    """Render the new object with radiance 1 and all else black, so that a pixel is the object's share of it.

    Area lights emit on the side of their normals alone.  An open mesh gets a second light, flipped and slightly behind.
    """
    new = insertion.new
    entries = shapes(insertion.scene.objects, dict.fromkeys(insertion.scene.materials, BLACK))
    surface = {"type": "diffuse", "reflectance": rgb(0.0)}
    emitter = {"type": "area", "radiance": rgb(1.0)}
    for label in new.mesh.labels:
        part = submesh(new.mesh, label)
        sides = [part]
        if new.mesh.open:
            inner = part.vertices - HAIR * new.mesh.radius * part.normals
            sides.append(Mesh(inner, part.faces[:, ::-1].copy(), -part.normals, part.face_label, True))
        for number, side in enumerate(sides):
            entries[f"{new.name}_{label}_{number}"] = shape(side, surface, new.world_from_object, emitter)
    coverage = np.clip(render_scene(entries, insertion.sensor, samples, 1, 1)[..., 0], 0, 1)
    if not coverage.any():
        raise InputError(
            "the new object is invisible: it stands outside the picture, or other objects hide it",
            key="at",
            cure="name a visible place, `at: [x, y]`, or a smaller `size`",
        )
    return coverage


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
    recovered, shape = (float(np.corrcoef(logs[0], row)[0, 1]) for row in logs[1:])
    return ShadowMatch(recovered, shape, int(mask.sum()))
