"""Limits on the size of a mesh: far more than a rough mesh needs, but within the memory of a usual machine."""

from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.errors import InputError

VERTICES_A_TRIANGLE = 3
MOST_PARTS = 100_000  # greatest number of parts of one file


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits that are checked before a mesh is read; a mesh of a million triangles takes about 1 GB and 20 s."""

    megabytes: Annotated[float, msgspec.Meta(gt=0, le=1e6)] = 500.0
    """Greatest size of a mesh's file, and of all its buffers together, megabytes."""
    triangles: Annotated[int, msgspec.Meta(ge=1, le=10**9)] = 5_000_000
    """Greatest number of triangles of a mesh."""

    @property
    def bytes(self) -> int:
        """Greatest size of a file, bytes."""
        return int(self.megabytes * 1e6)

    def check(self, vertices: int, triangles: int, file: str | Path) -> None:
        """Check the numbers of vertices and triangles of a file against the limits.

        Args:
            vertices: Number of vertices.
            triangles: Number of triangles.
            file: File to name in the error.

        Raises:
            InputError: If there are too many triangles, or more vertices than the most triangles can use.
        """
        most_vertices = VERTICES_A_TRIANGLE * self.triangles
        for count, most, what in ((triangles, self.triangles, "triangles"), (vertices, most_vertices, "vertices")):
            if count > most:
                raise InputError(
                    f"has {count:,} {what}",
                    file=file,
                    cure=f'simplify it; at most {most:,} {what} are read (SET="align.limits.triangles=…")',
                )

    @staticmethod
    def check_parts(parts: int, file: str | Path) -> None:
        """Raise InputError for more than MOST_PARTS parts in one file."""
        if parts > MOST_PARTS:
            raise InputError(
                f"has {parts:,} parts",
                file=file,
                cure=f"join parts that have the same material: at most {MOST_PARTS:,} parts are read",
            )


NO_LIMITS = Limits(megabytes=1e6, triangles=10**9)  # for meshes that an earlier stage has checked
