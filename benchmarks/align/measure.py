"""One photo aligned as the stage aligns it, and how right the answer is."""

from __future__ import annotations

import resource

import msgspec
import numpy as np

from benchmarks.align.cases import Case, case
from benchmarks.solve.clock import Clock
from factorlib.align.place import KnownFocal, ObjectToPlace, placed
from factorlib.align.search import Found, RunnerUp, Search
from factorlib.align.silhouette import label_agreement, silhouette_iou, silhouette_of_object
from factorlib.align.trust import Trust, doubts, trust_in
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster, Maps, rasterise

RIGHT_DEG = {"exact": 2.0, "rough": 6.0}  # a pose is right when its median normal error is no more


def measured_key(key: tuple[str, str, int, int]) -> dict:
    """`measured` of a key, on a worker."""
    return measured(case(*key))


def measured(given: Case, search: Search = Search()) -> dict:
    """Seconds of the search (wall, processor), the scores that poses.json gives, doubts, and the error against the truth.

    memory_mb is the most that the process held so far.
    """
    caster = Caster(given.given_mesh())
    truth, blind = given.truth(), Camera(given.camera.width, given.camera.height, 1.0, given.camera.centre)
    clock = Clock()
    silhouette = silhouette_of_object({"label": given.label.astype(float)}, 1, caster.mesh.labels, own_mask=False)
    obj = ObjectToPlace("object", caster, silhouette)
    result = placed([obj], blind, KnownFocal(), given.name, search)
    seen, trust = rasterise(caster, result.camera, result.poses[0]), trust_in(obj, result, 0)
    taken, found = clock.taken(), result.found[0]
    iou, agreement = silhouette_iou(silhouette, seen.label), label_agreement(silhouette, seen.label)
    other = found.runner_up
    row = {
        "name": given.name, "kind": given.kind, "shape": given.shape, "wall_s": taken.wall, "processor_s": taken.processor,
        "memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024), "pixels": int(silhouette.inside.sum()),
        "silhouette_iou": iou, "label_agreement": agreement, "score": found.score,
        "runner_up_score": other.score if other else None, "runner_up_normals_deg": other.normal_difference_deg if other else None,
        **msgspec.to_builtins(trust),
    }  # fmt: skip
    if given.kind in RIGHT_DEG:
        row["normal_error_deg"] = normal_error_deg(truth, seen)
        row["of_the_mesh_deg"] = normal_error_deg(truth, rasterise(caster, given.camera, given.pose))
        row["focal_ratio"] = result.camera.focal / given.camera.focal
        row["right"] = row["normal_error_deg"] <= RIGHT_DEG[given.kind]
    return judged(row)


def judged(row: dict) -> dict:
    """The row with its doubts, by the standards of now: a row of an earlier run need not be measured again."""
    runner_up = (
        None if row["runner_up_score"] is None else RunnerUp(None, row["runner_up_score"], row["runner_up_normals_deg"])
    )
    trust = msgspec.convert({name: row[name] for name in Trust.__struct_fields__}, Trust)
    return row | {
        "doubts": doubts(
            row["silhouette_iou"], row["label_agreement"], trust, Found(None, row["score"], 0.0, runner_up)
        )
    }


def normal_error_deg(truth: Maps, found: Maps) -> float:
    """Median angle between normals over the true mask; a pixel without the found mesh counts as 180°."""
    cosine = np.clip(np.sum(truth.normal * found.normal, axis=-1), -1, 1)
    return float(np.median(np.where(found.label > 0, np.rad2deg(np.arccos(cosine)), 180.0)[truth.label > 0]))
