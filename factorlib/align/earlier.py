"""What of an earlier result's poses.json the search for poses starts from."""

from __future__ import annotations

from factorlib.align.place import Earlier, EarlierFocal
from factorlib.results.poses import CameraEntry, ObjectEntry


def earlier_pose(found: ObjectEntry) -> Earlier:
    """The pose, with its runner-up where there is one."""
    other = found.runner_up
    return Earlier(found.pose, other.pose, other.score, other.normal_difference_deg) if other else Earlier(found.pose)


def earlier_focal(camera: CameraEntry, factor: int) -> EarlierFocal:
    """In pixels of the photo averaged down by `factor`, which may have been another one then."""
    return EarlierFocal(camera.focal_px * (camera.factor / factor), camera.focal_source, camera.focal_relative_stderr)
