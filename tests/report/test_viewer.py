"""The relighting viewer and the page's controls: what they are handed, and what a browser makes of it."""

import base64
import io
import json
import re
import shutil

import msgspec
import numpy as np
import pytest
import trimesh
from PIL import Image

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_solid_angles
from factorlib.dataset.schema import LightSlice, ObjectsSlice, SetSlice
from factorlib.export.gltf_writer import write_glb
from factorlib.generate.solids import sphere
from factorlib.images.exr import write_rgb_exr
from factorlib.images.picture import picture
from factorlib.meshes.mesh import Mesh
from factorlib.report import viewer
from factorlib.report.artifacts import Artifacts
from factorlib.report.pictures import light_row
from factorlib.results.materials import Reflectance
from tests.align.scenes import mesh_of
from tests.browser import BACK, CHROMIUM, HALF_FIELD, ball_seen, error, opened, rendered, shown
from tests.evaluate.made_artifacts import TRUE, lobes_of, perturbed
from tests.report.test_page import LINKED, page_of

SIZE = 64
WHY = "no Chromium on this machine (Debian: apt-get install chromium): no browser opens the page"
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason=WHY)


def artifacts(inputs) -> Artifacts:
    return Artifacts(inputs.folders, msgspec.convert(inputs.facts["dataset.set"], SetSlice))


def viewed(inputs) -> dict:
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    objects = msgspec.convert(inputs.facts["dataset.objects"], dict[str, ObjectsSlice])
    return viewer.viewer_data(artifacts(inputs), lights, objects, dict.fromkeys(LINKED, 1.0))


# ── What is handed over ──────────────────────────────────────────────────────────────────────────────────────────────


def numbers(text: str, kind: str, columns: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind).reshape(-1, columns)


def test_meshes_keep_their_shape_and_stand_as_in_the_photo(report_page):
    (result,), objects = (viewed(report_page[1])[name] for name in ("meshes", "objects"))
    assert (result["name"], result["simplified_from"]) == ("ball", None)
    assert [(each["photo"], each["mesh"]) for each in objects] == [(photo, 0) for photo in LINKED]
    for each in objects:
        assert np.allclose(np.reshape(each["rotation"], (3, 3)), YUP_FROM_CAMERA) and np.allclose(
            each["eye"], [0, 0, 1]
        )
        assert each["materials"] == ["brass", "red", "white"]
    vertices, normals = (
        numbers(result["vertices"], "<u2", 3) / 32767.5 - 1,
        numbers(result["normals"], "<i2", 3) / 32767,
    )
    assert np.allclose(np.linalg.norm(vertices, axis=1), 1, atol=4e-3)  # a sphere about its middle
    assert np.allclose(vertices, normals, atol=0.01)
    assert not numbers(result["sight"]["counts"], "<u2", 1).any()  # no convex mesh hides anything from itself


def floor_and_plate(open_=False) -> Mesh:
    """A floor in z = 0 and above its middle, at height 1, a disc of radius 1, each its own material; closed, or sheets."""
    floor, disc = trimesh.creation.box((3, 3, 0.1)), trimesh.creation.cylinder(1.0, 0.1, sections=64)
    floor.apply_translation([0, 0, -0.05])
    disc.apply_translation([0, 0, 1.05])
    if open_:
        for part in (floor, disc):
            part.update_faces(part.vertices[part.faces][..., 2].max(1) < part.bounds[1, 2] - 0.05)  # the lower side
    return mesh_of([floor, disc], [1, 2])


@pytest.mark.parametrize("open_", [False, True])
def test_under_a_plane_no_light_comes_from_above(tmp_path, open_):
    """The middle of the floor, or the upper side of its sheet, sees the disc's lower side within about 45° of the vertical, and the sky beside it."""
    white = TRUE["white"]
    write_glb(tmp_path / "two.glb", floor_and_plate(open_), ["red", "white"], {"red": white, "white": white})
    packed, _ = viewer._mesh(trimesh.load_scene(tmp_path / "two.glb", process=False).geometry, 1.0)
    sight, place = packed["sight"], numbers(packed["vertices"], "<u2", 3) / 32767.5 - 1
    normals, directions = numbers(packed["normals"], "<i2", 3) / 32767, numbers(sight["directions"], "<f4", 3)
    edges = [np.ptp(place[numbers(part, "<u4", 3)], axis=1).max() for part in packed["parts"]]
    assert packed["open"] == open_ and len(directions) == 256 and max(edges) < 0.2  # two triangles a side before
    counts = numbers(sight["counts"], "<u2", 1)[:, 0]
    vertex, k, occluder = (
        np.repeat(np.arange(len(counts)), counts),
        numbers(sight["hidden"], "u1", 1)[:, 0],
        numbers(sight["met"], "<u2", 1)[:, 0],
    )
    low, high = place[:, 2].min(), place[:, 2].max()
    ground = low if open_ else place[(normals[:, 2] > 0.9) & (place[:, 2] < 0), 2].min()
    upward = np.flatnonzero((np.abs(place[:, 2] - ground) < 1e-3) & (normals[:, 2] > 0.9))
    middle = upward[np.linalg.norm(place[upward, :2], axis=1).argmin()]
    mine, above = vertex == middle, np.flatnonzero(directions[:, 2] > 0.82)
    assert set(above) <= set(k[mine]) and (directions[k[mine], 2] > 0.55).all()
    assert (normals[occluder[mine], 2] < -0.9).all() and (place[occluder[mine], 2] > ground + 0.3).all()
    there = occluder < len(normals)
    assert (
        np.sum(normals[occluder[there]] * directions[k[there]], axis=1) < 0
    ).all() and there.any()  # the side that is met
    assert not np.isin(vertex, np.flatnonzero((normals[:, 2] > 0.9) & (place[:, 2] > high - 0.02))).any()


def test_large_meshes_are_simplified_and_the_page_says_so(report_page, tmp_path, monkeypatch):
    monkeypatch.setattr(viewer, "MOST_TRIANGLES", 2000)
    monkeypatch.setattr(viewer, "MOST_VERTICES", 1)  # no room for more vertices than it has
    (result,) = viewed(report_page[1])["meshes"]
    triangles = sum(len(numbers(part, "<u4", 3)) for part in result["parts"])
    assert result["simplified_from"] == len(sphere().faces) and triangles <= 2100
    assert "is simplified for this page" in page_of(report_page[1], tmp_path / "simplified")


def test_a_name_cannot_end_the_script(report_page, tmp_path):
    evil = "</script><script>alert(1)</script>"
    inputs, names, folders = report_page[1], ["brass", evil, "white"], {}
    for stage in ("export", "solve"):
        folders[stage] = shutil.copytree(inputs[stage], tmp_path / stage)
        table = folders[stage] / "materials.json"
        table.write_text(table.read_text().replace('"red"', json.dumps(evil)))
    facts = {**inputs.facts, "dataset.set": {**inputs.facts["dataset.set"], "materials": names}}
    write_glb(tmp_path / "export" / "ball.glb", sphere(0.5), names, dict.fromkeys(names, TRUE["red"]))
    html = page_of(msgspec.structs.replace(inputs, folders=inputs.folders | folders, facts=facts), tmp_path / "report")
    assert html.count("<script") == 2 and "alert(1)</" not in html
    data = re.search(r'id="viewer-data">(.*?)</script>', html, re.DOTALL).group(1)
    assert evil in json.loads(data)["materials"]


# ── In a browser ─────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def browser(report_page):
    """Not across processes: Playwright's loop lives in this one."""
    size, allowed = {"width": 1440, "height": 900}, ["clipboard-read", "clipboard-write"]
    with opened(report_page[0] / "report" / "index.html", viewport=size, permissions=allowed) as (page, complaints):
        page.evaluate(f"viewer.canvas.style.width = '{SIZE}px'")  # software draws slowly
        page.evaluate("viewer.canvas.scrollIntoView()")  # it draws only while it is seen
        yield page, complaints


@needs_chromium
@pytest.mark.parametrize(
    "material, view",
    [("brass", {"azimuth": 0.7, "elevation": -0.4, "turn": 1.1}), ("white", {"turn": -2.0})],
)
def test_it_shows_what_the_pipeline_renders(browser, material, view):
    """The glossiest material and the roughest; 2 % at the 95th percentile of pixels."""
    normals, views, inside = ball_seen(view.get("azimuth", 0.0), view.get("elevation", 0.0), SIZE)
    result = shown(browser[0], -1, material, "noon", view, SIZE)[inside]
    want = rendered(lobes_of(1), perturbed(TRUE[material], 1.0), normals, views, view.get("turn", 0.0))
    assert np.percentile(error(result[:, :3], want), 95) < 0.02 and np.allclose(result[:, 3], 1, atol=1e-5)


FURNACE = """() => {
  const of = (diffuse, specular) => ({ diffuse: Array(3).fill(diffuse), specular: Array(3).fill(specular), roughness: 0.2 });
  Object.assign(viewer.data.materials, { full: of(1, 0), none: of(0, 0), mirror: of(0, 1), ruby: { ...of(0, 0), diffuse: [1, 0, 0] } });
  viewer.data.lights.day = { face: 32, lobes: new Float32Array([0, 1, 0, 1e-3, 1, 1, 1]) };
  viewer.renderer.lights.clear();
}"""


@pytest.mark.long
@needs_chromium
def test_what_is_hidden_sends_what_it_gets(report_page, tmp_path):
    """In a sky of radiance 1 white is 1 everywhere, mirrored or not; the middle of the floor loses half of the light to a black disc, and two
    colours of that half to a red one; where the floor mirrors the black disc it is dark."""
    export = shutil.copytree(report_page[1]["export"], tmp_path / "export")
    write_glb(export / "ball.glb", floor_and_plate(), ["red", "white"], TRUE)
    page_of(
        msgspec.structs.replace(report_page[1], folders={**report_page[1].folders, "export": export}),
        tmp_path / "report",
    )
    azimuth = np.pi / 2 + np.radians(35)  # 35° above the floor, whose up is the camera's forward
    back, right = np.array([np.sin(azimuth), 0, np.cos(azimuth)]), np.array([np.cos(azimuth), 0, -np.sin(azimuth)])
    with opened(tmp_path / "report" / "index.html", viewport={"width": 1440, "height": 900}) as (page, complaints):
        page.evaluate(FURNACE)

        def seen(floor: str, disc: str, x: float) -> np.ndarray:
            """The radiance of the point (x, 0, 0) of the floor."""
            picture = shown(page, 0, "", "day", {"azimuth": azimuth, "materials": [floor, disc]}, SIZE)
            if floor == disc == "full":
                assert np.abs(picture[..., :3] - picture[..., 3:]).max() < 0.02
            point = np.array([x, 0, 0.5]) / np.linalg.norm([1.5, 1.5, 0.6])
            across = (point @ right) / (BACK - point @ back) / np.tan(HALF_FIELD)
            return picture[SIZE // 2, int((1 + across) / 2 * SIZE), :3]

        assert seen("full", "full", 0.0) == pytest.approx([1, 1, 1], abs=0.02)
        assert seen("full", "none", 0.0) == pytest.approx([0.5, 0.5, 0.5], abs=0.03)
        assert seen("full", "ruby", 0.0) == pytest.approx([1, 0.5, 0.5], abs=0.03)
        assert seen("mirror", "full", 1.2) == pytest.approx([1, 1, 1], abs=0.05)
        assert seen("mirror", "none", 1.2) == pytest.approx([0, 0, 0], abs=0.2)
        assert complaints == []


@needs_chromium
@pytest.mark.parametrize("simplified", [pytest.param(False, marks=pytest.mark.long), True])
def test_paint_is_shown_while_its_part_has_its_own_material(report_page, tmp_path, monkeypatch, simplified):
    """The left half of a ball has half of red's diffuse reflectance, the right half all of it."""
    monkeypatch.setattr(viewer, "MOST_TRIANGLES", 4000 if simplified else 10**6)
    export = shutil.copytree(report_page[1]["export"], tmp_path / "export")
    ball = sphere(0.5)
    detail = np.where(ball.vertices[:, :1] < 0, 0.5, 1.0) * np.ones(3)
    painted = msgspec.structs.replace(ball, detail=detail, face_label=np.full(len(ball.faces), 2, np.int16))
    red = msgspec.convert(json.loads((export / "materials.json").read_text())["materials"]["red"], Reflectance)
    write_glb(export / "ball.glb", painted, ["brass", "red", "white"], TRUE | {"red": red})
    folders = {**report_page[1].folders, "export": export}
    page_of(msgspec.structs.replace(report_page[1], folders=folders), tmp_path / "report")
    with opened(tmp_path / "report" / "index.html", viewport={"width": 1440, "height": 900}) as (page, complaints):
        page.evaluate(FURNACE)
        page.evaluate("Object.assign(viewer.data.materials.red, { specular: [0, 0, 0] })")

        def seen(material: str) -> np.ndarray:
            """The radiance in a sky of radiance 1, of the left and the right half."""
            picture = shown(page, 0, "", "day", {"materials": [material]}, SIZE)
            return picture[SIZE // 2, [SIZE // 3, 2 * SIZE // 3], :3]

        assert seen("") == pytest.approx(np.outer([0.5, 1.0], red.diffuse), abs=0.02)
        assert seen("red") == pytest.approx(np.outer([1.0, 1.0], red.diffuse), abs=0.02)
        assert complaints == []


@needs_chromium
def test_what_faces_the_eye_straight_is_not_black(browser):
    """Where a surface faces the eye straight, n·o rounds to more than 1; enlarged, many pixels of a ball do."""
    assert np.isfinite(shown(browser[0], -1, "brass", "noon", {"azimuth": 0.6, "zoom": 1000}, SIZE)).all()


@needs_chromium
def test_a_mesh_shows_its_parts_where_they_are(browser):
    """The set's own ball is cut into three materials by turns: on the whole it is as bright as their mean."""
    page = browser[0]
    page.evaluate("viewer.controls.object.selectedIndex = 0")
    script = """(material) => { const state = {...viewer.state(), materials: Array(3).fill(material)}; viewer.renderer.draw(state, 64, 0, 4);
      const pixels = new Float32Array(4 * 64 * 64), gl = viewer.renderer.gl;
      gl.readPixels(0, 0, 64, 64, gl.RGBA, gl.FLOAT, pixels); return pixels.reduce((a, b) => a + b); }"""
    own, *each = (page.evaluate(script, m) for m in ("", "red", "white", "brass"))
    assert own == pytest.approx(np.mean(each), rel=0.02)
    red, white, brass = each
    page.select_option("[data-control=materials] label:nth-child(1) select", label="white")  # the brass part alone
    changed = page.evaluate(script.replace("Array(3).fill(material)", "viewer.state().materials"))
    assert changed - own == pytest.approx((white - brass) / 3, rel=0.05)


def choose_brass_ball(page) -> None:
    """Choose a ball of brass in the light of noon."""
    page.select_option("[data-control=object]", label="a ball")
    page.select_option("[data-control=materials] select", label="brass")
    page.select_option("[data-control=light]", label="noon")


@needs_chromium
def test_controls_work_by_mouse_and_keys(browser):
    page, _ = browser
    choose_brass_ball(page)
    label = "document.querySelector('#viewer canvas').ariaLabel"
    page.wait_for_function(f"{label}.startsWith('a ball of brass in the light of noon')")
    page.focus("#viewer canvas")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowUp")
    page.wait_for_function(f"{label}.includes('from 5° to the right and 5° above')")
    box = page.locator("#viewer canvas").bounding_box()
    page.mouse.move(box["x"] + 20, box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 30, box["y"] + 20, steps=3)
    page.mouse.up()
    page.wait_for_function(f"!{label}.includes('from 5°')")
    page.fill("[data-control=turn]", "90")
    page.wait_for_function(f"{label}.endsWith('turned by 90°')")
    page.click("[data-control=reset]")
    page.wait_for_function(f"{label}.endsWith('turned by 0°')")
    assert "from 0° to the right" in page.get_attribute("#viewer canvas", "aria-label")


@needs_chromium
def test_the_picture_on_the_screen_is_the_radiance_exposed(browser):
    page, _ = browser
    frames = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    choose_brass_ball(page)
    page.click("[data-control=reset]")
    page.evaluate("viewer.canvas.scrollIntoView()")
    page.evaluate(frames)  # a busy machine has the passes of the picture before until then
    refining = "getComputedStyle(document.querySelector('[data-refining]')).visibility"
    page.wait_for_function(f"viewer.pass > 0 && {refining} === 'visible'")
    page.wait_for_function(f"viewer.canvas.width === {SIZE} && viewer.pass >= 128", timeout=120000)  # all passes
    page.evaluate(frames)  # what is drawn is on the screen
    assert page.evaluate(refining) == "hidden"
    exposure = page.evaluate("viewer.state().exposure")
    box = page.locator("#viewer canvas").bounding_box()
    clip = {"x": round(box["x"]), "y": round(box["y"]), "width": SIZE, "height": SIZE}
    shot = Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")
    normals, views, inside = ball_seen(0.0, 0.0, SIZE)
    want = picture(rendered(lobes_of(1), perturbed(TRUE["brass"], 1.0), normals, views), exposure).astype(float)
    assert np.median(np.abs(np.asarray(shot).astype(float)[inside] - want)) < 3


@pytest.mark.long
@needs_chromium
def test_no_object_burns_out(browser):
    """However bright the photo is, 98 % of the object's pixels come to at most 0.9; a dim one keeps its exposure, and no view changes either."""
    page = browser[0]
    for given in (100.0, 1e-3):
        page.evaluate(f"viewer.data.photos[0].exposure = {given}, viewer.renderer.metered = null")
        state = "{...viewer.state(), photo: viewer.data.photos[0], object: viewer.renderer.objects[0]}"
        exposure = page.evaluate(f"viewer.renderer.exposure({{...{state}, azimuth: 1, turn: 2, zoom: 3, sky: true}})")
        result = shown(page, 0, "", page.evaluate("viewer.data.photos[0].name"), size=64)
        bright = exposure * np.quantile(result[result[..., 3] > 0.99][:, :3].max(axis=1), 0.98)
        assert bright == pytest.approx(0.9, abs=0.05) if given > 1 else exposure == given
    page.evaluate("viewer.data.photos[0].exposure = 1, viewer.renderer.metered = null")
    assert browser[1] == []  # last, after everything above


@needs_chromium
def test_without_webgl_it_says_so(report_page, tmp_path):
    (tmp_path / "index.html").write_text(report_page[2].replace('canvas.getContext("webgl2"', 'null && ("webgl2"'))
    with opened(tmp_path / "index.html") as (page, complaints):
        assert "this browser offers no WebGL 2" in page.inner_text("#viewer-missing")
        assert not page.is_visible("#viewer") and complaints == []


def test_what_is_known_of_a_lamp_is_measured_by_the_lamp(report_page, tmp_path):
    """An error of twice the mean radiance is small where the light is brighter than that."""
    run = artifacts(report_page[1])
    export = shutil.copytree(report_page[1]["export"], tmp_path / "export")
    run = msgspec.structs.replace(run, folders={**run.folders, "export": export})
    light = run.rgb("export", "illumination/day")
    (export / "coverage").mkdir()
    write_rgb_exr(tmp_path / "export" / "coverage" / "day.exr", np.full_like(light, 2.0))
    area = lat_long_solid_angles(*light.shape[:2])[:, None] * np.ones(light.shape[1])
    grey = light.mean(axis=-1)
    bright = grey > 2 * (grey * area).sum() / (4 * np.pi)
    known = light_row(run, "day", ["day"], None)["known"]
    assert known == pytest.approx((bright * area).sum() / (4 * np.pi), abs=1e-3) and bright.any()
