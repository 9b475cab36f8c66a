"""Real photographs whose poses are known from elsewhere: `python -m benchmarks.align --real FOLDER [--real FOLDER …]`.

FOLDER is a dataset with a `reference_poses.json` in the layout of align's poses.json.  Every photo is aligned by the stages
`masks` and `align` with all that is said of cameras and poses withheld; EXIF belongs to the photo and stays.

Not every turn between the two answers is an error of the alignment.  Taken off, one at a time:

    the ray's turn     a longer lens from further away shows nearly the same picture, and every ray to the object leans less:
                       the turn of the ray to the object's middle follows from the focal length, not from the mask
    the common turn    of all photos of a set, about the mesh's axes: how the mesh lies in the reference's frame
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from benchmarks.align.measure import normal_error_deg
from benchmarks.solve.clock import Clock
from factorlib.align.coarse import toward
from factorlib.dataset.read import read_dataset
from factorlib.dataset.schema import Dataset, ObjectEntry
from factorlib.dataset.slices import dataset_slice
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose, angle_between
from factorlib.geometry.raster import Caster, rasterise
from factorlib.meshes.read import read_mesh
from factorlib.results.file import read_result
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import PhotoPoses, read_photo_poses
from factorlib.stage import Inputs, silent
from stages import align, masks

REFERENCE = "reference_poses.json"
CURE = "name a dataset whose poses are known, as align's poses.json has them"


class Reference(PhotoPoses, frozen=True):
    """A photo's entry of reference_poses.json; silhouette_iou: of all its objects together, None where it is not known."""

    silhouette_iou: float | None = None


def real_keys(folders: list[Path]) -> Iterator[tuple[Path, str]]:
    """(folder, photo) of every photo that has a reference pose.  Raises InputError for a folder without references."""
    for folder in folders:
        if not (folder / REFERENCE).is_file():
            raise InputError(f"there is no {REFERENCE}", file=folder, cure=CURE)
        known = read_result(folder / REFERENCE, dict[str, Reference], "align", CURE)
        yield from ((folder, photo.name) for photo in read_dataset(folder).spec.photos if photo.name in known)


def measured_photo(key: tuple[Path, str]) -> list[dict]:
    """One row per object of the photo: errors against the reference, and what the stage itself says of the pose."""
    folder, photo = key
    dataset = withheld(read_dataset(folder))
    with TemporaryDirectory() as made:
        clock = Clock()
        entry, size = _aligned(dataset, photo, Path(made))
        taken = clock.taken()
    said = {"set": folder.resolve().name, "photo": photo, "wall_s": taken.wall, "processor_s": taken.processor}
    reference = read_result(folder / REFERENCE, dict[str, Reference], "align", CURE)[photo]
    return [said | _errors(dataset, obj, size, entry, reference) for obj in dataset.photo(photo).objects]


def withheld(dataset: Dataset) -> Dataset:
    """The dataset without cameras, poses, keypoints and what a source of cameras says."""
    replace = msgspec.structs.replace
    photos = [
        replace(photo, camera=None, objects=[replace(obj, pose=None, keypoints=[]) for obj in photo.objects])
        for photo in dataset.spec.photos
    ]
    return replace(dataset, spec=replace(dataset.spec, photos=photos), external={})


def _aligned(dataset: Dataset, photo: str, folder: Path) -> tuple[PhotoPoses, tuple[int, int]]:
    """The photo's entry of poses.json, and its width and height."""
    slices = {name: dataset_slice(dataset, name, photo) for name in ("photo", "materials", "objects")}
    facts = {f"dataset.{name}": part.facts for name, part in slices.items()}
    files = {path: dataset.folder / path for part in slices.values() for path in part.files}
    folders = {name: folder / name for name in ("masks", "align")}
    for made in folders.values():
        made.mkdir()
    inputs = Inputs(folders, facts, files, photo)
    masks.main(masks.Params(), inputs, folders["masks"], silent)
    align.main(align.Params(), inputs, folders["align"], silent)
    facts = read_photo_facts(folders["masks"] / f"{photo}.json")
    return read_photo_poses(folders["align"] / f"{photo}.json"), (facts.width, facts.height)


def _errors(dataset: Dataset, obj: ObjectEntry, size: tuple[int, int], entry: PhotoPoses, reference: Reference) -> dict:
    mesh = dataset.spec.meshes[obj.mesh]
    caster = Caster(read_mesh(dataset.folder / mesh.file, dataset.spec.materials, mesh.made_of, obj.materials))
    (camera, pose), (true_camera, true_pose) = (_seen(said, obj.name, size) for said in (entry, reference))
    found = entry.objects[obj.name]
    return {
        "object": obj.name,
        "turn": Rotation.from_matrix(true_pose.rotation.T @ pose.rotation).as_rotvec().tolist(),
        "rotation_error_deg": angle_between(pose.rotation, true_pose.rotation),
        "about_the_ray_deg": angle_between(*(about_the_ray(p, caster.centre) for p in (pose, true_pose))),
        "normal_error_deg": normal_error_deg(
            rasterise(caster, true_camera, true_pose), rasterise(caster, camera, pose)
        ),
        "focal_ratio": camera.focal / true_camera.focal,
        "focal_source": entry.camera.focal_source,
        "reference_iou": reference.silhouette_iou,
        **{
            name: getattr(found, name)
            for name in ("silhouette_iou", "label_agreement", "contour_error", "normal_stderr_deg", "doubts")
        },
    }


def about_the_ray(pose: Pose, centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation as a camera sees it that looks straight at the object's centre: cam_from_object less the ray's turn."""
    middle = pose.apply(centre[None])[0]
    return toward(middle[:2] / middle[2]).T @ pose.rotation


def common_turn(turns: list[list[float]]) -> tuple[float, list[float]]:
    """Angle of the mean of rotation vectors, and what is left of each without it, degrees.

    >>> [round(float(angle), 6) for angle in common_turn([[0, 0, 0.1], [0, 0, 0.3]])[1]]
    [5.729578, 5.729578]
    """
    each = Rotation.from_rotvec(turns)
    return float(np.rad2deg(each.mean().magnitude())), np.rad2deg((each * each.mean().inv()).magnitude()).tolist()


def _seen(entry: PhotoPoses, name: str, size: tuple[int, int]) -> tuple[Camera, Pose]:
    return entry.camera.camera(*size), entry.objects[name].pose
