"""Material errors do not see the gauge, and see everything else."""

import pytest

from factorlib.evaluate.materials import compare_materials
from factorlib.results.materials import Reflectance
from tests.evaluate.made_artifacts import TRUE, perturbed

ONE = dict.fromkeys(TRUE, 0)


def scaled(material, factor):
    times = [tuple(v * f for v, f in zip(colour, factor)) for colour in (material.diffuse, material.specular)]
    return Reflectance(*times, material.roughness)


def test_a_factor_per_channel_is_no_error():
    found = compare_materials({n: scaled(m, (2.0, 0.5, 3.0)) for n, m in TRUE.items()}, TRUE, ONE)
    assert found.factor["0"] == pytest.approx((0.5, 2.0, 1 / 3))
    assert found.worst_diffuse == pytest.approx(0, abs=1e-12) and found.worst_specular == pytest.approx(0, abs=1e-12)


def test_each_component_has_its_own_factor():
    component = {"red": 0, "white": 0, "brass": 1, "black": 1}
    estimates = {n: scaled(m, (1.0 + component[n],) * 3) for n, m in TRUE.items()}
    assert compare_materials(estimates, TRUE, component).worst_diffuse == pytest.approx(0, abs=1e-12)
    assert compare_materials(estimates, TRUE, ONE).worst_diffuse > 0.2


def test_errors_are_the_perturbation():
    found = compare_materials({n: perturbed(m, 1.0) for n, m in TRUE.items()}, TRUE, ONE)
    # diffuse ×1.04, specular ×0.95: the common factor cannot take away the ratio 1.04 / 0.95
    red = found.materials["red"].error
    assert red.roughness == pytest.approx(0.02)
    assert (1 + red.diffuse[0]) / (1 + red.specular[0]) == pytest.approx(1.04 / 0.95)
    assert found.mean_diffuse < found.null_mean_diffuse


def test_the_null_is_what_a_grey_ball_would_score():
    found = compare_materials(TRUE, TRUE, ONE).materials["black"].null
    assert found.roughness == pytest.approx(0.3)
    # red channel: true diffuse + specular .56 .65 .55 .06, grey's .55: the median ratio is .555 / .55
    assert found.diffuse[0] == pytest.approx((0.5 * 0.555 / 0.55 - 0.02) / 0.02)
    assert found.specular[0] == pytest.approx((0.05 * 0.555 / 0.55 - 0.04) / 0.04)


def test_unseen_and_untold_materials_are_left_out():
    assert set(compare_materials(TRUE, TRUE, {"red": 0}).materials) == {"red"}
    assert compare_materials(TRUE, {}, ONE) is None


def test_black_specular_has_no_infinite_error():
    truth = {"chalk": Reflectance((0.5, 0.5, 0.5), (0.0, 0.0, 0.0), 0.5)}
    estimate = {"chalk": Reflectance((0.5, 0.5, 0.5), (0.005, 0.0, 0.0), 0.5)}
    assert compare_materials(estimate, truth, {"chalk": 0}).materials["chalk"].error.specular[0] == pytest.approx(
        0.5, rel=0.3
    )
