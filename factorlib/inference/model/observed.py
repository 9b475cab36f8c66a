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
from factorlib.images.exr import read_rgb_exr
from factorlib.inference.model.background import Background, concatenate_backgrounds
from factorlib.inference.model.blocks import CLUSTER, LEAST_CONFIDENCE, Block, Noise
from factorlib.inference.model.interreflection import bounced_light
from factorlib.inference.model.problem import Spread
from factorlib.urm.extract import with_surface_normals
from factorlib.urm.observations import Observations, concatenate, read_observations
from factorlib.urm.reduction import merge

Rotations = Mapping[str, Float[np.ndarray, "3 3"]]  # world_from_camera, by the name of a photo
Maps = Mapping[str, Float[np.ndarray, "h w 3"]]  # lat-long map, by the name of a photo


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


def gather_observations(
    files: Sequence[Path],
    degrees: float,
    spread: Spread,
    surface: Path | None = None,
    tick: Callable[[], None] = lambda: None,
) -> list[PhotoObservations]:
    """Read each file in order, and merge observations of one material with similar normals and mirror directions.

    Args:
        files: Files of `urm`.
        degrees: Size of the cells of normals and mirror directions (`factorlib.urm.reduction`); 0 merges nothing.
        spread: Map over independent work.
        surface: Folder of the stage `surface`, whose normals replace those of the mesh; None for the mesh's.
        tick: Called after each file.
    """

    def read_merged(path: Path) -> PhotoObservations:
        """Return the usable observations of one file, merged."""
        read = with_surface_normals(read_observations(path), surface)
        usable = usable_observations(read)
        tick()
        return PhotoObservations(merge(usable, degrees), len(read), len(read) - len(usable))

    return list(spread(read_merged, files))


def blocks_of_observations(
    observations: Observations,
    noise: Noise,
    *,
    held_out: float = 0.1,
    world_from_camera: Rotations | None = None,
    seed: int = 0,
    backgrounds: Maps | None = None,
    grounds: Sequence[Observations] = (),
) -> list[Block]:
    """Return one block per illumination, in order of names, without unusable observations.

    Args:
        observations: Observations of all photos.
        noise: Noise model.
        held_out: Share of the observations that select models.
        world_from_camera: Rotation of each photo whose illumination is fixed to the world.
        seed: Seed of the random choice of held-out cells.
        backgrounds: Maps of `read_backgrounds`.
        grounds: Observations of `read_grounds`.

    Raises:
        InputError: If no usable observation is left, or all are black.
    """
    usable = usable_observations(observations)
    if len(usable) == 0:
        raise InputError(
            "no valid observation in any photo",
            cure="check in the overlays of `align` that masks and meshes overlap; `make status` names doubtful poses "
            'that were left out, and SET="align.keep_doubtful=true" lets them in',
        )
    if (usable.radiance <= 0).all():
        raise InputError(
            "every observation is black",
            cure="check the exposure and `encoding` of the photos, and that the masks lie on the objects",
        )
    block = partial(_block, noise=noise, share=held_out, rotations=world_from_camera or {}, seed=seed)
    rows_by_light = [np.flatnonzero(usable.illumination == i) for i in range(len(usable.illuminations))]
    blocks = [block(usable, rows) for rows in rows_by_light if len(rows)]
    if backgrounds:
        blocks = [_with_background(block, backgrounds, world_from_camera or {}) for block in blocks]
    blocks = [_with_ground(block, grounds, world_from_camera or {}) for block in blocks]
    return sorted(blocks, key=lambda block: block.name)


def read_backgrounds(folder: Path, exposures: Mapping[str, float]) -> Maps:
    """Read the maps of the surroundings that photos show, at the exposure of the observations.

    Args:
        folder: Folder of the stage `urm`.
        exposures: Relative exposure of each photo.
    """
    files = {photo: folder / "background" / f"{photo}.exr" for photo in exposures}
    return {photo: read_rgb_exr(file) / exposures[photo] for photo, file in files.items() if file.is_file()}


def _with_background(block: Block, maps: Maps, rotations: Rotations) -> Block:
    """Return the block with the surroundings that its photos show."""
    backgrounds = [
        Background.from_map(maps[photo], rotations.get(photo, np.eye(3)), block.unit)
        for photo in block.photos
        if photo in maps
    ]
    return msgspec.structs.replace(block, background=concatenate_backgrounds(backgrounds))


def read_grounds(folder: Path) -> list[Observations]:
    """Read the observations of the ground of each photo that has some, from the folder of the stage `urm`."""
    return [read_observations(file) for file in sorted((folder / "ground").glob("*.parquet"))]


def _with_ground(block: Block, grounds: Sequence[Observations], rotations: Rotations) -> Block:
    """Return the block with the ground of its photos."""
    shown = [ground for ground in grounds if ground.photos[0] in block.photos]
    if not shown:
        return block
    observations = concatenate(shown)
    ground = _block(observations, np.arange(len(observations)), block.noise, 0.0, rotations, 0)
    return msgspec.structs.replace(block, ground=ground)


def usable_observations(observations: Observations) -> Observations:
    """Return the observations with finite radiance, finite and non-zero directions, and finite positive weight."""
    vectors = np.stack([observations.radiance, observations.normal, observations.view])
    directed = (observations.normal != 0).any(1) & (observations.view != 0).any(1)
    return observations.take(
        np.isfinite(vectors).all((0, 2)) & directed & (observations.weight > 0) & np.isfinite(observations.weight)
    )


def _block(
    all_observations: Observations,
    rows: Int[np.ndarray, " n"],
    noise: Noise,
    share: float,
    rotations: Rotations,
    seed: int,
) -> Block:
    """Return the block of the observations `rows` of one illumination."""
    observations = all_observations.take(rows)
    name = all_observations.illuminations[all_observations.illumination[rows[0]]]
    photos = sorted({observations.photos[i] for i in np.unique(observations.photo)})
    local = np.array([photos.index(p) if p in photos else -1 for p in observations.photos])[observations.photo]
    # order by material, photo, row and column
    order = np.lexsort((observations.x, observations.y, local, observations.material))
    observations = observations.take(order)
    local = local[order]
    turned = {photo: np.asarray(rotation, dtype=float) for photo, rotation in rotations.items() if rotation is not None}
    normal, given_normal, view = (
        _rotate_units(vectors, observations, turned)
        for vectors in (observations.normal, observations.cell_normal, observations.view)
    )
    sure = observations.confidence
    sure = None if sure is None else np.maximum(sure.astype(float), LEAST_CONFIDENCE)
    radiance = observations.radiance.astype(float)
    # radiance in units of the weighted mean
    unit = max(float(np.average(radiance.mean(1), weights=observations.weight)), 1e-30)
    scaled = radiance / unit
    # whole clusters of mirror directions are held out, so that no fitted observation has their errors
    held_out = held_out_by_cells(mirror_cells(given_normal, view, CLUSTER), observations.material, share, seed)
    visibility = directions = None
    if observations.visibility is not None and (observations.visibility < 255).any():
        sphere = fibonacci_sphere(observations.visibility.shape[1])
        visibility = observations.visibility
        directions = np.stack([sphere @ turned.get(p, np.eye(3)).T for p in photos])
    bounced = bounced_light(observations, scaled)
    # the confidence of a normal counts as its variance, where that matters (`factorlib.inference.model.normal_errors`)
    pixels = observations.weight / (1.0 if sure is None else sure)
    block = Block(
        name, tuple(photos), unit, normal, view, scaled,
        observations.clipped.astype(bool), noise.inverse_sigma(scaled, pixels),
        observations.material.astype(np.int64), local, held_out, visibility, directions,
        bounced if bounced is not None and bounced.any() else None, noise,
        sure,
        None if observations.place is None else _rotate(observations.place, observations, turned), rows[order],
        given_normal=None if observations.given_normal is None else given_normal,
        object=observations.object,
    )  # fmt: skip
    if observations.detail is None or (observations.detail == 1).all():
        return block
    return block.on_surface(block.normal, observations.detail.astype(float))


def _rotate_units(
    vectors: Float[np.ndarray, "n 3"], observations: Observations, rotations: Rotations
) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors in the illumination's frame."""
    turned = _rotate(vectors, observations, rotations)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def _rotate(
    vectors: Float[np.ndarray, "n 3"], observations: Observations, rotations: Rotations
) -> Float[np.ndarray, "n 3"]:
    """Return vectors in the illumination's frame: each photo's rotated by its world_from_camera."""
    turned = vectors.astype(float)
    for i, photo in enumerate(observations.photos):
        if photo in rotations:
            turned[observations.photo == i] = turned[observations.photo == i] @ rotations[photo].T
    return turned


def held_out_by_cells(
    cell: Int[np.ndarray, " n"], material: Int[np.ndarray, " n"], share: float, seed: int
) -> Bool[np.ndarray, " n"]:
    """Return a mask of the held-out observations: all those of randomly chosen cells, but never all of a material.

    Neighbouring pixels have similar errors.  If single pixels were held out, a lobe that only fits a local error would
    explain them as well as a lobe that the light needs.  At least one cell is held out, unless the share is 0.

    Args:
        cell: Number of each observation's cell.
        material: Number of each observation's material.
        share: Share of the cells.
        seed: Seed of the random choice.
    """
    names, number = np.unique(cell, return_inverse=True)
    is_held_out = (np.random.default_rng(seed).permutation(len(names)) < share * len(names))[number.reshape(-1)]
    # cells that show a material which no other cell shows are fitted
    is_needed = ~np.isin(material, material[~is_held_out])
    return is_held_out & ~np.isin(cell, cell[is_needed])
