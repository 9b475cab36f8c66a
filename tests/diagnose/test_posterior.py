"""Standard errors of a fit in natural lights: they cover the truth, and nothing is known for sure that is not."""

import msgspec
import numpy as np
import pytest

from factorlib.diagnose.coverage import LARGEST
from factorlib.diagnose.posterior import MODEL_ERROR, Posterior, in_gauge_of
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.solve.fit import Schedule, fitted
from studies.scenes.problems import MATERIALS, factor_between
from tests.solve.made import FREE, PRIOR, begun, photographed


@pytest.fixture(scope="module")
def solved():
    problem, true = photographed(5, 3)
    return problem, true, fitted(problem, begun(problem), PRIOR, Schedule(4, (14, 10)), FREE)


def with_materials(fit, **parts):
    return msgspec.structs.replace(
        fit, point=Point(msgspec.structs.replace(fit.point.materials, **parts), fit.point.lights)
    )


def test_a_nil_reflectance_is_not_known_for_sure(solved):
    problem, _, found = solved
    there = with_materials(found, diffuse=np.where([[False], [False], [True]], 0.0, found.point.materials.diffuse))
    errors, at_nil = (Posterior(problem, one, PRIOR).standard_errors().materials for one in (found, there))
    assert (at_nil.diffuse[2] > 0.3 * errors.diffuse[2]).all()
    assert (errors.vector() > 0).all()


def test_no_observation_mends_what_the_model_has_wrong(solved):
    """k_s and roughness are never known better than the model is right, as far as residuals say that it is wrong."""
    problem, _, found = solved
    errors, materials = Posterior(problem, found, PRIOR).standard_errors(), found.point.materials
    wrong = min(1.0, errors.deviation) * MODEL_ERROR
    assert (errors.materials.roughness >= wrong[6]).all() and (
        errors.materials.specular >= wrong[3:6] * materials.specular
    ).all()
    assert (errors.materials.diffuse >= wrong[:3] * materials.diffuse).all() and (MODEL_ERROR > 0).all()


def test_materials_lie_within_a_few_standard_errors(solved):
    problem, _, found = solved
    errors, m = Posterior(problem, found, PRIOR).standard_errors().materials, found.point.materials
    factor = factor_between(m, MATERIALS)
    off = np.column_stack(
        [
            m.diffuse * factor - MATERIALS.diffuse,
            m.specular * factor - MATERIALS.specular,
            m.roughness - MATERIALS.roughness,
        ]
    )
    scale = np.column_stack([errors.diffuse * factor, errors.specular * factor, errors.roughness])
    assert np.mean(np.abs(off) < scale) > 0.5 and np.mean(np.abs(off) < 3 * scale) > 0.95, np.round(off / scale, 1)


def test_lights_lie_within_their_standard_errors(solved):
    """Log radiance of cells, after the factor per channel that is free: about 68 % within one posterior standard deviation."""
    problem, true, found = solved
    posterior, within = Posterior(problem, found, PRIOR), []
    for system, light, true_light in zip(posterior.systems(with_scores=False), found.point.lights, true, strict=True):
        cells = 3 * len(light)
        deviation = np.sqrt(np.diag(np.linalg.inv(system.light_hessian))[:cells]).reshape(3, -1)
        off = light.log_radiance - true_light.log_radiance
        within.append(np.abs(off - np.median(off, axis=1, keepdims=True)) < deviation)
    assert 0.5 < np.mean(within) < 0.9
    maps = posterior.relative_standard_errors()
    assert set(maps) == {"room0", "room1", "room2"}
    assert all(((m > 0) & (m <= LARGEST)).all() and np.isfinite(m).all() for m in maps.values())


def test_fewer_observations_tell_less(solved):
    problem, _, found = solved
    errors, of_few = (Posterior(p, found, PRIOR).standard_errors().materials for p in (problem, problem.sampled(60, 0)))
    assert np.mean(of_few.vector() > errors.vector()) > 0.8
    maps, maps_of_few = (
        Posterior(p, found, PRIOR).relative_standard_errors()["room0"] for p in (problem, problem.sampled(60, 0))
    )
    assert maps_of_few.mean() > maps.mean()


def test_cells_that_have_split_have_maps_too(solved):
    problem, _, found = solved
    lights = [light.split(light.weight[:, 1] > np.quantile(light.weight[:, 1], 0.95)) for light in found.point.lights]
    split = msgspec.structs.replace(found, point=Point(found.point.materials, lights))
    one, other = (Posterior(problem, fit, PRIOR).relative_standard_errors()["room0"] for fit in (found, split))
    assert other.shape == one.shape and np.isfinite(other).all() and 0.7 < other.mean() / one.mean() < 1.5


def test_errors_go_with_the_gauge(solved):
    problem, _, found = solved
    errors, m = Posterior(problem, found, PRIOR).standard_errors(), found.point.materials
    factor = np.array([2.0, 1.0, 0.5])
    there = in_gauge_of(errors, m, Materials(m.diffuse * factor, m.specular * factor, m.roughness)).materials
    np.testing.assert_allclose(there.diffuse, errors.materials.diffuse * factor)
    np.testing.assert_allclose(there.specular, errors.materials.specular * factor)
    np.testing.assert_array_equal(there.roughness, errors.materials.roughness)
