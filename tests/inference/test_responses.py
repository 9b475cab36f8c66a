"""Tabulated responses, and the derivatives of the forward model that come of them."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.inference.blocks import RobustLoss
from factorlib.inference.forward import Illumination
from factorlib.inference.lights import UnitLobes, fibonacci_cells
from factorlib.inference.materials import Materials
from factorlib.inference.responses import NODES, ResponseTable, diffuse_response, specular_response
from factorlib.scenes.joint_problems import MATERIALS, block
from tests.inference.made_lights import OPERATOR, drawn, on_even_cells

CELLS, ALL = 60, RobustLoss(1e6)  # no outliers


def made(seed, photos=1, toned=False, hidden=False, bounced=False, clipped=False, near=False) -> Illumination:
    """Two materials of random reflectances in one light of several photos, with its table; what the photos show is of another light."""
    rng = np.random.default_rng(seed)
    exposure = [0.0, *rng.normal(0, 0.5, photos - 1)]
    light = on_even_cells(drawn(seed, CELLS) * 0.6, exposure, rng.uniform(-0.25, 0.25, photos) if toned else ())
    materials = Materials(rng.uniform(0.05, 0.6, (2, 3)), rng.uniform(0.03, 0.4, (2, 3)), rng.uniform(0.12, 0.9, 2))
    data = block(f"room{seed}", light, materials, [0, 1], OPERATOR, size=8)
    light = light.with_log_radiance(light.log_radiance - np.log(data.unit))
    n = len(data)
    if hidden:
        turned = [fibonacci_sphere(96) @ np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(photos)]
        seen = (255 * (rng.random((n, 96)) < 0.8)).astype(np.uint8)
        data = msgspec.structs.replace(data, visibility=seen, directions=np.stack(turned))
    if bounced:
        data = msgspec.structs.replace(data, bounced=rng.random((n, 6)) * (rng.random((n, 1)) < 0.5))
    if near:
        data = msgspec.structs.replace(data, place=rng.normal(size=(n, 3)) / 3**0.5)
        light = msgspec.structs.replace(light, curvature=0.2)
    if clipped:
        data = msgspec.structs.replace(data, clipped=rng.random((n, 3)) < 0.3)
    off = np.exp(rng.normal(0, 0.2, data.radiance.shape))
    one = Illumination(msgspec.structs.replace(data, radiance=data.radiance * off), light, materials, OPERATOR)
    return msgspec.structs.replace(one, table=ResponseTable(one.block, light.unit_lobes, OPERATOR))


ANY = {
    "seed": st.integers(0, 10_000),
    "photos": st.integers(1, 3),
    "toned": st.booleans(),
    "hidden": st.booleans(),
    "bounced": st.booleans(),
    "near": st.booleans(),
}
FEW_EXAMPLES = settings(max_examples=8, deadline=None, derandomize=True)


@FEW_EXAMPLES
@given(**ANY)
def test_the_table_shows_what_the_operator_shows(**how):
    one = made(**how)
    by_operator = msgspec.structs.replace(one, table=None)
    np.testing.assert_allclose(one.radiance(), by_operator.radiance(), atol=0.01)  # a block's mean is 1
    assert one.predict().responses and not by_operator.predict().responses


def linear(one: Illumination, of, change) -> np.ndarray:
    """What `of` (a part of a Linearised) says of a change, for all residuals."""
    result = np.zeros((len(one.block), 3))
    for part in one.linearise(one.predict(), ALL):
        result[part.rows, part.channel] = of(part, change)
    return result


def check_against_differences(one: Illumination, moved, found: np.ndarray, step: float) -> None:
    """moved: the illumination at a multiple of a change; what is held out or where a bound of the residual is passed is left out."""
    high, low = (moved(sign * step).residuals() for sign in (1, -1))
    difference = (high - low) / (2 * step)
    counts = ~one.block.held_out[:, None] & ~(
        one.block.clipped & (np.minimum(high, low) < 0) & (np.maximum(high, low) >= 0)
    )
    np.testing.assert_allclose(found[counts], difference[counts], rtol=0.01, atol=0.003 * np.abs(difference).max())
    assert not found[np.broadcast_to(one.block.held_out[:, None], found.shape)].any()


def check_derivatives(one: Illumination) -> None:
    """Of the residuals by every unknown."""
    replaced, light, materials = msgspec.structs.replace, one.light, one.materials
    rng, m, k = np.random.default_rng(0), len(one.materials), len(one.block.photos)

    def with_u(change):
        return replaced(one, light=light.with_log_radiance(light.log_radiance + change))

    def with_materials(change):
        kd, ks = materials.diffuse * np.exp(change[:, :3]), materials.specular * np.exp(change[:, 3:6])
        return replaced(one, materials=Materials(kd, ks, materials.roughness + change[:, 6]))

    def with_photos(change):
        exposure = light.log_exposure + np.concatenate([[0.0], change[: k - 1]])
        return replaced(one, light=replaced(light, log_exposure=exposure, log_tone=light.log_tone + change[k - 1 :]))

    def by_material(part, by):
        return part.by_material @ by.reshape(-1)[part.places]

    du, dm = rng.normal(size=light.log_radiance.shape), rng.normal(size=(m, 7)) * np.array([1.0] * 6 + [0.05])
    dp = rng.normal(size=k - 1 + len(light.log_tone))
    kinds = np.repeat([0, 1, 2], [3, 3, 1])  # k_d, k_s, roughness
    exposures = np.arange(len(dp)) < k - 1
    changes = [(with_u, lambda part, by: (part.diffuse + part.specular) @ by[part.channel], du, 5e-3)]
    changes += [(with_materials, by_material, dm * (kinds == kind), 1e-2) for kind in range(3)]
    changes += [(with_photos, lambda part, by: part.by_photo @ by, dp * own, 5e-3) for own in (exposures, ~exposures)]
    for moved, of, by, step in changes:
        if by.any():
            check_against_differences(one, lambda s, moved=moved, by=by: moved(s * by), linear(one, of, by), step)


@FEW_EXAMPLES
@given(**ANY)
def test_derivatives_are_finite_differences(**how):
    check_derivatives(made(**how))


@pytest.mark.parametrize("toned", [False, True])
def test_derivatives_are_finite_differences_where_channels_are_clipped(toned):
    one = made(3, photos=2, toned=toned, clipped=True)
    idle = one.block.clipped & (one.residuals() >= 0)
    assert idle.sum() > 20
    check_derivatives(one)
    for part in one.linearise(one.predict(), ALL):
        none = idle[part.rows, part.channel]
        assert not part.diffuse[none].any() and not part.by_material[none].any() and not part.residual[none].any()


def test_outliers_and_temperature_are_factors_on_residual_and_derivatives():
    one = made(4)
    plain, weighed = (list(one.linearise(one.predict(), loss, T)) for loss, T in ((ALL, 1.0), (RobustLoss(0.5), 4.0)))
    trust = np.sqrt(RobustLoss(0.5).weights(one.residuals()))
    for a, b in zip(plain, weighed, strict=True):
        factor = trust[a.rows, a.channel] / 2
        for name in ("diffuse", "by_roughness", "by_material"):
            np.testing.assert_allclose(getattr(b, name), factor[:, None] * getattr(a, name), rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(b.residual, factor * a.residual, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("sharpness", [None, 500.0])  # None: of the cells; 500: every node is needed
def test_responses_between_nodes_are_those_of_the_operator(sharpness):
    data = block("room", on_even_cells(drawn(0, CELLS)), MATERIALS, [0, 1, 2], OPERATOR, size=10)
    cells = fibonacci_cells(CELLS)
    lobes = cells if sharpness is None else UnitLobes(cells.axis, np.full(CELLS, sharpness))
    table = ResponseTable(data, lobes, OPERATOR)
    rows = table.rows(1)
    assert (data.material[rows] == 1).all() and (data.material == 1).sum() == rows.stop - rows.start
    for roughness in (0.1, 0.28, 0.55, float(NODES[3]), 1.0):
        found = table.interpolate(1, roughness)
        assert np.allclose(found.diffuse, diffuse_response(data, rows, lobes, OPERATOR), rtol=1e-5, atol=1e-7)
        specular = specular_response(data, rows, lobes, roughness, OPERATOR)
        assert np.abs(found.specular - specular).max() < 0.01 * specular.max()
    step = 1e-3
    slope = (table.interpolate(1, 0.28 + step).specular - table.interpolate(1, 0.28 - step).specular) / (2 * step)
    assert np.allclose(table.interpolate(1, 0.28).by_roughness, slope, rtol=0.02, atol=1e-3 * np.abs(slope).max())
