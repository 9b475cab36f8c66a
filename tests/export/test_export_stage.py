"""The stage `export`: gauge, files and bytes; materials as MaterialX and glTF, and what other programs show of them."""

import base64
import json
import struct
import xml.etree.ElementTree as ET
from functools import partial
from io import BytesIO

import msgspec
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from factorlib.conventions import FRONT, YUP_FROM_CAMERA
from factorlib.export.gltf_writer import EXTENSION, gltf_material, read_parts_of_glb, write_glb
from factorlib.export.materialx import materialx
from factorlib.export.mitsuba import headroom_factor, table_in_gauge
from factorlib.images.exr import read_rgb_exr
from factorlib.jsonfile import read_json, write_json
from factorlib.light.latlong import map_energy
from factorlib.meshes.mesh import Mesh
from factorlib.reflection import reflection_operator
from factorlib.results.lobe_table import read_lobes, write_lobes
from factorlib.results.materials import Gauge, MaterialTable, Reflectance, StandardErrors, attach_errors, read_materials
from factorlib.stage import silent
from stages import export
from tests.export import made_export
from tests.export.test_textures import colours_at
from tests.refusal import refusal
from tests.runner.toy import files_of
from tests.stages.made import ran

run = partial(ran, export, progress=silent, height=32, mitsuba_height=32)


@pytest.fixture
def inputs(tmp_path):
    return made_export.make(tmp_path)


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
    assert set(first) == {
        *(
            "dataset.json",
            "exposures.json",
            "lights.json",
            "lobes.parquet",
            "materials.json",
            "materials.mtlx",
        ),
        *("ball.glb", "egg.glb", "meshes/ball.ply", "meshes/egg.ply", "source/ball.obj", "source/egg.obj"),
        *("illumination/room_sky.exr", "illumination/room_suns.gltf"),
        *(f"illumination/{name}.{kind}" for name in ("front", "room") for kind in ("exr", "hdr")),
        *(f"scenes/{name}.{kind}" for name in ("front", "side") for kind in ("xml", "json")),
        *("scenes/blender.py", "scenes/light/front.exr", "scenes/light/room.exr"),
        *(f"scenes/meshes/{name}.ply" for name in ("ball.red", "egg.red", "egg.brass")),
    }
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
    meshes = {f"{name}.ply" for name in ("egg.unseen", "egg.2.red", "egg.2.brass")}
    assert {p.name for p in (out / "scenes" / "meshes").iterdir()} == meshes
    assert "egg.unseen.ply" in (out / "scenes" / "front.xml").read_text()
    assert "egg.2.red.ply" in (out / "scenes" / "side.xml").read_text()


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


# ── x ───────────────────────────────────────────────────────────────────────────────────────────────────────────────


def bright(scale: float) -> Reflectance:
    return Reflectance(*(tuple(scale * v for v in colour) for colour in ((0.9, 0.3, 0.2), (0.1, 0.2, 0.3))), 0.5)


CASES = {"bright": bright(0.8), "lambertian": Reflectance((0.2, 0.3, 0.4), (0, 0, 0), 0.9),
         "metal": Reflectance((0, 0, 0), (0.5, 0.4, 0.3), 0.2), "black": Reflectance((0, 0, 0), (0, 0, 0), 0.5)}  # fmt: skip


@pytest.mark.parametrize("scale", [0.1, 0.8, 1.0, 30.0])
def test_factor_leaves_headroom_and_touches_nothing_that_has_it(scale):
    materials = {"a": bright(scale), "b": bright(0.01)}
    factor = headroom_factor(materials)
    assert max(factor * m.total for m in materials.values()) <= 1 - 1e-5 + 1e-15
    assert factor == 1.0 if bright(scale).total < 1 - 1e-5 else factor < 1


def test_gauge_scales_reflectances_and_their_errors_only_and_says_so():
    before = attach_errors(Reflectance((0.8,) * 3, (0.4,) * 3, 0.3), StandardErrors((0.1,) * 3, (0.2,) * 3, 0.05))
    half = attach_errors(Reflectance((0.4,) * 3, (0.2,) * 3, 0.3), StandardErrors((0.05,) * 3, (0.1,) * 3, 0.05))
    result = table_in_gauge(MaterialTable({"a": before}, Gauge(rule="x")), 0.5)
    assert result.materials == {"a": half} and result.gauge.rule == "x" and result.gauge.export_factor == 0.5


def numbers(text: str) -> np.ndarray:
    return np.array([float(word) for word in text.split(",")])


def test_materialx_mixes_to_the_solved_reflectances_and_its_standard_surface_has_them_under_no_fresnel():
    root = ET.fromstring(materialx(CASES))
    value = {(n.get("name"), i.get("name")): i.get("value") for n in root for i in n}
    for name, material in CASES.items():
        weight, parts = float(value[f"m_{name}_bsdf", "mix"]), (("diffuse", "color"), ("specular", "color0"))
        diffuse, specular = (numbers(value[f"m_{name}_{part}", key]) for part, key in parts)
        np.testing.assert_allclose((1 - weight) * diffuse, material.diffuse, atol=1e-12)
        np.testing.assert_allclose(weight * specular, material.specular, atol=1e-12)
        assert numbers(value[f"m_{name}_specular", "roughness"]).tolist() == [material.alpha] * 2
        standard = {key: numbers(v) for (node, key), v in value.items() if node == f"m_{name}_standard_surface_surface"}
        specular, ior = standard["specular"], standard["specular_IOR"]
        assert ((ior - 1) / (ior + 1)) ** 2 > 1 - 5e-4 and standard["specular_roughness"] == material.roughness
        np.testing.assert_allclose(specular * standard["specular_color"], material.specular, atol=1e-12)
        np.testing.assert_allclose((1 - specular) * standard["base_color"], material.diffuse, atol=1e-12)
    named = {node.get("name") for node in root.iter("surfacematerial")}
    assert named == {f"m_{name}{more}" for name in CASES for more in ("", "_standard_surface")}


def test_materialx_is_valid_where_its_library_is_there():
    library = pytest.importorskip("MaterialX", reason='MaterialX is not installed: make setup EXTRAS="interchange"')
    document, standard = library.createDocument(), library.createDocument()
    library.loadLibraries(library.getDefaultDataLibraryFolders(), library.getDefaultDataSearchPath(), standard)
    document.importLibrary(standard)
    library.readFromXmlString(document, materialx(CASES, {"scenes/meshes/a.png": ["bright"], "b.png": ["metal"]}))
    assert document.validate() == (True, "")


def test_glb_keeps_the_mesh_and_gives_exact_reflectances(tmp_path):
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces, normals = np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.tile([0.0, 0, 1], (4, 1))
    mesh = Mesh(square, faces, normals, np.array([1, 3], np.int16), open=True)
    write_glb(tmp_path / "a.glb", mesh, ["bright", "unused", "metal"], CASES)
    result = trimesh.load(tmp_path / "a.glb")
    assert set(result.geometry) == {"bright", "metal"} and result.area == pytest.approx(1.0)
    tree = read_tree(tmp_path / "a.glb")
    assert tree["extensionsUsed"] == ["KHR_materials_specular"]
    for entry in tree["materials"]:
        material, core = CASES[entry["name"]], entry["pbrMetallicRoughness"]
        assert core["roughnessFactor"] == material.roughness and entry["doubleSided"]
        if entry["name"] == "metal":
            assert core["metallicFactor"] == 1 and core["baseColorFactor"] == [*material.specular, 1]
            continue
        more = entry["extensions"]["KHR_materials_specular"]
        f0 = 0.04 * np.array(more["specularColorFactor"])
        np.testing.assert_allclose(f0 + 1 / 75, material.specular, atol=1e-12)
        assert more["specularFactor"] == 1
        base = np.array(core["baseColorFactor"][:3])
        np.testing.assert_allclose(base * (1 - max(material.specular)), material.diffuse, atol=1e-12)
        assert core["metallicFactor"] == 0


def test_values_are_in_gltfs_ranges():
    """F0 rises steadily with k_s."""
    rng, last = np.random.default_rng(0), 0.0
    for k_s in np.linspace(0.001, 0.09, 30):
        specular = gltf_material(Reflectance((0.5, 0.4, 0.3), (k_s,) * 3, 0.4))["extensions"][EXTENSION]
        assert specular["specularFactor"] == 1 and last < specular["specularColorFactor"][0] <= 2
        last = specular["specularColorFactor"][0]
    for _ in range(100):
        share, diffuse, specular = rng.uniform(0, 0.99, 1), rng.uniform(0, 1, 3), rng.uniform(0, 1, 3)
        entry = gltf_material(Reflectance(tuple((1 - share) * diffuse), tuple(share * specular), rng.uniform()))
        core, more = entry["pbrMetallicRoughness"], entry.get("extensions", {}).get(EXTENSION)
        values = [*core["baseColorFactor"], core["metallicFactor"], core["roughnessFactor"]]
        assert 0 <= min(values) and max(values) <= 1
        assert more is None or (0 <= 0.04 * max(more["specularColorFactor"]) <= 1 and 0 <= more["specularFactor"] <= 1)


def test_variants_give_every_part_its_material_in_each_of_them(tmp_path):
    """Two parts of one material are two primitives where a variant tells them apart; without variants there is no extension."""
    rng = np.random.default_rng(0)
    vertices, faces = rng.uniform(size=(15, 3)), np.arange(15, dtype=np.int32).reshape(5, 3)
    labels = {"": [1, 1, 3, 3, 1], "legs: lambertian": [1, 2, 3, 3, 2], "all dark": [3, 3, 3, 3, 3]}
    normals, names = np.tile([0.0, 0, 1], (15, 1)), ["bright", "lambertian", "metal"]
    mesh, *others = (Mesh(vertices, faces, normals, np.array(each, np.int16)) for each in labels.values())
    write_glb(tmp_path / "a.glb", mesh, names, CASES, dict(zip([*labels][1:], others)))
    tree, result = read_tree(tmp_path / "a.glb"), trimesh.load(tmp_path / "a.glb").geometry
    parts = read_parts_of_glb(tmp_path / "a.glb")
    variants = tree["extensions"]["KHR_materials_variants"]["variants"]
    assert [each["name"] for each in variants] == [*labels][1:]
    assert "KHR_materials_variants" in tree["extensionsUsed"] and len(tree["materials"]) == 3
    for variant, own in labels.items():
        for face, label in enumerate(own):
            (holds,) = [n for n, part in result.items() if np.isclose(part.vertices, vertices[3 * face]).all(1).any()]
            assert parts[holds].materials[variant] == names[label - 1]
    for each in tree["meshes"]:
        mappings = each["primitives"][0]["extensions"]["KHR_materials_variants"]["mappings"]
        assert sorted(v for mapping in mappings for v in mapping["variants"]) == [0, 1]  # each once
    write_glb(tmp_path / "b.glb", mesh, names, CASES)
    plain = (tmp_path / "b.glb").read_bytes()
    assert b"variants" not in plain
    parts = read_parts_of_glb(tmp_path / "b.glb")
    assert {name: part.materials for name, part in parts.items()} == {n: {"": n} for n in ("bright", "metal")}


def test_every_variant_has_its_own_paint(tmp_path):
    """Base colour times the image at a vertex is the reflectance times the detail of the variant; plain ones have none."""
    detail, labels = np.array([[0.4, 0.5, 0.6], [0.8, 0.7, 0.6], [1.05, 1.0, 0.9]]), np.array([1], np.int16)
    mesh = Mesh(np.eye(3), np.array([[0, 1, 2]], np.int32), np.tile([0.0, 0, 1], (3, 1)), labels, detail=detail)
    dim = msgspec.structs.replace(mesh, face_label=labels + 1, detail=detail[::-1] * 1.5)
    bare = msgspec.structs.replace(mesh, face_label=labels + 2, detail=np.ones((3, 3)))
    write_glb(tmp_path / "a.glb", mesh, ["bright", "lambertian", "metal"], CASES, {"dim": dim, "bare": bare})
    ((_, part),) = trimesh.load(tmp_path / "a.glb").geometry.items()
    source = np.abs(part.vertices[:, None] - mesh.vertices).sum(-1).argmin(1)
    tree = read_tree(tmp_path / "a.glb")
    assert [entry["name"] for entry in tree["materials"]] == ["bright", "lambertian", "metal"]
    for entry, each in zip(tree["materials"][:2], (mesh, dim), strict=True):
        material, core = CASES[entry["name"]], entry["pbrMetallicRoughness"]
        uri = tree["images"][tree["textures"][core["baseColorTexture"]["index"]]["source"]]["uri"]
        with Image.open(BytesIO(base64.b64decode(uri.partition(",")[2]))) as image:
            shade = colours_at(np.asarray(image), part.visual.uv)
        base = 1 - max(material.specular)
        assert core["baseColorFactor"] == [1, 1, 1, 1]
        np.testing.assert_allclose(base * shade, each.detail[source] * material.diffuse, atol=0.005)
    assert "baseColorTexture" not in tree["materials"][2]["pbrMetallicRoughness"]


def read_tree(path) -> dict:
    """The JSON chunk of a GLB."""
    data = path.read_bytes()
    return json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
