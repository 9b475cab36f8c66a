"""The data of the joint problem, one block per illumination, in that illumination's frame and radiance unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from factorlib.errors import InputError
from factorlib.light.sphere import fibonacci_sphere
from factorlib.urm.observations import Observations

HELD_OUT_CELL = 0.1  # size of the cells of mirror directions that are held out together


class Block(msgspec.Struct, frozen=True):
    """The n observations under one illumination, sorted by material.

    radiance is divided by `unit` (the block's mean radiance); precision is 1/σ of the noise model times the root of
    the observation's weight, zero where a channel tells nothing; held_out observations choose the model and do not
    fit it.  visibility says how much of each direction an observation sees, 0 to 255 (None: all of all of them);
    directions are those, in the block's frame, of each photo.
    """

    name: str
    photos: tuple[str, ...]
    unit: float
    normal: Float[np.ndarray, "n 3"]
    view: Float[np.ndarray, "n 3"]
    radiance: Float[np.ndarray, "n 3"]
    clipped: Bool[np.ndarray, "n 3"]
    precision: Float[np.ndarray, "n 3"]
    material: Int[np.ndarray, "n"]
    photo: Int[np.ndarray, "n"]
    held_out: Bool[np.ndarray, "n"]
    visibility: UInt8[np.ndarray, "n k"] | None = None
    directions: Float[np.ndarray, "f k 3"] | None = None

    def __len__(self) -> int:
        return len(self.material)


class Noise(msgspec.Struct, frozen=True):
    """σ² = absolute² + (relative · radiance)², in units of a block's mean radiance.

    The relative part stands for what a photo's tone curve, rough normals and the lobes' own bias do to bright pixels.
    """

    absolute: float = 0.05
    relative: float = 0.05
    most_weight: float = 8.0  # a merged observation counts as this many independent ones at most


def blocks_of_observations(
    observations: Observations,
    noise: Noise,
    *,
    held_out: float = 0.1,
    world_from_camera: Mapping[str, Float[np.ndarray, "3 3"]] | None = None,
    seed: int = 0,
) -> list[Block]:
    """One block per illumination, in order of names; observations that are not `usable` are dropped.

    world_from_camera: rotation of each photo whose illumination is fixed to the world
    held_out:          share of observations kept for choosing the model
    Raises InputError where nothing is left, or nothing but black.
    """
    seen = usable(observations)
    if len(seen) == 0:
        raise InputError("no valid observation in any photo", cure="look at the overlays of `align`: masks and meshes must overlap")
    if (seen.radiance <= 0).all():
        raise InputError("every observation is black", cure="look at the photos that `masks` wrote: exposure, `encoding`, label masks")
    rotations = world_from_camera or {}
    blocks = [
        _block(seen.take(seen.illumination == i), name, noise, held_out, rotations, seed)
        for i, name in enumerate(seen.illuminations)
        if (seen.illumination == i).any()
    ]
    return sorted(blocks, key=lambda block: block.name)


def usable(observations: Observations) -> Observations:
    """Those whose radiance and directions are finite, whose directions have a length, and that weigh something."""
    vectors = np.stack([observations.radiance, observations.normal, observations.view])
    directed = (observations.normal != 0).any(1) & (observations.view != 0).any(1)
    return observations.take(np.isfinite(vectors).all((0, 2)) & directed & (observations.weight > 0) & np.isfinite(observations.weight))


def _block(seen: Observations, name: str, noise: Noise, held_out: float, rotations: Mapping, seed: int) -> Block:
    photos = sorted({seen.photos[i] for i in np.unique(seen.photo)})
    local = np.array([photos.index(p) if p in photos else -1 for p in seen.photos])[seen.photo]
    order = np.lexsort((seen.x, seen.y, local, seen.material))
    seen, local = seen.take(order), local[order]
    normal, view = _in_frame(seen.normal, seen, rotations), _in_frame(seen.view, seen, rotations)
    radiance = seen.radiance.astype(float)
    unit = max(float(np.average(radiance.mean(1), weights=seen.weight)), 1e-30)
    scaled = radiance / unit
    sigma = np.sqrt(noise.absolute**2 + (noise.relative * scaled) ** 2)
    weight = seen.weight / (1 + seen.weight / noise.most_weight)
    chosen = _held_out(normal, view, seen.material, held_out, seed)
    return Block(
        name, tuple(photos), unit, normal, view, scaled, seen.clipped.astype(bool), np.sqrt(weight)[:, None] / sigma,
        seen.material.astype(np.int64), local, chosen, *_visibility(seen, photos, rotations),
    )  # fmt: skip


def _visibility(seen: Observations, photos: Sequence[str], rotations: Mapping) -> tuple:
    """Visibility and its directions in the block's frame; None where nothing is hidden."""
    if seen.visibility is None or (seen.visibility == 255).all():
        return None, None
    directions = fibonacci_sphere(seen.visibility.shape[1])
    frames = [np.eye(3) if rotations.get(photo) is None else np.asarray(rotations[photo], dtype=float) for photo in photos]
    return seen.visibility, np.stack([directions @ frame.T for frame in frames])


def _held_out(normal: np.ndarray, view: np.ndarray, material: np.ndarray, share: float, seed: int) -> Bool[np.ndarray, "n"]:
    """About a `share` of the observations: all whose mirror direction lies in one of randomly chosen cells.  Never all of a material.

    Neighbouring pixels err alike, so single pixels would not tell a lobe that the light needs from one that explains
    the error of a place.
    """
    names, cell = np.unique(mirror_cells(normal, view, HELD_OUT_CELL), return_inverse=True)
    chosen = (np.random.default_rng(seed).random(len(names)) < share)[cell.reshape(-1)]
    return chosen & np.isin(material, material[~chosen])


def mirror_cells(normal: Float[np.ndarray, "n 3"], view: Float[np.ndarray, "n 3"], size: float) -> Int[np.ndarray, "n"]:
    """A name of the cell, a cube of `size` cut by the unit sphere, in which each observation's mirror direction lies."""
    mirror = 2 * np.sum(normal * view, axis=1, keepdims=True) * normal - view
    return np.floor((mirror + 1) / size).astype(int) @ [1, 1_000, 1_000_000]


def _in_frame(vectors: np.ndarray, seen: Observations, rotations: Mapping) -> Float[np.ndarray, "n 3"]:
    turned = vectors.astype(float)
    for i, photo in enumerate(seen.photos):
        if rotations.get(photo) is not None:
            rows = seen.photo == i
            turned[rows] = turned[rows] @ np.asarray(rotations[photo], dtype=float).T
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def of_rows(block: Block, rows: np.ndarray) -> Block:
    """The observations `rows` (indices or a mask) alone."""
    fields = ("normal", "view", "radiance", "clipped", "precision", "material", "photo", "held_out")
    visibility = None if block.visibility is None else block.visibility[rows]
    return msgspec.structs.replace(block, **{name: getattr(block, name)[rows] for name in fields}, visibility=visibility)


def not_held_out(block: Block) -> Block:
    """What is there to be fitted."""
    return of_rows(block, ~block.held_out) if block.held_out.any() else block


def sampled(block: Block, count: int, seed: int) -> Block:
    """At most `count` fitted and `count`/3 held-out observations, each material with its share, order kept."""
    random = np.random.default_rng(seed)
    kept = [
        random.permutation(rows)[:most]
        for rows, most in ((np.flatnonzero(~block.held_out), count), (np.flatnonzero(block.held_out), count // 3))
    ]
    return of_rows(block, np.sort(np.concatenate(kept)))


def connected_components(blocks: Sequence[Block], materials: int) -> list[tuple[tuple[int, ...], tuple[str, ...]]]:
    """Components of the material × illumination matrix: (material indices, illumination names) of each, in order.

    Two materials are linked where one light shows both; within a component a factor per channel is undetermined.
    """
    groups: list[tuple[set, set]] = [({m}, set()) for m in range(materials)]
    for block in blocks:
        seen = set(np.unique(block.material).tolist())
        touching = [g for g in groups if g[0] & seen]
        joined = (set().union(*(g[0] for g in touching)), {block.name}.union(*(g[1] for g in touching)))
        groups = [g for g in groups if g not in touching] + [joined]
    return sorted((tuple(sorted(m)), tuple(sorted(i))) for m, i in groups)
