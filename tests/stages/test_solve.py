"""The stage `solve` from observations to its files: what it writes, chooses, warns of, starts from and refuses."""

import logging

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.geometry.sphere import mirror_directions
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.inference.model.blocks import Noise
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.observed import blocks_of_observations
from factorlib.jsonfile import read_json, write_json
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.light.lobes import Lobes, lobe_energy
from factorlib.reflection import reflection_operator
from factorlib.reflection.network import SHIPPED
from factorlib.results.lobe_table import read_lobes
from factorlib.results.surface_table import FILE, SurfaceTable
from factorlib.scenes.joint_problems import MATERIALS, random_light, sphere_normals
from factorlib.stage import Inputs
from factorlib.urm.observations import Observations, write_observations
from stages import solve
from tests.inference.made import observations_from_front
from tests.refusal import refusal
from tests.runner.toy import files_of
from tests.stages.made import Killed, ran

NAMES = ("red", "green", "blue")


def observations(photo: str, materials, seed: int, size: int = 16, unit: float = 1.0) -> Observations:
    """A sphere of each of the materials under a light of two lobes, as `network` renders it."""
    normals = np.tile(sphere_normals(size), (len(materials), 1))
    material = np.repeat(materials, len(normals) // len(materials))
    empty = observations_from_front(normals, np.ones(normals.shape), material, NAMES, photo)
    (block,) = blocks_of_observations(empty, Noise())
    light = random_light(np.random.default_rng(seed), 2)
    radiance = Illumination(block, light, MATERIALS, reflection_operator("network")).radiance()
    return msgspec.structs.replace(empty, radiance=unit * radiance)


def run(folder, photos, progress=None, unfinished=None, start=None, light=None, known=None, files=None, **params):
    (urm := folder / "urm").mkdir(parents=True, exist_ok=True)
    for name, part in photos.items():
        write_observations(urm / f"{name}.parquet", part)
    light = light or {name: {"illumination": name, "world_from_camera": None} for name in photos}
    folders = {"urm": urm, "train": SHIPPED} | ({"start": start} if start else {})
    if (folder / "surface").is_dir():
        folders["surface"] = folder / "surface"
    facts = {"dataset.materials": list(NAMES), "dataset.light": light, "dataset.known": known or {}}
    inputs = Inputs(folders, facts, files or {}, unfinished=unfinished)
    joint = {"cells": 24, "splittings": 0, "observations": 150, "tone": "off"}
    quick = {"merge_degrees": 0.0} | (joint if params.get("solver") != "paper" else {})
    return ran(solve, inputs, folder / "out", progress, **quick | params)


def random_lobes(seed: int) -> Lobes:
    """The light of `observations` of that seed."""
    return random_light(np.random.default_rng(seed), 2).lobes


def table(folder):
    return read_json(folder / "materials.json")


@pytest.fixture(scope="module")
def linked():
    """Two photos that share the green material."""
    return {"a": observations("a", [0, 1], 1), "b": observations("b", [1, 2], 2)}


@pytest.fixture(scope="module")
def solved(tmp_path_factory, linked):
    return run(tmp_path_factory.mktemp("solved"), linked)


@pytest.fixture(scope="module")
def earlier(tmp_path_factory, linked):
    """A solution of the first photo alone, and what was said of it."""
    messages = []
    handler = logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())
    logging.getLogger().addHandler(handler)
    out = run(tmp_path_factory.mktemp("earlier"), {"a": linked["a"]})
    logging.getLogger().removeHandler(handler)
    return out, "\n".join(messages)


def test_radiance_below_0_of_colours_beyond_rec709_is_solved_as_hardly_any_reflectance(tmp_path, linked, solved):
    radiance = linked["a"].radiance.copy()
    radiance[linked["a"].material == linked["a"].material.min(), 2] *= -0.1
    out = run(tmp_path, linked | {"a": msgspec.structs.replace(linked["a"], radiance=radiance)}, tone="auto")
    wide, plain = (np.array(table(folder)["materials"]["red"]["diffuse"]) for folder in (out, solved))
    assert 0 <= wide[2] < 0.05 * plain[2] and (wide[:2] > 0.5 * plain[:2]).all()


def test_writes_the_fixed_artifacts(solved):
    assert set(table(solved)) == {"materials", "gauge", "model"}
    for name in NAMES:
        material = table(solved)["materials"][name]
        assert material["alpha"] == pytest.approx(material["roughness"] ** 2)
        assert len(material["diffuse"]) == len(material["specular"]) == len(material["stderr"]["diffuse"]) == 3
        assert (
            all(0 <= share <= 1 for share in material["prior_share"].values())
            and material["prior_share"]["specular"] > 0
        )
    lobes = pq.read_table(solved / "lobes.parquet").to_pydict()
    assert set(lobes["illumination"]) == {"a", "b"} and min(lobes["weight_r"]) >= 0
    assert read_json(solved / "exposures.json") == {"a": [1.0] * 3, "b": [1.0] * 3}
    assert (solved / "convergence.parquet").exists() and (solved / "uncertainty.json").exists()


def test_lights_are_cells_with_errors_and_coverage_and_splittings_are_said(tmp_path, linked):
    out = run(tmp_path, linked, splittings=1)
    model = table(out)["model"]
    splitting, *again = model["splitting_chosen_by"]
    measures = {
        "held_out_loss_with",
        "held_out_loss_without",
        "margin",
        "log_bayes_factor",
        "correlation",
        "width",
        "share",
        "warmth",
    }
    assert set(splitting) == {"kept", *measures}
    counts = [model["lobes"][name] - model["suns_chosen_by"][name]["kept"] for name in "ab"]
    assert model["light_prior"] and any(each["kept"] for each in (splitting, *again)) == (max(counts) > 24)
    assert all(count >= 24 for count in counts)
    assert min(min(m["stderr"]["diffuse"]) for m in table(out)["materials"].values()) > 0
    assert {p.stem for p in (out / "coverage").glob("*.exr")} == {"a", "b"}


def test_another_order_and_a_solve_that_was_killed_give_the_same_bytes(tmp_path, linked, solved):
    def killed_while_lights_are_fitted(done, total, text=""):
        if text.startswith("lights"):
            raise Killed

    photos = dict(reversed(linked.items()))
    with pytest.raises(Killed):
        run(tmp_path, photos, killed_while_lights_are_fitted, tmp_path / "unfinished")
    assert files_of(run(tmp_path, photos, unfinished=tmp_path / "unfinished")) == files_of(solved)


def test_brighter_photos_change_lights_not_materials(tmp_path, linked, solved):
    other = run(tmp_path, {"a": observations("a", [0, 1], 1, unit=8.0), "b": linked["b"]})
    for name in NAMES:
        a, b = (table(folder)["materials"][name]["diffuse"] for folder in (solved, other))
        np.testing.assert_allclose(a, b, rtol=1e-4)
    rows = [pq.read_table(folder / "lobes.parquet").to_pydict() for folder in (solved, other)]
    one, eight = (np.array(row["weight_g"])[np.array(row["illumination"]) == "a"] for row in rows)
    np.testing.assert_allclose(eight, 8 * one, rtol=1e-3, atol=1e-6)


def test_what_is_not_linked_or_not_observed_is_named_and_nothing_at_all_refused(tmp_path, caplog, earlier, linked):
    out, text = earlier
    assert "'blue' is observed in no photo" in text
    assert min(table(out)["materials"]["blue"]["diffuse"]) > 0.01, "about as bright as the others"
    run(tmp_path / "apart", {"a": linked["a"], "b": observations("b", [2], 2)})
    assert "2 sets that share no material" in caplog.text and "blue" in caplog.text
    refusal("no valid observation", run, tmp_path / "none", {"a": linked["a"].take(np.zeros(0, int))})


def test_the_papers_solver_writes_the_same_artifacts_and_takes_no_start(tmp_path, linked):
    how = {"solver": "paper", "operator": "network", "paper_lobes": 3, "paper_samplings": 1.0}
    out = run(tmp_path / "out", linked, **how)
    model = table(out)["model"]
    assert model["solver"] == "paper" and not model.get("light_prior") and set(table(out)["materials"]) == set(NAMES)
    assert model["lobes"] == {"a": 3, "b": 3}
    files = {"lobes.parquet", "exposures.json", "convergence.parquet", "uncertainty.json"}
    assert files <= {path.name for path in out.iterdir()}
    refusal("starts from the photos alone", run, tmp_path / "start", linked, start=tmp_path, **how)


@pytest.mark.parametrize(
    ("solver", "option", "value"),
    [("paper", "cells", 100), ("paper", "tone", "off"), ("joint", "paper_lobes", 8), ("joint", "paper_prior", 0.0)],
)
def test_an_option_of_the_other_solver_is_refused(tmp_path, linked, solver, option, value):
    caught = refusal("this option belongs to solve.solver", run, tmp_path, linked, solver=solver, **{option: value})
    assert caught.key == f"solve.{option}" and "solve.solver" in caught.cure


def test_a_start_gives_the_answer_from_nothing_and_is_said(tmp_path, linked, solved, earlier):
    warm, cold = table(run(tmp_path, linked, start=earlier[0])), table(solved)
    assert warm["model"]["started_from"] == {"materials": sorted(NAMES), "illuminations": ["a"]}
    assert "started_from" not in cold["model"]
    for name in NAMES:
        rough, expected = (result["materials"][name]["roughness"] for result in (warm, cold))
        assert rough == pytest.approx(expected, abs=0.03)


def test_a_known_material_is_written_as_it_was_given_and_said(tmp_path, linked, caplog):
    known = {"materials": {"green": {"diffuse": [0.2, 0.4, 0.25], "specular": None, "roughness": 0.4}}}
    out = table(run(tmp_path, linked, known=known))
    green, red = out["materials"]["green"], out["materials"]["red"]
    assert green["diffuse"] == [0.2, 0.4, 0.25] and green["roughness"] == 0.4
    assert green["given"] == ["diffuse", "roughness"] and "given" not in red
    assert green["stderr"]["diffuse"] == [0, 0, 0] and green["stderr"]["roughness"] == 0
    assert min(green["stderr"]["specular"]) > 0 and min(red["stderr"]["diffuse"]) > 0
    assert "come from these: green" in out["gauge"]["rule"] and "that alone is fixed" in out["gauge"]["stderr"]
    assert "by convention" not in caplog.text
    bright = {"materials": {"green": {"diffuse": [0.99, 0.99, 0.99], "specular": [0, 0, 0]}}}
    run(tmp_path / "bright", linked, known=bright)
    assert "more than falls on it" in caplog.text


def test_a_named_kind_chooses_the_class_and_fixes_no_value(tmp_path, linked):
    out = table(run(tmp_path, linked, known={"materials": {"green": {"kind": "metal"}}}))
    green = out["materials"]["green"]
    assert green["kind"] == {"name": "metal", "probability": 1.0} and "given" not in green
    assert "come from these" not in out["gauge"]["rule"]


def test_a_known_material_that_nothing_shows_and_another_solver_are_refused(tmp_path, linked):
    known = {"materials": {"blue": {"diffuse": [0.2, 0.4, 0.25]}}}
    refusal("no observation shows material 'blue'", run, tmp_path, {"a": linked["a"]}, known=known)
    refusal("cannot hold quantities fixed", run, tmp_path, linked, known=known, solver="paper")


def test_a_known_map_ball_and_exposures_are_held(tmp_path, linked, caplog):
    """A ball that mirrors half of the light stands beside the red sphere; the map of the other light is in other units."""
    light, both = random_lobes(1), observations("a", [0, 2], 1, size=40)
    ball = both.material == 2
    both.radiance[ball] = 0.5 * light.radiance(mirror_directions(both.normal[ball], both.view[ball]))
    write_rgb_exr(tmp_path / "b.exr", 9 * lat_long_of_lobes(random_lobes(2), 16, 32), LAT_LONG)
    again = msgspec.structs.replace(linked["b"], photos=("c",), radiance=linked["b"].radiance / 4)
    photos = {"a": both, "b": linked["b"], "c": again, "d": observations("d", [0, 1], 3)}
    known = {
        "materials": {"blue": {"diffuse": [0, 0, 0], "specular": [0.5, 0.5, 0.5]}},
        "balls": {"a": {"photo": "a", "material": "blue"}}, "maps": {"b": "b.exr"}, "exposure": {"b": 0, "c": -2},
    }  # fmt: skip
    lights = {k: {"illumination": "b" if k == "c" else k, "world_from_camera": None} for k in photos}
    out = run(tmp_path, photos, light=lights, known=known, files={"b.exr": tmp_path / "b.exr"}, splittings=1)
    result = read_lobes(out / "lobes.parquet")
    np.testing.assert_allclose(result["a"].energy, light.energy, rtol=0.05)
    shares = [one / one.sum() for one in (result["b"].energy, random_lobes(2).energy)]
    np.testing.assert_allclose(*shares, rtol=1e-3)
    assert read_json(out / "exposures.json")["c"] == [0.25] * 3
    solved = table(out)
    assert "come from these: blue, a" in solved["gauge"]["rule"] and "up to a factor" in solved["gauge"]["rule"]
    blue, red = solved["materials"]["blue"], solved["materials"]["red"]
    assert blue["given"] == ["diffuse", "specular", "roughness"] and blue["roughness"] == 0.1
    assert red["diffuse"] == pytest.approx(MATERIALS.diffuse[0].tolist(), rel=0.1)
    assert "'blue'" not in caplog.text
    small, fewer = {k: known[k] for k in ("balls", "materials")}, photos | {"a": observations("a", [0, 2], 1)}
    refusal("shows 192 pixels of the ball", run, tmp_path / "small", fewer, light=lights, known=small)


def test_a_held_out_photo_changes_no_answer_and_is_predicted(tmp_path, linked, solved):
    same_light = msgspec.structs.replace(observations("c", [0], 1), illuminations=("a",))
    own_light = observations("d", [1], 7)
    photos = linked | {"c": same_light, "d": own_light}
    light = {name: {"illumination": name, "world_from_camera": None} for name in linked}
    light |= {"c": {"illumination": "a", "world_from_camera": None, "held_out": True}}
    light |= {"d": {"illumination": "d", "world_from_camera": None, "held_out": True}}
    out = run(tmp_path, photos, light=light)
    for name in ("materials.json", "uncertainty.json", "convergence.parquet"):
        assert (out / name).read_bytes() == (solved / name).read_bytes()
    lobes, before = read_lobes(out / "lobes.parquet"), read_lobes(solved / "lobes.parquet")
    assert set(lobes) == {"a", "b", "d"} and (lobes["a"].weight == before["a"].weight).all()
    assert read_json(out / "exposures.json") == {name: [1.0] * 3 for name in "abcd"}
    # the light of its own explains the photo
    energy, true = (
        (lobe.weight * lobe_energy(lobe.sharpness)[:, None]).sum(0) for lobe in (lobes["d"], random_lobes(7))
    )
    material = table(out)["materials"]["green"]
    reflectance = np.add(material["diffuse"], material["specular"]) / (MATERIALS.diffuse + MATERIALS.specular)[1]
    np.testing.assert_allclose(energy * reflectance / true, 1, atol=0.25)


def test_lights_that_were_not_selected_are_fitted_to_the_materials_of_the_others(tmp_path, linked, solved):
    """By the photos that are not held out alone."""
    same_light = msgspec.structs.replace(observations("e", [1], 3), illuminations=("d",))
    photos = linked | {"d": observations("d", [1], 7), "e": same_light}
    light = {name: {"illumination": name, "world_from_camera": None} for name in "abd"}
    lobes = []
    for chosen in (photos, {name: photos[name] for name in "abd"}):
        folder = tmp_path / str(len(chosen))
        (folder / "surface").mkdir(parents=True)
        write_json(folder / "surface" / FILE, SurfaceTable(lights=["a", "b"]))
        held_out = {"e": {"illumination": "d", "world_from_camera": None, "held_out": True}} if "e" in chosen else {}
        out = run(folder, chosen, light=light | held_out)
        assert (out / "materials.json").read_bytes() == (solved / "materials.json").read_bytes()
        assert read_json(out / "exposures.json") == {name: [1.0] * 3 for name in chosen}
        lobes.append((out / "lobes.parquet").read_bytes())
    assert lobes[0] == lobes[1] and set(read_lobes(out / "lobes.parquet")) == {"a", "b", "d"}


def test_the_background_of_a_held_out_photo_tells_its_light(tmp_path, linked):
    """Where its surfaces, which face up, do not."""
    photo = observations("d", [1], 7)
    photo = photo.take(photo.normal[:, 1] < -0.3)
    directions = lat_long_directions(32, 64)
    below = directions[..., 1] < 0

    def true(seed: int) -> np.ndarray:
        return random_lobes(seed).radiance((directions @ YUP_FROM_CAMERA).reshape(-1, 3)).reshape(32, 64, 3)

    light = {name: {"illumination": name, "world_from_camera": None, "held_out": name == "d"} for name in "abd"}
    errors, tables = [], []
    for seeds in ({"a": 1, "b": 2}, {"a": 1, "b": 2, "d": 7}):
        folder = tmp_path / str(len(seeds)) / "urm/background"
        folder.mkdir(parents=True)
        for name, seed in seeds.items():
            write_rgb_exr(folder / f"{name}.exr", true(seed) * below[..., None], LAT_LONG)
        out = run(folder.parents[1], linked | {"d": photo}, light=light)
        estimate = lat_long_of_lobes(read_lobes(out / "lobes.parquet")["d"], 32, 64)
        errors.append(np.abs(np.log(estimate / true(7)))[below].mean())
        tables.append(table(out))
    assert tables[0] == tables[1] and tables[0]["model"]["background_chosen_by"]["b"]["kept"]
    assert errors[1] < 0.8 * errors[0]


def test_exposures_of_held_out_photos_follow_exif(tmp_path, linked):
    a, b = (msgspec.structs.replace(part, exposures=(1.0,)) for part in linked.values())
    c = msgspec.structs.replace(observations("c", [0], 1), illuminations=("a",), exposures=(4.0,))
    light = {name: {"illumination": name, "world_from_camera": None} for name in linked}
    light |= {"c": {"illumination": "a", "world_from_camera": None, "held_out": True}}
    out = run(tmp_path, {"a": a, "b": b, "c": c}, light=light)
    assert read_json(out / "exposures.json")["c"] == [4.0] * 3


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_held_out_photo_without_a_usable_value_gets_no_light_and_spoils_nothing(tmp_path, linked, solved, value):
    dark = observations("d", [1], 7)
    photos = linked | {"d": msgspec.structs.replace(dark, radiance=np.full_like(dark.radiance, value))}
    light = {name: {"illumination": name, "world_from_camera": None} for name in photos}
    light["d"]["held_out"] = True
    out = run(tmp_path, photos, light=light)
    assert (out / "materials.json").read_bytes() == (solved / "materials.json").read_bytes()
    assert set(read_lobes(out / "lobes.parquet")) == {"a", "b"}
