"""The stage `export`: gauge, files, and bytes."""

import msgspec
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from factorlib.conventions import FRONT, YUP_FROM_CAMERA
from factorlib.images.exr import read_rgb_exr
from factorlib.jsonfile import read_json, write_json
from factorlib.light.latlong import map_energy
from factorlib.reflection import reflection_operator
from factorlib.results.lobe_table import read_lobes, write_lobes
from factorlib.results.materials import read_materials
from factorlib.stage import silent
from stages import export
from tests.export import made_export
from tests.refusal import refusal
from tests.runner.toy import files_of

SMALL = export.Params(height=32, mitsuba_height=32)


@pytest.fixture
def inputs(tmp_path):
    return made_export.make(tmp_path)


def run(inputs, out, params=SMALL):
    out.mkdir()
    export.main(params, inputs, out, silent)
    return out


def test_exported_materials_in_exported_lights_are_the_solved_ones(inputs, tmp_path):
    out, operator = run(inputs, tmp_path / "out"), reflection_operator("closed_form", dtype="float64")
    solved, exported = (read_materials(f / "materials.json").materials for f in (inputs["solve"], out))
    lobes, normal = read_lobes(out / "lobes.parquet"), torch.tensor(FRONT[None])
    for name, light in made_export.lights().items():
        for material in solved:
            expected = operator(light, solved[material], normal, normal)
            np.testing.assert_allclose(operator(lobes[name], exported[material], normal, normal), expected, rtol=1e-6)
        energy = map_energy(read_rgb_exr(out / "illumination" / f"{name}.exr"))
        np.testing.assert_allclose(energy, lobes[name].energy, rtol=1e-4)
    assert max(m.total for m in exported.values()) <= 1 - 1e-5 + 1e-12
    assert read_json(out / "materials.json")["gauge"]["export_factor"] == pytest.approx((1 - 1e-5) / 1.1)


def test_files_are_all_there_and_the_same_bytes_again(inputs, tmp_path):
    first, second = (files_of(run(inputs, tmp_path / name)) for name in ("one", "two"))
    expected = {
        "dataset.json",
        "exposures.json",
        "lights.json",
        "illumination/room_sky.exr",
        "illumination/room_suns.gltf",
        "lobes.parquet",
        "losses.json",
        "ball.glb",
        "egg.glb",
        "meshes/ball.ply",
        "meshes/egg.ply",
        "materials.json",
        "materials.mtlx",
        "source/ball.obj",
        "source/egg.obj",
    }
    expected |= {f"illumination/{name}.{kind}" for name in ("front", "room") for kind in ("exr", "hdr")}
    expected |= {f"scenes/{name}.{kind}" for name in ("front", "side") for kind in ("xml", "json", "usda")}
    expected |= {"scenes/blender.py", "scenes/light/front.exr", "scenes/light/room.exr"}
    for name in ("ball.red", "egg.red", "egg.brass"):
        expected |= {f"scenes/meshes/{name}.{kind}" for kind in ("ply", "usda")}
    assert set(first) == expected
    assert first == second


def test_scenes_have_the_bounces_that_the_solve_chose(inputs, tmp_path):
    file = inputs["solve"] / "materials.json"
    table = read_json(file)
    for bounces, depth in ((False, 2), (True, -1)):
        write_json(file, table | {"model": {"self_shadowing": True, "interreflection": bounces}})
        scene = (run(inputs, tmp_path / str(bounces)) / "scenes" / "front.xml").read_text()
        assert f'name="max_depth" value="{depth}"' in scene


def test_another_choice_of_materials_for_a_mesh_gets_its_own_files(inputs, tmp_path):
    facts = msgspec.to_builtins(inputs.facts)
    facts["dataset.objects"]["front"] = facts["dataset.objects"]["side"] | {
        "objects": [{"name": "chair", "mesh": "egg", "materials": {"upper": "unseen", "lower": "unseen"}}]
    }
    out = run(msgspec.structs.replace(inputs, facts=facts), tmp_path / "out")
    meshes = {f"{name}.{kind}" for name in ("egg.unseen", "egg.2.red", "egg.2.brass") for kind in ("ply", "usda")}
    assert {p.name for p in (out / "scenes" / "meshes").iterdir()} == meshes
    assert "egg.unseen.ply" in (out / "scenes" / "front.xml").read_text()
    assert "egg.2.red.ply" in (out / "scenes" / "side.xml").read_text()
    assert "@./meshes/egg.2.red.usda@" in (out / "scenes" / "side.usda").read_text()


def test_a_coloured_exposure_has_a_map_of_its_own(inputs, tmp_path):
    write_json(inputs["solve"] / "exposures.json", {"front": [1, 1, 1], "side": [2.0, 1.0, 0.5]})
    out = run(inputs, tmp_path / "out")
    own, shared = (read_rgb_exr(out / "scenes" / "light" / name) for name in ("side.exposed.exr", "room.exr"))
    np.testing.assert_allclose(own, shared * [2.0, 1.0, 0.5], rtol=1e-5)
    assert "side.exposed.exr" in (out / "scenes" / "side.xml").read_text()


def test_suns_are_said_once_in_every_form(inputs, tmp_path):
    """The sky and the sun together are the map; glTF's light shines where lights.json says."""
    out = run(inputs, tmp_path / "out")
    lights, tree = read_json(out / "lights.json"), read_json(out / "illumination/room_suns.gltf")
    assert lights["front"] == [] and not (out / "illumination/front_sky.exr").exists()
    (sun,), (light,), (node,) = lights["room"], tree["extensions"]["KHR_lights_punctual"]["lights"], tree["nodes"]
    whole, sky = (map_energy(read_rgb_exr(out / f"illumination/room{kind}.exr")) for kind in ("", "_sky"))
    np.testing.assert_allclose(whole - sky, sun["irradiance"], rtol=1e-3)
    np.testing.assert_allclose(Rotation.from_quat(node["rotation"]).apply([0, 0, 1]), sun["direction"], atol=1e-6)
    np.testing.assert_allclose(np.array(light["color"]) * light["intensity"], sun["irradiance"], rtol=1e-6)
    expected = YUP_FROM_CAMERA @ made_export.WORLD_FROM_CAMERA["side"] @ made_export.SUN_DIRECTION
    np.testing.assert_allclose(sun["direction"], expected, atol=1e-6)


def test_a_light_that_is_called_as_the_sky_of_another_is_refused(inputs, tmp_path):
    lobes = made_export.lights()
    write_lobes(inputs["solve"] / "lobes.parquet", lobes | {"room_sky": lobes["front"]})
    facts = msgspec.to_builtins(inputs.facts)
    facts["dataset.light"]["front"]["illumination"] = "room_sky"
    refusal("room_sky", run, msgspec.structs.replace(inputs, facts=facts), tmp_path / "out")
