"""Errors of normals by their confidence, and of poses, where true ones are known.

`python -m studies.measured.normals DATASET …` shows how well `factorlib.inference.model.normal_errors` states them.
"""

import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.dataset.read_dataset import read_dataset
from factorlib.evaluate.truth import pose_error
from factorlib.images.exr import read_exr
from factorlib.inference.model.normal_errors import DEVIATION
from factorlib.results.poses import FILE, read_poses
from factorlib.urm.extract import read_geometry
from studies.measured.tools import ROOT, machine, markdown_table, run_verb

EDGES = (0.0, 0.1, 0.3, 0.6, 0.85, 0.97, 1.0)  # of ranges of confidence
LARGEST = 60.0  # degrees; a pixel whose normal is further off shows another surface than the mesh's


def errors_of(dataset: Path) -> Float[np.ndarray, "n 2"]:
    """Return confidence, and error of the normal in degrees, of every pixel of a data set that has true normals."""
    run_verb("surface", dataset)
    read = read_dataset(dataset)
    build = ROOT / "build" / dataset.name
    rows = []
    for photo, file in (read.truth.normals if read.truth else {}).items():
        geometry = read_geometry(build / "align", build / "surface", photo)
        true = read_exr(dataset / file)
        pairs = [np.stack([maps[f"normal.{a}"] for a in "xyz"], axis=-1) for maps in (geometry, true)]
        if pairs[0].shape != pairs[1].shape:
            continue  # averaged down
        both = np.all([np.linalg.norm(normal, axis=-1) > 0.5 for normal in pairs], axis=0)
        cosine = np.sum(pairs[0][both] * pairs[1][both], axis=-1)
        rows.append(np.column_stack([geometry["confidence"][both], np.degrees(np.arccos(cosine.clip(-1, 1)))]))
    return np.vstack(rows)


def turns_of(dataset: Path) -> list[float]:
    """Return the error of the rotation of every estimated pose whose true one is known, in degrees."""
    truth = read_dataset(dataset).truth
    poses = read_poses(ROOT / "build" / dataset.name / "align" / FILE)
    pairs = ((poses[photo].objects, true) for photo, true in (truth.poses if truth else {}).items())
    return [pose_error(entries[name], true[name]).rotation_deg for entries, true in pairs for name in true]


def main() -> None:
    """Print the table of the data sets that are named."""
    datasets = [Path(word).resolve() for word in sys.argv[1:]]
    errors = np.vstack([errors_of(dataset) for dataset in datasets])
    errors = errors[errors[:, 1] < LARGEST]
    rows = []
    for low, high in zip(EDGES, EDGES[1:]):
        confidence, angle = errors[(errors[:, 0] > low) & (errors[:, 0] <= high)].T
        if not len(angle):
            continue
        stated = np.degrees(DEVIATION) / np.median(confidence)  # with that of a sure normal
        measured = np.sqrt(np.mean(angle**2) / 2)  # along one of two tangents
        rows.append(
            [f"{low} to {high}", f"{len(angle):,}", *(f"{v:.1f}" for v in (measured, np.median(angle), stated))]
        )
    print(machine())
    for dataset in datasets:
        turn = np.sqrt(np.mean(np.square(turns_of(dataset))) / 3)
        print(f"{dataset.name}: poses are turned by {turn:.2f}° about an axis (RMS)")
    print(markdown_table(["confidence", "pixels", "RMS along a tangent, °", "median, °", "stated, °"], rows))


if __name__ == "__main__":
    main()
