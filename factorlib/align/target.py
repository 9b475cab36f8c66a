"""Silhouette of one object in a photo, at a resolution at which poses are compared with it quickly.

For each material, the signed distance to the border of its region tells how far, and in which direction, a contour of
the mesh is off. Unknown pixels are a dead zone: a contour may lie there at no cost. So an occluder or the frame of the
photo is never taken for the object's own contour.
"""

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt

from factorlib.align.silhouette import UNKNOWN, Mask, ObjectView, Silhouette
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
    """Window about the mask of a view.

    left, top    corner of the window in the photo, photo pixels
    pixel        photo pixels per window pixel
    silhouette   the mask in the window
    regions      region of each material of the mesh, by label
    """

    view: ObjectView
    left: float
    top: float
    pixel: float
    silhouette: Silhouette
    regions: dict[int, Region]

    def window(self, focal: float) -> Camera:
        """Return the photo's camera at a focal length, restricted to the window, in the window's pixels."""
        height, width = self.silhouette.label.shape
        camera = msgspec.structs.replace(self.view.camera, focal=focal)
        return camera.window(self.left, self.top, self.pixel, width, height)

    @property
    def extent(self) -> float:
        """Longer side of the mask's bounding box, window pixels."""
        return bounding_box(self.silhouette)[2]


def bounding_box(silhouette: Silhouette) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the lowest and highest (x, y) corner of the mask's bounding box, and its longer side, in pixels."""
    rows, columns = np.nonzero(silhouette.inside)
    low = np.array([columns.min(), rows.min()], float)
    high = np.array([columns.max(), rows.max()], float) + 1
    return low, high, float((high - low).max())


def make_target(view: ObjectView, labels: tuple[int, ...], resolution: int, margin: float = 0.2) -> Target:
    """Cut out the mask with a margin around it and compute the region of each material.

    Args:
        view: The mask of the object and the photo's camera.
        labels: Labels of the mesh's materials.
        resolution: Pixels of the mask's longer side in the window; fewer if the photo has fewer.
        margin: Margin as a share of the mask's extent.

    Returns:
        The window.
    """
    silhouette = view.silhouette
    low, high, extent = bounding_box(silhouette)
    pixel = max(extent / resolution, 1.0)
    height, width = silhouette.label.shape
    # nearest photo pixel of each window pixel
    low = np.maximum(np.floor(low - margin * extent), 0)
    high = np.minimum(np.ceil(high + margin * extent), (width, height))
    columns, rows = (np.arange(int(np.ceil((high[k] - low[k]) / pixel))) for k in (0, 1))
    x = np.minimum((low[0] + (columns + 0.5) * pixel).astype(int), width - 1)
    y = np.minimum((low[1] + (rows + 0.5) * pixel).astype(int), height - 1)
    window = silhouette.label[np.ix_(y, x)]
    # one pixel around the window, unknown beyond the photo's frame
    padded = np.pad(window, 1, mode="edge")
    borders = low[1] == 0, high[1] == height, low[0] == 0, high[0] == width
    for is_frame, edge in zip(borders, (padded[0], padded[-1], padded[:, 0], padded[:, -1]), strict=True):
        if is_frame:
            edge[:] = UNKNOWN
    regions = {label: _region(padded == label, padded != UNKNOWN) for label in labels}
    return Target(view, float(low[0]), float(low[1]), pixel, Silhouette(window), regions)


def _region(inside: Mask, known: Mask) -> Region:
    """Return the region `inside`, from a window with a border of one pixel around it."""

    def distance_to(where: Mask) -> Float[np.ndarray, "h w"]:
        """Return the distance of each pixel to the nearest pixel in `where`."""
        return distance_transform_edt(~where) if where.any() else np.full(where.shape, float(sum(where.shape)))

    # signed distance to the border, 0 on unknown pixels, and its gradient
    distance = np.where(inside, 0.5 - distance_to(~inside), distance_to(inside | ~known) - 0.5)
    distance[~known] = 0.0
    by_y, by_x = np.gradient(distance)
    slope = np.stack([by_x, by_y], axis=-1)
    # contour points between neighbouring pixels, with their normals
    a, b = border_pairs(inside, known & ~inside)
    normal = slope[a[:, 0], a[:, 1]] + slope[b[:, 0], b[:, 1]]
    length = np.linalg.norm(normal, axis=1)
    clear = length > 0.4  # a vanishing gradient has no direction
    contour = ((a + b) / 2 + 0.5)[clear][:, ::-1]
    outward = normal[clear] / length[clear, None]
    return Region(distance[1:-1, 1:-1], slope[1:-1, 1:-1], contour - 1.0, outward)


def border_pairs(inside: Mask, outside: Mask) -> tuple[Int[np.ndarray, "n 2"], Int[np.ndarray, "n 2"]]:
    """Return pairs of neighbouring pixels (row, column): the first in `inside`, the second in `outside`.

    Neighbours are right, left, upper and lower ones.
    """
    pairs = []
    for axis in (0, 1):
        low = (slice(None),) * axis + (slice(None, -1),)
        high = (slice(None),) * axis + (slice(1, None),)
        step = np.eye(2, dtype=int)[axis]
        first = np.argwhere(inside[low] & outside[high])
        second = np.argwhere(outside[low] & inside[high])
        pairs += [(first, first + step), (second + step, second)]
    return np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])
