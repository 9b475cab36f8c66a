"""Scenes as OpenUSD: text that is checked as text, and what the USD library reads of it."""

import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.export.exported_scene import ExportedScene, ExportedShape, ExposedMap
from factorlib.export.usd import shader_inputs, write_usd_scene
from factorlib.geometry.camera import Camera
from factorlib.images.exr import read_rgb_exr
from factorlib.meshes.ply import submesh
from factorlib.meshes.read import read_mesh
from factorlib.results.lobe_table import read_lobes
from factorlib.results.materials import Reflectance
from tests.export import made_export

ROWS = 256
PHOTOS = list(made_export.MESHES)
GLOSSY = Reflectance((0.4, 0.2, 0.1), (0.1, 0.2, 0.3), 0.45)
METAL = Reflectance((0, 0, 0), (0.8, 0.6, 0.4), 0.7)
LAMBERTIAN = Reflectance((0.5, 0.4, 0.3), (0, 0, 0), 0.2)
MISSING = 'OpenUSD is not installed: make setup EXTRAS="interchange"'


# as text -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def text_of(tmp_path):
    """The text of a scene in which every object has every material."""

    def written(objects=("chair",), materials=("red",), file="meshes/a.ply", exposure=(2.0, 1.0, 0.5)) -> str:
        place = np.arange(16.0).reshape(4, 4)
        place[3] = [0, 0, 0, 1]
        shapes = [ExportedShape(f"{name}.{each}", file, each, place, False) for name in objects for each in materials]
        light = ExposedMap("../illumination/a.exr", np.array(exposure), np.eye(3))
        scene = ExportedScene(Camera(64, 48, 100.0, (30.0, 20.0)), shapes, dict.fromkeys(materials, GLOSSY), light)
        write_usd_scene(tmp_path / "scene.usda", scene)
        return (tmp_path / "scene.usda").read_text()

    return written


def test_files_are_quoted_matrices_written_for_rows_and_exposure_is_intensity_times_colour(text_of):
    text, dark = text_of(), text_of(file="meshes/a@b.ply", exposure=(0, 0, 0))
    assert "references = @./meshes/a.usda@" in text and "references = @@@./meshes/a@b.usda@@@" in dark
    turned = "((0.0, -4.0, -8.0, 0.0), (1.0, -5.0, -9.0, 0.0), (2.0, -6.0, -10.0, 0.0), (3.0, -7.0, -11.0, 1.0))"
    assert f"matrix4d xformOp:transform = {turned}" in text
    assert "inputs:color = (1.0, 0.5, 0.25)" in text and "inputs:intensity = 2.0" in text
    assert "inputs:color = (1.0, 1.0, 1.0)" in dark and "inputs:intensity = 0.0" in dark


@pytest.mark.parametrize("material", [GLOSSY, METAL, LAMBERTIAN], ids=["glossy", "metal", "lambertian"])
def test_shader_reflects_what_was_solved_at_normal_incidence(material):
    found = shader_inputs(material)
    assert (found["useSpecularWorkflow"] == 0) == (material is METAL)
    if found["useSpecularWorkflow"]:
        f0, diffuse = found["specularColor"], found["diffuseColor"] * (1 - found["specularColor"])
    else:
        f0, diffuse = found["diffuseColor"], np.zeros(3)
        assert found["metallic"] == 1
    np.testing.assert_allclose(f0, material.specular)
    np.testing.assert_allclose(diffuse, material.diffuse)
    assert found["roughness"] == (material.roughness if any(material.specular) else 1.0)


# as the USD library reads it -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pxr():
    return pytest.importorskip("pxr", reason=MISSING)


def opened(exported, photo):
    from pxr import Usd

    return Usd.Stage.Open(str(exported[1] / "scenes" / f"{photo}.usda"))


def world_of(prim) -> np.ndarray:
    """world_from_prim, for columns."""
    from pxr import UsdGeom

    return np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim)).T


@pytest.mark.parametrize("photo", PHOTOS)
def test_usds_own_validators_find_nothing(pxr, exported, photo):
    validation = pytest.importorskip("pxr.UsdValidation", reason="this OpenUSD has no validators")
    stage = opened(exported, photo)
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    assert [error.GetErrorAsString() for error in validation.ValidationContext(validators).Validate(stage)] == []
    assert stage.Flatten().ExportToString() and not stage.GetCompositionErrors()


@pytest.mark.parametrize("photo", PHOTOS)
def test_vertices_stand_where_the_pose_puts_them(pxr, exported, photo):
    from pxr import UsdGeom

    stage, name, pose = opened(exported, photo), made_export.MESHES[photo], made_export.POSES[photo]
    entry = exported[0].facts["dataset.objects"][photo]["meshes"][name]
    mesh = read_mesh(exported[0].files[f"{name}.obj"], made_export.NAMES, entry["parts"])
    for label in mesh.labels:
        part = submesh(mesh, label)
        prim = stage.GetPrimAtPath(f"/scene/objects/chair/{made_export.NAMES[label - 1]}")
        found, place = UsdGeom.Mesh(prim), world_of(prim)
        points, normals = (np.array(attribute.Get()) for attribute in (found.GetPointsAttr(), found.GetNormalsAttr()))
        expected = pose.apply(part.vertices) @ YUP_FROM_CAMERA
        np.testing.assert_allclose(points @ place[:3, :3].T + place[:3, 3], expected, atol=2e-6)
        np.testing.assert_allclose(normals, part.normals, atol=1e-6)
        np.testing.assert_array_equal(np.array(found.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), part.faces)
        assert set(found.GetFaceVertexCountsAttr().Get()) == {3} and found.GetNormalsInterpolation() == "vertex"


@pytest.mark.parametrize("photo", PHOTOS)
def test_dome_shows_the_light_from_where_it_came(pxr, exported, photo):
    """By the layout that OpenUSD's DomeLight documents: OpenEXR's, up +y, longitude 0 at +z, π/2 at +x, from π to −π."""
    from pxr import UsdLux

    stage = opened(exported, photo)
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/scene/light"))
    file = dome.GetTextureFileAttr().Get().resolvedPath
    assert dome.GetTextureFormatAttr().Get() == "latlong" and file
    found = read_rgb_exr(file) * dome.GetIntensityAttr().Get() * np.array(dome.GetColorAttr().Get())
    name, world = ("front", np.eye(3)) if photo == "front" else ("room", made_export.WORLD_FROM_CAMERA["side"])
    light = read_lobes(exported[1] / "lobes.parquet")[name].scaled(made_export.EXPOSURES[photo][0]).turned(world.T)
    directions = lat_long_directions(8, 16).reshape(-1, 3)[16:-16] @ YUP_FROM_CAMERA
    x, y, z = (directions @ YUP_FROM_CAMERA @ world_of(dome.GetPrim())[:3, :3]).T
    rows, columns = (np.pi / 2 - np.arcsin(y)) / np.pi * ROWS, (np.pi - np.arctan2(x, z)) / (2 * np.pi) * 2 * ROWS
    expected = light.radiance(directions)
    assert expected.max() > 3 * np.median(expected)
    texels = found[rows.astype(int), columns.astype(int)]
    np.testing.assert_allclose(texels, expected, rtol=0.25, atol=0.01 * expected.max())
