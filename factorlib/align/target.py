"""What the silhouette of one object is in a photo, at a resolution that a pose can be compared with quickly.

For each material, the signed distance to the border of its region says how far, and which way, a contour of the mesh
is off.  Unknown pixels are a dead zone: a contour may lie there at no cost, so an occluder or the frame of the photo
is never taken for the object's own contour.
"""

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt

from factorlib.align.silhouette import UNKNOWN, Mask, Silhouette
from factorlib.geometry.camera import Camera


class Region(msgspec.Struct, frozen=True):
    """One material in the photo, in pixels of the window.

    distance  [h, w] signed distance to the region's border, negative inside, 0 where unknown
    slope     [h, w, 2] its gradient (x, y)
    contour   [n, 2] points (x, y) between the region's pixels and known pixels outside it
    outward   [n, 2] unit directions out of the region there
    """

    distance: Float[np.ndarray, "h w"]
    slope: Float[np.ndarray, "h w 2"]
    contour: Float[np.ndarray, "n 2"]
    outward: Float[np.ndarray, "n 2"]


class Target(msgspec.Struct, frozen=True):
    """A window about the mask: its place in the photo, its labels, and a region per material of the mesh."""

    left: float
    top: float
    pixel: float  # photo pixels per window pixel
    silhouette: Silhouette
    regions: dict[int, Region]

    def camera(self, photo_camera: Camera) -> Camera:
        """The photo's camera seen through the window, in the window's pixels."""
        height, width = self.silhouette.label.shape
        return photo_camera.window(self.left, self.top, self.pixel, width, height)

    @property
    def extent(self) -> float:
        """Longer side of the mask's bounding box, window pixels."""
        return extent_of(self.silhouette)[2]


def extent_of(silhouette: Silhouette) -> tuple[np.ndarray, np.ndarray, float]:
    """Lowest and highest (x, y) corner of the mask's bounding box, and its longer side, in pixels."""
    rows, columns = np.nonzero(silhouette.inside)
    low, high = np.array([columns.min(), rows.min()], float), np.array([columns.max(), rows.max()], float) + 1
    return low, high, float((high - low).max())


def target_of(silhouette: Silhouette, labels: tuple[int, ...], resolution: int, margin: float = 0.2) -> Target:
    """The silhouette, cut out with `margin` of its extent around it.

    resolution: pixels of the mask's longer side in the window, fewer if the photo has fewer
    """
    low, high, extent = extent_of(silhouette)
    pixel = max(extent / resolution, 1.0)
    height, width = silhouette.label.shape
    low = np.maximum(np.floor(low - margin * extent), 0)
    high = np.minimum(np.ceil(high + margin * extent), (width, height))
    columns, rows = (np.arange(int(np.ceil((high[k] - low[k]) / pixel))) for k in (0, 1))
    x = np.minimum((low[0] + (columns + 0.5) * pixel).astype(int), width - 1)
    y = np.minimum((low[1] + (rows + 0.5) * pixel).astype(int), height - 1)
    window = silhouette.label[np.ix_(y, x)]
    padded = np.pad(window, 1, mode="edge")
    at_frame = low[1] == 0, high[1] == height, low[0] == 0, high[0] == width
    for touches, edge in zip(at_frame, (padded[0], padded[-1], padded[:, 0], padded[:, -1]), strict=True):
        if touches:
            edge[:] = UNKNOWN
    regions = {label: _region(padded == label, padded != UNKNOWN) for label in labels}
    return Target(float(low[0]), float(low[1]), pixel, Silhouette(window), regions)


def _region(inside: Mask, known: Mask) -> Region:
    """The region `inside`, from a window with a border of one pixel beyond it."""

    def distance_to(where: Mask) -> Float[np.ndarray, "h w"]:
        return distance_transform_edt(~where) if where.any() else np.full(where.shape, float(sum(where.shape)))

    distance = np.where(inside, 0.5 - distance_to(~inside), distance_to(inside | ~known) - 0.5)
    distance[~known] = 0.0
    by_y, by_x = np.gradient(distance)
    slope = np.stack([by_x, by_y], axis=-1)
    a, b = border_pairs(inside, known & ~inside)
    normal = slope[a[:, 0], a[:, 1]] + slope[b[:, 0], b[:, 1]]
    length = np.linalg.norm(normal, axis=1)
    good = length > 0.4  # where it vanishes it says no direction
    contour, outward = ((a + b) / 2 + 0.5)[good][:, ::-1], normal[good] / length[good, None]
    return Region(distance[1:-1, 1:-1], slope[1:-1, 1:-1], contour - 1.0, outward)


def border_pairs(inside: Mask, outside: Mask) -> tuple[Int[np.ndarray, "n 2"], Int[np.ndarray, "n 2"]]:
    """(row, column) of each pixel in `inside` with a right, left, lower or upper neighbour in `outside`, and of that."""
    pairs = []
    for axis in (0, 1):
        low, high = (slice(None),) * axis + (slice(None, -1),), (slice(None),) * axis + (slice(1, None),)
        step = np.eye(2, dtype=int)[axis]
        first, second = np.argwhere(inside[low] & outside[high]), np.argwhere(outside[low] & inside[high])
        pairs += [(first, first + step), (second + step, second)]
    return np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])
