"""Poses of real photographs, against poses from elsewhere: `make results ONLY=real_poses REAL="FOLDER …"`.

Each folder is a data set with a `reference_poses.json` in the layout of align's poses.json.  Every photo is aligned by
the stages `masks` and `align` without the data set's cameras and poses; EXIF belongs to the photo and stays.  A photo
takes six to nine seconds of the processor.

Not every turn between the two answers is an error of the alignment.  Taken off, one at a time:

    the ray's turn     a longer lens from further away shows nearly the same picture, and every ray to the object leans
                       less: the turn of the ray to the object's middle follows from the focal length, not from the mask
    the common turn    of all photos of a set, about the mesh's axes: how the mesh lies in the reference's frame
"""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from factorlib.align.coarse import rotation_to_ray
from factorlib.dataset.read_dataset import read_dataset
from factorlib.dataset.schema import Dataset
from factorlib.errors import InputError
from factorlib.geometry.camera import Pose, angle_between
from factorlib.geometry.raster import Caster, rasterise
from factorlib.jsonfile import read_result
from factorlib.meshes.read_mesh import read_mesh
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import PhotoPoses, read_photo_poses
from factorlib.scenes.stage_runs import run_stages
from stages import align, masks
from studies.measured.align import normal_error_deg, share
from studies.measured.tools import Tables, environment_words

REFERENCE = "reference_poses.json"
CURE = "name a dataset whose poses are known, as align's poses.json has them"
ANGLES = {
    "normal_error_deg": "normals (°)",
    "rotation_error_deg": "rotation (°)",
    "about_the_ray_deg": "less the ray's turn (°)",
}


class ReferencePoses(PhotoPoses, frozen=True):
    """Entry of a photo in reference_poses.json; silhouette_iou: of all its objects together, None if unknown."""

    silhouette_iou: float | None = None


def read_references(folder: Path) -> dict[str, ReferencePoses]:
    """Return the known poses by photo.  InputError for a folder without any."""
    if not (folder / REFERENCE).is_file():
        raise InputError(f"there is no {REFERENCE}", file=folder, cure=CURE)
    return read_result(folder / REFERENCE, dict[str, ReferencePoses], "align", CURE)


def without_poses(dataset: Dataset) -> Dataset:
    """Return the dataset without cameras, poses, keypoints and cameras from another program."""
    replace = msgspec.structs.replace
    bare = [[replace(obj, pose=None, keypoints=[]) for obj in photo.objects] for photo in dataset.spec.photos]
    photos = [replace(p, camera=None, objects=objects) for p, objects in zip(dataset.spec.photos, bare, strict=True)]
    return replace(dataset, spec=replace(dataset.spec, photos=photos), external={})


def measure(folder: Path, photo: str) -> list[dict]:
    """Return one row per object of the photo: errors against the reference, and the doubts of the stage."""
    dataset = without_poses(read_dataset(folder))
    reference = read_references(folder)[photo]
    start_s = time.process_time()
    with TemporaryDirectory() as build:
        run_stages(dataset, Path(build), (masks, align), photos=[photo])
        size = read_photo_facts(Path(build) / "masks" / f"{photo}.json")
        estimate = read_photo_poses(Path(build) / "align" / f"{photo}.json")
    seconds = time.process_time() - start_s
    camera, true_camera = (entry.camera.camera(size.width, size.height) for entry in (estimate, reference))
    rows = []
    for obj in dataset.photo(photo).objects:
        file = dataset.spec.meshes[obj.mesh]
        mesh = read_mesh(dataset.folder / file.file, dataset.spec.materials, file.part_materials, obj.materials)
        caster = Caster(mesh)
        pose, true = (entry.objects[obj.name].pose for entry in (estimate, reference))
        normals = rasterise(caster, true_camera, true), rasterise(caster, camera, pose)
        rows.append(
            {
                "set": folder.resolve().name,
                "object": obj.name,
                "processor_s": seconds,
                "turn": Rotation.from_matrix(true.rotation.T @ pose.rotation).as_rotvec().tolist(),
                "rotation_error_deg": angle_between(pose.rotation, true.rotation),
                "normal_error_deg": normal_error_deg(*normals),
                "about_the_ray_deg": angle_between(*(about_the_ray(p, caster.centre) for p in (pose, true))),
                "focal_ratio": camera.focal / true_camera.focal,
                "doubts": estimate.objects[obj.name].doubts,
            }
        )
    return rows


def about_the_ray(pose: Pose, centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation in the frame of a camera that looks straight at the object's centre.

    It is cam_from_object less the ray's turn.
    """
    middle = pose.apply(centre[None])[0]
    return rotation_to_ray(middle[:2] / middle[2]).T @ pose.rotation


def common_turn(turns: list[list[float]]) -> tuple[float, list[float]]:
    """Return the angle of the mean of rotation vectors, and the angle of each vector less that mean, degrees.

    >>> [round(float(angle), 6) for angle in common_turn([[0, 0, 0.1], [0, 0, 0.3]])[1]]
    [5.729578, 5.729578]
    """
    each = Rotation.from_rotvec(turns)
    return float(np.rad2deg(each.mean().magnitude())), np.rad2deg((each * each.mean().inv()).magnitude()).tolist()


def rows() -> Tables:
    """Return the table of sets, with medians and worst values over photos."""
    folders = [Path(word) for word in environment_words("REAL", "folders of photographs with known poses")]
    photos = [(f, p.name) for f in folders for p in read_dataset(f).spec.photos if p.name in read_references(f)]
    return tables_of([row for key in photos for row in measure(*key)])


def tables_of(measures: list[dict]) -> Tables:
    """Return the table of the sets whose photos were measured."""
    sets = []
    for name in dict.fromkeys((row["set"], row["object"]) for row in measures):
        rows = [row for row in measures if (row["set"], row["object"]) == name]
        column = {key: [row[key] for row in rows] for key in rows[0]}
        common, rest = common_turn(column["turn"])
        cells = [f"{np.median(column[key]):.1f}, {max(column[key]):.1f}" for key in ANGLES]
        cells += [f"{common:.1f}", f"{np.median(rest):.1f}, {max(rest):.1f}"]
        cells += [f"{min(column['focal_ratio']):.2f} to {max(column['focal_ratio']):.2f}", share(column["doubts"])]
        cells.append(f"{np.median(column['processor_s']):.0f}, {max(column['processor_s']):.0f}")
        sets.append([" ".join(name), str(len(rows)), *cells])
    more = ["common turn (°)", "less that (°)", "focal length, of the reference's", "doubtful", "processor (s)"]
    return {"Sets: median, worst": [["set, object", "photos", *ANGLES.values(), *more], *sets]}
