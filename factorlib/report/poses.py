"""How well the meshes lie on the photos."""

from __future__ import annotations

import msgspec

from factorlib.report.artifacts import Artifacts
from factorlib.report.headlines import LOW_IOU
from factorlib.report.photos import longest_side
from factorlib.report.png import box_of, data_uri, reduced
from factorlib.results.photos import PhotoFacts
from factorlib.results.poses import AS_IT_IS, ObjectEntry, PhotoPoses, RunnerUp


class ObjectRow(msgspec.Struct, frozen=True):
    """What was measured of one object's pose, None for what was not, and in words what speaks against it."""

    name: str
    iou: float | None
    suspicious: bool
    agreement: float | None
    score: float | None
    runner_up: RunnerUp | None
    doubts: list[str]
    left_out: bool
    earlier: bool = False  # taken from an earlier result
    scale: tuple[float, float, float] | None = None  # factors of the mesh's axes, where they are not 1


class PoseRow(msgspec.Struct, frozen=True):
    """An overlay picture of a photo, its focal length, its objects, and how far it was averaged down from what size."""

    photo: str
    uri: str | None
    focal_px: float
    focal_source: str | None
    objects: list[ObjectRow]
    factor: int
    original_size: tuple[int, int] | None


def pose_rows(run: Artifacts) -> list[PoseRow]:
    """A row for every photo that has an entry in poses.json, in the set's order."""
    poses, facts = run.poses(), run.photo_facts()
    return [_row(run, photo, poses[photo], facts.get(photo)) for photo in run.set.photos if photo in poses]


def _row(run: Artifacts, photo: str, entry: PhotoPoses, facts: PhotoFacts | None) -> PoseRow:
    source = entry.camera.focal_source
    return PoseRow(
        photo,
        _overlay(run, photo),
        entry.camera.focal_px,
        None if source == "estimated" else source,
        [_object(name, found) for name, found in entry.objects.items()],
        facts.factor if facts else 1,
        facts.original_size if facts else None,
    )


def _object(name: str, found: ObjectEntry) -> ObjectRow:
    iou, doubts = found.silhouette_iou, found.doubts
    suspicious = bool(doubts) or (iou is not None and iou < LOW_IOU)
    return ObjectRow(
        name, iou, suspicious, found.label_agreement, found.score, found.runner_up, doubts, found.left_out,
        found.source == "refined", found.scale if found.scale != AS_IT_IS else None,
    )  # fmt: skip


def _overlay(run: Artifacts, photo: str) -> str | None:
    pixels = run.overlay(photo)
    if pixels is None:
        return None
    label = run.masks(photo)["label"] > 0.5
    crop = pixels[box_of(label, 0.15)] if label.shape == pixels.shape[:2] else pixels
    return data_uri(reduced(crop.astype("f4"), longest_side(len(run.set.photos))).round().astype("u1"))
