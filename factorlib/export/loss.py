"""What is lost on the way to other programs: the difference that a ball of a material shows there, in three lights.

Ball       of radius 1, seen from far away in PIXELS × PIXELS; pixels where n·o is under LEAST_COSINE are left out.
Lights     a sky of the same radiance from everywhere; a lamp above the viewer's left shoulder; a lamp behind the ball, to the right, whose
           light grazes it, where shadowing and Fresnel differ most.  White, without shadows.
Difference |shown − solved| / max(solved, 0.001), per channel; in the sky a white Lambertian ball sends 1.  "mean" and "worst" are over
           all lit pixels, channels and lights.
"""

from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.export.usd import with_roughness_of_file
from factorlib.export.viewers import MODELS, Angles, Model, distribution, mirrored, solved, spread
from factorlib.geometry.sphere import ball_normals
from factorlib.jsonfile import write_json
from factorlib.results.materials import Reflectance

PIXELS, LEAST_COSINE, FLOOR = 48, 0.1, 1e-3
LEAST_ROUGHNESS = 1e-3**0.5  # mirrors are taken at this roughness
LAMPS = {"lamp": (-1.0, 1.0, 1.5), "grazing lamp": (1.0, 0.3, -0.6)}  # x right, y up, z toward the viewer
SKY_NODES, SKY_SAMPLES = 33, 1024


class Loss(msgspec.Struct, frozen=True):
    """Relative differences."""

    mean: float
    worst: float


def write_losses(path: str | Path, materials: Mapping[str, Reflectance]) -> None:
    """Write {material: {model of `viewers.MODELS`: mean, worst}}."""
    write_json(path, {name: losses(material) for name, material in materials.items()})


def losses(material: Reflectance) -> dict[str, Loss]:
    """Return the loss of each of `viewers.MODELS` against the model of the solve, rounded to 5 digits; a black material loses nothing."""
    material = msgspec.structs.replace(material, roughness=max(material.roughness, LEAST_ROUGHNESS))
    filed = {name: with_roughness_of_file(material) if name == "usd" else material for name in MODELS}
    true = np.concatenate(ball(material, solved))
    return {name: _loss(np.concatenate(ball(filed[name], model)), true) for name, model in MODELS.items()}


def _loss(shown: Float[np.ndarray, "n 3"], true: Float[np.ndarray, "n 3"]) -> Loss:
    relative = (np.abs(shown - true) / np.maximum(true, FLOOR))[(true > 0) | (shown > 0)]
    return Loss(round(float(relative.mean()), 5), round(float(relative.max()), 5)) if relative.size else Loss(0.0, 0.0)


def ball(material: Reflectance, model: Model) -> list[Float[np.ndarray, "n 3"]]:
    """Radiance of the ball's pixels in each light: sky of radiance 1, lamps of irradiance π."""
    normals = ball_normals(PIXELS)[0]
    normals = normals[normals[:, 2] >= LEAST_COSINE]
    nodes = np.linspace(LEAST_COSINE, 1.0, SKY_NODES)
    sky = in_sky(material, model, nodes)
    in_the_sky = np.stack([np.interp(normals[:, 2], nodes, sky[:, c]) for c in range(3)], axis=-1)
    return [in_the_sky, *(in_lamp(material, model, normals, np.array(lamp)) for lamp in LAMPS.values())]


def in_lamp(
    material: Reflectance, model: Model, normals: Float[np.ndarray, "n 3"], lamp: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """f · n·i · π for a lamp far away in the direction `lamp`."""
    view, light = np.array([0.0, 0.0, 1.0]), lamp / np.linalg.norm(lamp)
    half = (view + light) / np.linalg.norm(view + light)
    ni = (normals @ light).clip(0)
    angles = Angles(ni, normals[:, 2], (normals @ half).clip(0), np.full(len(normals), view @ half))
    parts = model(material, angles)
    return np.pi * ni[:, None] * (parts.diffuse + distribution(material.alpha, angles.nh)[:, None] * parts.lobe)


def in_sky(material: Reflectance, model: Model, no: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """∫ f n·i di by n·o: the specular part over directions spread by the GGX, the diffuse part over ones spread by n·i."""
    angles, weight = mirrored(material.alpha, no, SKY_SAMPLES)
    specular = (weight[..., None] * model(material, angles).lobe).mean(axis=1)
    square, phi = spread(SKY_SAMPLES)
    ni = np.broadcast_to(np.sqrt(square), (len(no), square.size))
    no = np.broadcast_to(no[:, None], ni.shape)
    io = ni * no + np.sqrt((1 - ni**2) * (1 - no**2)) * np.cos(phi)
    oh = np.sqrt((1 + io) / 2)
    return specular + np.pi * model(material, Angles(ni, no, (ni + no) / (2 * oh), oh)).diffuse.mean(axis=1)
