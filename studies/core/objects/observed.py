"""What a case of objects sees: radiance of the true normals, beside the normals of where the objects are thought to be.

Pixels     those that both the true object and the one of the perturbed pose and mesh show, as the stage `urm` takes them
Noise      each radiance times 1 + .01 · normal, drawn for each pixel by itself: a perturbation leaves what a pixel shows as it is
Normals    of the mesh that is given, at the pose that is given: perturbed, or fitted to the outline from there
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.align.confidence import confidence
from factorlib.align.refine import FocalPrior, refined
from factorlib.align.silhouette import Silhouette
from factorlib.align.state import state_of
from factorlib.align.target import target_of
from factorlib.conventions import FRONT, YUP_FROM_CAMERA
from factorlib.evaluate.ball import Light
from factorlib.geometry.camera import Pose, rotation_of_vector
from factorlib.geometry.raster import Caster, Maps, rasterise
from factorlib.meshes.mesh import scaled
from factorlib.results.materials import Reflectance
from factorlib.urm.observations import Observations, concatenate
from studies.core.case import light_name
from studies.core.objects.case import ObjectsCase, Perturbation
from studies.core.objects.world import CAMERA, body, body_of, pose_of
from studies.core.observed import NOISE
from studies.core.world import GRAZING, spheres

STEPS = 12  # of the fit to the outline
WINDOW, MARGIN = 200, 0.1  # as the stage `refine` takes them


class Seen(msgspec.Struct, frozen=True):
    """An entry's observations, and the median angle between the normals given and the true ones, degrees."""

    observations: Observations
    normal_error_deg: float


class Given(msgspec.Struct, frozen=True):
    """The mesh and the pose that stand for an object."""

    mesh: Caster
    pose: Pose


def observations_of(
    case: ObjectsCase, materials: Mapping[str, Reflectance], lights: Mapping[int, Light]
) -> dict[str, list[Seen]]:
    """The entries of each photo, one photo a light, by name."""
    return {
        light_name(li): [_entry(case, m, li, materials, lights[li]) for m, at in case.entries if at == li]
        for li in case.lights
    }


def together(entries: list[Seen]) -> Observations:
    """A photo's observations.  Pixels of different entries are numbered on."""
    parts = [each.observations for each in entries]
    y = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return msgspec.structs.replace(concatenate(parts), y=y)


def _entry(case: ObjectsCase, m: int, li: int, materials: Mapping[str, Reflectance], light: Light) -> Seen:
    rng = np.random.default_rng([14, case.seed, m, li])
    whole = body(body_of(m, li))
    truth = pose_of(whole, rng)
    shown, given = rasterise(whole, CAMERA, truth), given_of(body_of(m, li), truth, case.perturbation, rng)
    outline = Silhouette(shown.label.astype(np.int16))
    if case.refined:
        given = Given(given.mesh, fitted(given, outline))
    had = rasterise(given.mesh, CAMERA, given.pose)
    sure = confidence(had, outline) if case.confidence else np.ones(had.label.shape)
    kept = np.flatnonzero(((shown.label > 0) & (had.label > 0) & (sure > 0) & _facing(had)).reshape(-1))
    kept = np.sort(rng.permutation(kept)[: case.pixels])
    true, believed = (maps.normal.reshape(-1, 3)[kept] for maps in (shown, had))
    radiance = spheres([list(materials.values())[m]], light, true @ YUP_FROM_CAMERA.T)[0]
    noise = np.random.default_rng([13, case.seed, li, m, 0]).standard_normal((had.label.size, 3))[kept]
    seen = _observations(case, m, li, believed, radiance * (1 + NOISE * noise), sure.reshape(-1)[kept])
    return Seen(msgspec.structs.replace(seen, x=kept), angle_deg(true, believed))


def _facing(maps: Maps) -> np.ndarray:
    return maps.normal @ FRONT > GRAZING


def given_of(name: str, truth: Pose, perturbation: Perturbation, rng: np.random.Generator) -> Given:
    """What stands for the body `name` at pose `truth` after `perturbation`."""
    whole, mesh = body(name), body(name, perturbation.triangles)
    if perturbation.larger:
        mesh = Caster(scaled(mesh.mesh, (1 + perturbation.larger,) * 3))
    axis, side = (v / np.linalg.norm(v) for v in (rng.normal(size=3), np.append(rng.normal(size=2), 0.0)))
    rotation = rotation_of_vector(np.radians(perturbation.turned_deg) * axis) @ truth.rotation
    middle = truth.rotation @ whole.centre + truth.translation + perturbation.shifted * 2 * whole.radius * side
    return Given(mesh, Pose(rotation, middle - rotation @ (whole.centre * (1 + perturbation.larger))))


def fitted(given: Given, outline: Silhouette) -> Pose:
    """The pose nearby whose contours lie on those of the mask: how the stages `align` and `refine` end a search."""
    target = target_of(outline, given.mesh.mesh.labels, WINDOW, MARGIN)
    start = state_of(given.pose, CAMERA, given.mesh)
    return refined(given.mesh, target, CAMERA, start, FocalPrior(CAMERA.focal, 0.0), STEPS).state.pose(given.mesh)


def angle_deg(first: Float[np.ndarray, "n 3"], second: Float[np.ndarray, "n 3"]) -> float:
    """The median angle between unit vectors, degrees; 180 of none."""
    cosine = np.clip(np.sum(first * second, axis=1), -1, 1)
    return float(np.degrees(np.median(np.arccos(cosine)))) if len(cosine) else 180.0


def _observations(
    case: ObjectsCase, m: int, li: int, normal: np.ndarray, radiance: np.ndarray, sure: np.ndarray
) -> Observations:
    n, zero, photo = len(normal), np.zeros(len(normal), int), (light_name(li),)
    return Observations(
        normal=normal, view=np.tile(FRONT, (n, 1)), radiance=radiance, clipped=np.zeros((n, 3), bool),
        material=np.full(n, case.materials.index(m)), photo=zero, illumination=zero, x=zero, y=zero, weight=sure,
        materials=tuple(case.material_names), photos=photo, illuminations=photo, confidence=sure,
    )  # fmt: skip
