"""Poses against rendered truth: success, doubts, time: `make results ONLY=align` (about ten minutes of two cores).

The bodies of `factorlib/scenes/bodies.py` are photographed at known poses.  Rotations are uniform over SO(3),
focal lengths log-uniform (`FOCALS`), sizes and places uniform where the frame cuts nothing; a pose is searched without
any of these.

    exact           the mesh that was photographed
    rough           500 triangles, warped by 3 %
    wrong mesh      the mesh of another shape
    wrong mask      a random blot where the object was
    tiny mask       the object so far away that some 20 pixels show it
"""

import resource
import time
import zlib
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np
from jaxtyping import Int
from scipy.spatial.transform import Rotation

from factorlib.align.photo_alignment import KnownFocal, ObjectToAlign, align_photo
from factorlib.align.reliability import find_doubts, measure_reliability
from factorlib.align.silhouette import label_agreement, silhouette_iou, silhouette_of_object
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, Maps, rasterise
from factorlib.meshes.mesh import Mesh
from factorlib.scenes import bodies
from factorlib.scenes.bodies import SHAPES
from studies.measured.tools import Tables, format_numbers

WIDTH = 640
HEIGHT = 480
FOCALS = (0.8, 2.5)  # of the width
FILLS = (0.5, 0.9)
TINY_FILL = 0.015  # bounding sphere's diameter in the image, of the height
RIGHT_DEG = {"exact": 2.0, "rough": 6.0}  # a pose is right when its median normal error is no more
WRONG = ("wrong mesh", "wrong mask", "tiny mask")
SEEDS = 3
JOBS = 2
VIEWS = {"exact": 20, "rough": 4} | dict.fromkeys(WRONG, 1)  # photos of each shape and seed
Key = tuple[str, str, int, int]  # kind, shape, seed, number


class PosedPhoto(NamedTuple):
    """Photo at a known pose: camera, pose, mask with labels [h, w] (0 is background), mesh, and the true maps."""

    camera: Camera
    pose: Pose
    label: Int[np.ndarray, "h w"]
    mesh: Mesh
    truth: Maps


def posed_photo(kind: str, shape: str, seed: int, number: int) -> PosedPhoto:
    """Return a photo of a kind; equal arguments give the same photo."""
    rng = np.random.default_rng(zlib.crc32(f"{kind} {shape} {seed} {number}".encode()))
    fill = TINY_FILL if kind == "tiny mask" else rng.uniform(*FILLS)
    camera, pose, label = random_photograph(bodies.photographed_mesh(shape), rng, fill)
    truth = rasterise(bodies.photographed_mesh(shape), camera, pose)
    mesh = bodies.rough_mesh(shape, seed) if kind == "rough" else bodies.photographed_mesh(shape)
    if kind == "wrong mask":
        label = _blot(label, mesh.labels, rng)
    if kind == "wrong mesh":
        mesh = bodies.photographed_mesh(str(rng.choice([other for other in SHAPES if other != shape])))
        label = np.minimum(label, max(mesh.labels))
    return PosedPhoto(camera, pose, np.ascontiguousarray(label), mesh, truth)


def random_photograph(mesh: Mesh, rng: np.random.Generator, fill: float) -> tuple[Camera, Pose, Int[np.ndarray, "h w"]]:
    """Return a camera, a pose that the frame does not cut, and the labels of the visible object."""
    focal = WIDTH * float(np.exp(rng.uniform(*np.log(FOCALS))))
    camera = Camera(WIDTH, HEIGHT, focal, (WIDTH / 2, HEIGHT / 2))
    rotation = Rotation.random(rng=rng).as_matrix()
    depth = 2 * focal * mesh.radius / (fill * HEIGHT)
    while True:
        place = rng.uniform(-0.5, 0.5, 2) * (WIDTH, HEIGHT) / focal
        pose = Pose(rotation, depth * np.array([*place, 1.0]) - rotation @ mesh.centre)
        label = rasterise(mesh, camera, pose).label
        if label.any() and not any(rim.any() for rim in (label[:2], label[-2:], label[:, :2], label[:, -2:])):
            return camera, pose, label


def _blot(label: np.ndarray, labels: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Return a star-shaped region of about the mask's area and middle, with a straight border between its materials."""
    rows, columns = np.nonzero(label)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    y = y - rows.mean()
    x = x - columns.mean()
    angle = np.arctan2(y, x)
    order = np.arange(1, 6)[:, None, None]
    height = rng.normal(0, 0.35, (5, 1, 1))
    phase = rng.uniform(0, 6.3, (5, 1, 1))
    wave = np.sum(height / order**0.5 * np.sin(order * angle + phase), axis=0)
    inside = np.hypot(x, y) < np.sqrt(len(rows) / np.pi) * np.exp(wave)
    turn = rng.uniform(0, 2 * np.pi)
    return np.where(inside, np.where(np.cos(turn) * x + np.sin(turn) * y > 0, labels[-1], labels[0]), 0)


def measure(key: Key) -> dict:
    """Measure time and memory of a search, its doubts and, where a pose can be right, errors of normals.

    Time is in seconds, memory the most that the process held so far.
    """
    kind = key[0]
    photo = posed_photo(*key)
    caster = Caster(photo.mesh)
    start_s = (time.process_time(), time.perf_counter())
    silhouette = silhouette_of_object({"label": photo.label.astype(float)}, 1, caster.mesh.labels, has_mask=False)
    obj = ObjectToAlign("object", caster, silhouette)
    result = align_photo([obj], Camera(WIDTH, HEIGHT, 1.0, photo.camera.centre), KnownFocal(), " ".join(map(str, key)))
    maps = rasterise(caster, result.camera, result.poses[0])
    fit = silhouette_iou(silhouette, maps.label), label_agreement(silhouette, maps.label)
    row = {
        "kind": kind,
        "shape": key[1],
        "doubts": find_doubts(*fit, measure_reliability(obj, result, 0), result.estimates[0]),
        "processor_s": time.process_time() - start_s[0],
        "wall_s": time.perf_counter() - start_s[1],
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    if kind in RIGHT_DEG:
        row["normal_error_deg"] = normal_error_deg(photo.truth, maps)
        row["mesh_error_deg"] = normal_error_deg(photo.truth, rasterise(caster, photo.camera, photo.pose))
        row["right"] = row["normal_error_deg"] <= RIGHT_DEG[kind]
    return row


def normal_error_deg(truth: Maps, estimate: Maps) -> float:
    """Return the median angle between normals over the true mask; a pixel without the estimated mesh counts as 180°."""
    cosine = np.clip(np.sum(truth.normal * estimate.normal, axis=-1), -1, 1)
    return float(np.median(np.where(estimate.label > 0, np.rad2deg(np.arccos(cosine)), 180.0)[truth.label > 0]))


def share(flags: list) -> str:
    """Format the number of flags that are set, and their total.

    >>> share([True, False]), share([])
    ('1 of 2', '–')
    """
    return f"{sum(map(bool, flags))} of {len(flags)}" if flags else "–"


def rows() -> Tables:
    """Return tables of success by kind and shape, doubts about provoked failures, time and memory by kind."""
    keys = [(k, shape, s, n) for k in VIEWS for s in range(SEEDS) for shape in SHAPES for n in range(VIEWS[k])]
    with ProcessPoolExecutor(JOBS, mp_context=get_context("spawn")) as pool:
        return tables_of(list(pool.map(measure, keys)))


def doubtful(rows: list[dict]) -> str:
    """Count the rows that have doubts."""
    return share([row["doubts"] for row in rows])


def quantiles(rows: list[dict], measure: str, *levels: float) -> str:
    """Format quantiles of a measure."""
    return format_numbers(np.quantile([row[measure] for row in rows], levels))


def tables_of(measures: list[dict]) -> Tables:
    """Return the tables of all photos that were measured."""

    def select(**values: object) -> list[dict]:
        """Return the rows with these values."""
        return [row for row in measures if all(row[key] == value for key, value in values.items())]

    def success(name: str, rows: list[dict]) -> list[str]:
        """Return the line of a kind and shape: shares of right poses, errors, and doubts."""
        errors = quantiles(rows, "normal_error_deg", 0.5, 0.9, 1), quantiles(rows, "mesh_error_deg", 0.5)
        flagged = (doubtful([row for row in rows if row["right"] is right]) for right in (True, False))
        return [name, share([row["right"] for row in rows]), *errors, *flagged]

    by_shape = [
        success(f"{kind}, {shape or 'all'}", rows)
        for kind in RIGHT_DEG
        for shape in (*SHAPES, None)
        if (rows := select(kind=kind, shape=shape) if shape else select(kind=kind))
    ]
    provoked = {kind: select(kind=kind) for kind in WRONG}
    provoked["all"] = [row for rows in provoked.values() for row in rows]
    flags = [
        [kind, doubtful(rows), *(doubtful([row for row in rows if row["shape"] == shape]) for shape in SHAPES)]
        for kind, rows in provoked.items()
    ]
    times = [
        [
            kind,
            *(quantiles(rows, measure, 0.5, 1) for measure in ("processor_s", "wall_s")),
            f"{max(row['memory_mb'] for row in rows):.0f}",
        ]
        for kind in VIEWS
        if (rows := select(kind=kind))
    ]
    errors = "right (≤ 2°, rough ≤ 6°)|normal error: median, 90 %, worst (°)|of the mesh alone (°)"
    return {
        "Success": [["case", *errors.split("|"), "right but flagged", "wrong and flagged"], *by_shape],
        "Provoked failures": [["provoked", "flagged", *SHAPES], *flags],
        "From mask to pose with its reliability, 640×480": [
            ["case", "processor: median, worst (s)", "wall: median, worst (s)", "memory (MB)"],
            *times,
        ],
    }
