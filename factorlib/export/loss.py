"""Losses of exported materials: the difference in radiance of a ball, in three lights, against the solved model.

Ball        Radius 1, seen from far away in PIXELS × PIXELS; pixels with n·o under LEAST_COSINE are left out.
Lights      A sky of constant radiance; a lamp above the viewer's left shoulder; a lamp behind the ball, to the right.
            The last one grazes the ball, where shadowing and Fresnel differ most.  White, without shadows.
Difference  |shown − solved| / max(solved, 0.001), per channel; a white Lambertian ball in the sky has radiance 1.
            "mean" and "worst" are over all lit pixels, channels and lights.
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

PIXELS = 48  # width and height of the ball's picture
LEAST_COSINE = 0.1  # least n·o of a pixel
FLOOR = 1e-3  # least denominator of a relative difference
LEAST_ROUGHNESS = 1e-3**0.5  # roughness used for mirrors
LAMPS = {"lamp": (-1.0, 1.0, 1.5), "grazing lamp": (1.0, 0.3, -0.6)}  # x right, y up, z toward the viewer
SKY_NODES = 33
SKY_SAMPLES = 1024


class Loss(msgspec.Struct, frozen=True):
    """Mean and largest relative difference."""

    mean: float
    worst: float


def write_losses(path: str | Path, materials: Mapping[str, Reflectance]) -> None:
    """Write {material: {model of `viewers.MODELS`: mean, worst}}."""
    write_json(path, {name: losses(material) for name, material in materials.items()})


def losses(material: Reflectance) -> dict[str, Loss]:
    """Return the loss of each of `viewers.MODELS` against the solved model, rounded to 5 digits.

    The losses of a black material are 0.
    """
    material = msgspec.structs.replace(material, roughness=max(material.roughness, LEAST_ROUGHNESS))
    filed = {name: with_roughness_of_file(material) if name == "usd" else material for name in MODELS}
    true = np.concatenate(ball(material, solved))
    return {name: _loss(np.concatenate(ball(filed[name], model)), true) for name, model in MODELS.items()}


def _loss(shown: Float[np.ndarray, "n 3"], true: Float[np.ndarray, "n 3"]) -> Loss:
    relative = (np.abs(shown - true) / np.maximum(true, FLOOR))[(true > 0) | (shown > 0)]
    return Loss(round(float(relative.mean()), 5), round(float(relative.max()), 5)) if relative.size else Loss(0.0, 0.0)


def ball(material: Reflectance, model: Model) -> list[Float[np.ndarray, "n 3"]]:
    """Return the radiance of the ball's pixels in each light: sky of radiance 1, lamps of irradiance π."""
    normals = ball_normals(PIXELS)[0]
    normals = normals[normals[:, 2] >= LEAST_COSINE]
    nodes = np.linspace(LEAST_COSINE, 1.0, SKY_NODES)
    sky = in_sky(material, model, nodes)
    in_the_sky = np.stack([np.interp(normals[:, 2], nodes, sky[:, c]) for c in range(3)], axis=-1)
    return [in_the_sky, *(in_lamp(material, model, normals, np.array(lamp)) for lamp in LAMPS.values())]


def in_lamp(
    material: Reflectance, model: Model, normals: Float[np.ndarray, "n 3"], lamp: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Return f · n·i · π, the radiance in the light of a distant lamp.

    Args:
        material: the reflectance
        model: the reflection model
        normals: unit normals; x right, y up, z toward the viewer
        lamp: direction to the lamp, of any length
    """
    view = np.array([0.0, 0.0, 1.0])
    light = lamp / np.linalg.norm(lamp)
    half = (view + light) / np.linalg.norm(view + light)
    ni = (normals @ light).clip(0)
    angles = Angles(ni, normals[:, 2], (normals @ half).clip(0), np.full(len(normals), view @ half))
    parts = model(material, angles)
    return np.pi * ni[:, None] * (parts.diffuse + distribution(material.alpha, angles.nh)[:, None] * parts.lobe)


def in_sky(material: Reflectance, model: Model, no: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Integrate f n·i over the hemisphere, in a sky of radiance 1.

    Args:
        material: the reflectance
        model: the reflection model
        no: cosines n·o
    """
    # specular part, by importance sampling of the GGX distribution
    angles, weight = mirrored(material.alpha, no, SKY_SAMPLES)
    specular = (weight[..., None] * model(material, angles).lobe).mean(axis=1)
    # diffuse part, by cosine-weighted sampling
    square, phi = spread(SKY_SAMPLES)
    ni = np.broadcast_to(np.sqrt(square), (len(no), square.size))
    no = np.broadcast_to(no[:, None], ni.shape)
    io = ni * no + np.sqrt((1 - ni**2) * (1 - no**2)) * np.cos(phi)
    oh = np.sqrt((1 + io) / 2)
    return specular + np.pi * model(material, Angles(ni, no, (ni + no) / (2 * oh), oh)).diffuse.mean(axis=1)
