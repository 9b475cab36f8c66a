"""Values and gradients hold where formulas break: finite, within stated bounds, and NaN never comes out as a number."""

import math
from functools import lru_cache
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from factorlib.reflection import reflection_operator
from factorlib.scenes.operator_variant import operator_variant
from tests.reflection.operator_cases import (
    ALL,
    CASES,
    answers,
    case,
    draw_grazing_inputs,
    draw_inputs,
    gradient_error,
    reference_values,
    scene,
    specular_values,
    value_error,
)

FAST = {
    "closed_form": reflection_operator("closed_form"), "network": reflection_operator("network"),
    "network in torch": operator_variant("network", "float32", compiled=False),
    "closed_form float64": reflection_operator("closed_form", dtype="float64"),
    "network float64": reflection_operator("network", dtype="float64"),
}  # fmt: skip
fast = pytest.mark.parametrize("name", FAST)
single = pytest.mark.parametrize("name", ["closed_form", "network", "network in torch"])
cases = pytest.mark.parametrize("changed", [*CASES, ALL])

# float32 against float64: |R − S| / (S + E/100), and of gradients
ROUNDING = {
    "view at n·o = 10⁻⁴": (3e-3, 0.03),
    "lobe along the mirror direction": (2e-4, 5e-3),
    "lobe along −o": (1e-3, 0.1),  # the half vector is 0 / 0 there
    ALL: (0.03, 2.0),
}
# |R − S| / (S + E/100) of the network against the reference, where it is far off its median of .1 %
VALUE = {"view at n·o = 10⁻⁴": 0.5, "roughness .03": 0.2}
BRIGHTEST = 1.0  # S of a unit lobe is at most that, exactly: the operators hold it there


@lru_cache(maxsize=256)
def answer_of(name: str, changed: str):
    return answers(FAST[name], case(changed))


@fast
@cases
def test_everything_is_finite_and_not_negative(name, changed):
    answer = answer_of(name, changed)
    assert answer.finite()
    assert all((answer.fields[part] >= 0).all() for part in ("diffuse", "specular"))


@single
@cases
def test_single_precision_is_enough(name, changed):
    given = case(changed)
    answer, exactly = answer_of(name, changed), answer_of(f"{name.split()[0]} float64", changed)
    value, gradient = ROUNDING.get(changed, (1e-4, 1e-3))
    assert value_error(answer, exactly, given).max() < value
    assert gradient_error(answer, exactly, given).max() < gradient


@pytest.mark.parametrize("changed", CASES)
def test_the_network_is_near_the_reference(changed):
    given, some = case(changed), slice(0, None, 23)
    answer, true = answer_of("network", changed), reference_values(given, some)
    for part in true:
        error = (answer.fields[part][some] - true[part]).abs() / (true[part] + given.scale()[some])
        assert error.max() < VALUE.get(changed, 0.08), part


# gradients of the call ------------------------------------------------------------------------------------------------

PLACES = ("n", "−n", "mirror", "o", "−o", "anywhere")
vector = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 1e-3)


def leaves_of(light, material, normals, views, dtype) -> dict[str, torch.Tensor]:
    named = vars(light) | vars(material) | {"normals": normals, "views": views}
    return {key: t.detach().to(dtype).clone().requires_grad_() for key, t in named.items()}


def called(operator, leaves):
    return operator(SimpleNamespace(**leaves), SimpleNamespace(**leaves), leaves["normals"], leaves["views"])


def gradients(operator, leaves) -> dict[str, torch.Tensor]:
    radiance = called(operator, leaves)
    slopes = torch.autograd.grad(radiance.sum(), list(leaves.values()))
    return {"radiance": radiance.detach(), **dict(zip(leaves, slopes, strict=True))}


@fast
@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    normal=vector, view=vector, axis=vector, place=st.sampled_from(PLACES), roughness=st.floats(0.03, 1),
    weight=st.sampled_from([0.0, 1.0, 1e6]),
    log_sharpness=st.floats(math.log(1e-4), math.log(1e6)), cosine=st.sampled_from([None, 1e-4, 1.0]),
)  # fmt: skip
def test_all_gradients_are_finite(name, normal, view, axis, place, roughness, weight, log_sharpness, cosine):
    operator = FAST[name]
    n, o, z = (torch.nn.functional.normalize(torch.tensor(v, dtype=torch.float64), dim=0) for v in (normal, view, axis))
    if cosine is not None:
        across = torch.nn.functional.normalize(torch.linalg.cross(n, o) + 1e-12, dim=0)
        o = cosine * n + math.sqrt(1 - cosine**2) * across
    z = {"n": n, "−n": -n, "mirror": 2 * (n @ o) * n - o, "o": o, "−o": -o, "anywhere": z}[place]
    sharpness, half = torch.tensor([math.exp(log_sharpness)]), torch.full((3,), 0.5)
    light = SimpleNamespace(axis=z[None], sharpness=sharpness, weight=torch.full((1, 3), weight))
    material = SimpleNamespace(diffuse=half, specular=half, roughness=torch.tensor(roughness))
    slopes = gradients(operator, leaves_of(light, material, n[None], o[None], operator.dtype))
    assert all(t.isfinite().all() for t in slopes.values()), {k: t for k, t in slopes.items() if not t.isfinite().all()}
    assert (slopes["radiance"] >= 0).all()
    assert slopes["radiance"].max() <= 0.5 * weight * (1.01 + BRIGHTEST)


@fast
@pytest.mark.parametrize("sharpness", [(-4, 0), (0, 3), (3, 6)], ids=["wide", "ordinary", "sharp"])
def test_gradients_obey_the_laws_of_the_radiance(name, sharpness):
    """Linear in weight, and in k: Euler's Σ w ∂R/∂w = R.  Nothing changes when all turns: Σ x × ∂R/∂x = 0."""
    operator = FAST[name]
    leaves = leaves_of(*scene(3, sharpness=sharpness), operator.dtype)
    slopes = gradients(operator, leaves)
    total, most = slopes["radiance"].sum(), {torch.float32: 1e-5, torch.float64: 1e-10}[operator.dtype]
    for keys in (("weight",), ("diffuse", "specular")):
        euler = sum((leaves[k].detach() * slopes[k]).sum() for k in keys)
        assert abs(float(euler / total) - 1) < most
    torque = [torch.linalg.cross(leaves[k].detach(), slopes[k]) for k in ("axis", "normals", "views")]
    size = sum(t.norm(dim=1).sum() for t in torque) + total
    assert float(sum(t.sum(0) for t in torque).norm() / size) < 30 * most


# what is not a number -------------------------------------------------------------------------------------------------

INPUTS = ("roughness", "sharpness", "no", "nz", "oz")
TOUCHED = {"roughness": ("specular",), "sharpness": ("diffuse", "specular"), "no": ("specular",),
"nz": ("diffuse", "specular"), "oz": ("specular",)}  # fmt: skip


@fast
@pytest.mark.parametrize("bad", INPUTS)
def test_nan_reaches_every_value_that_depends_on_it_and_no_other(name, bad):
    operator = FAST[name]
    values = torch.tensor(0.4), torch.tensor([3.0, 30.0]), torch.tensor([0.5, 0.6]), *[torch.rand(2, 2)] * 2
    point = {key: t.to(operator.dtype).clone() for key, t in zip(INPUTS, values, strict=True)}
    point[bad].view(-1)[0] = math.nan
    expected, all_ = torch.zeros(2, 2, dtype=torch.bool), slice(None)
    expected[{"roughness": (all_, all_), "sharpness": (all_, 0), "no": (0, all_)}.get(bad, (0, 0))] = True
    response = operator.response(**point)
    with torch.no_grad():
        values = {"diffuse": operator.diffuse(point["sharpness"], point["nz"]), "specular": operator.specular(**point)}
    for part in ("diffuse", "specular"):
        touched = expected if part in TOUCHED[bad] else torch.zeros_like(expected)
        assert torch.equal(getattr(response, part).isnan(), touched), part
        assert torch.equal(values[part].isnan(), touched), part


# laws -----------------------------------------------------------------------------------------------------------------


@single
@pytest.mark.parametrize("least_roughness, least_no", [(0.1, 0.02), (0.1, 1e-4), (0.03, 1e-4)])
@pytest.mark.parametrize("draw", [draw_inputs, draw_grazing_inputs])
def test_a_unit_lobe_is_reflected_no_brighter_than_it_is(name, least_roughness, least_no, draw):
    values = specular_values(FAST[name], *draw(least_roughness, least_no, 1024))
    assert values.min() >= 0 and values.max() <= BRIGHTEST


@fast
def test_constant_light_comes_back_from_white(name):
    operator = FAST[name]
    cosines, wide = torch.linspace(-1, 1, 512, dtype=operator.dtype), torch.tensor([1e-4], dtype=operator.dtype)
    with torch.no_grad():
        assert (operator.diffuse(wide, cosines[:, None]) - 1).abs().max() < 1e-3
    alpha, lam, *cosines = draw_inputs(0.1, 0.02, 512)
    assert specular_values(operator, alpha, torch.full_like(lam, 1e-4), *cosines).max() < 1.01
