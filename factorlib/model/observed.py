"""From observations to the data of the joint problem: one block per illumination."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Float, UInt8

from factorlib.errors import InputError
from factorlib.geometry.sphere import fibonacci_sphere, mirror_cells
from factorlib.model.blocks import Block
from factorlib.model.clusters import HELD_OUT_CELL, held_out_by_cells
from factorlib.model.interreflection import bounced_light
from factorlib.model.noise import Noise
from factorlib.urm.observations import Observations

Rotations = Mapping[str, Float[np.ndarray, "3 3"]]  # world_from_camera, by the name of a photo


class _How(msgspec.Struct, frozen=True):
    """How observations become blocks."""

    noise: Noise
    held_out: float
    world_from_camera: Rotations
    seed: int


def blocks_of_observations(
    observations: Observations,
    noise: Noise,
    *,
    held_out: float = 0.1,
    world_from_camera: Rotations | None = None,
    seed: int = 0,
) -> list[Block]:
    """One block per illumination, in order of names; observations that are not `usable` are dropped.

    world_from_camera: rotation of each photo whose illumination is fixed to the world
    held_out:          share of observations kept for choosing the model
    Raises InputError where nothing is left, or nothing but black.
    """
    seen = usable(observations)
    if len(seen) == 0:
        raise InputError(
            "no valid observation in any photo", cure="look at the overlays of `align`: masks and meshes must overlap"
        )
    if (seen.radiance <= 0).all():
        raise InputError(
            "every observation is black",
            cure="look at the photos that `masks` wrote: exposure, `encoding`, label masks",
        )
    how = _How(noise, held_out, world_from_camera or {}, seed)
    blocks = [
        _block(seen.take(seen.illumination == i), name, how)
        for i, name in enumerate(seen.illuminations)
        if (seen.illumination == i).any()
    ]
    return sorted(blocks, key=lambda block: block.name)


def usable(observations: Observations) -> Observations:
    """The observations whose radiance and directions are finite, whose directions are not zero, and whose weight is positive."""
    vectors = np.stack([observations.radiance, observations.normal, observations.view])
    directed = (observations.normal != 0).any(1) & (observations.view != 0).any(1)
    return observations.take(
        np.isfinite(vectors).all((0, 2)) & directed & (observations.weight > 0) & np.isfinite(observations.weight)
    )


def _block(seen: Observations, name: str, how: _How) -> Block:
    photos = sorted({seen.photos[i] for i in np.unique(seen.photo)})
    local = np.array([photos.index(p) if p in photos else -1 for p in seen.photos])[seen.photo]
    order = np.lexsort((seen.x, seen.y, local, seen.material))
    seen, local = seen.take(order), local[order]
    normal, view = (_in_frame(vectors, seen, how.world_from_camera) for vectors in (seen.normal, seen.view))
    radiance = seen.radiance.astype(float)
    unit = max(float(np.average(radiance.mean(1), weights=seen.weight)), 1e-30)
    scaled = radiance / unit
    held_out = held_out_by_cells(mirror_cells(normal, view, HELD_OUT_CELL), seen.material, how.held_out, how.seed)
    return Block(
        name, tuple(photos), unit, normal, view, scaled, seen.clipped.astype(bool), how.noise.precision(scaled, seen.weight),
        seen.material.astype(np.int64), local, held_out, *_visibility(seen, photos, how.world_from_camera), _bounced(seen, scaled),
        how.noise, None if seen.confidence is None else seen.confidence.astype(float),
    )  # fmt: skip


def _visibility(
    seen: Observations, photos: Sequence[str], rotations: Rotations
) -> tuple[UInt8[np.ndarray, "n k"] | None, Float[np.ndarray, "f k 3"] | None]:
    """Visibility and its directions in the block's frame; None where nothing is hidden."""
    if seen.visibility is None or (seen.visibility == 255).all():
        return None, None
    directions = fibonacci_sphere(seen.visibility.shape[1])
    frames = [
        np.eye(3) if rotations.get(photo) is None else np.asarray(rotations[photo], dtype=float) for photo in photos
    ]
    return seen.visibility, np.stack([directions @ frame.T for frame in frames])


def _bounced(seen: Observations, radiance: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 6"] | None:
    """None where no observation is hidden from anything."""
    sent = bounced_light(seen, radiance)
    return sent if sent is not None and sent.any() else None


def _in_frame(vectors: Float[np.ndarray, "n 3"], seen: Observations, rotations: Rotations) -> Float[np.ndarray, "n 3"]:
    turned = vectors.astype(float)
    for i, photo in enumerate(seen.photos):
        if rotations.get(photo) is not None:
            rows = seen.photo == i
            turned[rows] = turned[rows] @ np.asarray(rotations[photo], dtype=float).T
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)
