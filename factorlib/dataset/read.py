"""Reading a dataset: YAML to types, then every check that needs no pixel.

Imports nothing heavy, for a run that finds nothing to do passes here too; only a dataset that names a source of cameras
pays for pycolmap (.2 s).
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

from factorlib.dataset.check import check_dataset, check_lights, check_truth
from factorlib.dataset.companions import companions_of_mesh
from factorlib.dataset.paths import Refusal, is_there
from factorlib.dataset.schema import Dataset, DatasetFile, TruthFile
from factorlib.errors import InputError
from factorlib.reading import reading
from factorlib.yamlfile import read_yaml

FILE = "dataset.yaml"
RESERVED = ("studies", "bench", "store")  # folders of build/ that are no datasets
log = logging.getLogger("factorlib.dataset")


def read_dataset(path: str | Path) -> Dataset:
    """The dataset in a folder, or of a dataset.yaml.

    A missing truth.yaml, or one that names missing maps, is a warning: only what compares with the truth needs it.
    Anything else that is wrong is an InputError that names file, key and cure.
    """
    with reading("a dataset", path, "DATASET"):
        file = Path(path) / FILE if Path(path).is_dir() else Path(path)
    if not is_there(file, "DATASET"):
        raise InputError("there is no such dataset", file=file, cure=f"name a folder with a {FILE} in it")
    folder = Path(os.path.abspath(file)).parent
    if folder.name in RESERVED:
        raise InputError(
            f"a dataset cannot be called {folder.name!r}", file=file, cure="rename its folder: build/ uses that name"
        )
    spec = read_yaml(file, DatasetFile)
    check_dataset(spec, file)
    companions, external = _companions(spec, file), {}
    if spec.cameras is not None:
        from factorlib.dataset.sources.external import external_cameras

        spec, external = external_cameras(spec, file)
    check_lights(spec.photos, file)
    return Dataset(folder=folder, spec=spec, companions=companions, external=external, truth=_read_truth(spec, file))


def _companions(spec: DatasetFile, file: Path) -> dict[str, list[str]]:
    refuse = Refusal(file, file.parent)
    return {name: companions_of_mesh(mesh.file, f"meshes.{name}.file", refuse) for name, mesh in spec.meshes.items()}


def _read_truth(spec: DatasetFile, file: Path) -> TruthFile | None:
    if spec.truth is None:
        return None
    truth_file = file.parent / spec.truth
    if not is_there(truth_file, "truth"):
        log.warning("%s: truth: there is no %s: nothing is compared with the truth", file, spec.truth)
        return None
    truth = read_yaml(truth_file, TruthFile)
    check_truth(truth, spec, truth_file, file.parent)
    for path in truth_paths(truth):
        if not is_there(file.parent / path, "truth"):
            log.warning("%s: there is no %s: nothing is compared with the truth", truth_file, path)
            return None
    return truth


def truth_paths(truth: TruthFile) -> list[str]:
    """The maps a truth.yaml names, in a fixed order."""
    return sorted({*truth.illumination.values(), *truth.normals.values()})
