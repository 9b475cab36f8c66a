"""Conversion of the photos' observations, as `urm` writes them, to the blocks of the joint problem.

There is one block per illumination.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

from factorlib.errors import InputError
from factorlib.geometry.sphere import fibonacci_sphere, mirror_cells
from factorlib.inference.blocks import Block
from factorlib.inference.interreflection import bounced_light
from factorlib.inference.noise import Noise
from factorlib.inference.problem import Spread
from factorlib.urm.merge import merge
from factorlib.urm.observations import Observations, read_observations
from factorlib.urm.surface_maps import with_surface_normals

Rotations = Mapping[str, Float[np.ndarray, "3 3"]]  # world_from_camera, by the name of a photo


HELD_OUT_CELL = 0.1  # side of the cells of mirror directions that are held out together


class PhotoObservations(msgspec.Struct, frozen=True):
    """Usable observations of one file, merged.

    Attributes:
        merged: Merged observations.
        count: Number of observations in the file.
        unusable: Number of those that are not usable.
    """

    merged: Observations
    count: int
    unusable: int


def gathered(
    files: Sequence[Path],
    degrees: float,
    spread: Spread,
    surface: Path | None = None,
    tick: Callable[[], None] = lambda: None,
) -> list[PhotoObservations]:
    """Read each file in order, and merge its observations within `degrees` of each other (`factorlib.urm.merge`).

    Args:
        files: Files of `urm`.
        degrees: Largest angle between merged observations.
        spread: Map over independent work.
        surface: Folder of the stage `surface`, whose normals replace those of the mesh; None for the mesh's.
        tick: Called after each file.
    """

    def merged(path: Path) -> PhotoObservations:
        """Return the usable observations of one file, merged."""
        read = with_surface_normals(read_observations(path), surface)
        seen = usable(read)
        tick()
        return PhotoObservations(merge(seen, degrees), len(read), len(read) - len(seen))

    return list(spread(merged, files))


def blocks_of_observations(
    observations: Observations,
    noise: Noise,
    *,
    held_out: float = 0.1,
    world_from_camera: Rotations | None = None,
    seed: int = 0,
) -> list[Block]:
    """Return one block per illumination, in order of names, without unusable observations.

    Args:
        observations: Observations of all photos.
        noise: Noise model.
        held_out: Share of the observations that select models.
        world_from_camera: Rotation of each photo whose illumination is fixed to the world.
        seed: Seed of the random choice of held-out cells.

    Raises:
        InputError: If no usable observation is left, or all are black.
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
    block = partial(_block, noise=noise, share=held_out, rotations=world_from_camera or {}, seed=seed)
    shown = [np.flatnonzero(seen.illumination == i) for i in range(len(seen.illuminations))]
    blocks = [block(seen, rows) for rows in shown if len(rows)]
    return sorted(blocks, key=lambda block: block.name)


def usable(observations: Observations) -> Observations:
    """Return the observations with finite radiance, finite and non-zero directions, and finite positive weight."""
    vectors = np.stack([observations.radiance, observations.normal, observations.view])
    directed = (observations.normal != 0).any(1) & (observations.view != 0).any(1)
    return observations.take(
        np.isfinite(vectors).all((0, 2)) & directed & (observations.weight > 0) & np.isfinite(observations.weight)
    )


def _block(
    every: Observations, rows: Int[np.ndarray, " n"], noise: Noise, share: float, rotations: Rotations, seed: int
) -> Block:
    """Return the block of the observations `rows` of one illumination."""
    seen = every.take(rows)
    name = every.illuminations[every.illumination[rows[0]]]
    photos = sorted({seen.photos[i] for i in np.unique(seen.photo)})
    local = np.array([photos.index(p) if p in photos else -1 for p in seen.photos])[seen.photo]
    # order by material, photo, row and column
    order = np.lexsort((seen.x, seen.y, local, seen.material))
    seen = seen.take(order)
    local = local[order]
    turned = {photo: np.asarray(of, dtype=float) for photo, of in rotations.items() if of is not None}
    normal, view = (_in_frame(vectors, seen, turned) for vectors in (seen.normal, seen.view))
    radiance = seen.radiance.astype(float)
    # radiance in units of the weighted mean
    unit = max(float(np.average(radiance.mean(1), weights=seen.weight)), 1e-30)
    scaled = radiance / unit
    # whole cells of mirror directions are held out
    held_out = held_out_by_cells(mirror_cells(normal, view, HELD_OUT_CELL), seen.material, share, seed)
    visibility = directions = None
    if seen.visibility is not None and (seen.visibility < 255).any():
        sphere = fibonacci_sphere(seen.visibility.shape[1])
        visibility = seen.visibility
        directions = np.stack([sphere @ turned.get(p, np.eye(3)).T for p in photos])
    bounced = bounced_light(seen, scaled)
    block = Block(
        name, tuple(photos), unit, normal, view, scaled,
        seen.clipped.astype(bool), noise.precision(scaled, seen.weight),
        seen.material.astype(np.int64), local, held_out, visibility, directions,
        bounced if bounced is not None and bounced.any() else None, noise,
        None if seen.confidence is None else seen.confidence.astype(float),
        None if seen.place is None else _turned(seen.place, seen, turned), rows[order],
    )  # fmt: skip
    if seen.detail is None or (seen.detail == 1).all():
        return block
    return block.on_surface(block.normal, seen.detail.astype(float))


def _in_frame(vectors: Float[np.ndarray, "n 3"], seen: Observations, rotations: Rotations) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors in the illumination's frame."""
    turned = _turned(vectors, seen, rotations)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def _turned(vectors: Float[np.ndarray, "n 3"], seen: Observations, rotations: Rotations) -> Float[np.ndarray, "n 3"]:
    """Return vectors in the illumination's frame: each photo's rotated by its world_from_camera."""
    turned = vectors.astype(float)
    for i, photo in enumerate(seen.photos):
        if photo in rotations:
            turned[seen.photo == i] = turned[seen.photo == i] @ rotations[photo].T
    return turned


def held_out_by_cells(
    cell: Int[np.ndarray, " n"], material: Int[np.ndarray, " n"], share: float, seed: int
) -> Bool[np.ndarray, " n"]:
    """Return a mask of the held-out observations: all those of randomly chosen cells, but never all of a material.

    Neighbouring pixels have similar errors.  If single pixels were held out, a lobe that only fits a local error would
    explain them as well as a lobe that the light needs.

    Args:
        cell: Number of each observation's cell.
        material: Number of each observation's material.
        share: Share of the cells.
        seed: Seed of the random choice.
    """
    names, number = np.unique(cell, return_inverse=True)
    chosen = (np.random.default_rng(seed).random(len(names)) < share)[number.reshape(-1)]
    return chosen & np.isin(material, material[~chosen])
