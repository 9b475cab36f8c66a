"""The stage `render`: its files, masks, frames and bytes; and reflectors, whose radiance is that of quadrature and of the operator."""

import msgspec
import numpy as np
import pytest
import torch

from factorlib.conventions import FRONT, YUP_FROM_CAMERA, lat_long_directions, lat_long_solid_angles
from factorlib.geometry.sphere import NO_OCCLUDER, ball_normals, fibonacci_sphere
from factorlib.images.exr import read_exr, read_rgb_exr, write_exr
from factorlib.images.tone import curve
from factorlib.inference.model.interreflection import bounced_light
from factorlib.jsonfile import read_json, write_json
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.light.lobes import Lobes, no_lobes
from factorlib.reflection import reflection_operator
from factorlib.reflection.reference import Reference
from factorlib.render import resynthesis
from factorlib.render.resynthesis import PointEffects, Reflector, interpolation_nodes, render_ball, resynthesise
from factorlib.results.lobe_table import write_lobes
from factorlib.results.materials import Reflectance, read_materials
from factorlib.stage import silent
from factorlib.urm.observations import write_observations
from stages import render, shading
from tests.export import made_export
from tests.export.made_export import instead
from tests.inference.made import observations_from_front
from tests.integral import reflected
from tests.runner.toy import files_of
from tests.stages.made import ran


@pytest.fixture
def inputs():
    return made_export.shared()[0]


def run(inputs, photo, out):
    of_photo = made_export.of_photo(inputs, photo)
    shaded = ran(shading, of_photo, out.with_name(f"{out.name}, shading"), silent, operator="closed_form")
    after = msgspec.structs.replace(of_photo, folders={**of_photo.folders, "shading": shaded})
    return ran(render, after, out, silent, operator="closed_form", ball_size=33)


def test_pictures_are_all_there_and_the_same_bytes_again(inputs, tmp_path):
    first, second = map(files_of, ([run(inputs, "side", tmp_path / name) for name in "ab"]))
    stems = [f"materials/side/{m}" for m in made_export.NAMES]
    assert set(first) == {f"{stem}.{suffix}" for stem in ["resynthesis/side", *stems] for suffix in ("exr", "png")}
    assert first == second


@pytest.mark.parametrize("photo", ["front", "side"])
def test_ball_is_the_solved_material_in_the_solved_light_at_the_photos_exposure(inputs, tmp_path, photo):
    world, light = made_export.WORLD_FROM_CAMERA[photo], made_export.lights()[made_export.LIGHTS[photo]]
    normal = torch.tensor((FRONT if world is None else world @ FRONT)[None])  # in the light's own frame
    solved, operator = read_materials(inputs["solve"] / "materials.json").materials, reflection_operator("closed_form")
    out = run(inputs, photo, tmp_path / "out")
    for name in made_export.NAMES:
        expected = operator(light, solved[name], normal, normal)[0] * made_export.EXPOSURES[photo][0]
        np.testing.assert_allclose(read_rgb_exr(out / "materials" / photo / f"{name}.exr")[16, 16], expected, rtol=2e-3)


def test_resynthesis_is_lit_inside_the_mask_alone(inputs, tmp_path):
    out = run(inputs, "front", tmp_path / "out")
    picture = read_rgb_exr(out / "resynthesis" / "front.exr")
    assert picture.shape == (made_export.HEIGHT, made_export.WIDTH, 3)
    np.testing.assert_array_equal(picture.max(-1) > 0, read_exr(inputs["masks"] / "front.exr")["label"] > 0)


def test_unknown_light_is_black_and_said(inputs, tmp_path, caplog):
    """As of a photo without observations: `solve` writes no light, and `export` one without lobes."""
    solved = instead(inputs["solve"] / "lobes.parquet", lambda file: write_lobes(file, {}))
    exported = instead(inputs["export"] / "lobes.parquet", lambda file: write_lobes(file, {"front": no_lobes()}))
    with solved, exported:
        out = run(inputs, "front", tmp_path / "out")
    assert "nothing is known of its light" in caplog.text
    assert not read_rgb_exr(out / "resynthesis" / "front.exr").any()


def with_model(inputs, **model):
    file = inputs["solve"] / "materials.json"
    table = read_json(file) | {"model": model}
    return instead(file, lambda file: write_json(file, table))


def test_resynthesis_goes_through_the_photos_tone_curve_and_nothing_else_does(inputs, tmp_path):
    straight, tone = run(inputs, "front", tmp_path / "straight"), {"side": {"exponent": 2.0, "pivot": 1.0}}
    with with_model(inputs, tone=tone | {"front": {"exponent": 1.5, "pivot": 0.3}}):
        curved = run(inputs, "front", tmp_path / "curved")
    linear, shown = (read_rgb_exr(of / "resynthesis" / "front.exr") for of in (straight, curved))
    np.testing.assert_allclose(shown, 0.3 * curve(linear / 0.3, 1.5), rtol=1e-4, atol=1e-6)
    other = [p for p in straight.rglob("*.exr") if "resynthesis" not in p.parts]
    assert all(p.read_bytes() == (curved / p.relative_to(straight)).read_bytes() for p in other)


def test_what_is_hidden_is_lit_by_what_the_photo_shows_there(inputs, tmp_path):
    """In the gauge of the solve: the factor that `export` took from the reflectances does not weaken it."""
    y, x = np.nonzero(read_exr(inputs["masks"] / "front.exr")["label"] > 0)
    n, geometry = len(x), read_exr(inputs["align"] / "front.exr")
    visibility = np.where(fibonacci_sphere(64)[:, 1] > 0, 0, 255).astype(
        np.uint8
    )  # the lower half is hidden, by nothing known
    normal, view = (np.stack([geometry[f"{kind}.{a}"][y, x] for a in "xyz"], axis=-1) for kind in ("normal", "view"))
    columns = {"view": view, "x": x, "y": y, "visibility": np.tile(visibility, (n, 1))}
    columns |= {"occluder": np.full((n, 64), NO_OCCLUDER, np.uint16)}
    radiance, names = np.full((n, 3), 0.3), tuple(made_export.NAMES)
    observed = observations_from_front(normal, radiance, np.zeros(n, int), names, "front", **columns)
    (tmp_path / "urm").mkdir()
    write_observations(tmp_path / "urm" / "front.parquet", observed)
    pictures, hidden = [], msgspec.structs.replace(inputs, folders={**inputs.folders, "urm": tmp_path / "urm"})
    for bounces in (True, False):
        with with_model(inputs, self_shadowing=True, interreflection=bounces):
            out = run(hidden, "front", tmp_path / str(bounces))
        pictures.append(read_rgb_exr(out / "resynthesis" / "front.exr")[y, x])
    assert read_materials(inputs["export"] / "materials.json").gauge.export_factor < 1
    red, bounced = made_export.MATERIALS["red"], bounced_light(observed, observed.radiance)
    expected = np.array(red["diffuse"]) * bounced[:, :3] + np.array(red["specular"]) * bounced[:, 3:]
    np.testing.assert_allclose(pictures[0] - pictures[1], expected, rtol=1e-3, atol=1e-4)
    assert expected.max() > 0.1


def test_a_surface_with_other_normals_and_detail_is_rendered_as_it_is(inputs, tmp_path):
    geometry = read_exr(inputs["align"] / "front.exr")
    normal, inside = np.stack([geometry[f"normal.{a}"] for a in "xyz"], axis=-1), geometry["object"] > 0
    pictures = []
    for name, detail in (("plain", 1.0), ("painted", 0.5)):
        (tmp_path / name / "photos").mkdir(parents=True)
        channels = {f"normal.{a}": normal[..., k] for k, a in enumerate("xyz")} | {
            f"detail.{c}": detail * inside for c in "RGB"
        }
        write_exr(tmp_path / name / "photos" / "front.exr", channels)
        on = msgspec.structs.replace(inputs, folders={**inputs.folders, "surface": tmp_path / name})
        pictures.append(read_rgb_exr(run(on, "front", tmp_path / f"out {name}") / "resynthesis" / "front.exr"))
    given = read_rgb_exr(run(inputs, "front", tmp_path / "given") / "resynthesis" / "front.exr")
    np.testing.assert_allclose(pictures[0], given, rtol=1e-5, atol=1e-6)
    diffuse, specular = resynthesis.read_shading(tmp_path / "given, shading", "front")
    np.testing.assert_allclose(given, diffuse + specular, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(pictures[1], 0.5 * diffuse + specular, rtol=1e-5, atol=1e-6)  # not the specular part
    assert pictures[1].sum() < 0.9 * given.sum()


# ── Reflectors: the same radiance as quadrature over the exported map, and as the operator without short cuts; balls


GLOSSY = Reflectance((0.4, 0.2, 0.1), (0.1, 0.2, 0.3), 0.4)


def unit(count: int, seed: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def light(count: int = 5) -> Lobes:
    weight = np.random.default_rng(1).uniform(0.2, 2, (count, 3)) * np.geomspace(1, 20, count)[:, None]
    return Lobes(unit(count, 0), np.geomspace(1, 150, count), weight)


def cells(sharpest: float = 900.0) -> Lobes:
    """A light as it is solved for: lobes all around, some bright and narrow."""
    narrow = np.arange(300) % 50 == 0
    weight = np.random.default_rng(6).uniform(0.2, 2, (300, 3)) * np.where(narrow, 0.05 * sharpest, 1)[:, None]
    return Lobes(fibonacci_sphere(300), np.where(narrow, sharpest, 70.0), weight)


def points(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Normals and views that see the surface."""
    normals, views = unit(count, 2), unit(count, 3)
    return normals, views * np.sign((normals * views).sum(1, keepdims=True))


def test_radiance_is_the_integral_over_the_exported_map():
    light_map, (normals, views) = lat_long_of_lobes(light(), 128, 256), points(12)
    texels = light_map * lat_long_solid_angles(128, 256)[:, None, None]
    incoming = (lat_long_directions(128, 256) @ YUP_FROM_CAMERA).reshape(-1, 3)
    expected = reflected(GLOSSY, normals, views, incoming, texels.reshape(-1, 3))
    result = Reflector(Reference(tolerance=1e-4), light())(GLOSSY, normals, views)
    np.testing.assert_allclose(result, expected, rtol=2e-3)


@pytest.mark.parametrize("roughness, sharpest", [(0.1, 900.0), (0.3, 900.0), (0.3, 2e5), (0.6, 900.0)])
def test_balls_are_the_operator_at_every_pixel(roughness, sharpest):
    glossy = msgspec.structs.replace(GLOSSY, roughness=roughness)
    reflector = Reflector(reflection_operator("network"), cells(sharpest))
    for picture in (render_ball(reflector, glossy, size) for size in (96, 48)):
        normals, inside = ball_normals(len(picture))
        normals = normals * (1, -1, -1)
        expected = reflector(glossy, normals, np.broadcast_to(FRONT, normals.shape))
        error = np.abs(picture[inside] - expected)
        assert not picture[~inside].any()
        assert np.sqrt((error**2).mean() / (expected**2).mean()) < 0.003
        assert np.percentile(error / expected, 99) < 0.005


def test_chunks_do_not_show(monkeypatch):
    operator, reports = reflection_operator("closed_form"), []
    whole = Reflector(operator, light())(GLOSSY, *points(50))
    monkeypatch.setattr("factorlib.render.resynthesis.PAIRS_AT_ONCE", 35)
    parts = Reflector(operator, light())(GLOSSY, *points(50), report=lambda done, total: reports.append((done, total)))
    np.testing.assert_allclose(parts, whole, rtol=1e-6)
    assert reports[0] == (7, 50) and reports[-1] == (50, 50)


@pytest.mark.parametrize(
    "roughness, share",
    [pytest.param(0.15, 1.0, marks=pytest.mark.long), pytest.param(0.3, 0.8, marks=pytest.mark.long), (0.6, 0.3)],
)
def test_interpolated_pixels_are_those_that_the_operator_gives(roughness, share, monkeypatch):
    """Of a large ball, of which only a share is evaluated: the rim, and more with narrower highlights."""
    normals, inside = ball_normals(140)
    normal, view = np.zeros((2, 140, 140, 3))
    normal[inside], view[inside] = normals * (1, -1, -1), FRONT
    vectors = {"normal": normal, "view": view}
    geometry = {f"{kind}.{a}": v[..., k] for kind, v in vectors.items() for k, a in enumerate("xyz")}
    reflector, material = (
        Reflector(reflection_operator("network"), cells(60.0)),
        msgspec.structs.replace(GLOSSY, roughness=roughness),
    )
    evaluated = []
    parts = reflector.parts
    monkeypatch.setattr(reflector, "parts", lambda m, n, *rest: evaluated.append(len(n)) or parts(m, n, *rest))
    fast = resynthesise(reflector, [material], {"label": inside.astype(float)}, geometry).sum(0)
    monkeypatch.setattr(resynthesis, "LARGEST_SPREAD", 0.0)
    exact = resynthesise(reflector, [material], {"label": inside.astype(float)}, geometry).sum(0)
    assert evaluated[1] == inside.sum() >= evaluated[0] / share
    assert np.sqrt(np.mean((fast - exact) ** 2)) < 0.005 * np.sqrt(np.mean(exact**2))


def evaluated(normals: np.ndarray, toward: np.ndarray = FRONT) -> np.ndarray:
    """Mask of the pixels of a square picture that are evaluated, for a material of α = 0.1."""
    size = len(normals)
    flat = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).reshape(-1, 3)
    nodes, weights = interpolation_nodes(np.ones((size, size), bool), flat, np.tile(toward, (size**2, 1)), 0.1)
    np.testing.assert_allclose(weights @ flat[nodes], flat, atol=0.01)
    return np.isin(np.arange(size**2), nodes).reshape(size, size)


@pytest.mark.parametrize("slope, all_of_them", [(0.005, False), (0.03, True)])
def test_pixels_of_a_surface_that_bends_in_the_width_of_a_highlight_are_all_evaluated(slope, all_of_them):
    normals = np.tile(FRONT, (31, 31, 1)) + slope * np.arange(31)[:, None, None] * [1, 0, 0]
    assert evaluated(normals)[:30, :30].all() == all_of_them


@pytest.mark.parametrize("bump, count", [(0.005, 100), (0.02, 101)])
def test_a_pixel_of_another_normal_than_its_neighbours_is_evaluated(bump, count):
    normals = np.tile(FRONT, (31, 31, 1))
    normals[13, 17] += [bump, 0, 0]
    assert evaluated(normals)[:30, :30].sum() == count


def test_nothing_is_interpolated_that_faces_away_nor_over_rough_normals():
    assert evaluated(np.tile(FRONT, (31, 31, 1)), -FRONT).all() and evaluated(unit(900, 2).reshape(30, 30, 3)).all()


@pytest.mark.parametrize("lit, facing", [(no_lobes(), 1), (light().scale(0.0), 1), (light(), -1)])
def test_darkness_is_black_and_so_is_what_faces_away(lit, facing):
    normals, views = points(20)
    assert not Reflector(reflection_operator("closed_form"), lit)(GLOSSY, normals, facing * views).any()


def test_shadows_that_hide_nothing_change_nothing_and_those_that_hide_all_leave_darkness():
    reflector, (normals, views) = Reflector(reflection_operator("closed_form"), light()), points(40)
    for level, factor in ((255, 1.0), (0, 0.0)):
        result = reflector(GLOSSY, normals, views, effects=PointEffects(visibility=np.full((40, 256), level, np.uint8)))
        np.testing.assert_allclose(result, factor * reflector(GLOSSY, normals, views), rtol=1e-5, atol=2e-3)


@pytest.mark.parametrize("lobes", [light(), cells(), cells(20000.0)], ids=["few", "many", "suns"])
def test_the_shadow_of_the_diffuse_part_is_as_if_each_lobe_had_its_own(lobes):
    """Half of the directions are hidden, on one side of a plane through the point."""
    operator, matt = reflection_operator("closed_form"), Reflectance((0.4, 0.2, 0.1), (0.0,) * 3, 1.0)
    (normals, views), sphere = points(60), fibonacci_sphere(256)
    seen = np.where(sphere @ unit(60, 9).T > 0, 255, 0).T.astype(np.uint8)
    together = Reflector(operator, lobes)(matt, normals, views, effects=PointEffects(visibility=seen))
    ones = [Reflector(operator, lobes.take(np.arange(len(lobes)) == k)) for k in range(len(lobes))]
    each = sum(one(matt, normals, views, effects=PointEffects(visibility=seen)) for one in ones)
    full = Reflector(operator, lobes)(matt, normals, views)
    assert np.abs(together - each).max() < 0.02 * full.max() and (each < 0.7 * full).any()


def test_a_near_light_is_to_each_point_a_far_one_of_moved_lobes():
    operator, lobes, (normals, views) = reflection_operator("closed_form", dtype="float64"), light(), points(20)
    place, curvature = 1.5 * unit(20, 5), 0.2
    near = Reflector(operator, lobes, curvature)(GLOSSY, normals, views, effects=PointEffects(place=place))
    for k, x in enumerate(curvature * place):
        to = lobes.axis - x
        d = np.linalg.norm(to, axis=1, keepdims=True)
        moved = Lobes(to / d, lobes.sharpness, lobes.weight * (1 - lobes.axis @ x)[:, None] / d**3)
        far = Reflector(operator, moved)(GLOSSY, normals[k : k + 1], views[k : k + 1])[0]
        np.testing.assert_allclose(near[k], far, rtol=1e-4)
    middle = Reflector(operator, lobes, curvature)(GLOSSY, normals, views, effects=PointEffects(place=0 * place))
    np.testing.assert_allclose(middle, Reflector(operator, lobes)(GLOSSY, normals, views), rtol=1e-9)
    assert np.abs(near / middle - 1).max() > 0.1
