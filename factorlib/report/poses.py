"""How well the meshes lie on the photos."""

from __future__ import annotations

import msgspec

from factorlib.report.artifacts import Artifacts
from factorlib.report.headlines import LOW_IOU
from factorlib.report.photos import longest_side
from factorlib.report.png import box_of, data_uri, reduced


class PoseRow(msgspec.Struct, frozen=True):
    """An overlay picture of a photo, its focal length, and each object's overlap (None if not said)."""

    photo: str
    uri: str | None
    focal_px: float | None
    focal_source: str | None
    objects: list[tuple[str, float | None, bool]]  # name, silhouette IoU, suspicious


def pose_rows(run: Artifacts) -> list[PoseRow]:
    poses, facts = run.json("align", "poses.json") or {}, run.photo_facts()
    return [_row(run, photo, poses[photo], facts.get(photo, {})) for photo in run.set.photos if photo in poses]


def _row(run: Artifacts, photo: str, entry: dict, facts: dict) -> PoseRow:
    objects = [(name, o.get("silhouette_iou")) for name, o in entry["objects"].items()]
    return PoseRow(
        photo,
        _overlay(run, photo),
        entry["camera"].get("focal_px"),
        facts.get("focal_source"),
        [(name, iou, iou is not None and iou < LOW_IOU) for name, iou in objects],
    )


def _overlay(run: Artifacts, photo: str) -> str | None:
    pixels = run.overlay(photo)
    if pixels is None:
        return None
    label = run.masks(photo)["label"] > 0.5
    crop = pixels[box_of(label, 0.15)] if label.shape == pixels.shape[:2] else pixels
    return data_uri(reduced(crop.astype("f4"), longest_side(len(run.set.photos))).round().astype("u1"))
