"""Training data of the paper's network: pixels of rendered spheres, each of one material in the light of one lobe.

Scene    A unit sphere in the camera frame (OpenCV), which is Mitsuba's world here. The camera is infinitely far away,
         so that every pixel's view is (0, 0, −1).
Light    A unit lobe exp(λ(ω·z − 1)) as an `envmap` rotated so that its pole is along z: the map is then a function of
         its row alone, and `MAP_ROWS` rows of a few columns resolve the sharpest lobe.
Pixels   Single rays, not squares: the light of a sharp lobe on a glossy sphere changes within a pixel of any small
         image. Half of them are spread evenly over the sphere's disc, half about its highlight.
Material Reflectances of 1: the model is linear in them, and its colour channels are independent.
"""

from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import FRONT
from factorlib.geometry.raster import unit
from factorlib.tracing.scene import SAMPLER, rgb, rigid, transform
from factorlib.tracing.variant import mitsuba

MAP_ROWS = 2048
MAP_COLUMNS = 8
SPP = 16  # number of rays per pixel
SHADOW_RAYS = 4  # number of directions per ray sampled by the light, and as many by the material
LEAST_FACING = 0.01  # least n·o of a pixel
ALPHA = (0.008, 1.0)  # range of α, log-uniform
SHARPNESS = (0.05, 1e4)  # range of λ, log-uniform


class Spheres(msgspec.Struct, frozen=True):
    """Parameters of n spheres: the lobe's axis (camera frame, unit) and sharpness, and the material's roughness."""

    axis: Float[np.ndarray, "n 3"]
    sharpness: Float[np.ndarray, " n"]
    roughness: Float[np.ndarray, " n"]


class Pixels(msgspec.Struct, frozen=True):
    """Pixels of spheres [n, m]: unit normals in the camera frame, and radiance at unit reflectance and unit weight."""

    normal: Float[np.ndarray, "n m 3"]
    diffuse: Float[np.ndarray, "n m"]
    specular: Float[np.ndarray, "n m"]


def random_spheres(rng: np.random.Generator, count: int) -> Spheres:
    """Draw spheres: axes uniform on the sphere, α and λ log-uniform."""
    axis = unit(rng.standard_normal((count, 3)))
    alpha, sharpness = (np.exp(rng.uniform(low, high, count)) for low, high in np.log([ALPHA, SHARPNESS]))
    return Spheres(axis, sharpness, np.sqrt(alpha))


def render_spheres(spheres: Spheres, pixels: int, rng: np.random.Generator) -> Pixels:
    """Render random pixels of each sphere by Mitsuba.

    Args:
        spheres: The spheres.
        pixels: Number of pixels of each sphere.
        rng: Random generator; equal ones give equal bytes on one machine.

    Returns:
        The pixels.
    """
    rows = []
    lambertian = {"type": "diffuse", "reflectance": rgb(1.0)}
    for k, (axis, sharpness, alpha) in enumerate(
        zip(spheres.axis, spheres.sharpness, spheres.roughness**2, strict=True)
    ):
        normal = _normals(axis, sharpness, alpha, pixels, rng)
        light = _envmap(axis, sharpness)
        sensor = _sensor(normal)
        glossy = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": float(alpha)}
        rows.append((normal, *(_radiance(bsdf, light, sensor, k) for bsdf in (lambertian, glossy))))
    return Pixels(*(np.stack(column) for column in zip(*rows, strict=True)))


def _normals(
    axis: Float[np.ndarray, "3"], sharpness: float, alpha: float, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "m 3"]:
    """Draw normals that the camera sees: first the even ones, then those about the highlight.

    A change of a normal rotates the mirror direction twice as much. So the highlight's normals have a spread of √(α²/2
    + 1/λ), half of that of lobes in `factorlib.reflection.samples`.
    """
    angle = rng.uniform(0, 2 * np.pi, 4 * count)
    radius = np.sqrt(rng.uniform(0, 1, 4 * count))
    even = np.stack([radius * np.cos(angle), radius * np.sin(angle), -np.sqrt(1 - radius**2)], axis=-1)
    highlight = unit(axis + FRONT) + np.sqrt(alpha**2 / 2 + 1 / sharpness) * rng.standard_normal((4 * count, 3))
    even, highlight = (n[n @ FRONT > LEAST_FACING] for n in (even, unit(highlight)))
    half = min(count // 2, len(highlight))  # a light right behind the sphere has no visible highlight
    return np.concatenate([even[: count - half], highlight[:half]])


def _envmap(axis: Float[np.ndarray, "3"], sharpness: float) -> Any:
    """Return a lobe of peak 1 as Mitsuba's emitter."""
    theta = np.arange(MAP_ROWS) / (MAP_ROWS - 1) * np.pi  # polar angle of Mitsuba's rows
    radiance = np.exp(-2 * sharpness * np.sin(theta / 2) ** 2).astype(np.float32)
    bitmap = mitsuba().Bitmap(np.tile(radiance[:, None, None], (1, MAP_COLUMNS, 3)))
    across = unit(np.cross(axis, np.eye(3)[np.abs(axis).argmin()]))
    turn = np.stack([across, axis, np.cross(across, axis)], axis=-1)
    return mitsuba().load_dict({"type": "envmap", "bitmap": bitmap, "to_world": transform(rigid(turn, np.zeros(3)))})


def _sensor(normal: Float[np.ndarray, "m 3"]) -> Any:
    """Return a sensor of one ray per pixel, toward the sphere's points of these normals, in an image of one row."""
    film = {"type": "hdrfilm", "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    ray = {"type": "radiancemeter", "direction": (-FRONT).tolist(), "film": film | {"width": 1}}
    rays = {f"ray{k:05d}": ray | {"origin": (point + FRONT).tolist()} for k, point in enumerate(normal)}
    sensor = {"type": "batch", "film": film | {"width": len(rays)}, "sampler": {"type": SAMPLER}, **rays}
    return mitsuba().load_dict(sensor, parallel=False)


def _radiance(bsdf: dict[str, Any], light: Any, sensor: Any, seed: int) -> Float[np.ndarray, " m"]:
    """Render the sphere with a BSDF and return the radiance of each pixel."""
    mi = mitsuba()
    integrator = {"type": "direct", "emitter_samples": SHADOW_RAYS, "bsdf_samples": SHADOW_RAYS}
    ball = mi.load_dict({"type": "sphere", "bsdf": bsdf})
    scene = {"type": "scene", "integrator": integrator, "ball": ball, "light": light, "sensor": sensor}
    scene = mi.load_dict(scene, parallel=False)
    return np.array(mi.render(scene, seed=seed, spp=SPP), dtype=np.float64)[0, :, 0]
