"""The pixels of a photo that poses are compared on, and what posed meshes show in them.

A pixel and its view direction are fixed; only the normal that it shows changes with a pose.  Whole cells of the image are held out,
because neighbouring pixels have similar errors.  The cells are the same for all poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter, minimum_filter

from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, face_normals, smooth_normals, unit
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.geometry.visibility import Occluders, sight
from factorlib.model.blocks import Block
from factorlib.model.noise import Noise
from factorlib.urm.extract import GRAZING

EDGE = 5  # pixels: the square about a pixel that shows one material, all of it valid
CELLS = 20  # along the masks' extent
HELD_OUT = 0.3  # of the cells


class Pixels(msgspec.Struct, frozen=True):
    """n pixels, sorted by material.

    x, y       column and row            radiance   in units of `unit`, the mean radiance of all
    precision  1/σ of the noise model, 0 where a channel is clipped: it is not compared
    material   index, from 0             cell       number of the pixel's cell
    """

    x: Int[np.ndarray, " n"]
    y: Int[np.ndarray, " n"]
    radiance: Float[np.ndarray, "n 3"]
    unit: float
    precision: Float[np.ndarray, "n 3"]
    material: Int[np.ndarray, " n"]
    cell: Int[np.ndarray, " n"]
    held_out: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.x)


def pixels_of(
    photo: Mapping[str, Float[np.ndarray, "h w"]], known: Sequence[bool], count: int, seed: int = 0
) -> Pixels | None:
    """Return at most `count` of the pixels inside a material that is `known`; None where there are too few cells to hold any out.

    photo: channels R, G, B, label, valid, clipped.R/G/B of the stage `masks`
    """
    label = np.rint(photo["label"]).astype(int)
    whole = (minimum_filter(label, EDGE) == maximum_filter(label, EDGE)) & np.array([False, *known])[label]
    whole &= minimum_filter(photo["valid"], EDGE) > 0.5
    y, x = np.nonzero(whole)
    if len(x) == 0:
        return None
    random = np.random.default_rng(seed)
    chosen = np.sort(random.permutation(len(x))[:count])
    chosen = chosen[np.argsort(label[y[chosen], x[chosen]], kind="stable")]
    x, y = x[chosen], y[chosen]
    size = max(max(np.ptp(x), np.ptp(y)) + 1, CELLS) / CELLS
    names, cell = np.unique((y // size).astype(int) * 1000 + (x // size).astype(int), return_inverse=True)
    radiance = np.maximum(np.stack([photo[c][y, x] for c in "RGB"], axis=-1).astype(float), 0.0)
    mean = max(float(radiance.mean()), 1e-30)
    clipped = np.stack([photo[f"clipped.{c}"][y, x] for c in "RGB"], axis=-1) > 0.5
    out = random.permutation(len(names)) < HELD_OUT * len(names)
    if not 2 <= out.sum() < len(names):
        return None
    cell, precision = cell.reshape(-1), np.where(clipped, 0.0, 1 / Noise().sigma(radiance / mean))
    return Pixels(x, y, radiance / mean, mean, precision, label[y, x] - 1, cell, out[cell])


class Seen(msgspec.Struct, frozen=True):
    """What meshes show at n pixels: unit normals in the camera frame, and whether the mesh shows the mask's material, facing the camera."""

    normal: Float[np.ndarray, "n 3"]
    agrees: Bool[np.ndarray, " n"]


class View:
    """The meshes of a photo over its pixels."""

    def __init__(self, pixels: Pixels, casters: Sequence[Caster], trusted: Sequence[bool], shadows: int = 0):
        """trusted: objects whose pixels count;  shadows: directions in which they may shadow each other and themselves (0: not)."""
        self.pixels, self.casters, self.trusted, self.shadows = pixels, casters, trusted, shadows

    def seen(self, camera: Camera, poses: Sequence[Pose]) -> Seen:
        """Return what the nearest mesh shows under each pixel."""
        along = camera.rays_through(np.column_stack([self.pixels.x, self.pixels.y]) + 0.5)
        n, view = len(self.pixels), -unit(along)
        normal, label, nearest = np.tile([0.0, 0.0, -1.0], (n, 1)), np.zeros(n, int), np.full(n, np.inf)
        for caster, pose, trusted in zip(self.casters, poses, self.trusted, strict=True):
            hits = caster.cast_along(along, pose)
            wins = (hits.face >= 0) & (hits.depth < nearest)
            face = hits.face[wins]
            smooth = unit(smooth_normals(caster.mesh, face, hits.uv[wins]) @ pose.rotation.T)
            behind = np.sum(face_normals(caster.mesh, face) @ pose.rotation.T * view[wins], axis=1) < 0
            nearest[wins], normal[wins] = hits.depth[wins], np.where(behind[:, None], -smooth, smooth)
            label[wins] = caster.mesh.face_label[face] if trusted else 0
        agrees = (label == self.pixels.material + 1) & (np.sum(normal * view, axis=1) > GRAZING)
        return Seen(normal, agrees)

    def block(
        self, camera: Camera, seen: Seen, like: Block | None = None, poses: Sequence[Pose] | None = None
    ) -> Block:
        """All pixels as observations; visibility as in `like`, or of `poses`."""
        pixels, n = self.pixels, len(self.pixels)
        view = -unit(camera.rays_through(np.column_stack([pixels.x, pixels.y]) + 0.5))
        block = Block(
            "photo", ("photo",), pixels.unit, seen.normal, view, pixels.radiance, np.zeros((n, 3), bool), pixels.precision,
            pixels.material, np.zeros(n, int), pixels.held_out,
        )  # fmt: skip
        if like is not None:
            return msgspec.structs.replace(block, visibility=like.visibility, directions=like.directions)
        if not (self.shadows and poses):
            return block
        occluders, where = Occluders([c.mesh for c in self.casters], poses), np.column_stack([pixels.x, pixels.y])
        past = sight(occluders, camera, where, seen.normal, self.shadows, n)
        directions = fibonacci_sphere(self.shadows)[None]
        return msgspec.structs.replace(block, visibility=past.visibility, directions=directions) if past else block
