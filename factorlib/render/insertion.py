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
from factorlib.meshes.ply import submesh
from factorlib.render.ground import Plane, height_over
from factorlib.render.photo_scene import PhotoScene, PlacedMesh, light_entries, shapes
from factorlib.render.placement import RADIUS, Spot, rotation_between
from factorlib.results.materials import Reflectance, vec3
from factorlib.tracing.denoise import denoised
from factorlib.tracing.scene import bsdf, rendered, rgb, rigid, sensor, shape, transform

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
STEPS = 5
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
        spot: the requested place
        found: the actual place
        moved: a sentence that says why the two differ, or an empty string
    """

    scene: PhotoScene
    ground: GroundSurface
    new: PlacedMesh
    spot: Spot
    found: Spot
    moved: str


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
                "Shadows were not compared: too little is seen of the ground near the photo's objects "
                f"({self.pixels} pixels)."
            )
        light = f"{self.correlation:.2f}"
        shape = f"{self.constant_light:.2f}"
        words = (
            f"The photo's shading of the ground correlates with the predicted one by {light}; "
            f"with that of a constant light by {shape}."
        )
        return words if self.correlation >= BELIEVED else f"{words} So the shadow is not to be believed."


class InsertionResult(msgspec.Struct, frozen=True):
    """A photo with the new object.

    Attributes:
        composite: (2), linear radiance
        coverage: α
        shadow: s of (1)
        ground: diffuse reflectance used for the ground
        match: comparison of the photo's own shadow with the predicted one
    """

    composite: Picture
    coverage: Float[np.ndarray, "h w"]
    shadow: Picture
    ground: Float[np.ndarray, "3"]
    match: ShadowMatch


def inserted(
    there: InsertionScene,
    photo: Picture,
    covered: Bool[np.ndarray, "h w"],
    samples: int,
    report: Callable[[int], None] = lambda done: None,
    seed: int = 1,
    compared: bool = True,
) -> InsertionResult:
    """Return the photo with the new object.

    Args:
        there: the scene and the new object's place
        photo: linear radiance, with the tone curve undone
        covered: pixels that show something other than the ground
        samples: samples per pixel
        report: receives the number of steps done, of STEPS
        seed: seed of the random numbers, which all renderings share
        compared: compare the photo's own shadow with the predicted one; if False, `match` has no pixels

    Raises:
        InputError: The new object is not visible.
    """
    scene = there.scene
    new = there.new
    spot = there.found
    ground = there.ground
    camera = sensor(scene.camera, rigid(YUP_FROM_CAMERA, np.zeros(3)), near=scene.near)
    old = shapes(scene.objects, scene.materials)
    light = light_entries(scene.light, scene.size)
    more = shapes([new], scene.materials)

    def traced(
        entries: dict[str, Any], samples: int = samples, light: dict[str, Any] = light, guides: bool = False
    ) -> Float[np.ndarray, "h w c"]:
        """Render with the same random numbers each time."""
        return rendered({**light, **old, **entries}, camera, samples, seed, ALL_BOUNCES, True, guides)

    rays = scene.camera.rays() @ YUP_FROM_CAMERA
    points = spot.plane.hit(rays.reshape(-1, 3)).reshape(rays.shape)  # points of the ground; NaN above the horizon
    distance = np.nan_to_num(np.linalg.norm(points - spot.point, axis=-1) / (RADIUS * spot.height), nan=np.inf)
    # fade: 1 near the spot, smoothly to 0 at the rim of the disc; 1 above the horizon, where only objects are seen
    t = np.clip((1 - np.where(np.isinf(distance), 0, distance)) / (1 - FADE), 0, 1)
    near = (t * t * (3 - 2 * t))[..., None]
    shows_ground = (distance < 1) & ~covered
    coverage = _coverage(scene, new, camera, samples)
    if not coverage.any():
        found = "the new object is not seen: it stands outside the picture, or something hides it"
        raise InputError(found, key="at", cure="say where it stands, `at: [x, y]`, or make it smaller")
    report(1)
    # diffuse reflectance of the ground, estimated if dataset.yaml does not give it
    diffuse = ground.diffuse
    if diffuse is None:
        grey = traced(_disc(spot, Reflectance((GREY,) * 3, (0.0,) * 3, 1.0)), FIT_SAMPLES)
        diffuse = _ground_colour(grey, photo, shows_ground)
    report(2)
    # L₀, the scene without the new object, and the photo's own shadow against it
    disc = _disc(spot, Reflectance(diffuse, (0.0,) * 3, 1.0))
    without, guides_without = np.split(traced(disc, guides=scene.denoise), [3], axis=-1)
    match = ShadowMatch(None, None, 0)
    if compared:
        constant = traced(disc, light={"light": {"type": "constant", "radiance": rgb(1.0)}})
        close = np.any([np.linalg.norm(points - foot, axis=-1) < far for foot, far in _feet(scene, spot.plane)], axis=0)
        match = shadow_match(photo, without, constant, binary_erosion(shows_ground & close, iterations=RIM))
    report(3)
    # L₁, the scene with the new object, and s of (1)
    with_, guides_with = np.split(traced({**disc, **more}, guides=scene.denoise), [3], axis=-1)
    report(4)
    beside = (1 - coverage)[..., None]
    shadow = _shadow(without, with_, coverage, near)
    if scene.denoise:  # not the photo, nor pixels whose paths miss the object
        clean, with_ = (
            denoised(np.concatenate([noisy, np.ones_like(beside), guides], axis=-1))[..., :3]
            for noisy, guides in ((shadow, guides_without), (with_, guides_with))
        )
        shadow = np.where(shadow == 1, 1, clean)
    # (2)
    own = np.maximum(with_ - beside * shadow * without, 0) * (beside < 1)
    composite = beside * shadow * photo + own
    # change of the ground's specular part: the object's reflection in it
    if ground.polish is not None:
        polished = _disc(spot, ground.polish)
        mirrored = traced({**polished, **more}) - traced(polished)
        composite = np.maximum(composite + mirrored * shows_ground[..., None] * beside * near, 0)
    report(STEPS)
    return InsertionResult(composite, coverage, shadow, np.asarray(diffuse), match)


def _ground_colour(lit: Picture, photo: Picture, shows_ground: Bool[np.ndarray, "h w"]) -> tuple[float, float, float]:
    """Return the diffuse reflectance at which the ground matches the photo: the median over its pixels.

    `lit` is the scene on ground of reflectance GREY.
    """
    usable = shows_ground & (lit.min(axis=-1) > 0)
    if not usable.any():
        return (GREY,) * 3
    found = GREY * np.median(photo[usable] / lit[usable], axis=0)
    return vec3(np.clip(found, DARKEST, BRIGHTEST))


def _feet(scene: PhotoScene, plane: Plane) -> list[tuple[Float[np.ndarray, "3"], float]]:
    """Return the foot of each object's centroid on the ground, and the radius of its shadow's neighbourhood."""
    return [
        (plane.onto(each.vertices.mean(axis=0)[None])[0], NEAR * height_over(plane, each)) for each in scene.objects
    ]


def _disc(spot: Spot, material: Reflectance) -> dict[str, Any]:
    """Return the ground about the spot as a Mitsuba disk."""
    frame = np.eye(4)
    frame[:3, :3] = RADIUS * spot.height * rotation_between(np.array([0.0, 0.0, 1.0]), spot.plane.normal)
    frame[:3, 3] = spot.point - HAIR * spot.height * spot.plane.normal
    return {GROUND: {"type": "disk", "to_world": transform(frame), "bsdf": bsdf(material)}}


def _coverage(scene: PhotoScene, new: PlacedMesh, camera: dict[str, Any], samples: int) -> Float[np.ndarray, "h w"]:
    """Render the new object with radiance 1 and all else black, so that a pixel is the object's share of it."""
    sides = [(label, side) for label in new.mesh.labels for side in range(1 + new.mesh.open)]
    glowing = {f"{new.name}_{label}_{side}": _emitter(new, label, side) for label, side in sides}
    black = shapes(scene.objects, scene.materials, black=[each.name for each in scene.objects])
    picture = rendered({**black, **glowing}, camera, samples, 1, 1)
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
    without: Picture, with_: Picture, coverage: Float[np.ndarray, "h w"], near: Float[np.ndarray, "h w 1"]
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
    return 1 + (shadow - 1) * near


def shadow_match(photo: Picture, lit: Picture, constant: Picture, where: Bool[np.ndarray, "h w"]) -> ShadowMatch:
    """Return the correlation of the photo's shading of the ground with two predictions of it.

    Args:
        photo: linear radiance
        lit: the ground with the photo's objects in the recovered light
        constant: the ground with the photo's objects in a constant light
        where: pixels that show ground
    """
    luminances = [picture @ LUMINANCE for picture in (photo, lit, constant)]
    where = where & np.all([luminance > 0 for luminance in luminances], axis=0)
    logs = [np.log(luminance[where]) for luminance in luminances]
    if where.sum() < FEWEST or min(map(np.ptp, logs)) == 0:
        return ShadowMatch(None, None, int(where.sum()))
    recovered, shape = (float(np.corrcoef(logs[0], other)[0, 1]) for other in logs[1:])
    return ShadowMatch(recovered, shape, int(where.sum()))
