"""A further object in a photo: what the photo would show.

Let B be the photo, L₀ and L₁ the path-traced scene of objects and ground without and with the new object, α its coverage.  The ground
and the objects answer the change of light by

    s = L₁ / L₀     (1)

which is exact for a Lambertian surface of any texture in the light of the scene, where the difference L₁ − L₀ (Debevec, "Rendering synthetic objects into real
scenes", 1998) needs the texture's own albedo.  With the new object's own radiance L₁ − (1 − α) s L₀,

    composite = (1 − α) s B + max(L₁ − (1 − α) s L₀, 0)     (2)

s under the object is that of the nearest pixel beside it.  L₀ and L₁ take the same random numbers, so s is exactly 1 where no path
meets the object: those pixels stay as they were.  A ground that reflects adds what it shows of the object, the change of its specular part
alone; s then also scales what the photo shows of that part, so such a ground is right only where it is mostly diffuse.

The photo's own shadow is compared with the predicted one where the photo shows ground near its objects: over these pixels, the correlation
of the logarithm of luminance of B with that of L₀, which on a plane in light from infinity is, up to a constant, that of the share of
irradiance that the objects leave.

The ground is a disc about the object, its diffuse reflectance that which makes L₀ look as the photo.  Beyond it nothing is known of what
the photo shows, and shadows fade out toward its rim.
"""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion, distance_transform_edt

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.export.scene import ALL_BOUNCES
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply import submesh
from factorlib.render.ground import Plane, height_over
from factorlib.render.photo_scene import PhotoScene, Placed, light_entries, shapes
from factorlib.render.placement import RADIUS, Spot, rotation_between
from factorlib.results.materials import Reflectance, vec3
from factorlib.tracing.denoise import denoised
from factorlib.tracing.scene import bsdf, rendered, rgb, rigid, sensor, shape, transform

FADE = 0.5  # share of the disc's radius from which on shadows fade
FIT_SAMPLES = 16
GREY, DARKEST, BRIGHTEST = 0.3, 0.02, 0.85  # diffuse reflectance of the ground: where nothing tells it, and its bounds
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear Rec. 709
HAIR = 1e-4  # of an object's size: how far apart surfaces are that must not meet
NEAR = 2.0  # shadows are compared within so many heights of an object
RIM, FEWEST = 2, 100  # so many pixels off the masks, over at least so many pixels
BELIEVED = 0.3  # correlation from which the light is believed to cast the shadow: on data/eames four photos have .40 to .91, and two .14 and .09
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


class Standing(msgspec.Struct, frozen=True):
    """A photo's scene, to whose materials the new object's are added, and where that object stands.

    ground: on which it stands;  spot, found: where it was to stand, and where it stands;  moved: a sentence that says why, or nothing
    """

    scene: PhotoScene
    ground: Ground
    new: Placed
    spot: Spot
    found: Spot
    moved: str


class ShadowMatch(msgspec.Struct, frozen=True):
    """Correlation of log luminance, photo and prediction, on the ground near the photo's objects; None where there are too few pixels.

    constant_light: the same with a constant light in place of the recovered one: what shape alone predicts
    """

    correlation: float | None
    constant_light: float | None
    pixels: int

    def __str__(self) -> str:
        if self.correlation is None:
            return f"Shadows were not compared: too little is seen of the ground near the photo's objects ({self.pixels} pixels)."
        light, shape = f"{self.correlation:.2f}", f"{self.constant_light:.2f}"
        words = f"The photo's shading of the ground correlates with the predicted one by {light}; with that of a constant light by {shape}."
        return words if self.correlation >= BELIEVED else f"{words} So the shadow is not to be believed."


class Inserted(msgspec.Struct, frozen=True):
    """composite: (2), linear;  coverage: α;  shadow: s of (1);  ground: the diffuse reflectance that was found for it;  match: of the photo's own shadow"""

    composite: Picture
    coverage: Float[np.ndarray, "h w"]
    shadow: Picture
    ground: Float[np.ndarray, "3"]
    match: ShadowMatch


def inserted(
    there: Standing,
    photo: Picture,
    covered: Bool[np.ndarray, "h w"],
    samples: int,
    report: Callable[[int], None] = lambda done: None,
    seed: int = 1,
    compared: bool = True,
) -> Inserted:
    """The photo with the new object.  Raises InputError where that is not seen.

    photo: linear radiance, its tone curve undone;  covered: pixels that show something else than the ground
    report: how many of STEPS are done;  seed: of the random numbers, which all tracings share
    compared: whether the photo's own shadow is compared with the predicted one; without, `match` is of no pixels
    """
    scene, new, spot, ground = there.scene, there.new, there.found, there.ground
    camera = sensor(scene.camera, rigid(YUP_FROM_CAMERA, np.zeros(3)), near=scene.near)
    there, light = shapes(scene.objects, scene.materials), light_entries(scene.light, scene.size)
    more = shapes([new], scene.materials)

    def traced(
        entries: dict[str, Any], samples: int = samples, light: dict[str, Any] = light, guides: bool = False
    ) -> Float[np.ndarray, "h w c"]:
        """With the same random numbers each time."""
        return rendered({**light, **there, **entries}, camera, samples, seed, ALL_BOUNCES, True, guides)

    rays = scene.camera.rays() @ YUP_FROM_CAMERA
    points = spot.plane.hit(rays.reshape(-1, 3)).reshape(rays.shape)  # of the ground; NaN above the horizon
    distance = np.nan_to_num(np.linalg.norm(points - spot.point, axis=-1) / (RADIUS * spot.height), nan=np.inf)
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
    without, guides_without = np.split(traced(disc, guides=scene.denoise), [3], axis=-1)
    match = ShadowMatch(None, None, 0)
    if compared:
        constant = traced(disc, light={"light": {"type": "constant", "radiance": rgb(1.0)}})
        close = np.any([np.linalg.norm(points - foot, axis=-1) < far for foot, far in _feet(scene, spot.plane)], axis=0)
        match = shadow_match(photo, without, constant, binary_erosion(shows_ground & close, iterations=RIM))
    report(3)
    with_, guides_with = np.split(traced({**disc, **more}, guides=scene.denoise), [3], axis=-1)
    report(4)
    beside = (1 - coverage)[..., None]
    shadow = _shadow(without, with_, coverage, near)
    if scene.denoise:  # the photo's own noise, and what no path changes, stay
        clean, with_ = (
            denoised(np.concatenate([noisy, np.ones_like(beside), guides], axis=-1))[..., :3]
            for noisy, guides in ((shadow, guides_without), (with_, guides_with))
        )
        shadow = np.where(shadow == 1, 1, clean)
    own = np.maximum(with_ - beside * shadow * without, 0) * (beside < 1)
    composite = beside * shadow * photo + own
    if ground.polish is not None:
        polished = _disc(spot, ground.polish)
        mirrored = traced({**polished, **more}) - traced(polished)
        composite = np.maximum(composite + mirrored * shows_ground[..., None] * beside * near, 0)
    report(STEPS)
    return Inserted(composite, coverage, shadow, np.asarray(diffuse), match)


def _ground_colour(lit: Picture, photo: Picture, shows_ground: Bool[np.ndarray, "h w"]) -> tuple[float, float, float]:
    """The diffuse reflectance that makes the ground look as in the photo: the median over what shows it.  lit: the scene on GREY ground"""
    usable = shows_ground & (lit.min(axis=-1) > 0)
    if not usable.any():
        return (GREY,) * 3
    found = GREY * np.median(photo[usable] / lit[usable], axis=0)
    return vec3(np.clip(found, DARKEST, BRIGHTEST))


def _feet(scene: PhotoScene, plane: Plane) -> list[tuple[Float[np.ndarray, "3"], float]]:
    """Where the middle of each object stands on the ground, and how far from there its shadow is looked for."""
    return [
        (plane.onto(each.vertices.mean(axis=0)[None])[0], NEAR * height_over(plane, each)) for each in scene.objects
    ]


def _disc(spot: Spot, material: Reflectance) -> dict[str, Any]:
    """The ground about the spot."""
    frame = np.eye(4)
    frame[:3, :3] = RADIUS * spot.height * rotation_between(np.array([0.0, 0.0, 1.0]), spot.plane.normal)
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


def shadow_match(photo: Picture, lit: Picture, constant: Picture, where: Bool[np.ndarray, "h w"]) -> ShadowMatch:
    """Return how well a prediction of the ground's radiance explains what the photo shows there.

    lit, constant: the ground with the photo's objects in their light, and in a constant one;  where: pixels that show ground
    """
    luminances = [picture @ LUMINANCE for picture in (photo, lit, constant)]
    where = where & np.all([luminance > 0 for luminance in luminances], axis=0)
    logs = [np.log(luminance[where]) for luminance in luminances]
    if where.sum() < FEWEST or min(map(np.ptp, logs)) == 0:
        return ShadowMatch(None, None, int(where.sum()))
    recovered, shape = (float(np.corrcoef(logs[0], other)[0, 1]) for other in logs[1:])
    return ShadowMatch(recovered, shape, int(where.sum()))
