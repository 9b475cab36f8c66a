"""surface.json of `surface`: how meshes differ from the given ones, as shading has it, and what decided."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.jsonfile import read_result

FILE = "surface.json"


class SurfaceTable(msgspec.Struct, frozen=True):
    """What was found.

    kept           whether surfaces differ from the given meshes
    held_out_loss_with, held_out_loss_without, margin   of held-out observations of photos that had no part in the surface, and their difference in
                   standard errors; None where nothing was tried
    stiffness      of the surface, the best of those that were tried
    gains          by photo: how much minus twice the log marginal likelihood of its observations fell, while it had no part in the surface
    displacements  by mesh: along the normal of each node of the subdivided mesh (`factorlib.meshes.fine`), over the mesh's extent; none where not kept
    """

    kept: bool = False
    held_out_loss_with: float | None = None
    held_out_loss_without: float | None = None
    margin: float | None = None
    stiffness: float | None = None
    gains: dict[str, float] = {}
    displacements: dict[str, list[float]] = {}


def read_surface(folder: str | Path | None) -> SurfaceTable:
    """The table in the folder of a result of `surface`; without a folder, meshes are as given.  Raises InputError for a file that is none."""
    if folder is None:
        return SurfaceTable()
    return read_result(Path(folder) / FILE, SurfaceTable, "surface")
