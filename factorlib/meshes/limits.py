"""How large a mesh may be: far more than a rough mesh needs, and what a machine still holds."""

from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.errors import InputError

VERTICES_A_TRIANGLE = 3


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is refused before it is read; a mesh of a million triangles takes about 1 GB and 20 s."""

    megabytes: Annotated[float, msgspec.Meta(gt=0, le=1e6)] = 500.0
    """Largest size of a mesh's file, and of the buffers it refers to together, in megabytes."""
    triangles: Annotated[int, msgspec.Meta(ge=1, le=10**9)] = 5_000_000
    """Most triangles of a mesh."""

    @property
    def bytes(self) -> int:
        """The limit of a file in bytes."""
        return int(self.megabytes * 1e6)

    def check(self, vertices: int, triangles: int, file: str | Path) -> None:
        """Raises InputError for more triangles, or more vertices than so many triangles can use."""
        most_vertices = VERTICES_A_TRIANGLE * self.triangles
        for count, most, what in ((triangles, self.triangles, "triangles"), (vertices, most_vertices, "vertices")):
            if count > most:
                cure = f'simplify it; at most {most:,} {what} are read (SET="align.limits.triangles=…")'
                raise InputError(f"has {count:,} {what}", file=file, cure=cure)


NO_LIMITS = Limits(megabytes=1e6, triangles=10**9)  # of what an earlier stage has read within its own
