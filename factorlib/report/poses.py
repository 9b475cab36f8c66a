"""How well the meshes lie on the photos."""

from __future__ import annotations

import msgspec

from factorlib.report.artifacts import Artifacts
from factorlib.report.headlines import LOW_IOU
from factorlib.report.photos import longest_side
from factorlib.report.png import box_of, data_uri, reduced


class ObjectRow(msgspec.Struct, frozen=True):
    """What was measured of one object's pose, None for what was not, and in words what speaks against it."""

    name: str
    iou: float | None
    suspicious: bool
    agreement: float | None
    score: float | None
    runner_up: dict | None  # score, normal_difference_deg
    doubts: list[str]
    left_out: bool
    earlier: bool = False  # taken from an earlier result
    scale: list[float] | None = None  # factors of the mesh's axes, where they are not 1


class PoseRow(msgspec.Struct, frozen=True):
    """An overlay picture of a photo, its focal length, its objects, and how far it was averaged down from what size."""

    photo: str
    uri: str | None
    focal_px: float | None
    focal_source: str | None
    objects: list[ObjectRow]
    factor: int
    original_size: list[int] | None


def pose_rows(run: Artifacts) -> list[PoseRow]:
    poses, facts = run.json("align", "poses.json") or {}, run.photo_facts()
    return [_row(run, photo, poses[photo], facts.get(photo, {})) for photo in run.set.photos if photo in poses]


def _row(run: Artifacts, photo: str, entry: dict, facts: dict) -> PoseRow:
    source = entry["camera"].get("focal_source", facts.get("focal_source"))
    return PoseRow(
        photo,
        _overlay(run, photo),
        entry["camera"].get("focal_px"),
        None if source == "estimated" else source,
        [_object(name, said) for name, said in entry["objects"].items()],
        facts.get("factor", 1),
        facts.get("original_size"),
    )


def _object(name: str, said: dict) -> ObjectRow:
    iou, doubts = said.get("silhouette_iou"), said.get("doubts", [])
    suspicious = bool(doubts) or (iou is not None and iou < LOW_IOU)
    scale = said.get("scale", [1.0] * 3)
    return ObjectRow(
        name, iou, suspicious, said.get("label_agreement"), said.get("score"), said.get("runner_up"), doubts, said.get("left_out", False),
        said.get("source") == "refined", scale if scale != [1.0] * 3 else None,
    )  # fmt: skip


def _overlay(run: Artifacts, photo: str) -> str | None:
    pixels = run.overlay(photo)
    if pixels is None:
        return None
    label = run.masks(photo)["label"] > 0.5
    crop = pixels[box_of(label, 0.15)] if label.shape == pixels.shape[:2] else pixels
    return data_uri(reduced(crop.astype("f4"), longest_side(len(run.set.photos))).round().astype("u1"))
