"""Laws that every operator obeys, and errors of the fast ones against the reference."""

import math
from types import SimpleNamespace

import pytest
import torch

from factorlib.errors import InputError
from factorlib.jsonfile import read_json
from factorlib.reflection import reflection_operator
from factorlib.reflection.accuracy import quantiles
from factorlib.reflection.lobe import lobe_integral, lobe_moments
from factorlib.reflection.network import FEATURES, SHIPPED, Layers, read_layers, write_layers
from factorlib.reflection.reference import diffuse_quadrature
from factorlib.reflection.samples import diffuse_samples, specular_samples

FAST = {
    (name, dtype): reflection_operator(name, dtype=dtype)
    for name in ("closed_form", "network")
    for dtype in ("float32", "float64")
}
EVERY = FAST | {("reference", "float64"): reflection_operator("reference")}
fast = pytest.mark.parametrize("operator", FAST.values(), ids=map("-".join, FAST))
every = pytest.mark.parametrize("operator", EVERY.values(), ids=map("-".join, EVERY))


def unit(generator, *shape):
    v = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    return v / v.norm(dim=-1, keepdim=True)


def scene(seed=0, points=40, lobes=5):
    g = torch.Generator().manual_seed(seed)
    light = SimpleNamespace(
        axis=unit(g, lobes),
        sharpness=torch.logspace(0, 2.5, lobes, dtype=torch.float64),
        weight=torch.rand(lobes, 3, generator=g).double(),
    )
    material = SimpleNamespace(
        diffuse=torch.tensor([0.3, 0.2, 0.1]).double(),
        specular=torch.tensor([0.2, 0.3, 0.4]).double(),
        roughness=torch.tensor(0.5).double(),
    )
    normals = unit(g, points)
    views = normals + 0.8 * unit(g, points)
    return light, material, normals, views / views.norm(dim=-1, keepdim=True)


def changed(namespace, **changes):
    return SimpleNamespace(**(vars(namespace) | changes))


@every
def test_radiance_is_not_negative_and_linear_in_light_and_reflectance(operator):
    light, material, normals, views = scene()
    radiance = operator(light, material, normals, views)
    assert (radiance >= 0).all() and radiance.shape == (40, 3)
    torch.testing.assert_close(
        operator(changed(light, weight=3 * light.weight), material, normals, views), 3 * radiance
    )
    torch.testing.assert_close(
        operator(
            light, changed(material, diffuse=2 * material.diffuse, specular=2 * material.specular), normals, views
        ),
        2 * radiance,
    )


@every
def test_turning_everything_changes_nothing_and_surfaces_that_face_away_reflect_nothing(operator):
    light, material, normals, views = scene()
    assert (operator(light, material, normals, -views) == 0).all()
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(4)).double()).Q
    turned = operator(changed(light, axis=light.axis @ turn.T), material, normals @ turn.T, views @ turn.T)
    scale = float(turned.max())
    torch.testing.assert_close(turned, operator(light, material, normals, views), rtol=1e-3, atol=1e-4 * scale)


STATED = {
    "network": read_json(SHIPPED / "accuracy.json"),
    "closed_form": {"diffuse": {"p99": 0.0068}, "specular": {"p99": 0.53}},
}  # docs/operator.md


@pytest.mark.parametrize("name, dtype", EVERY)
def test_no_more_is_reflected_than_arrives(name, dtype):
    """Constant light of radiance 1: k_d + k_s ≤ 1 reflects at most 1, and the operator's stated error (99 %)."""
    operator, stated = EVERY[name, dtype], STATED.get(name)
    most = 1 + (0.4 * stated["diffuse"]["p99"] + 0.6 * stated["specular"]["p99"] if stated else 1e-4)
    _, material, normals, views = scene()
    light = SimpleNamespace(
        axis=torch.tensor([[0.0, 0, 1]]).double(),
        sharpness=torch.tensor([1e-4]).double(),
        weight=torch.ones(1, 3).double(),
    )
    for roughness in (0.1, 0.5, 1.0):
        white = changed(
            material,
            diffuse=torch.full((3,), 0.4).double(),
            specular=torch.full((3,), 0.6).double(),
            roughness=torch.tensor(roughness).double(),
        )
        radiance = operator(light, white, normals, views)
        assert (radiance <= most).all() and (radiance >= 0.4).all()


def grid(roughness, dtype=torch.float64, rows=24):
    """Scalars of `rows` random points under six lobes: roughness, λ, n·o, n·z, o·z."""
    g = torch.Generator().manual_seed(7)
    n, o, z = torch.tensor([0.0, 0, 1], dtype=torch.float64), unit(g, rows), unit(g, rows, 6)
    o[:, 2] = o[:, 2].abs().clamp_min(0.15)
    o = o / o.norm(dim=1, keepdim=True)
    lam = torch.logspace(-0.3, 2.7, 6, dtype=torch.float64)
    return tuple(t.to(dtype) for t in (torch.tensor(roughness), lam, o @ n, z @ n, (z * o[:, None]).sum(-1)))


@pytest.mark.parametrize("name", ["closed_form", "network"])
@pytest.mark.parametrize("roughness", [0.25, 0.5, 0.9])
def test_response_is_value_and_finite_differences(name, roughness):
    operator, h = FAST[name, "float64"], 1e-6
    r, lam, no, nz, oz = grid(roughness)
    point = {"roughness": r, "log_sharpness": lam.log(), "nz": nz, "oz": oz}

    def parts(roughness, log_sharpness, nz, oz):
        return operator.diffuse(log_sharpness.exp(), nz), operator.specular(roughness, log_sharpness.exp(), no, nz, oz)

    response, values = operator.response(r, lam, no, nz, oz), parts(**point)
    for part, value in zip(("diffuse", "specular"), values, strict=True):
        torch.testing.assert_close(getattr(response, part), value)
        for key in {"diffuse": ("log_sharpness", "nz"), "specular": tuple(point)}[part]:
            up, down = (parts(**(point | {key: point[key] + step}))[part == "specular"] for step in (h, -h))
            found = getattr(response, f"{part}_by_{key}")
            error = (found - (up - down) / (2 * h)).abs() / (found.abs() + value + 0.01 / lam)
            assert error.max() < 2e-4, (part, key)


@pytest.mark.parametrize("name", ["closed_form", "network"])
def test_gradients_are_those_of_the_reference(name):
    errors = []
    for roughness in (0.2, 0.4, 0.8):
        found, exact = (
            o.response(*grid(roughness, o.dtype, rows=12))
            for o in (FAST[name, "float32"], EVERY["reference", "float64"])
        )
        floor = exact.specular + lobe_integral(grid(roughness)[1]) / 100
        for field in exact.__struct_fields__[4:]:
            true = getattr(exact, field)
            errors.append((getattr(found, field).double() - true).abs() / (true.abs() + floor))
    assert torch.cat([e.reshape(-1) for e in errors]).median() < {"closed_form": 0.06, "network": 0.01}[name]


@fast
def test_response_of_many_is_that_of_each(operator):
    g = torch.Generator().manual_seed(1)
    no, lam = torch.rand(3000, generator=g).to(operator.dtype), torch.logspace(-1, 3, 9, dtype=operator.dtype)
    nz, oz = (2 * torch.rand(3000, 9, generator=g).to(operator.dtype) - 1 for _ in range(2))
    roughness = torch.tensor(0.4, dtype=operator.dtype)
    whole, part = (
        operator.response(roughness, lam, no, nz, oz),
        operator.response(roughness, lam, no[-7:], nz[-7:], oz[-7:]),
    )
    for name in whole.__struct_fields__:
        torch.testing.assert_close(getattr(whole, name)[-7:], getattr(part, name), rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("name", ["closed_form", "network"])
def test_diffuse_is_exact_to_a_thousandth_of_the_peak_in_float32(name):
    """Half the 0.15 % that Tokuyoshi et al. (2024) reach."""
    lam, nz = torch.logspace(-3, 6, 40).double(), torch.linspace(-1, 1, 101).double()
    exact = diffuse_quadrature(*torch.broadcast_tensors(lam[:, None], nz), 80)
    found = FAST[name, "float32"].diffuse(lam.float(), nz.float()[:, None].expand(-1, 40)).T.double()
    assert ((found - exact).abs().amax(1) / exact.amax(1)).max() < 7e-4


def test_errors_of_the_closed_form_and_the_shipped_network():
    s = specular_samples(4096, 77, tolerance=1e-5)
    formula, network = (
        quantiles((one_each(FAST[name, "float32"], s) - s.value) / s.scale()) for name in ("closed_form", "network")
    )
    assert formula["median"] < 0.02 and formula["p95"] < 0.4
    assert network["median"] < 0.002 and network["p95"] < 0.015 and network["p99"] < 0.045
    d = diffuse_samples(2048, 78)
    value = FAST["network", "float32"].diffuse(d.sharpness[:, None].float(), d.nz[:, None].float())[:, 0].double()
    assert quantiles((value - d.value) / d.scale())["p95"] < 0.01


def one_each(operator, samples):
    """The specular part of samples that share nothing: one lobe and one roughness each."""
    a, lam, no, nz, oz = (t.to(operator.dtype) for t in samples.inputs())
    return operator.specular(a.sqrt()[:, None], lam[:, None], no, nz[:, None], oz[:, None])[:, 0].double()


def test_moments_of_a_lobe():
    lam = torch.tensor([0.01, 1.0, 30.0, 1e4], dtype=torch.float64)
    t = torch.cos(torch.linspace(0, math.pi, 2_000_001, dtype=torch.float64))
    for k, sharpness in enumerate(lam):
        weight = torch.exp(sharpness * (t - 1)) * torch.sqrt(1 - t * t)
        mean = (weight * t).sum() / weight.sum()
        mean_square = (weight * t * t).sum() / weight.sum()
        expected = mean, (weight * (t - mean) ** 2).sum() / weight.sum(), (1 - mean_square) / 2
        assert [m[k].item() for m in lobe_moments(lam)] == pytest.approx([e.item() for e in expected], rel=1e-4)
        assert lobe_integral(lam)[k].item() == pytest.approx(
            2 * math.pi * (weight.sum() * math.pi / 2_000_000).item(), rel=1e-4
        )


def test_unknown_names_say_what_is_known_and_weights_that_are_not_there_are_named(tmp_path):
    with pytest.raises(InputError, match="no reflection operator 'netwrok'"):
        reflection_operator("netwrok")
    with pytest.raises(InputError, match="no weights"):
        reflection_operator("network", weights=tmp_path)


def test_weights_of_another_version_are_refused(tmp_path):
    for part in ("diffuse", "specular"):
        layers = read_layers(SHIPPED / f"{part}.safetensors", FEATURES[part])
        fewer = Layers(
            layers.mean[1:], layers.scale[1:], [layers.weights[0][:, 1:], *layers.weights[1:]], layers.biases
        )
        write_layers(tmp_path / f"{part}.safetensors", fewer)
    with pytest.raises(InputError, match="a network of 7 features, not 8"):
        reflection_operator("network", weights=tmp_path)
