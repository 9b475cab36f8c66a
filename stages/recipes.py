"""Pictures that a recipe asks for: the photos' objects from another side, in other light, of other material, with a further object.

Writes for each photo <photo>.png (8-bit sRGB) and <photo>.exr (linear), or <photo>/<light>.…, an animation <photo>.gif with its frames
<photo>/000.png …, or one grid.png.
"""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.dataset.schema import GroundSlice, LightSlice, MeshEntry, ObjectEntry, ObjectsSlice
from factorlib.errors import InputError
from factorlib.images.exr import read_exr, write_exr, write_rgb_exr
from factorlib.images.light_map import read_light_map
from factorlib.images.picture import exposure_of, picture, write_gif, write_png
from factorlib.images.tone import shown
from factorlib.meshes.limits import NO_LIMITS
from factorlib.meshes.mesh import Mesh, scaled
from factorlib.meshes.read import CREASE_DEG, read_mesh
from factorlib.recipe import schema
from factorlib.recipe.schema import is_light_file, is_mesh_file, recipe_of
from factorlib.render.ground import Plane, resting_plane
from factorlib.render.insertion import ball, inserted, spot_at, spot_beside, stood
from factorlib.render.photo_light import light_of
from factorlib.render.photo_scene import (
    ALL_BOUNCES,
    DIRECT,
    Light,
    PhotoScene,
    Placed,
    lit_ball,
    orbit,
    resized,
    traced_photo,
    turned_light,
    world_from_camera_frame,
)
from factorlib.results.materials import MaterialTable, Reflectance, read_materials, reflectances
from factorlib.results.poses import PhotoPoses, read_poses
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.recipes")
MOST_REFLECTED = 0.999  # max k_d + max k_s of a material of one's own


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How meshes are read; what pictures show stands in the recipe."""

    crease_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = CREASE_DEG
    """Angle, in degrees, between the normals of two triangles above which the edge between them stays sharp."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Make the pictures of one recipe."""
    recipe = recipe_of(inputs.facts["recipe"])
    results = Results(params, inputs)
    if isinstance(recipe, schema.Grid):
        return write_grid(recipe, results, out, progress)
    photos = recipe.photos or list(results.poses)
    draw = DRAWN[type(recipe)]
    for done, photo in enumerate(photos):
        draw(recipe, results, photo, out, _part(progress, done, len(photos), photo))
    progress(len(photos), len(photos))


def _part(progress: Progress, done: int, total: int, photo: str) -> Callable[[float], None]:
    """Says how much of one photo's pictures is done."""
    return lambda share: progress(done + share, total, photo)


Report = Callable[[float], None]


# ── the photo's own pixels and path-traced objects ───────────────────────────────────────────────────────────────────


def resynthesis(recipe: schema.Resynthesis, results: "Results", photo: str, out: Path, report: Report) -> None:
    """Path-traced objects over the photo's background."""
    report(0)
    traced = traced_photo(results.scene(photo), recipe.samples)
    _write(out / photo, _over(results.photo(photo), traced, results.tone(photo)))


def transfer(recipe: schema.Transfer, results: "Results", photo: str, out: Path, report: Report) -> None:
    """The same with other materials."""
    report(0)
    known, scene = results.known(recipe.table), results.scene(photo)
    materials = {name: known[recipe.materials.get(name, name)] for name in scene.materials}
    traced = traced_photo(msgspec.structs.replace(scene, materials=materials), recipe.samples)
    _write(out / photo, _over(results.photo(photo), traced, results.tone(photo)))


def insertion(recipe: schema.Insert, results: "Results", photo: str, out: Path, report: Report) -> None:
    """A further object on the ground of one that is there."""
    scene = results.scene(photo)
    neighbour = next((each for each in scene.objects if each.name == recipe.beside), scene.objects[0])
    plane, diffuse = results.ground(photo, neighbour)
    known = results.known(recipe.table)
    mesh, names, up = results.mesh(recipe.mesh, recipe.material, recipe.up)
    if recipe.at is not None:
        spot = spot_at(scene, plane, neighbour, recipe.at, recipe.size)
    else:
        tall = np.ptp(mesh.vertices @ up)
        wide = 2 * float(np.linalg.norm(np.cross(mesh.vertices - mesh.centre, up), axis=1).max())
        spot = spot_beside(scene, plane, neighbour, recipe.size, wide / tall)
    new = stood("inserted", mesh, names, up, recipe.turn, spot)
    gloss = Reflectance((0.0,) * 3, recipe.ground.specular, recipe.ground.roughness) if any(recipe.ground.specular) else None
    found = inserted(
        msgspec.structs.replace(scene, materials={**scene.materials, **known}),
        new,
        spot,
        results.photo(photo),
        results.covered(photo),
        recipe.samples,
        diffuse=diffuse,
        gloss=gloss,
        shown=results.tone(photo),
        report=lambda done, total: report(done / total),
    )
    _write(out / photo, found.composite)


# ── pictures of the objects alone ────────────────────────────────────────────────────────────────────────────────────


def view(recipe: schema.View, results: "Results", photo: str, out: Path, report: Report) -> None:
    """From another side."""
    report(0)
    scene = resized(results.scene(photo), recipe.width)
    camera = orbit(scene, recipe.azimuth, recipe.elevation, recipe.zoom)
    traced = traced_photo(scene, recipe.samples, world_from_camera=camera, with_light=recipe.background == "light")
    _write_alone(out / photo, traced, results.tone(photo))


def turntable(recipe: schema.Turntable, results: "Results", photo: str, out: Path, report: Report) -> None:
    """Once around."""
    scene, frames = resized(results.scene(photo), recipe.width), []
    for k in range(recipe.frames):
        report(k / recipe.frames)
        camera = orbit(scene, 360 * k / recipe.frames)
        frames.append(traced_photo(scene, recipe.samples, world_from_camera=camera, with_light=recipe.background == "light"))
    _write_animation(out, photo, frames, results.tone(photo), recipe.seconds)


def moving_light(recipe: schema.MovingLight, results: "Results", photo: str, out: Path, report: Report) -> None:
    """The light turns once."""
    scene, frames = resized(results.scene(photo), recipe.width), []
    for k in range(recipe.frames):
        report(k / recipe.frames)
        turned = msgspec.structs.replace(scene, light=turned_light(scene.light, 360 * k / recipe.frames))
        frames.append(traced_photo(turned, recipe.samples))
    _write_animation(out, photo, frames, results.tone(photo), recipe.seconds)


def relight(recipe: schema.Relight, results: "Results", photo: str, out: Path, report: Report) -> None:
    """In other photos' lights, or those of files: shown as the light's own photo would be, or exposed for the objects."""
    scene = resized(results.scene(photo), recipe.width)
    lights = recipe.lights or [name for name in results.poses if name != photo]
    for k, name in enumerate(lights):
        report(k / len(lights))
        lit = msgspec.structs.replace(scene, light=turned_light(results.light(name), recipe.rotate))
        traced = traced_photo(lit, recipe.samples, with_light=recipe.background == "light")
        exposure = exposure_of(traced[..., :3], traced[..., 3] > 0.5) if is_light_file(name) else 1.0
        _write_alone(out / photo / Path(name).stem, traced * np.array([exposure] * 3 + [1.0]), lambda radiance: radiance)


DRAWN = {
    schema.Resynthesis: resynthesis,
    schema.Transfer: transfer,
    schema.Insert: insertion,
    schema.View: view,
    schema.Turntable: turntable,
    schema.MovingLight: moving_light,
    schema.Relight: relight,
}


def write_grid(recipe: schema.Grid, results: "Results", out: Path, progress: Progress) -> None:
    """Balls of materials (rows) in lights (columns), each column exposed for all its balls."""
    materials = recipe.materials or list(results.table.materials)
    lights = recipe.lights or list(results.poses)
    columns, total = [], len(materials) * len(lights)
    for k, name in enumerate(lights):
        light, balls = results.light(name), []
        for j, material in enumerate(materials):
            progress(k * len(materials) + j, total, f"{material}, {name}")
            balls.append(lit_ball(light, results.materials[material], recipe.size, recipe.samples))
        column = np.concatenate(balls)
        exposure = exposure_of(column[..., :3], column[..., 3] > 0.5)
        columns.append(column * np.array([exposure] * 3 + [1.0]))
    _write_alone(out / "grid", np.concatenate(columns, axis=1), lambda radiance: radiance)
    (out / "grid.txt").write_text(f"rows: {', '.join(materials)}\ncolumns: {', '.join(lights)}\n", encoding="utf-8")
    progress(total, total)


# ── what was solved ──────────────────────────────────────────────────────────────────────────────────────────────────


class Results:
    """The solved materials, lights and poses, and the photos; each is read when first asked for."""

    def __init__(self, params: Params, inputs: Inputs):
        self.inputs, self.crease_deg = inputs, params.crease_deg
        self.names: list[str] = inputs.facts["dataset.materials"]
        self.objects = msgspec.convert(inputs.facts["dataset.objects"], dict[str, ObjectsSlice])
        self.lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
        self.grounds = msgspec.convert(inputs.facts["dataset.ground"], dict[str, GroundSlice])
        self.poses: dict[str, PhotoPoses] = read_poses(inputs["align"] / "poses.json")
        self.table: MaterialTable = read_materials(inputs["export"] / "materials.json")
        self.materials = reflectances(self.table)
        self._meshes: dict[tuple, Mesh] = {}

    def scene(self, photo: str) -> PhotoScene:
        """The photo's objects, in their poses, in its light."""
        poses, objects = self.poses[photo], self.objects[photo]
        if not objects.objects:
            raise InputError("the photo has no objects to draw", key=f"photos.{photo}.objects", cure="name other photos in the recipe")
        pixels = read_exr(self.inputs["masks"] / f"{photo}.exr")["label"]
        camera = poses.camera.camera(pixels.shape[1], pixels.shape[0])
        placed = tuple(self._placed(obj, objects.meshes[obj.mesh], poses) for obj in objects.objects)
        depth = ALL_BOUNCES if self.table.model.interreflection else DIRECT
        return PhotoScene(camera, placed, self.light(photo), self.materials, depth)

    def photo(self, photo: str) -> np.ndarray:
        """Its linear radiance."""
        channels = read_exr(self.inputs["masks"] / f"{photo}.exr")
        return np.nan_to_num(np.stack([channels[c] for c in "RGB"], axis=-1).astype(float))

    def covered(self, photo: str) -> np.ndarray:
        """Pixels that are no background."""
        channels = read_exr(self.inputs["masks"] / f"{photo}.exr")
        return (channels["label"] > 0) | (channels["left_out"] > 0)

    def tone(self, photo: str) -> Callable[[np.ndarray], np.ndarray]:
        """What the photo shows of radiance."""
        tone = self.table.model.tone.get(photo)
        return (lambda radiance: shown(radiance, tone.exponent, tone.pivot)) if tone else lambda radiance: radiance

    def light(self, name: str) -> Light:
        """A photo's light in its camera's axes, or that of a file."""
        if is_light_file(name):
            return read_light_map(self.inputs.file(f"recipe file:{name}"))
        return light_of(self.inputs["export"], name, self.lights[name])

    def known(self, table: str | None) -> dict[str, Reflectance]:
        """The solved materials, and those of a table of one's own, which go before."""
        if table is None:
            return self.materials
        file = self.inputs.file(f"recipe file:{table}")
        own = reflectances(read_materials(file))
        for name, material in own.items():
            if material.total > MOST_REFLECTED:
                found = f"max diffuse + max specular = {material.total:.3f}: more light is reflected than arrives"
                raise InputError(found, file=file, key=f"materials.{name}", cure=f"at most {MOST_REFLECTED}")
        return {**self.materials, **own}

    def ground(self, photo: str, neighbour: Placed) -> tuple[Plane, tuple[float, float, float] | None]:
        """Given with the photo, or what the neighbour rests on; its diffuse reflectance where it is given."""
        given = self.grounds[photo].ground
        if given is None:
            return resting_plane(neighbour), None
        normal = YUP_FROM_CAMERA @ np.array(given.normal)
        return Plane(normal / np.linalg.norm(normal), YUP_FROM_CAMERA @ np.array(given.point)), given.diffuse

    def mesh(self, name: str, material: str | None, up: str) -> tuple[Mesh, tuple[str, ...], np.ndarray]:
        """A mesh to insert, its materials by label, and which way is up in its own frame: of the data set's, as it stands in a photo."""
        axis = np.eye(3)["xyz".index(up)]
        if name == "ball":
            return ball(), (material or self.names[0],), axis
        if is_mesh_file(name):
            wanted = material or self.names[0]
            return read_mesh(self.inputs.file(f"recipe file:{name}"), [wanted], None, wanted, {}, self.crease_deg, NO_LIMITS), (wanted,), axis
        photo, obj = next((photo, obj) for photo, o in self.objects.items() for obj in o.objects if obj.mesh == name)
        placed = self._placed(obj, self.objects[photo].meshes[name], self.poses[photo])
        upright = placed.world_from_object[:3, :3].T @ self.ground(photo, placed)[0].normal
        return placed.mesh, tuple([material] * len(self.names)) if material else placed.materials, upright

    def _placed(self, obj: ObjectEntry, entry: MeshEntry, poses: PhotoPoses) -> Placed:
        pose = poses.objects[obj.name]
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = np.array(pose.rotation), pose.translation
        return Placed(obj.name, scaled(self._mesh(obj.mesh, entry, obj.materials), pose.scale), tuple(self.names), world_from_camera_frame(matrix))

    def _mesh(self, name: str, entry: MeshEntry, overrides: dict[str, str]) -> Mesh:
        key = (name, *sorted(overrides.items()))
        if key not in self._meshes:
            file = self.inputs.file(entry.file)
            self._meshes[key] = read_mesh(file, self.names, entry.parts, entry.material, overrides, self.crease_deg, NO_LIMITS)
        return self._meshes[key]


# ── files ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def _over(photo: np.ndarray, traced: np.ndarray, tone: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Traced objects over the photo."""
    share = np.clip(traced[..., 3:], 0, 1)
    return (1 - share) * photo + share * tone(_not_multiplied(traced))


def _not_multiplied(traced: np.ndarray) -> np.ndarray:
    """Radiance of what fills a pixel in part, as if it filled all of it."""
    return traced[..., :3] / np.where(traced[..., 3:] > 0, traced[..., 3:], 1)


def _write(stem: Path, radiance: np.ndarray) -> None:
    """At the photo's own exposure."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    write_rgb_exr(stem.with_name(stem.name + ".exr"), radiance)
    write_png(stem.with_name(stem.name + ".png"), picture(radiance, 1.0))


def _write_alone(stem: Path, traced: np.ndarray, tone: Callable[[np.ndarray], np.ndarray]) -> None:
    """Objects without a background: transparent beside them."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    write_exr(stem.with_name(stem.name + ".exr"), {c: traced[..., k] for k, c in enumerate("RGBA")})
    write_png(stem.with_name(stem.name + ".png"), _with_alpha(traced, tone))


def _with_alpha(traced: np.ndarray, tone: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    alpha = np.rint(255 * np.clip(traced[..., 3:], 0, 1)).astype(np.uint8)
    return np.concatenate([picture(tone(_not_multiplied(traced)), 1.0), alpha], axis=-1)


def _write_animation(out: Path, photo: str, frames: list[np.ndarray], tone: Callable[[np.ndarray], np.ndarray], seconds: float) -> None:
    """Every frame as a PNG, and all as a GIF on grey, which has no half-transparent pixels."""
    (out / photo).mkdir(parents=True)
    pixels = [_with_alpha(frame, tone) for frame in frames]
    for k, each in enumerate(pixels):
        write_png(out / photo / f"{k:03}.png", each)
    write_gif(out / f"{photo}.gif", pixels, seconds)
