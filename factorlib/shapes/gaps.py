"""Gaps: parts of the object that one mask lacks and the other photos show.

A hull loses all that one mask lacks, along that photo's rays.  Where the mask is right, the hull still fills the masks
of all other photos.  Where it is wrong, pixels of other masks stay uncovered.  So photo i lacks a point x of a grid if

    d_i(x) < −t,   at most a third of the photos deny x,   more photos need x than deny it, at least two           (1)

with d_i the signed distance of x to the mask, in pixels, and t the error of the silhouettes.  Photo j needs x if its
mask has a pixel there that is farther than t from what the hull covers.  The photo that lacks most points is mended:
its pixels there become unknown, so that they carve nothing.  Other parts of the hull cover a narrow gap in most photos,
so that (1) holds only in pieces of it.  A gap is therefore extended to what a closing of the mask by its depth fills
and the other photos hold.  That is repeated until no photo lacks a point.  Votes of photos for and against a point are
those of shape from inconsistent silhouettes (Landabaso, Pardàs and Casas 2008).
"""

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt, label

from factorlib.align.silhouette import UNKNOWN, bounding_box
from factorlib.errors import InputError
from factorlib.geometry.raster import Caster, rasterise
from factorlib.shapes.hull import LEAST_Z, consensus_box, grid_over, hull_surface, signed_distance
from factorlib.shapes.outline import Outline, Triangles

GRID_CELLS = 80  # cells of the grid's longest side
MASK_PIXELS = 400  # pixels of a mask's longer side, to which larger ones are sampled down
CAMERA_ERROR = 3.0  # pixels by which cameras and masks may be off without a gap, at least
RIM = 0.9  # share of a mask's border that is off by at most the silhouettes' error, where the mask has no gap
MOST_ERROR = 3.0  # pixels of that error at most: masks and cameras that are off by more are not told from gaps
SURE = 2.0  # t beyond CAMERA_ERROR, in units of that error
WITNESSES = 2  # least number of photos that need a point
Mask = Bool[np.ndarray, "h w"]


class Gap(msgspec.Struct, frozen=True):
    """Part of the object that a mask lacks.

    Attributes:
        photo: name of the photo
        x: column of its centre, pixels of the mask
        y: row of its centre
        pixels: number of its pixels
        witnesses: number of other photos that show it
    """

    photo: str
    x: int
    y: int
    pixels: int
    witnesses: int

    def scaled(self, factor: float) -> "Gap":
        """Return the gap in the pixels of a picture that was averaged down by a factor."""
        x, y, pixels = (round(each) for each in (factor * self.x, factor * self.y, factor**2 * self.pixels))
        return msgspec.structs.replace(self, x=x, y=y, pixels=pixels)

    def __str__(self) -> str:
        return (
            f"mask of {self.photo} lacks a part at ({self.x}, {self.y}), {self.pixels} px, that {self.witnesses} other "
            "photos show: the hull ignores it there; draw it in `make label`, or leave it so"
        )


def mend_gaps(
    outlines: Sequence[Outline], report: Callable[[float], None] = lambda share: None
) -> tuple[list[Outline], list[Gap]]:
    """Return the outlines, with unknown pixels where a mask has a gap, and the gaps.

    Outlines without a gap are returned as they are.

    Args:
        outlines: Outlines, all with poses.
        report: Called with the completed share of the first pass, from 0 to 1.
    """
    mended = list(outlines)
    dissenting = (len(mended) - 1) // 3
    if not dissenting:
        return mended, []
    try:
        low, high = consensus_box(mended, dissenting)
    except InputError:  # `visual_hull` says what is wrong
        return mended, []
    origin, step, shape = grid_over(low, high, GRID_CELLS)
    points = origin + step * np.indices(tuple(shape.tolist())).reshape(3, -1).T
    factors = [max(int(bounding_box(each.view.silhouette)[2]) // MASK_PIXELS, 1) for each in mended]
    small = [_sampled_down(each, factor) for each, factor in zip(mended, factors, strict=True)]
    distance = np.empty((len(small), len(points)), np.float32)
    for k, each in enumerate(small):
        report(k / len(small))
        distance[k] = signed_distance([each], points)
    # size of a pixel at the object
    pixel = np.array([each.known_pose.apply((low + high)[None] / 2)[0, 2] / each.camera.focal for each in small])
    witnesses: dict[int, int] = {}
    while True:
        vertices, faces = hull_surface(distance.min(axis=0).reshape(shape).astype(float), step)
        if not len(faces):
            break
        bare, error = _uncovered(Triangles(origin + step * vertices, faces), small)
        tolerance = CAMERA_ERROR + SURE * error
        denied = distance < -tolerance * pixel[:, None]
        near = np.flatnonzero((1 <= (count := denied.sum(axis=0))) & (count <= dissenting))
        needed = np.sum([_look_up(each, far > tolerance, points[near]) for each, far in zip(small, bare)], axis=0)
        lacked = denied[:, near] & (needed >= WITNESSES) & (needed > count[near])
        k = int(lacked.sum(axis=1).argmax())
        if not lacked[k].any():
            break
        reach = tolerance + step / pixel[k]
        core = _places(small[k], points[near[lacked[k]]], reach)
        held = _places(small[k], points[near[denied[k, near]]], reach)
        gap = _extended(small[k].part, core, held)
        small[k] = msgspec.structs.replace(small[k], part=np.where(gap, UNKNOWN, small[k].part))
        distance[k] = signed_distance([small[k]], points)
        witnesses[k] = max(witnesses.get(k, 0), int(needed[lacked[k]].max()))
    gaps = []
    for k, number in sorted(witnesses.items()):
        outline = mended[k]
        sizes = zip(outline.part.shape, small[k].part.shape, strict=True)
        nearest = (np.minimum(np.arange(n) // factors[k], m - 1) for n, m in sizes)
        gap = (outline.part == 0) & (small[k].part == UNKNOWN)[np.ix_(*nearest)]
        y, x = np.argwhere(gap).mean(axis=0).astype(int).tolist()
        gaps.append(Gap(outline.photo, x, y, int(gap.sum()), number))
        mended[k] = msgspec.structs.replace(outline, part=np.where(gap, UNKNOWN, outline.part))
    return mended, gaps


def _sampled_down(outline: Outline, factor: int) -> Outline:
    """Return the outline with every so many pixels of its mask."""
    part = outline.part[factor // 2 :: factor, factor // 2 :: factor]
    camera = outline.camera.window(0, 0, factor, part.shape[1], part.shape[0])
    return outline if factor == 1 else msgspec.structs.replace(outline, part=part, camera=camera)


def _uncovered(hull: Triangles, outlines: Sequence[Outline]) -> tuple[list[Float[np.ndarray, "h w"]], float]:
    """Return the distance of each mask's pixels to those that a hull covers, and the median error of the borders."""
    caster = Caster(hull.as_mesh())
    bare = []
    errors = []
    for outline in outlines:
        inside = outline.part > 0
        covered = rasterise(caster, outline.camera, outline.known_pose).label > 0
        far = distance_transform_edt(~covered) if covered.any() else np.full(covered.shape, float(covered.size))
        bare.append(np.where(inside, far, 0.0))
        errors.append(np.quantile(far[inside & (distance_transform_edt(inside) <= 1)], RIM))
    return bare, min(float(np.median(errors)), MOST_ERROR)


def _pixels(outline: Outline, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return row and column of the pixels nearest to points, and the indices of the points within the photo."""
    place = outline.known_pose.apply(points)
    x, y = np.floor(outline.camera.project(np.maximum(place, [-np.inf, -np.inf, LEAST_Z]))).astype(int).T
    height, width = outline.part.shape
    within = (place[:, 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return y.clip(0, height - 1), x.clip(0, width - 1), np.flatnonzero(within)


def _look_up(outline: Outline, mask: Mask, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return the points whose pixels a mask has."""
    rows, columns, index = _pixels(outline, points)
    result = np.zeros(len(points), bool)
    result[index] = mask[rows[index], columns[index]]
    return result


def _places(outline: Outline, points: Float[np.ndarray, "n 3"], reach: float) -> Mask:
    """Return the background's pixels within reach of points, of which those beyond the frame count at its border.

    Beyond the frame, a mask that ends just before it lacks all that the photo crops.
    """
    rows, columns, _ = _pixels(outline, points)
    off = np.ones(outline.part.shape, bool)
    off[rows, columns] = False
    return (distance_transform_edt(off) <= reach) & (outline.part == 0)


def _extended(part: np.ndarray, core: Mask, held: Mask) -> Mask:
    """Return the pieces of a gap, extended to what a closing by its depth fills.

    Args:
        part: Mask, 0 on the background.
        core: Pixels that show points which the mask lacks.
        held: Pixels that show points which only few photos deny.
    """
    radius = float(distance_transform_edt(part == 0)[core].max())
    pad = int(radius) + 2
    grown = distance_transform_edt(np.pad((part == 0) & ~core, pad, constant_values=True)) <= radius
    closed = (distance_transform_edt(grown) > radius)[pad:-pad, pad:-pad]
    pieces = label(core | (held & closed), np.ones((3, 3)))[0]
    return (pieces > 0) & np.isin(pieces, pieces[core])
