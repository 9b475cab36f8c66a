"""The comparison: the sphere, what each method can do by its own rules, that none gets more than it may know, and scores by its steps.

Mitsuba's part needs LLVM, and is skipped visibly where there is none.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.evaluate.materials import compare_materials
from factorlib.export.environment import node_directions
from factorlib.light.latlong import sampled
from factorlib.results.materials import Reflectance
from factorlib.runner.project import LIBRARY
from factorlib.tracing.variant import _fastest
from studies.body import Photos, photographed, shown, turn, view
from studies.catalogue import comparison
from studies.errors import in_gauge, times
from studies.methods import (
    LAMBERT,
    Texture,
    averaged,
    decomposed,
    grey,
    harmonics,
    intrinsic,
    lambertian_part,
    light_coefficients,
    projective,
    rendered,
)
from studies.run import data_of
from studies.spheres import materials_of
from studies.steps import answer, compare
from studies.study import Comparison, full_matrix
from tests.studies.test_run import TINY, concluded

VIEW = turn(70, 15)
RNG = np.random.default_rng(0)


def light(seed, rows=32):
    """An even sky with a few coloured lamps, mean radiance about 1."""
    rng = np.random.default_rng(seed)
    directions, sky = lat_long_directions(rows, 2 * rows), np.full((rows, 2 * rows, 3), 0.4)
    for axis in rng.normal(size=(4, 3)):
        colour, cosine = rng.uniform(0.5, 4, 3), directions @ (axis / np.linalg.norm(axis))
        sky += colour * np.exp(rng.uniform(5, 60) * (cosine - 1))[..., None]
    return sky


def case(side=3, size=24, seed=0, method="ours", steps=2):
    """All of so many materials in as many lights."""
    return Comparison(seed, tuple(full_matrix(side, side)), size, method=method, pixels=12, steps=steps)


def lights(seed, count=4):
    return {li: light(100 * seed + li) for li in range(count)}


def photos(**how):
    of = case(**how)
    return photographed(of, materials_of(of.seed), lights(of.seed))[0]


# ── the sphere ─────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("side", [np.eye(3), VIEW, turn(160, -10)])
def test_a_camera_sees_the_front_of_the_sphere(side):
    seen = view(24, side)
    assert np.linalg.norm(seen.normals, axis=1) == pytest.approx(1) and len(seen.normals) == seen.inside.sum()
    assert ((seen.normals @ side[2]) > 0.15).all() and (seen.normals @ side[2]).max() > 0.99


def test_the_sphere_and_its_light_stay_where_they_are_when_the_camera_moves():
    """Lambert looks alike from everywhere: a point has one radiance in all views that see it."""
    here, there, material, of = (
        view(48),
        view(48, VIEW),
        Reflectance((0.5, 0.4, 0.3), (0.0,) * 3, 1.0),
        light(1, 64),
    )
    texture = Texture(here)
    both = texture.seen(there)
    carried, exact = texture.at(there, shown(material, of, here))[both], shown(material, of, there)[both]
    assert 0.3 < both.mean() < 0.95 and np.abs(carried / exact - 1).mean() < 0.02
    assert np.abs(carried / shown(material, of[:, ::-1], there)[both] - 1).mean() > 0.05


# ── methods ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_texture_is_the_photo_from_where_it_was_taken_and_is_filled_from_it_elsewhere():
    taken, back = photos(), view(24, turn(180, 0))
    found, photo = projective(taken, {}), taken.radiance["leaf", 1]
    assert found.of("leaf", 1, taken.view) == pytest.approx(photo, rel=1e-4)
    assert not Texture(taken.view).seen(back).any()
    colours = found.of("leaf", 1, back)
    assert (colours >= photo.min(axis=0)).all() and (colours <= photo.max(axis=0)).all()
    assert np.array_equal(found.of("leaf", light(1), back), found.of("leaf", light(2), back))
    assert found.of(materials_of(0)["gold"], 0, back) is None


def test_harmonics_are_orthonormal_and_shade_lambert_as_the_quadrature_does():
    directions, area = lat_long_directions(256, 512), lat_long_solid_angles(256, 512)
    basis = harmonics(directions)
    assert np.einsum("h,hwj,hwk->jk", area, basis, basis) == pytest.approx(np.eye(9), abs=1e-3)
    camera, of, white = view(16), light(3, 64), Reflectance((1.0,) * 3, (0.0,) * 3, 1.0)
    shaded = harmonics(camera.normals) @ (LAMBERT[:, None] * light_coefficients(of))
    assert np.abs(shaded / shown(white, of, camera) - 1).mean() < 0.03


def test_lambert_is_decomposed_exactly_and_a_highlight_is_what_is_left_over():
    normals, shading = view(24).normals, np.vstack([[3, 2.5, 2], 0.3 * RNG.normal(size=(8, 3))])
    albedo = {"a": np.array([0.5, 0.2, 0.1]), "b": np.array([0.1, 0.4, 0.3])}
    found = decomposed(normals, {name: k * (harmonics(normals) @ shading) for name, k in albedo.items()})
    assert found.albedo["a"] / found.albedo["b"] == pytest.approx(albedo["a"] / albedo["b"], rel=1e-6)
    assert all(of.max() < 1e-6 for of in found.highlight.values())
    lit = harmonics(normals) @ np.vstack([[3, 2.5, 2], np.full((8, 3), 0.2)])
    gloss = 5 * np.exp(80 * (normals @ np.array([0.3, 0.4, np.sqrt(0.75)]) - 1))[:, None]
    found = decomposed(normals, {"a": 0.4 * lit + gloss, "b": 0.2 * lit})
    assert found.albedo["a"] / found.albedo["b"] == pytest.approx(np.full(3, 2), rel=0.02)
    assert np.abs(found.highlight["a"] - gloss).mean() < 0.05 * gloss.mean()


def test_albedos_are_averaged_over_photos_that_each_know_them_but_for_a_factor():
    albedo = {n: np.array(v) for n, v in {"a": (0.5, 0.2, 0.1), "b": (0.1, 0.4, 0.3), "c": (0.3, 0.3, 0.3)}.items()}
    names, normals = {0: ("a", "b"), 1: ("b", "c"), 2: ("a", "b", "c")}, view(12).normals
    scale, flat = {li: RNG.uniform(0.5, 2, 3) for li in names}, np.ones((len(normals), 3))
    parts = {li: decomposed(normals, {n: scale[li] * albedo[n] * flat for n in of}) for li, of in names.items()}
    found, _ = averaged(parts)
    factor = albedo["a"] / found["a"]
    assert all(found[n] * factor == pytest.approx(albedo[n], rel=1e-6) for n in albedo)


@pytest.mark.parametrize("seed", [200, 201])
def test_the_decompositions_albedo_beats_a_grey_one_on_truth(seed):
    """Else it would be no baseline."""
    truths = materials_of(seed)
    found = intrinsic(photos(seed=seed, size=32), truths).materials
    errors = compare_materials(found, lambertian_part(truths), dict.fromkeys(found, 0))
    assert errors.mean_diffuse < 0.8 * errors.null_mean_diffuse


def test_a_decomposition_does_not_depend_on_the_scale_of_photos():
    """What no photo tells, a factor per channel and photo, changes neither albedos nor what is predicted of a new light."""
    taken, camera = photos(side=2), view(24, VIEW)
    scaled = Photos(taken.view, {(n, li): v * (1.0 + li) for (n, li), v in taken.radiance.items()})
    plain, other = (intrinsic(p, materials_of(0)) for p in (taken, scaled))
    assert np.allclose(plain.materials["leaf"].diffuse, other.materials["leaf"].diffuse, rtol=1e-3)
    assert other.of("leaf", 1, camera) == pytest.approx(2 * plain.of("leaf", 1, camera), rel=1e-2)


# ── scores ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def scores(prediction):
    world = compare.World(materials_of(0), lights(0, 3))
    taken = compare.shots(case(side=2, size=12), world, prediction(world))
    return compare.score_of(world, prediction(world), taken, 1.0), taken


def test_the_truth_in_any_gauge_scores_nothing_a_grey_ball_does_and_what_is_not_stated_has_no_score():
    factor = np.array([0.5, 2.0, 1.5])

    def true(world):
        materials = {n: times(world.materials[n], factor) for n in ("brick", "leaf")}
        return rendered(*in_gauge(materials, {li: world.lights[li] / factor for li in (0, 1)}, world.materials))

    score, taken = scores(true)
    assert {of.shot.kind for of in taken} == set(compare.KINDS)
    assert len({of.shot.name for of in taken}) == len(taken) == 8 + 2 + 6
    measures = [kind + suffix for kind in compare.KINDS for suffix in compare.SUFFIXES.values()]
    assert max(score.values[m] for m in (*measures, "mirror")) < 1e-6 and score.values["roughness"] == 0
    worse, _ = scores(lambda world: grey(photos(side=2, size=12), world.materials))
    assert min(worse.values[m] for m in measures) > 0.02 and "roughness" not in worse.values
    score, taken = scores(lambda world: projective(photos(side=2, size=12), {}))
    assert not {"diffuse", "mirror", "novel_material"} & score.values.keys() and "novel_view" in score.values


def test_from_worlds_to_pictures(tmp_path, monkeypatch):
    """By its steps; Mitsuba's stands still: it is given a made answer, for what takes LLVM is tested below."""
    monkeypatch.setitem(comparison.SIZES, "quick", (12, 12, 2))
    material = Reflectance((0.3,) * 3, (0.1,) * 3, 0.4)
    run = subprocess.run

    def stand_in(words, **how):
        if answer.__name__ not in words:
            return run(words, **how)
        return answer.written(Path(words[-1]), {"brick": material}, {0: np.ones((8, 16, 3))}, 1.0)

    monkeypatch.setattr(answer.subprocess, "run", stand_in)
    table, out = concluded(tmp_path, "comparison", data_of(tmp_path / "comparison", TINY), TINY, [answer, compare])
    cells = {row["name"]: {m: c["spread"]["mean"] for m, c in row["cells"].items()} for row in table["rows"]}
    assert list(cells) == ["ours", "mitsuba", "intrinsic", "projective", "grey"] and table["quick"]
    assert all({"novel_view", "novel_light", "processor"} <= of.keys() for of in cells.values())
    assert cells["ours"]["novel_view"] < cells["grey"]["novel_view"] and "novel_material" not in cells["projective"]
    assert {path.stem for path in (out / "pictures").iterdir()} == {f"{method}-seed0" for method in cells}
    assert compare.read_shots(tmp_path / "compare/ours-seed0")[0][1] > 0


# ── Mitsuba's optimisation ───────────────────────────────────────────────────────────────────────────────────────────

LLVM = pytest.mark.skipif(
    _fastest() != "llvm_ad_rgb",
    reason="Mitsuba has no derivatives without LLVM 16 or later (Debian: apt-get install libllvm19)",
)


def errors_of_renderings():
    """Relative errors of what Mitsuba's scene shows of true materials in a smooth light, the light as it stands and left-right mirrored."""
    answer.one_thread_with_derivatives()
    truths, errors, smooth = materials_of(0), [], sampled(light(5, 8), node_directions(64, 128))
    taken, _ = photographed(case(side=2, size=48), truths, dict.fromkeys(range(2), smooth))
    joint = answer.Joint(taken, 24)
    joint.begin(0.01)
    for kind in ("diffuse", "specular"):
        joint.optimiser[f"{kind} leaf"] = joint.mi.Color3f(*getattr(truths["leaf"], kind))
    joint.optimiser["roughness leaf"] = joint.mi.Float(truths["leaf"].roughness)
    for step in (1, -1):
        nodes = sampled(smooth, node_directions(16, 32))[:, ::step].astype("f4")
        joint.optimiser["light 0"] = joint.mi.TensorXf(np.concatenate([nodes[:, -1:], nodes, nodes[:, :1]], axis=1))
        joint.set(("leaf", 0))
        image, true = np.array(joint.mi.render(joint.scenes["leaf", 0], spp=256)), joint.shown["leaf", 0]
        errors.append(float(np.abs(image - true)[joint.mask].mean() / true[joint.mask].mean()))
        errors.append(float(np.abs(joint.light(0, 64) / smooth[:, ::step] - 1).mean()))
    return errors


def losses_of_two_runs():
    """Each of twelve steps."""
    of = case(side=1, method="mitsuba", steps=12)
    return [answer.optimised(of, photos(side=1))[0] for _ in range(2)]


def in_a_process_of_its_own(call):
    code = f"import sys, json; from tests.studies import test_comparison as t; print(json.dumps(t.{call}))"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(LIBRARY), str(LIBRARY / "tests")])}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=LIBRARY, capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@LLVM
@pytest.mark.long
def test_mitsubas_scene_is_the_one_that_was_photographed():
    """Coarse texels and samples leave a few per cent."""
    right, map_, mirrored, map_too = in_a_process_of_its_own("errors_of_renderings()")
    assert right < 0.06 and map_ < 0.06 and map_too < 0.06 and mirrored > 2 * right


@LLVM
@pytest.mark.long
def test_the_optimisation_goes_down_the_same_way_in_every_run():
    first, again = in_a_process_of_its_own("losses_of_two_runs()")
    assert first == again and first[-1] < 0.9 * first[0] and len(first) == 12 and not answer.flat(first)
