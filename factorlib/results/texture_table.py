"""texture.json and factors.parquet of `texture`: albedo textures of meshes, and the evidence for them."""

import json
from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float

from factorlib.jsonfile import read_result
from factorlib.parquetfile import read_columns
from factorlib.results.surface_table import DetailEvidence
from factorlib.wholefile import writing

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
