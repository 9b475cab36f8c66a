"""Never a NaN, never a silent failure: an answer within its bound, or a message that says why there is none.

Spheres in lights of a few lobes, rendered by the operator that solves, with 2 % noise.
"""

import logging

import msgspec
import numpy as np
import pytest

from factorlib.inference.identifiability import poorly_explained, undetermined_by_answer, undetermined_by_observations
from factorlib.inference.uncertainty import standard_errors
from factorlib.errors import InputError
from factorlib.jsonfile import read_json
from factorlib.inference.forward import Illumination
from factorlib.inference.materials import Materials
from factorlib.inference.noise import Noise
from factorlib.inference.observed import blocks_of_observations
from factorlib.inference.problem import JointProblem
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.inference.options import FewLobes
from factorlib.urm.observations import Observations
from studies.scenes.problems import factor_between, sphere_normals
from tests.inference.made import seen_from_the_front
from tests.inference.made_lights import OPERATOR, light_of
from tests.stages.test_solve import NAMES, run

OPTIONS = FewLobes(lobes=10, insert=5, rounds=4, iterations=10, polish=20)
THREE = np.array(
    [[0.5, 0.1, 0.1, *[0.12] * 3, 0.7], [0.2, 0.4, 0.25, *[0.2] * 3, 0.4], [0.1, 0.12, 0.2, 0.4, 0.35, 0.3, 0.25]]
)
FRONT = np.array([0.0, 0.0, -1.0])
FLAT = np.tile(np.array([[0.3, 0.1, -1.0]]) / np.sqrt(1.1), (60, 1))


def lamps(seed: int):
    """A broad lobe and two lamps."""
    rng = np.random.default_rng(seed)
    axis, sharpness = rng.normal(size=(3, 3)) + FRONT, np.array([0.5, *60 ** rng.uniform(0.5, 1, 2)])
    energy = rng.lognormal(0, 0.3, (3, 1)) * rng.lognormal(0, 0.1, (3, 3))
    return light_of(axis, sharpness, energy * sharpness[:, None] ** 0.8)


ROOMS = [lamps(0), lamps(1)]
CONSTANT = light_of([FRONT], 1e-4, 1.0)
POINT = light_of([[0.3, -0.5, -0.8]], 2000.0, 3000.0)


def observed(rows, lights=ROOMS, normals=None) -> tuple[Observations, Materials]:
    """All of the materials [m, 7] in each of the lights, with noise, and the materials."""
    normals, truth = sphere_normals(12) if normals is None else normals, Materials.of_rows(np.array(rows))
    n, m = len(normals), len(truth)
    material, photo = np.tile(np.repeat(np.arange(m), n), len(lights)), np.repeat(np.arange(len(lights)), m * n)
    rooms = tuple(f"room{k}" for k in range(len(lights)))
    where = {"photo": photo, "illumination": photo, "photos": rooms, "illuminations": rooms}
    normal = np.tile(normals, (m * len(lights), 1))
    seen = seen_from_the_front(normal, np.ones(normal.shape), material, NAMES[:m], **where)
    for k, (block, light) in enumerate(zip(blocks_of_observations(seen, Noise()), lights, strict=True)):
        seen.radiance[photo == k] = Illumination(block, light, truth, OPERATOR).radiance()
    noise = 1 + 0.02 * np.random.default_rng(0).normal(size=seen.radiance.shape)
    return msgspec.structs.replace(seen, radiance=seen.radiance * noise), truth


def half_clipped(seen: Observations) -> Observations:
    limit = np.median(seen.radiance)
    return msgspec.structs.replace(seen, radiance=np.minimum(seen.radiance, limit), clipped=seen.radiance >= limit)


def with_invalid(seen: Observations) -> Observations:
    """Some values that are not finite, and some views without direction."""
    radiance, normal, view = seen.radiance.copy(), seen.normal.copy(), seen.view.copy()
    radiance[::11, 0], radiance[1::11, 1], radiance[2::11, 2] = np.nan, np.inf, -np.inf
    normal[3::11, 0], view[4::11] = np.nan, 0
    return msgspec.structs.replace(seen, radiance=radiance, normal=normal, view=view)


ONE, TWO, BLACK = THREE[[1]], THREE[[1, 2]], THREE * [[*[0] * 6, 1], [1] * 7, [1] * 7]
LAMBERTIAN = TWO * [1, 1, 1, 0, 0, 0, 1]
RED, GREEN = (f"roughness of material '{name}' cannot be determined" for name in NAMES[:2])
CASES = {  # what is observed; bounds of the errors of reflectance and roughness, None where it cannot be determined; what is said
    "1 material × 1 light": (lambda: observed(ONE, ROOMS[:1]), 0.025, 0.02, ("by convention only, and a smooth material",)),
    "flat objects": (lambda: observed(TWO, normals=FLAT), None, None, ("'red' is flat", "'green' is flat", RED)),
    "all Lambertian": (lambda: observed(LAMBERTIAN), 0.0049, None, (RED, GREEN)),
    "a black material": (lambda: observed(BLACK), 0.0055, None, ("'red' is so dark", RED)),
    "a light of one point": (lambda: observed(TWO, [POINT]), 0.017, 0.0039, ()),
    "constant light": (lambda: observed(TWO, [CONSTANT] * 2), None, None, (RED,)),
    "half the values clipped": (lambda: changed(TWO, half_clipped), 0.042, 0.19, ("of the values of material 'red' are clipped",)),
    "NaN, infinite, no direction": (lambda: changed(TWO, with_invalid), 0.012, 0.015, ()),
}  # fmt: skip


def changed(rows, change) -> tuple[Observations, Materials]:
    seen, truth = observed(rows)
    return change(seen), truth


@pytest.mark.parametrize("name", CASES)
def test_the_answer_is_within_its_bound_or_says_why_not(name):
    made, reflectance, roughness, says = CASES[name]
    seen, truth = made()
    blocks = blocks_of_observations(seen, Noise())
    solution = few_lobes(problem := JointProblem(blocks, OPERATOR), len(truth), OPTIONS)
    point, found = solution.point, solution.point.materials
    errors = standard_errors(problem.with_loss(solution.loss), point)
    said = undetermined_by_observations(seen.materials, problem) + list(poorly_explained(problem, point))
    said += undetermined_by_answer(seen.materials, problem, found, errors.materials)
    for part in (found.vector(), *(getattr(light, of) for light in point.lights for of in light.__struct_fields__)):
        assert np.isfinite(part).all()
    (f, t), factor = (np.stack([of.diffuse, of.specular]) for of in (found, truth)), factor_between(found, truth)
    assert reflectance is None or np.abs(f * factor - t).mean() <= reflectance * t.sum(0).mean()
    assert roughness is None or np.abs(found.roughness - truth.roughness).max() <= roughness
    assert all(any(words in sentence for sentence in said) for words in says) and bool(says) == bool(said), said


def materials_of_stage(folder, seen: Observations, **params):
    """What the stage says of the materials, from one table per photo."""
    photos = {}
    for k, name in enumerate(seen.photos):
        own, zero = seen.take(seen.photo == k), np.zeros((seen.photo == k).sum(), int)
        photos[name] = msgspec.structs.replace(
            own, photos=(name,), illuminations=(name,), photo=zero, illumination=zero
        )
    folder.mkdir()
    brief = {"operator": "closed_form", "lobes": 4, "insert": 4, "rounds": 1, "iterations": 4, "polish": 3}
    return read_json(run(folder, photos, solver="few_lobes", **brief, **params) / "materials.json")["materials"]


def test_observations_that_are_not_finite_are_counted_and_spoil_no_neighbour(tmp_path, caplog):
    seen, _ = CASES["NaN, infinite, no direction"][0]()
    with caplog.at_level(logging.WARNING):
        found = materials_of_stage(tmp_path / "harmed", seen, merge_degrees=20.0)
    assert "observations are left out" in caplog.text
    kept = np.isfinite(seen.radiance).all(1) & np.isfinite(seen.normal).all(1) & (seen.view != 0).any(1)
    assert found == materials_of_stage(tmp_path / "whole", seen.take(kept), merge_degrees=20.0)


def test_black_photos_are_named_or_refused_and_what_cannot_be_told_is_in_the_log(tmp_path, caplog):
    seen, _ = observed(TWO)
    dark = msgspec.structs.replace(seen, radiance=np.where(seen.photo[:, None] == 0, 0.0, seen.radiance))
    flat, _ = observed(ONE, ROOMS[:1], FLAT)
    with caplog.at_level(logging.WARNING):
        materials_of_stage(tmp_path / "one", dark)
        materials_of_stage(tmp_path / "flat", flat, held_out=0.0)
    for words in ("'room0' is black", "is flat", "by convention only", RED):
        assert words in caplog.text
    with pytest.raises(InputError, match="black"):
        materials_of_stage(tmp_path / "all", msgspec.structs.replace(seen, radiance=np.zeros_like(seen.radiance)))
