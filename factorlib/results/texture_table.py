"""texture.json and factors.parquet of `texture`: albedo textures of meshes, and the evidence for them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float

from factorlib.jsonfile import read_result
from factorlib.parquetfile import read_columns
from factorlib.stage import Inputs
from factorlib.wholefile import writing

# surface.json of `surface`: refinement of the meshes by shading, and the evidence for it.

SURFACE_FILE = "surface.json"
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
    """

    moved: bool = False
    moved_by: DetailEvidence = DetailEvidence()
    painted: bool = False
    painted_by: DetailEvidence = DetailEvidence()
    gains: dict[str, float] = {}
    displacements: dict[str, list[float]] = {}
    log_factors: dict[str, list[tuple[float, float, float]]] = {}

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
    return read_result(Path(folder) / SURFACE_FILE, SurfaceTable, "surface")


FILE = "texture.json"
FACTORS = "factors.parquet"
CHANNELS = ("red", "green", "blue")


class TextureEvidence(msgspec.Struct, frozen=True):
    """Decision on the texture of one material of one mesh.

    Attributes:
        mesh: name of the mesh
        material: name of the material
        kept: True if the texture is used
        photos: number of solved photos that show it; one alone gives no evidence
        by: losses of each photo, predicted by the texture and by the flat colour of the others
    """

    mesh: str
    material: str
    kept: bool
    photos: int
    by: DetailEvidence


class TextureTable(msgspec.Struct, frozen=True):
    """Textures of a set.

    Attributes:
        longest: by mesh with a texture, its longest edge after subdivision, in units of its extent
        textures: decisions
    """

    longest: dict[str, float] = {}
    textures: list[TextureEvidence] = []


Factors = Mapping[tuple[str, str], Float[np.ndarray, "v 3"]]  # by mesh and material


def write_factors(path: Path, factors: Factors) -> None:
    """Write the factors at the nodes of each textured mesh and material, in the order of the nodes."""
    keys = [key for key, values in factors.items() for _ in values]
    table = np.vstack([np.zeros((0, 3)), *factors.values()]).astype(np.float32)
    columns = {"mesh": pa.array([mesh for mesh, _ in keys], pa.string())}
    columns |= {"material": pa.array([material for _, material in keys], pa.string())}
    columns |= {name: pa.array(table[:, c]) for c, name in enumerate(CHANNELS)}
    about = {"factor": "on the diffuse reflectance, at the nodes of the subdivided mesh in their order"}
    metadata = {"factorlib": json.dumps(about, sort_keys=True)}
    with writing(path):
        pq.write_table(pa.table(columns, metadata=metadata), path, compression="zstd")


def read_table(folder: str | Path | None) -> TextureTable:
    """Read the table in a result folder of `texture`; without a folder, there are no textures.

    Raises:
        InputError: The file is not such a table.
    """
    return TextureTable() if folder is None else read_result(Path(folder) / FILE, TextureTable, "texture")


def read_textures(folder: str | Path | None) -> dict[str, tuple[float, dict[str, Float[np.ndarray, "v 3"]]]]:
    """Return each textured mesh's longest edge and factors at nodes by material, as `MeshCache` takes them.

    Raises:
        InputError: A file is not of `texture`.
    """
    table = read_table(folder)
    if folder is None or not table.longest:
        return {}
    columns, _ = read_columns(Path(folder) / FACTORS, "a table of textures", ("mesh", "material", *CHANNELS))
    mesh, material = (np.array(columns[name].to_pylist(), dtype=object) for name in ("mesh", "material"))
    values = np.column_stack([columns[name].to_numpy() for name in CHANNELS])
    return {
        name: (longest, {m: values[(mesh == name) & (material == m)] for m in sorted(set(material[mesh == name]))})
        for name, longest in table.longest.items()
    }


# Result of the stage `exchange`, and the results that it replaces where it solved again.

EXCHANGE_FILE = "exchange.json"
REPLACED = ("solve", "shading", "texture")


class Exchange(msgspec.Struct, frozen=True):
    """Decision on the exchange of paint and light.

    Attributes:
        kept: True if the new textures are used; False also where no texture was kept, and nothing was tried
        loss_before: mean loss of held-out photos under the kept textures, before the exchange
        loss_after: the same after it
    """

    kept: bool
    loss_before: float | None = None
    loss_after: float | None = None


def with_exchange(inputs: Inputs) -> Inputs:
    """Return the inputs with the results of `solve`, `shading` and `texture` that the exchange replaced."""
    return msgspec.structs.replace(inputs, folders=exchanged_folders(inputs.folders))


def exchanged_folders(folders: Mapping[str, Path]) -> dict[str, Path]:
    """Return folders of stages, with those of the exchange in place of the results that it replaced."""
    folder = folders.get("exchange")
    replaced = {name: folder / name for name in REPLACED if folder is not None and (folder / name).is_dir()}
    return {**folders, **replaced}


def read_exchange(folder: Path | None) -> Exchange:
    """Read the decision in a result folder of `exchange`; without one nothing was tried.  InputError if it is none."""
    if folder is None or not (folder / EXCHANGE_FILE).exists():
        return Exchange(False)
    return read_result(folder / EXCHANGE_FILE, Exchange, "exchange")
