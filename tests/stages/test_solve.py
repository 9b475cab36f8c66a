import logging

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest

from factorlib.errors import InputError
from factorlib.geometry.met import BINS, UNMET
from factorlib.jsonfile import read_json
from factorlib.model.illumination import Illumination
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.reflection import reflection_operator
from factorlib.reflection.network import SHIPPED
from factorlib.results.solution import FILES
from factorlib.solve.evidence import FOR
from factorlib.stage import Inputs, silent
from factorlib.urm.observations import Observations, write_observations
from stages import solve
from tests.scenes.problems import MATERIALS, random_light, sphere_normals

NAMES = ("red", "green", "blue")


def observations(photo: str, shown, seed: int, size: int = 20, unit: float = 1.0) -> Observations:
    """A sphere of each material of `shown` under a light of two lobes, as `network` renders it."""
    normals = sphere_normals(size)
    n = len(normals) * len(shown)
    empty = Observations(
        normal=np.tile(normals, (len(shown), 1)), view=np.tile([0.0, 0.0, -1.0], (n, 1)), radiance=np.ones((n, 3)),
        clipped=np.zeros((n, 3), bool), material=np.repeat(shown, len(normals)), photo=np.zeros(n, int),
        illumination=np.zeros(n, int), x=np.arange(n), y=np.zeros(n, int), weight=np.ones(n),
        materials=NAMES, photos=(photo,), illuminations=(photo,),
    )  # fmt: skip
    (block,) = blocks_of_observations(empty, Noise())
    light = random_light(np.random.default_rng(seed), 2)
    radiance = Illumination(block, light, MATERIALS, reflection_operator("network")).radiance()
    return Observations(
        **{f: getattr(empty, f) for f in empty.__struct_fields__ if f != "radiance"}, radiance=unit * radiance
    )


def run(folder, seen: dict[str, Observations], progress=silent, unfinished=None, start=None, light=None, **params):
    urm, out = folder / "urm", folder / "out"
    urm.mkdir(parents=True, exist_ok=True), out.mkdir(exist_ok=True)
    for name, part in seen.items():
        write_observations(urm / f"{name}.parquet", part)
    light = light or {name: {"illumination": name, "world_from_camera": None} for name in seen}
    folders = {"urm": urm, "train": SHIPPED} | ({"start": start} if start else {})
    inputs = Inputs(folders, {"dataset.materials": list(NAMES), "dataset.light": light}, unfinished=unfinished)
    quick = {"cells": 40, "splittings": 0, "observations": 300, "merge_degrees": 0.0}
    solve.main(solve.Params(**{**quick, **params}), inputs, out, progress)
    return out


@pytest.fixture(scope="module")
def linked():
    return {"a": observations("a", [0, 1], 1), "b": observations("b", [1, 2], 2)}


def test_writes_the_fixed_artifacts(tmp_path, linked):
    out = run(tmp_path, linked)
    found = read_json(out / "materials.json")
    assert set(found) == {"materials", "gauge", "model"}
    for name in NAMES:
        material = found["materials"][name]
        assert material["alpha"] == pytest.approx(material["roughness"] ** 2)
        assert len(material["diffuse"]) == len(material["specular"]) == len(material["stderr"]["diffuse"]) == 3
    lobes = pq.read_table(out / "lobes.parquet").to_pydict()
    assert set(lobes["illumination"]) == {"a", "b"}
    assert min(lobes["weight_r"]) >= 0
    assert read_json(out / "exposures.json") == {"a": [1.0] * 3, "b": [1.0] * 3}
    assert (out / "convergence.parquet").exists() and (out / "uncertainty.json").exists()


def test_lights_are_cells_with_errors_and_coverage_and_splittings_are_said(tmp_path, linked):
    out = run(tmp_path, linked, splittings=1)
    found = read_json(out / "materials.json")
    (splitting,) = found["model"]["splitting_chosen_by"]
    assert set(splitting) == {"kept", "held_out_loss_with", "held_out_loss_without", "margin"}
    cells = 40 + 3 * 24 * splitting["kept"]
    assert found["model"]["light_prior"] and found["model"]["lobes"] == {"a": cells, "b": cells}
    assert min(min(m["stderr"]["diffuse"]) for m in found["materials"].values()) > 0
    assert {p.stem for p in (out / "coverage").glob("*.exr")} == {"a", "b"}


def test_self_shadowing_is_chosen_by_held_out_observations_and_said(tmp_path, linked):
    def hidden(part, kind):
        random = np.random.default_rng(0).integers(0, 2, (len(part), 128))
        return msgspec.structs.replace(
            part, visibility=np.full_like(random, 255) if kind == "nothing" else 255 * random
        )

    few = {"cells": 24, "observations": 150, "tone": "off"}
    same = [
        run(tmp_path / "plain", linked, **few),
        run(tmp_path / "open", {k: hidden(v, "nothing") for k, v in linked.items()}, **few),
    ]
    for file in sorted(p.relative_to(same[0]) for p in same[0].rglob("*") if p.is_file()):
        assert (same[0] / file).read_bytes() == (same[1] / file).read_bytes(), file
    wrong = {k: hidden(v, "random") for k, v in linked.items()}  # radiance was made without
    models = {
        c: read_json(run(tmp_path / c, wrong, self_shadowing=c, **few) / "materials.json")["model"]
        for c in ("auto", "on", "off")
    }
    assert [models[c]["self_shadowing"] for c in ("auto", "on", "off")] == [False, True, False]
    evidence = models["auto"]["self_shadowing_chosen_by"]
    assert evidence["held_out_loss_without"] < evidence["held_out_loss_with"] and evidence["margin"] < -2
    for file in ("lobes.parquet", "uncertainty.json"):
        assert (tmp_path / "auto" / "out" / file).read_bytes() == (tmp_path / "off" / "out" / file).read_bytes(), file
    assert models["on"]["self_shadowing_chosen_by"] == {}


def test_interreflection_is_chosen_by_held_out_observations_said_and_kept_by_a_start(tmp_path, linked):
    def lit(part):
        hidden = np.random.default_rng(0).random((len(part), 64)) < 0.3
        met = np.where(hidden, part.material[:, None] * BINS, UNMET).astype(np.uint16)
        return msgspec.structs.replace(part, visibility=np.where(hidden, 0, 255).astype(np.uint8), met=met)

    seen = {k: lit(v) for k, v in linked.items()}
    few = {"cells": 24, "observations": 150, "tone": "off", "self_shadowing": "on"}
    tables = {
        c: read_json(run(tmp_path / c, seen, interreflection=c, **few) / "materials.json")
        for c in ("auto", "on", "off")
    }
    models = {c: table["model"] for c, table in tables.items()}
    assert models["on"]["interreflection"] and not models["off"]["interreflection"]
    evidence = models["auto"]["interreflection_chosen_by"]
    assert models["auto"]["interreflection"] == (evidence["margin"] > FOR)
    assert "no free factor" in tables["on"]["gauge"]["rule"] and "no free factor" not in tables["off"]["gauge"]["rule"]
    assert models["off"]["interreflection_chosen_by"] == {}
    earlier = tmp_path / "auto" / "out"
    again = read_json(run(tmp_path / "again", seen, start=earlier, **few) / "materials.json")["model"]
    assert again["interreflection"] == models["auto"]["interreflection"]
    assert len(again["interreflection_chosen_by"]) < 2  # as it was decided


def test_the_same_observations_give_the_same_bytes(tmp_path, linked):
    one, other = run(tmp_path / "1", linked), run(tmp_path / "2", dict(reversed(linked.items())))
    for file in sorted(p.relative_to(one) for p in one.rglob("*") if p.is_file()):
        assert (one / file).read_bytes() == (other / file).read_bytes(), file


def test_brighter_photos_change_lights_not_materials(tmp_path, linked):
    brighter = {"a": observations("a", [0, 1], 1, unit=8.0), "b": linked["b"]}
    one, other = run(tmp_path / "1", linked), run(tmp_path / "2", brighter)
    a, b = (read_json(folder / "materials.json")["materials"] for folder in (one, other))
    for name in NAMES:
        np.testing.assert_allclose(a[name]["diffuse"], b[name]["diffuse"], rtol=1e-4)
    weights = [np.array(pq.read_table(f / "lobes.parquet").to_pydict()["weight_g"]) for f in (one, other)]
    is_a = np.array(pq.read_table(one / "lobes.parquet").to_pydict()["illumination"]) == "a"
    np.testing.assert_allclose(weights[1][is_a], 8 * weights[0][is_a], rtol=1e-3, atol=1e-6)


def test_photos_that_are_not_linked_are_named(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        run(tmp_path, {"a": observations("a", [0, 1], 1), "b": observations("b", [2], 2)})
    assert "2 sets that share no material" in caplog.text
    assert "blue" in caplog.text


def test_a_material_nobody_saw_is_named(tmp_path, caplog, linked):
    with caplog.at_level(logging.WARNING):
        out = run(tmp_path, {"a": linked["a"]})
    assert "'blue' is observed in no photo" in caplog.text
    assert np.isfinite(read_json(out / "materials.json")["materials"]["blue"]["diffuse"]).all()


def test_nothing_to_see_is_an_error_that_says_where_to_look(tmp_path, linked):
    with pytest.raises(InputError, match="no valid observation"):
        run(tmp_path, {"a": linked["a"].take(np.zeros(0, int))})


def test_the_papers_solver_writes_the_same_artifacts(tmp_path, linked):
    out = run(tmp_path, linked, solver="paper", operator="network", paper_lobes=3, paper_samplings=1.0)
    found = read_json(out / "materials.json")
    assert found["model"]["solver"] == "paper"
    assert found["model"]["lobes"] == {"a": 3, "b": 3}
    assert set(found["materials"]) == set(NAMES)
    assert {"lobes.parquet", "exposures.json", "convergence.parquet", "uncertainty.json"} <= {
        p.name for p in out.iterdir()
    }


def test_the_solver_of_few_lobes_writes_the_same_artifacts(tmp_path, linked):
    few = {"lobes": 6, "insert": 4, "rounds": 2, "iterations": 3, "polish": 2, "sample": 100}
    out = run(tmp_path, linked, solver="few_lobes", **few)
    found = read_json(out / "materials.json")
    assert found["model"]["solver"] == "few_lobes" and not found["model"]["light_prior"]
    assert max(found["model"]["lobes"].values()) <= 6 and set(found["materials"]) == set(NAMES)
    assert {"lobes.parquet", "exposures.json", "convergence.parquet", "uncertainty.json"} <= {
        p.name for p in out.iterdir()
    }


class Killed(Exception):
    pass


def test_a_killed_solve_goes_on_to_the_same_bytes(tmp_path, linked):
    said = []

    def killed_while_lights_are_fitted(done, total, text=""):
        said.append(text)
        if text.startswith("lights"):
            raise Killed

    whole = run(tmp_path / "whole", linked)
    with pytest.raises(Killed):
        run(tmp_path / "killed", linked, killed_while_lights_are_fitted, tmp_path / "unfinished")
    out = run(tmp_path / "killed", linked, unfinished=tmp_path / "unfinished")
    for file in sorted(p.relative_to(whole) for p in whole.rglob("*") if p.is_file()):
        assert (whole / file).read_bytes() == (out / file).read_bytes(), file


def test_a_start_gives_the_answer_from_nothing_and_is_said(tmp_path, linked):
    first = run(tmp_path / "first", {"a": linked["a"]})
    cold = run(tmp_path / "cold", linked)
    warm = run(tmp_path / "warm", linked, start=first)
    a, b = (read_json(folder / "materials.json") for folder in (warm, cold))
    assert a["model"]["started_from"] == {"materials": sorted(NAMES), "illuminations": ["a"]}
    assert "started_from" not in b["model"]
    for name in NAMES:
        assert a["materials"][name]["roughness"] == pytest.approx(b["materials"][name]["roughness"], abs=0.03)


@pytest.mark.parametrize("solver", ["paper", "few_lobes"])
def test_other_solvers_take_no_start(tmp_path, linked, solver):
    with pytest.raises(InputError, match="starts from nothing"):
        run(tmp_path, linked, solver=solver, start=tmp_path)


@pytest.mark.parametrize(
    "file, old, new, words",
    [
        ("materials.json", '"roughness"', '"rougness"', "missing required field `roughness`"),
        ("materials.json", '"diffuse": [', '"diffuse": [-1, ', "of length 3"),
        ("materials.json", '"component": {', '"component": {"gold": 0, ', "names other materials"),
        ("materials.json", "{", "(", "not readable as JSON"),
        ("exposures.json", "1.0", "0.0", "not a positive number"),
        ("exposures.json", "1.0", '"one"', "Expected `float`"),
        ("lobes.parquet", None, None, "not readable as a table of lobes"),
    ],
)
def test_a_start_that_is_none_says_which_file_and_what_to_do(tmp_path, a_result, linked, file, old, new, words):
    folder = tmp_path / "earlier"
    folder.mkdir()
    for name in FILES:
        (folder / name).write_bytes((a_result / name).read_bytes())
    path = folder / file
    path.write_bytes(b"rows") if old is None else path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError) as caught:
        run(tmp_path, linked, start=folder)
    assert words in str(caught.value) and str(path) in str(caught.value) and caught.value.cure


@pytest.fixture(scope="module")
def a_result(tmp_path_factory, linked):
    return run(tmp_path_factory.mktemp("result"), linked)


def of_one_room(exposures: dict[str, float], said: dict[str, float | None]) -> dict[str, Observations]:
    """Photos of three spheres in one light, `exposures` times as bright, whose EXIF says `said`."""
    return {
        name: msgspec.structs.replace(
            observations(name, [0, 1, 2], 1, 8, unit), illuminations=("room",), exposures=(said[name],)
        )
        for name, unit in exposures.items()
    }


def exposures_of(folder, seen, **params):
    light = {name: {"illumination": "room", "world_from_camera": None} for name in seen}
    out = run(folder, seen, light=light, tone="off", **params)
    return {name: factors[0] for name, factors in read_json(out / "exposures.json").items()}


def test_photos_of_one_light_start_from_what_exif_says_of_their_exposures(tmp_path):
    true = {"a": 1.0, "b": 64.0}  # six stops
    found = exposures_of(tmp_path / "said", of_one_room(true, {"a": 0.5, "b": 30.0}))
    assert found["a"] == 1 and found["b"] == pytest.approx(64, rel=0.1)
    unsaid = exposures_of(tmp_path / "unsaid", of_one_room(true, {"a": 0.5, "b": None}))
    assert abs(np.log(unsaid["b"] / 64)) > abs(np.log(found["b"] / 64))


def test_exif_of_a_photo_made_brighter_later_is_only_where_the_solve_starts(tmp_path, caplog):
    found = exposures_of(tmp_path, of_one_room({"a": 1.0, "b": 1.2}, {"a": 1.0, "b": 3.0}))
    assert found["b"] == pytest.approx(1.2, rel=0.02)
    assert "photo 'b': by its EXIF its exposure is 3 of its light's first photo" in caplog.text
