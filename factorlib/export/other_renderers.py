"""Reflection models of exported materials in other programs, and errors of a ball rendered by each.

All models are Lambert plus GGX of the same α.  They differ in shadowing, in Fresnel, and in the share that the specular
part leaves for the diffuse one:

    solved                 k_d/π + k_s D V,  V = G1(n·i) G1(n·o) / (4 (n·i)(n·o))      (`factorlib.reflection.brdf`)
    blender                V of the height-correlated Smith term (Heitz 2014, eq. 99), as Cycles' Glossy BSDF "GGX"
    glb                    glTF 2.0, appendix B, with KHR_materials_specular:
                           Schlick's F to F90 = specularFactor, diffuse × (1 − max F)
    glb_correlated         glb with the height-correlated term, as most viewers draw it
    glb_plain              glb in viewers without KHR_materials_specular: F0 = 0.04, F90 = 1
    mtlx                   MaterialX' own GLSL shaders: height-correlated, times 1 + F (1 − E)/E,
                           E the albedo for F = 1 (Turquin 2019)
    mtlx_standard_surface  mtlx, where the specular layer leaves 1 − specular · (its albedo for white) for the diffuse
                           one
    usd                    UsdPreviewSurface: Schlick's F to F90 = 1, diffuse × (1 − F) as OpenUSD's shader;
                           V, not specified, as solved

A material written as a metal has F0 = k_s and F90 = 1 in all three models of glTF.

Ball        Radius 1, seen from far away in PIXELS × PIXELS; pixels with n·o under LEAST_COSINE are left out.
Lights      A sky of constant radiance; a lamp above the viewer's left shoulder; a lamp behind the ball, to the right.
            The last one grazes the ball, where shadowing and Fresnel differ most.  White, without shadows.
Difference  |model − solved| / max(solved, 0.001), per channel; a white Lambertian ball in the sky has radiance 1.
            "mean" and "worst" are over all lit pixels, channels and lights.
"""

from collections.abc import Callable
from functools import cache, partial

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.export.gltf_writer import DIELECTRIC, EXTENSION, gltf_material
from factorlib.export.usd import shader_inputs, with_roughness_of_file
from factorlib.geometry.sphere import ball_normals
from factorlib.results.materials import Reflectance

ALBEDO_NODES = 64  # cosines in the table of albedos
ALBEDO_SAMPLES = 4096  # half vectors per cosine
GOLDEN = (5**0.5 - 1) / 2
PIXELS = 48  # width and height of the ball's picture
LEAST_COSINE = 0.1  # least n·o of a pixel
FLOOR = 1e-3  # least denominator of a relative difference
LEAST_ROUGHNESS = 1e-3**0.5  # roughness used for mirrors
LAMPS = {"lamp": (-1.0, 1.0, 1.5), "grazing lamp": (1.0, 0.3, -0.6)}  # x right, y up, z toward the viewer
SKY_NODES = 33
SKY_SAMPLES = 1024


class Angles(msgspec.Struct, frozen=True):
    """Cosines between normal n, light direction i, view direction o and half vector h, as arrays of one shape."""

    ni: Float[np.ndarray, "*n"]
    no: Float[np.ndarray, "*n"]
    nh: Float[np.ndarray, "*n"]
    oh: Float[np.ndarray, "*n"]


class BrdfTerms(msgspec.Struct, frozen=True):
    """A BRDF per channel, 1/steradian: diffuse + D(n·h) · lobe."""

    diffuse: Float[np.ndarray, "*n 3"]
    lobe: Float[np.ndarray, "*n 3"]


Model = Callable[[Reflectance, Angles], BrdfTerms]
Shadowing = Callable[[float, Angles], Float[np.ndarray, "*n"]]


def distribution(alpha: float, nh: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the GGX distribution D, 1/steradian."""
    return alpha**2 / (np.pi * ((alpha**2 - 1) * nh**2 + 1) ** 2)


def evaluate_solved_brdf(material: Reflectance, angles: Angles) -> BrdfTerms:
    """Evaluate the reflection model of the solve."""
    return _brdf_terms(angles, material.diffuse, material.specular, separable_smith(material.alpha, angles))


def mtlx(material: Reflectance, angles: Angles) -> BrdfTerms:
    """Evaluate the nodes of `factorlib.export.materialx`."""
    weight, _, specular = material.mixture
    brighter = 1 + np.multiply.outer(1 / np.interp(angles.no, *albedo_table(material.alpha)) - 1, specular)
    return _brdf_terms(
        angles, material.diffuse, weight * np.array(specular) * brighter, correlated_smith(material.alpha, angles)
    )


def mtlx_standard_surface(material: Reflectance, angles: Angles) -> BrdfTerms:
    """Evaluate the standard surface of `factorlib.export.materialx`; for its F of 1, E · (1 + (1 − E)/E) = 1."""
    specular = np.multiply.outer(1 / np.interp(angles.no, *albedo_table(material.alpha)), material.specular)
    return _brdf_terms(angles, material.diffuse, specular, correlated_smith(material.alpha, angles))


def usd(material: Reflectance, angles: Angles) -> BrdfTerms:
    """Evaluate UsdPreviewSurface with the inputs in the file, at the roughness of `material`.

    `differences` passes the material with the roughness of the file.
    """
    inputs = shader_inputs(material)
    base = np.asarray(inputs["diffuseColor"])
    visibility = separable_smith(material.alpha, angles)
    if not inputs["useSpecularWorkflow"]:  # a metal
        return _brdf_terms(angles, np.zeros(3), base, visibility)
    fresnel = schlick(np.asarray(inputs["specularColor"]), 1.0, angles)
    return _brdf_terms(angles, base * (1 - fresnel), fresnel, visibility)


# terms ---------------------------------------------------------------------------------------------------------------


def schlick(f0: Float[np.ndarray, "3"], f90: float, angles: Angles) -> Float[np.ndarray, "*n 3"]:
    """Return Schlick's Fresnel term, F0 at normal and F90 at grazing incidence."""
    return f0 + np.multiply.outer((1 - angles.oh) ** 5, f90 - f0)


def separable_smith(alpha: float, angles: Angles) -> Float[np.ndarray, "*n"]:
    """Return G1(n·i) G1(n·o) / (4 (n·i)(n·o)), finite at the horizon."""
    return 1 / ((angles.ni + _root(alpha, angles.ni)) * (angles.no + _root(alpha, angles.no)))


def correlated_smith(alpha: float, angles: Angles) -> Float[np.ndarray, "*n"]:
    """Return the height-correlated Smith term over 4 (n·i)(n·o)."""
    return 0.5 / (angles.no * _root(alpha, angles.ni) + angles.ni * _root(alpha, angles.no))


def _root(alpha: float, cosine: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    return np.sqrt(alpha**2 + (1 - alpha**2) * cosine**2)


@cache
def albedo_table(alpha: float) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return cosines n·o, and E, the albedo of a height-correlated GGX of F = 1, at each of them."""
    nodes = (np.arange(ALBEDO_NODES) + 1) / ALBEDO_NODES
    angles, weight = sample_directions(alpha, nodes, ALBEDO_SAMPLES)
    return nodes, (weight * correlated_smith(alpha, angles)).mean(axis=-1)


def lattice_points(count: int) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    """Return points spread evenly over [0, 1] × [0, π] (Fibonacci lattice); azimuths beyond π are mirror images."""
    index = np.arange(count)
    return (index + 0.5) / count, np.pi * (index * GOLDEN % 1)


def sample_directions(alpha: float, no: Float[np.ndarray, " n"], count: int) -> tuple[Angles, Float[np.ndarray, "n s"]]:
    """Sample light directions i for views at n·o = `no`, mirrored at half vectors distributed by D(n·h) n·h.

    The mean of weight · lobe is ∫ D · lobe · n·i di.  The weight is 4 (n·i)(o·h)/(n·h), and zero below the horizon.

    Args:
        alpha: GGX width α
        no: cosines n·o
        count: samples per cosine

    Returns:
        The angles and the weights.
    """
    # sample h by D(n·h) n·h, mirror o at h, and weight by the Jacobian
    u, phi = lattice_points(count)
    nh = np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u))
    oh = no[:, None] * nh + np.sqrt(1 - no[:, None] ** 2) * np.sqrt(1 - nh**2) * np.cos(phi)
    ni = 2 * oh * nh - no[:, None]
    weight = np.where((oh > 0) & (ni > 0), 4 * ni * oh / nh, 0.0)
    shape = weight.shape
    return Angles(ni.clip(0), np.broadcast_to(no[:, None], shape), np.broadcast_to(nh, shape), oh.clip(0)), weight


def _gltf(material: Reflectance, angles: Angles, shadowing: Shadowing, extension: bool = True) -> BrdfTerms:
    """Evaluate a model of glTF with the numbers in the file."""
    entry = gltf_material(material)
    base = np.array(entry["pbrMetallicRoughness"]["baseColorFactor"][:3])
    visibility = shadowing(material.alpha, angles)
    if entry["pbrMetallicRoughness"]["metallicFactor"]:
        return _brdf_terms(angles, np.zeros(3), schlick(base, 1.0, angles), visibility)
    specular = entry["extensions"][EXTENSION] if extension else {"specularFactor": 1.0, "specularColorFactor": 1.0}
    f90 = specular["specularFactor"]
    f0 = f90 * np.minimum(DIELECTRIC * np.broadcast_to(specular["specularColorFactor"], 3), 1)
    fresnel = schlick(f0, f90, angles)
    return _brdf_terms(angles, base * (1 - fresnel.max(axis=-1, keepdims=True)), fresnel, visibility)


def _brdf_terms(
    angles: Angles, diffuse: np.ndarray | tuple, specular: np.ndarray | tuple, visibility: Float[np.ndarray, "*n"]
) -> BrdfTerms:
    """Return the BRDF of a diffuse albedo, a Fresnel term (`specular`) and a shadowing term V (`visibility`)."""
    shape = (*angles.no.shape, 3)
    return BrdfTerms(np.broadcast_to(np.asarray(diffuse) / np.pi, shape), visibility[..., None] * np.asarray(specular))


MODELS: dict[str, Model] = {
    "blender": lambda m, angles: _brdf_terms(angles, m.diffuse, m.specular, correlated_smith(m.alpha, angles)),
    "glb": partial(_gltf, shadowing=separable_smith),
    "glb_correlated": partial(_gltf, shadowing=correlated_smith),
    "glb_plain": partial(_gltf, shadowing=separable_smith, extension=False),
    "mtlx": mtlx,
    "mtlx_standard_surface": mtlx_standard_surface,
    "usd": usd,
}


# differences ---------------------------------------------------------------------------------------------------------


def differences(material: Reflectance) -> dict[str, dict[str, float]]:
    """Return mean and worst relative difference of each of `MODELS` from the solved model; 0 for a black material.

    They are rounded to 5 digits.
    """
    material = msgspec.structs.replace(material, roughness=max(material.roughness, LEAST_ROUGHNESS))
    written = {name: with_roughness_of_file(material) if name == "usd" else material for name in MODELS}
    expected = ball_radiance(material, evaluate_solved_brdf)
    result = {}
    for name, model in MODELS.items():
        rendered = ball_radiance(written[name], model)
        relative = (np.abs(rendered - expected) / np.maximum(expected, FLOOR))[(expected > 0) | (rendered > 0)]
        numbers = (relative.mean(), relative.max()) if relative.size else (0.0, 0.0)
        result[name] = dict(zip(("mean", "worst"), (round(float(value), 5) for value in numbers)))
    return result


def ball_radiance(material: Reflectance, model: Model) -> Float[np.ndarray, "n 3"]:
    """Return the radiance of a ball's pixels in a sky of radiance 1, then under each of `LAMPS`, one after the other.

    Every lamp has irradiance π, so the radiance under it is f · n·i · π.
    """
    normals = ball_normals(PIXELS)[0]
    normals = normals[normals[:, 2] >= LEAST_COSINE]
    nodes = np.linspace(LEAST_COSINE, 1.0, SKY_NODES)
    sky = integrate_sky(material, model, nodes)
    pictures = [np.stack([np.interp(normals[:, 2], nodes, channel) for channel in sky.T], axis=-1)]
    view = np.array([0.0, 0.0, 1.0])
    for lamp in LAMPS.values():
        light = np.array(lamp) / np.linalg.norm(lamp)
        half = (view + light) / np.linalg.norm(view + light)
        ni = (normals @ light).clip(0)
        angles = Angles(ni, normals[:, 2], (normals @ half).clip(0), np.full(len(normals), view @ half))
        parts = model(material, angles)
        brdf = parts.diffuse + distribution(material.alpha, angles.nh)[:, None] * parts.lobe
        pictures.append(np.pi * ni[:, None] * brdf)
    return np.concatenate(pictures)


def integrate_sky(material: Reflectance, model: Model, no: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return the radiance ∫ f n·i di that a reflection model sends to views at some angles, in a sky of radiance 1.

    Args:
        material: the reflectance
        model: the reflection model
        no: cosines n·o
    """
    # specular part, by importance sampling of the GGX distribution
    angles, weight = sample_directions(material.alpha, no, SKY_SAMPLES)
    specular = (weight[..., None] * model(material, angles).lobe).mean(axis=1)
    # diffuse part, by cosine-weighted sampling
    square, phi = lattice_points(SKY_SAMPLES)
    ni = np.broadcast_to(np.sqrt(square), (len(no), square.size))
    no = np.broadcast_to(no[:, None], ni.shape)
    io = ni * no + np.sqrt((1 - ni**2) * (1 - no**2)) * np.cos(phi)
    oh = np.sqrt((1 + io) / 2)
    return specular + np.pi * model(material, Angles(ni, no, (ni + no) / (2 * oh), oh)).diffuse.mean(axis=1)
