"""surface.json of `surface`: refinement of the meshes by shading, and the evidence for it."""

from pathlib import Path
from typing import Any

import msgspec

from factorlib.jsonfile import read_result

FILE = "surface.json"
BEGINNING = "beginning.json"


class DetailEvidence(msgspec.Struct, frozen=True):
    """Evidence for a refinement from photos that it was not estimated from; None for what was not tried.

    Attributes:
        held_out_loss_with: loss of their held-out observations with the refinement
        held_out_loss_without: loss of their held-out observations without it
        margin: difference of the logarithms, in standard errors
        stiffness: stiffness of the refinement, the best of the values that were tried
        log_bayes_factor: logarithm of the Bayes factor of these photos, where it decides
    """

    held_out_loss_with: float | None = None
    held_out_loss_without: float | None = None
    margin: float | None = None
    stiffness: float | None = None
    log_bayes_factor: float | None = None

    @classmethod
    def from_decision(cls, evidence: Any, stiffness: float | None) -> "DetailEvidence":
        """Convert the solver's decision and the chosen stiffness."""
        losses = evidence.held_out_loss_with, evidence.held_out_loss_without
        return cls(*losses, evidence.margin, stiffness, evidence.log_bayes_factor)


class SurfaceTable(msgspec.Struct, frozen=True):
    """Differences between the surfaces of a set and its meshes.

    Attributes:
        moved: True if surfaces differ from the given meshes
        moved_by: evidence for it
        painted: True if diffuse reflectance has detail, beyond what moved surfaces explain
        painted_by: evidence for it
        gains: by photo: decrease of minus twice the log marginal likelihood of its observations, without a part in the
            surface
        displacements: by mesh: along the normal at each node of the subdivided mesh (`meshes.subdivision`), in
            units of the mesh's extent
        log_factors: by mesh: log factor on diffuse reflectance at each node, per channel
        lights: lights that surface and materials are estimated from; None for all
    """

    moved: bool = False
    moved_by: DetailEvidence = DetailEvidence()
    painted: bool = False
    painted_by: DetailEvidence = DetailEvidence()
    gains: dict[str, float] = {}
    displacements: dict[str, list[float]] = {}
    log_factors: dict[str, list[tuple[float, float, float]]] = {}
    lights: list[str] | None = None

    @property
    def disagreement(self) -> float | None:
        """RMS residual of photos that had no part in the surface, in σ of their noise; None if it was not measured."""
        by = self.painted_by if self.painted else self.moved_by
        loss = by.held_out_loss_with if self.painted or self.moved else by.held_out_loss_without
        return None if loss is None else float(loss**0.5)  # ρ(r) ≈ r² where r is not an outlier


def read_surface(folder: str | Path | None) -> SurfaceTable:
    """Read the table in a result folder of `surface`; without a folder, meshes are as given.

    Raises:
        InputError: The file is not such a table.
    """
    if folder is None:
        return SurfaceTable()
    return read_result(Path(folder) / FILE, SurfaceTable, "surface")
