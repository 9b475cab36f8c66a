"""Meshes of a data set, each read once for each choice of materials for its parts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from factorlib.dataset.schema import MeshEntry
from factorlib.meshes.limits import NO_LIMITS
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.read import read_mesh


class MeshesOnce:
    """file: the path of a file that dataset.yaml names;  materials: the data set's;  crease_deg: as of `read_mesh`

    Sizes are not limited: an earlier stage has read the same files within its limits.
    """

    def __init__(self, file: Callable[[str], Path], materials: Sequence[str], crease_deg: float):
        self.file, self.materials, self.crease_deg = file, materials, crease_deg
        self._meshes: dict[tuple, Mesh] = {}

    def mesh(self, name: str, entry: MeshEntry, overrides: Mapping[str, str] = {}) -> Mesh:
        """The mesh `name` with `overrides` of its parts' materials, read when first asked for."""
        key = (name, *sorted(overrides.items()))
        if key not in self._meshes:
            file = self.file(entry.file)
            self._meshes[key] = read_mesh(file, self.materials, entry.made_of, overrides, self.crease_deg, NO_LIMITS)
        return self._meshes[key]
