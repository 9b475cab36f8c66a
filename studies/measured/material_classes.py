"""Classes of the prior on materials, fitted to a table of measured materials.

`python -m studies.measured.material_classes FILE [--out factorlib/inference/model/material_classes.json]` takes a
second.

FILE is a .csv with a row a material: its name in `material`, and the Lambert + GGX that was fitted to it: `k_s` and
`roughness`, and `k_s_r`, `k_s_g`, `k_s_b`, `k_d_r`, `k_d_g` and `k_d_b`, whose ratios are the tints.  The class of a
row is that whose words its name has: METALS, FIBROUS, or else dielectric.
"""

import csv
import hashlib
import io
import re
from argparse import ArgumentParser
from pathlib import Path

import numpy as np

from factorlib.errors import InputError
from factorlib.inference.model.material_prior import Classes, MaterialClass
from factorlib.jsonfile import json_text, write_json
from factorlib.reading import read_bytes, reading

# Effect paints, satins with metallic threads and iridescent foils have flakes or wires that reflect as metal does.
METALS = (
    r"metal(?!$)|steel|ss440|chrom|brass|bronze|aluminium|nickel|gold|silver|tungsten|hematite|flake|chm_|vch_|cc_|color-chang"
    r"|satin|aurora|pearl|solo_m"
)
# Of fibres or powder: rough all through, which GGX imitates by a specular part of roughness .6 to 1.
FIBROUS = (
    r"(?<!specular-)fabric|felt|cloth|foam|paper_|cardboard_rgb|latex|ceiling|spectralon|"
    r"colodur_(azure|napoli)|polyethylene"
)
LEAST = 1e-3  # of k_s: what a fit calls nil
RAYLEIGH = np.sqrt(2 * np.log(2))  # the median length of a Gaussian vector of two dimensions, in standard deviations
COLUMNS = ("material", "k_s_r", "k_s_g", "k_s_b", "k_s", "roughness", "k_d_r", "k_d_g", "k_d_b")


def classes_of(path: Path) -> Classes:
    """Return means and covariances of the three classes.

    Raises InputError if a column is missing, or a class has fewer than four rows.
    """
    content = read_bytes(path, "a table of materials")
    rows = list(csv.DictReader(io.StringIO(content.decode("utf-8", "replace"))))
    if not rows or (missing := [name for name in COLUMNS if rows[0].get(name) is None]):
        raise InputError("it lacks columns", file=path, key=", ".join(missing if rows else COLUMNS), cure="see --help")
    by_class: dict[str, list[list[float]]] = {"dielectric": [], "metal": [], "fabric": []}
    for row in rows:
        name = row["material"].split("/")[-1]
        kind = "fabric" if re.search(FIBROUS, name) else "metal" if re.search(METALS, name) else "dielectric"
        with reading("a table of materials", path, f"the row of {name}", "give numbers there"):
            by_class[kind].append([float(row[column]) for column in COLUMNS[1:]])
            if not np.isfinite(by_class[kind][-1]).all():
                raise ValueError("a value is not finite")
    if few := [name for name, values in by_class.items() if len(values) < 4]:
        cure = "name the materials by what they are"
        raise InputError(f"only few rows are of the class {few[0]}", file=path, cure=cure)
    classes = tuple(_fit_class(name, np.array(values), len(rows)) for name, values in by_class.items())
    return Classes(classes, made_from=path.name, sha256=hashlib.sha256(content).hexdigest())


def _fit_class(name: str, values: np.ndarray, total: int) -> MaterialClass:
    specular, diffuse = values[:, :3], values[:, 5:]
    tint = _tints(specular)
    difference = None if name == "dielectric" else _deviation(tint - _tints(specular + diffuse))
    x = np.column_stack([np.log(np.maximum(values[:, 3], LEAST)), values[:, 4]])
    mean = np.round(x.mean(0), 3).tolist()
    covariance = np.round(np.cov(x.T), 4).tolist()
    share = round(len(values) / total, 3)
    return MaterialClass(name, share, tuple(mean), tuple(map(tuple, covariance)), _deviation(tint), difference)


def _tints(reflectance: np.ndarray) -> np.ndarray:
    """Return the logarithm of each row less its mean."""
    log = np.log(np.maximum(reflectance, LEAST))
    return log - log.mean(1, keepdims=True)


def _deviation(tints: np.ndarray) -> float:
    """Return the standard deviation of tints by their median length."""
    return round(float(np.median(np.linalg.norm(tints, axis=1)) / RAYLEIGH), 3)


def main(file: Path, out: Path | None = None) -> None:
    """Fit the classes of materials to a table of measured ones; print them, or write them to a file."""
    classes = classes_of(file)
    print(json_text(classes)) if out is None else write_json(out, classes)


if __name__ == "__main__":
    parser = ArgumentParser(description=main.__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--out", type=Path, help="file to write to")
    main(**vars(parser.parse_args()))
