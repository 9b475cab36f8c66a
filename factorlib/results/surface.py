"""surface.json of `surface`: how meshes differ from the given ones, as shading has it, and what decided."""

from pathlib import Path
from typing import Any

import msgspec

from factorlib.jsonfile import read_result

FILE, BEGINNING = "surface.json", "beginning.json"


class Tried(msgspec.Struct, frozen=True):
    """What decided, of photos that had no part in the surface; None where nothing was tried.

    held_out_loss_with, held_out_loss_without   of their held-out observations;  margin: of the difference of the logarithms, in standard errors
    stiffness   of what is kept: the best of those that were tried
    """

    held_out_loss_with: float | None = None
    held_out_loss_without: float | None = None
    margin: float | None = None
    stiffness: float | None = None

    @classmethod
    def of(cls, evidence: Any, stiffness: float | None) -> "Tried":
        """Make one of the solver's evidence."""
        return cls(evidence.held_out_loss_with, evidence.held_out_loss_without, evidence.margin, stiffness)


class SurfaceTable(msgspec.Struct, frozen=True):
    """How the surfaces of a set differ from its meshes.

    moved, moved_by      whether surfaces differ from the given meshes, and what decided
    painted, painted_by  whether diffuse reflectance has detail, over what moved surfaces explain
    gains          by photo: how much minus twice the log marginal likelihood of its observations fell, while it had no part in the surface
    displacements  by mesh: along the normal of each node of the subdivided mesh (`factorlib.meshes.fine`), over the mesh's extent; none where not moved
    log_factors    by mesh: of the diffuse reflectance at each node; none where not painted
    """

    moved: bool = False
    moved_by: Tried = Tried()
    painted: bool = False
    painted_by: Tried = Tried()
    gains: dict[str, float] = {}
    displacements: dict[str, list[float]] = {}
    log_factors: dict[str, list[float]] = {}


def read_surface(folder: str | Path | None) -> SurfaceTable:
    """The table in the folder of a result of `surface`; without a folder, meshes are as given.  Raises InputError for a file that is none."""
    if folder is None:
        return SurfaceTable()
    return read_result(Path(folder) / FILE, SurfaceTable, "surface")
