"""Truth of a data set: its maps, read and checked, and errors of recovered materials, albedo, normals and poses.

Normals    Angle between estimated and true normal over the pixels where both are known; null: every normal faces the
           camera.
Poses      Geodesic angle of rotation_estimateᵀ · rotation_truth, and the distance of the translations relative to the
           true distance from the camera.  The null is a random rotation, of mean error 126.5° (90° + 114.6° / π).
           A symmetric shape can have a large rotation error and yet match every pixel; the normals show it.
Roughness  Absolute difference.
Colours    Diffuse and specular, relative to the truth, after one factor per channel that all materials of a connected
           component share, because observations cannot separate it from the light.  The factor is the median over the
           component's materials of true over estimated diffuse + specular: a material's total reflectance is known
           best, and one bad material does not move a median.  A true albedo below 0.01 counts as 0.01.  The null is a
           grey ball: diffuse 0.5, specular 0.05, roughness 0.5 for every material, scaled by its own factor.
Albedo     |estimate / truth − 1| of k_d times the factor of the texture, per pixel and channel, over the pixels where
           both are known, after one factor per channel for the set.  The factor is the median over these pixels of
           truth over estimate.  The null is the flat material (factors of 1), scaled by its own factor.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from factorlib.conventions import FRONT
from factorlib.dataset.schema import RigidTransform
from factorlib.errors import InputError
from factorlib.images.exr import read_exr
from factorlib.images.light_map import read_light_map
from factorlib.images.photo import box_mean, box_sum
from factorlib.reading import reading
from factorlib.results.materials import Reflectance, Vec3, vec3
from factorlib.results.metrics import (
    AlbedoErrors,
    AngleError,
    ComparedMaterial,
    ErrorWithNull,
    MaterialError,
    MaterialScores,
    NormalError,
    PoseError,
    RelativeError,
)
from factorlib.results.poses import PoseEntry


def read_true_light(path: Path, name: str) -> Float[np.ndarray, "h w 3"]:
    """Read the lat-long map of illumination `name`; InputError if a texel is not a valid radiance."""
    return read_light_map(path, f"illumination.{name}").astype(np.float32)


def read_true_normals(path: Path, name: str, size: tuple[int, int]) -> Float[np.ndarray, "h w 3"]:
    """Read the true normals of a photo from channels normal.x/y/z, or R, G, B.

    Args:
        path: the EXR file
        name: name of the photo
        size: width and height of the photo

    Returns:
        Normals, zero or NaN where unknown.

    Raises:
        InputError: The file lacks a channel, has another size, or holds an infinite value.
    """
    key = f"normals.{name}"
    normals = _read_photo_map(path, key, size, vectors=True)
    if np.isinf(normals).any():
        raise InputError("a normal is infinite", file=path, key=key, cure="write 0 where the normal is unknown")
    return normals


def read_true_albedo(path: Path, name: str, size: tuple[int, int]) -> Float[np.ndarray, "h w 3"]:
    """Read the true k_d of a photo's pixels, linear Rec. 709, from channels R, G, B.

    Args:
        path: the EXR file
        name: name of the photo
        size: width and height of the photo

    Returns:
        k_d, zero or NaN where unknown.

    Raises:
        InputError: The file lacks a channel, has another size, or holds a value below 0 or above 1.
    """
    key = f"albedo.{name}"
    albedo = _read_photo_map(path, key, size)
    if (wrong := albedo[(albedo < 0) | (albedo > 1)]).size:
        raise InputError(
            f"an albedo is {wrong[0]:.4g}",
            file=path,
            key=key,
            cure="write the diffuse reflectance, from 0 to 1, and 0 where it is unknown",
        )
    return albedo


def _read_photo_map(path: Path, key: str, size: tuple[int, int], vectors: bool = False) -> Float[np.ndarray, "h w 3"]:
    """Read three channels of an EXR with the pixels of a photo of the given width and height.

    They are R, G, B, or, if they may be `vectors`, normal.x/y/z.
    """
    with reading("an image", path, key):
        channels = read_exr(path)
    axes = [f"normal.{axis}" for axis in "xyz"]
    names = axes if vectors and "normal.x" in channels else list("RGB")
    if missing := [channel for channel in names if channel not in channels]:
        forms = f"{', '.join(axes)}, or R, G, B" if vectors else "R, G, B"
        raise InputError(
            f"has no channel {missing[0]}, only {', '.join(channels)}",
            file=path,
            key=key,
            cure=f"write the {key.split('.')[0]} as channels {forms}",
        )
    values = np.stack([channels[channel] for channel in names], axis=-1)
    if values.shape[1::-1] != tuple(size):
        raise InputError(
            f"has {values.shape[1]} × {values.shape[0]} pixels, the photo {size[0]} × {size[1]}",
            file=path,
            key=key,
            cure="render it with the photo's own pixels",
        )
    return values


RANDOM_ROTATION_DEG = float(np.degrees(np.pi / 2 + 2 / np.pi))


def normal_error(
    estimate: Float[np.ndarray, "h w 3"], truth: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> NormalError | None:
    """Return the errors over the pixels of `mask` where both normals are known (not zero); None if there are none.

    Args:
        estimate: estimated unit normals, zero where unknown
        truth: true unit normals, zero where unknown
        mask: pixels to compare
    """
    known = mask & (np.linalg.norm(estimate, axis=-1) > 0.5) & (np.linalg.norm(truth, axis=-1) > 0.5)
    if not known.any():
        return None
    true = truth[known].astype(float)
    angles = [angles_deg(each.astype(float), true) for each in (estimate[known], np.broadcast_to(FRONT, true.shape))]
    percentiles = [[round(float(np.percentile(each, q)), 6) for q in (50, 90)] for each in angles]
    return NormalError(int(known.sum()), *(AngleError(*each) for each in percentiles))


def average_normals(normal: Float[np.ndarray, "h w 3"], factor: int) -> Float[np.ndarray, "i j 3"]:
    """Return unit mean normals of boxes of factor × factor pixels; zero where under half of a box is known."""
    if factor == 1:
        return normal
    known = np.linalg.norm(normal, axis=-1) > 0.5
    mean = box_sum(np.where(known[..., None], normal, 0), factor)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    enough = (2 * box_sum(known, factor, np.int64) >= factor**2)[..., None] & (length > 0)
    return np.where(enough, mean / np.where(enough, length, 1), 0)


def albedo_errors(
    kinds: Sequence[Float[np.ndarray, "n 3"]],
    truth: Float[np.ndarray, "n 3"],
    material: Int[np.ndarray, " n"],
    names: Sequence[str],
) -> AlbedoErrors | None:
    """Return the errors of albedo over pixels; None if there are none.

    Args:
        kinds: estimated k_d, and that without a texture
        truth: true k_d, above 0
        material: index of each pixel's material
        names: names of the materials
    """
    if not len(truth):
        return None
    # logarithms of the ratios to the truth, and relative errors after the factor
    logs = [np.log(np.maximum(kind, 1e-30) / truth) for kind in kinds]
    relative = [np.abs(np.expm1(log - np.median(log, axis=0))) for log in logs]

    def errors(pixels: Bool[np.ndarray, " n"]) -> ErrorWithNull[RelativeError]:
        """Return the errors of some pixels, over all channels."""
        percentiles = [[round(float(np.percentile(each[pixels], q)), 6) for q in (50, 90)] for each in relative]
        return ErrorWithNull(*(RelativeError(*each) for each in percentiles))

    materials = {name: errors(material == k) for k, name in enumerate(names) if (material == k).any()}
    return AlbedoErrors(len(truth), vec3(np.exp(-np.median(logs[0], axis=0))), errors(material >= 0), materials)


def average_albedo(albedo: Float[np.ndarray, "h w 3"], factor: int) -> Float[np.ndarray, "i j 3"]:
    """Return mean albedo of boxes of factor × factor pixels, over the pixels where it is known; zero without any."""
    known = np.asarray((albedo > 0).any(axis=-1))
    return box_mean(np.where(known[..., None], albedo, 0), known, factor)[0]


def angles_deg(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the angles between vectors of any length, in degrees, accurate for small angles too.

    >>> angles_deg(np.array([[1.0, 0, 0]]), np.array([[0, 2.0, 0]])).tolist()
    [90.0]
    """
    a, b = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (a, b))
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def pose_error(estimate: PoseEntry | RigidTransform, truth: RigidTransform) -> PoseError:
    """Return the difference of two cam_from_object; the translations are in one unit."""
    moved = np.linalg.norm(np.subtract(estimate.translation, truth.translation))
    distance = float(np.linalg.norm(truth.translation)) or 1.0
    chord = np.linalg.norm(np.subtract(estimate.rotation, truth.rotation))  # 2√2 sin(angle / 2)
    turned = np.degrees(2 * np.arcsin(min(1.0, chord / (2 * np.sqrt(2)))))
    return PoseError(float(turned), float(moved) / distance, RANDOM_ROTATION_DEG)


DARKEST = 0.01
GREY = Reflectance(diffuse=(0.5, 0.5, 0.5), specular=(0.05, 0.05, 0.05), roughness=0.5)


def compare_materials(
    estimates: Mapping[str, Reflectance], truths: Mapping[str, Reflectance], component: Mapping[str, int]
) -> MaterialScores | None:
    """Return the errors of the materials that have a truth; None if there are none.

    Args:
        estimates: recovered materials by name
        truths: true materials by name
        component: connected component of each material; a material without one was never observed and is left out
    """
    names = [n for n in estimates if n in truths and n in component]
    if not names:
        return None
    factors = {}
    compared = {}
    for c in sorted({component[n] for n in names}):
        group = [n for n in names if component[n] == c]
        kinds = [[estimates[n] for n in group], [GREY] * len(group)]
        factors[c] = [common_factor(kind, [truths[n] for n in group]) for kind in kinds]
        for n, *pair in zip(group, *kinds):
            errors = [_error(material, truths[n], factor) for material, factor in zip(pair, factors[c])]
            compared[n] = ComparedMaterial(c, truths[n], estimates[n], *errors)
    summary: dict[str, float] = {}
    for part in ("roughness", "diffuse", "specular"):
        sizes, null = (np.abs([getattr(getattr(m, k), part) for m in compared.values()]) for k in ("error", "null"))
        summary |= {f"mean_{part}": float(sizes.mean()), f"worst_{part}": float(sizes.max())}
        summary[f"null_mean_{part}"] = float(null.mean())
    return MaterialScores({str(c): factor for c, (factor, _) in factors.items()}, compared, **summary)


def common_factor(estimates: list[Reflectance], truths: list[Reflectance]) -> Vec3:
    """Return the median over materials of true over estimated diffuse + specular, per channel.

    A material that reflects nothing counts as 1.

    >>> m = Reflectance((0.2, 0.4, 0.1), (0.1, 0.1, 0.1), 0.3)
    >>> common_factor([m], [Reflectance((0.4, 0.4, 0.1), (0.2, 0.1, 0.1), 0.3)])
    (2.0, 1.0, 1.0)
    """
    estimated, true = (np.array([_albedos(m).sum(axis=0) for m in group]) for group in (estimates, truths))
    ratio = np.where(estimated > 0, true / np.maximum(estimated, 1e-30), 1.0)
    return vec3(np.median(ratio, axis=0))


def _albedos(material: Reflectance) -> Float[np.ndarray, "2 3"]:
    return np.array([material.diffuse, material.specular], float)


def _error(estimate: Reflectance, truth: Reflectance, factor: Vec3) -> MaterialError:
    relative = (_albedos(estimate) * factor - _albedos(truth)) / np.maximum(_albedos(truth), DARKEST)
    diffuse, specular = (vec3(row) for row in relative)
    return MaterialError(roughness=abs(estimate.roughness - truth.roughness), diffuse=diffuse, specular=specular)
