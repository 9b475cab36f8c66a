"""shapes.json: cameras from structure from motion, and shapes reconstructed from masks."""

from pathlib import Path

import msgspec

from factorlib.dataset.schema import ExternalCamera
from factorlib.jsonfile import read_result

FILE = "shapes.json"


class ShapeEntry(msgspec.Struct, frozen=True):
    """A reconstructed shape.

    Attributes:
        kind: hull, lathe, ball, box or cylinder
        extent: size of its bounding box, in its own units
        photos: photos whose outlines were used
        overlap: mean IoU of the shape with these outlines
    """

    kind: str
    extent: tuple[float, float, float]
    triangles: int
    photos: list[str]
    overlap: float


class ShapesTable(msgspec.Struct, frozen=True):
    """Content of shapes.json.

    Attributes:
        cameras: cameras that structure from motion placed, by photo
        meshes: shapes by name
    """

    cameras: dict[str, ExternalCamera] = {}
    meshes: dict[str, ShapeEntry] = {}


def read_shapes(folder: Path | None) -> ShapesTable:
    """Read the table in the folder of the stage `shapes`; it is empty without a folder."""
    return ShapesTable() if folder is None else read_result(folder / FILE, ShapesTable, "shapes")
