"""shapes.json: cameras that structure from motion found, and shapes that were found of masks."""

from pathlib import Path

import msgspec

from factorlib.dataset.schema import ExternalCamera
from factorlib.jsonfile import read_result

FILE = "shapes.json"


class ShapeEntry(msgspec.Struct, frozen=True):
    """kind: hull, lathe, ball, box or cylinder;  extent: of its bounding box, in its own units;  photos: whose outlines were used

    overlap: of the shape with these outlines, mean IoU
    """

    kind: str
    extent: tuple[float, float, float]
    triangles: int
    photos: list[str]
    overlap: float


class ShapesTable(msgspec.Struct, frozen=True):
    """cameras: by photo, of those that structure from motion placed;  meshes: by name"""

    cameras: dict[str, ExternalCamera] = {}
    meshes: dict[str, ShapeEntry] = {}


def read_shapes(folder: Path | None) -> ShapesTable:
    """Read the table in the folder of the stage `shapes`; it is empty where a data set has none."""
    return ShapesTable() if folder is None else read_result(folder / FILE, ShapesTable, "shapes")
