"""Whether shading mends poses and leaves right ones alone, and whether contours mend proportions: `make results ONLY=refine`.

Poses: sets of four photos of `studies/scenes/posed.py`, refined as `refine` does, with materials that were solved with the wrong poses.
Proportions: photos of a shape with a mesh of it, one axis of which is too long.  Poses and focal lengths are searched with the wrong
mesh, as `align` does; then factors of the axes are fitted, as `fit_mesh` does.
"""

from __future__ import annotations

import time
import zlib

import numpy as np
from tqdm import tqdm

from factorlib.align.proportions import Sighting, proportions
from factorlib.align.search import find, focal_prior
from factorlib.align.silhouette import Silhouette
from factorlib.align.target import target_of
from factorlib.geometry.raster import Caster, rasterise
from factorlib.meshes.mesh import scaled
from factorlib.model.materials import Materials
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.reflection.operator import Operator
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.solve.options import FewLobes
from factorlib.urm.extract import Taken, observations_of_photo
from factorlib.urm.merge import merge
from factorlib.urm.observations import concatenate
from studies.measured.align import FILLS, normal_error_deg, photographed
from studies.measured.tools import Tables, exacts
from studies.scenes import posed, shapes

SETS = 3
PHOTOS, OFF, ROUGH_OFF = 4, (1.0, 1.1, 1.15), (1.0, 1.12)
HEAD = [
    "shape",
    "axis times",
    "used",
    "factors off by at most (%)",
    "normal error before: median, worst (°)",
    "after (°)",
    "s",
]
POSED_HEAD = [
    "case", "photos", "changed: better, worse", "normal error before: median, worst (°)", "after (°)", "of the mesh alone (°)", "s",
]  # fmt: skip


def measured(shape: str, axis: int, off: float, rough: bool) -> list[str]:
    """A line of the table: what is fitted where the mesh's axis of that number is `off` times too long."""
    rng, factors = np.random.default_rng(zlib.crc32(f"{shape} {axis} {off} {rough}".encode())), np.ones(3)
    factors[axis] = off
    true = shapes.mesh(shape)
    given = scaled(shapes.rough(shape, 0) if rough else true, factors)
    caster, sightings, truths = Caster(given), [], []
    for _ in range(PHOTOS):
        camera, pose, label = photographed(true, rng, rng.uniform(*FILLS))
        silhouette, prior = Silhouette(label.astype(np.int16)), focal_prior(None, None, camera.width, camera.height)
        state, target = find(caster, silhouette, camera, prior).state, target_of(silhouette, given.labels, 200, 0.15)
        sightings.append(Sighting(given, target, state.camera(camera), prior, state))
        truths.append(rasterise(true, camera, pose))
    start = time.perf_counter()
    verdict = proportions(sightings)
    seconds, wanted = time.perf_counter() - start, 1 / factors / (1 / factors).prod() ** (1 / 3)
    meshes = (given, [one.state for one in sightings]), (scaled(given, verdict.factors), verdict.states)
    before, after = (
        [
            normal_error_deg(truth, rasterise(mesh, state.camera(one.camera), state.pose(mesh)))
            for truth, one, state in zip(truths, sightings, states, strict=True)
        ]
        for mesh, states in meshes
    )
    error = float(100 * np.abs(verdict.factors / wanted - 1).max())
    errors = [exacts((np.median(of), max(of))) for of in (before, after)]
    return [shape, f"{off:g}", "yes" if verdict.used else "no", f"{error:.2g}", *errors, f"{seconds:.2g}"]


def solved_materials(photos: list[posed.Photo], operator: Operator) -> Materials:
    """As the pipeline would, with the poses that are had."""
    seen = []
    for k, photo in enumerate(photos):
        maps = rasterise(photo.given, photo.camera, photo.pose)
        vectors = {"normal": maps.normal, "view": maps.view}
        geometry = {f"{name}.{a}": v[..., i] for name, v in vectors.items() for i, a in enumerate("xyz")}
        geometry |= {"label": maps.label, "depth": maps.depth, "confidence": (maps.label > 0) * ~maps.bent * 1.0}
        name = f"photo{k}"
        seen.append(merge(observations_of_photo(photo.channels, geometry, Taken(name, name), ["a", "b", "c"]), 2.0))
    blocks = blocks_of_observations(concatenate(seen), Noise())
    options = FewLobes(rounds=4, sample=800, polish=4)
    return few_lobes(JointProblem(blocks, operator), 3, options).point.materials


def shading() -> list[list[str]]:
    """One line a kind: of photos that changed, how many became better; normal errors before and after."""
    operator, lines = reflection_operator("network"), []
    for kind in posed.KINDS:
        measures = []
        for seed in tqdm(range(SETS), desc=kind):
            rng = np.random.default_rng([11, seed, posed.KINDS.index(kind)])
            photos = [posed.photographed(kind, k, rng, operator) for k in range(4)]
            materials = solved_materials(photos, operator)
            for photo in photos:
                start = time.perf_counter()
                result = posed.refined_of(photo, materials, operator)
                seconds, moved = time.perf_counter() - start, result.settled and result.settled.chosen != "found"
                poses = (result.before.pose(photo.given), result.after.pose(photo.given), photo.truth)
                measures.append((*(posed.normal_error(photo, pose) for pose in poses), seconds, bool(moved)))
        before, after, mesh, seconds, moved = (np.array(column) for column in zip(*measures, strict=True))
        better, worse = np.sum(moved & (after < before)), np.sum(moved & (after >= before))
        spans = [f"{np.median(errors):.2g}, {errors.max():.2g}" for errors in (before, after)]
        medians = [f"{np.median(numbers):.2g}" for numbers in (mesh, seconds)]
        lines.append([kind, str(len(moved)), f"{better}, {worse}", *spans, *medians])
    return [POSED_HEAD, *lines]


def rows() -> Tables:
    """Poses by shading, and proportions of exact and of rough meshes, an axis of each too long."""
    lines = {
        title: [HEAD, *(measured(shape, k % 3, off, rough) for k, shape in enumerate(shapes.SHAPES) for off in offs)]
        for title, offs, rough in (("exact", OFF, False), ("rough", ROUGH_OFF, True))
    }
    tables = {f"Proportions, {kind} meshes": of for kind, of in lines.items()}
    return {f"Poses: {SETS} sets of four photos": shading()} | tables
