"""Rendering of recipes to files: other views, other light, other materials, and inserted objects.

A photo gets <photo>.png (8-bit sRGB) and <photo>.exr (linear), or one pair per light as <photo>/<light>.png and .exr.
An animation is <photo>.gif with its frames <photo>/000.png and so on.  A grid is one grid.png. <photo>.json holds the
caption of the picture and other facts about it, if there are any.
"""

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.images.exr import write_rgb_exr
from factorlib.images.film import write_gif, write_mp4
from factorlib.images.picture import picture, write_png
from factorlib.jsonfile import write_json
from factorlib.recipe import kinds
from factorlib.recipe.kinds import AnyRecipe, is_light_file
from factorlib.render.insertion import NEW, STEPS, InsertionScene, inserted
from factorlib.render.photo_scene import PhotoScene, lit_ball, orbit, resized, traced_photo, turned_light
from factorlib.render.placement import spot_at, spot_beside, stood, stood_free
from factorlib.render.solved_set import SolvedSet
from factorlib.render.studio import on_floor
from factorlib.render.traced_picture import TracedPicture
from factorlib.results.materials import Reflectance
from factorlib.stage import Progress
from factorlib.tracing.denoise import denoiser
from factorlib.wholefile import write_text

log = logging.getLogger("factorlib.recipes")
SUN = (
    "The sun is assumed, not recovered: it stands in direction {sun.direction} of the light's map, {sun.size:g}° wide, "
    "and holds {sun.strength:.0%} of the light's energy, which is kept."
)
DENOISED = "Denoised by {denoiser}, from {recipe.samples} samples a pixel."


def draw(recipe: AnyRecipe, results: SolvedSet, out: Path, progress: Progress) -> None:
    """Write the pictures of one recipe into a folder.

    Args:
        recipe: the recipe to render
        results: the solved data set
        out: the folder to write to
        progress: receives the number of photos done and their total

    Raises:
        InputError: None of the recipe's photos can be rendered, or one that the recipe names cannot.
    """
    if isinstance(recipe, kinds.GridRecipe):
        return write_grid(recipe, results, out, progress)
    photos = recipe.photos or results.photos
    refusals = []
    for done, photo in enumerate(photos):
        try:
            report = partial(_report, progress, done, len(photos), photo)
            facts = DRAWN[type(recipe)](recipe, results, photo, out, report) or {}
            captions = [facts.pop("caption")] if facts else []
            if recipe.sun is not None:
                facts["assumed_sun"] = msgspec.to_builtins(recipe.sun)
                captions.append(SUN.format(sun=recipe.sun))
            if recipe.denoise:
                facts["denoised"] = denoiser()
                captions.append(DENOISED.format(recipe=recipe, denoiser=denoiser()))
            if facts:
                write_json(out / f"{photo}.json", {**facts, "caption": " ".join(captions)})
        except InputError as error:
            if recipe.photos:
                raise
            # The recipe names no photos: a photo that cannot be drawn is skipped.
            log.warning("%s: left out: %s", photo, error.found)
            refusals.append(error)
    if len(refusals) == len(photos):
        raise refusals[0]
    progress(len(photos), len(photos))


def _report(progress: Progress, done: int, total: int, photo: str, share: float) -> None:
    """Report the progress within one photo; `share`, in [0, 1], is the part of it that is done."""
    progress(done + share, total, photo)


Report = Callable[[float], None]


def resynthesis(
    recipe: kinds.ResynthesisRecipe | kinds.TransferRecipe, results: SolvedSet, photo: str, out: Path, report: Report
) -> None:
    """Write a photo with its objects path-traced over it, with other materials if the recipe replaces some.

    Args:
        recipe: the recipe to render
        results: the solved data set
        photo: name of the photo
        out: the folder to write to
        report: receives the share that is done, in [0, 1]
    """
    report(0)
    scene = results.scene(photo, recipe.sun, recipe.denoise)
    if isinstance(recipe, kinds.TransferRecipe):
        known = results.known(recipe.table)
        other = recipe.materials
        materials = {name: known[other[name]] if name in other else own for name, own in scene.materials.items()}
        worn = {each.materials[label - 1] for each in scene.objects for label in each.mesh.labels}
        if recipe.photos and not worn & other.keys():
            words = "%s: no object has %s, so the picture shows nothing new; there are %s"
            log.warning(words, photo, ", ".join(map(repr, sorted(other))), ", ".join(sorted(worn)))
        scene = msgspec.structs.replace(scene, materials=materials)
    traced = TracedPicture(traced_photo(scene, recipe.samples), results.tone(photo))
    _write(out / photo, traced.over(results.photo(photo)))


def standing(recipe: kinds.InsertRecipe, results: SolvedSet, photo: str) -> InsertionScene:
    """Place the new object of a recipe on the ground of a photo.

    Args:
        recipe: the recipe to render
        results: the solved data set
        photo: name of the photo

    Returns:
        The scene with the new object's materials, the ground, and the object's pose.

    Raises:
        InputError: The photo shows no place for the object, or the assumed sun stands below the ground.
    """
    scene = results.scene(photo, recipe.sun, recipe.denoise)
    neighbour = next((each for each in scene.objects if each.name == recipe.beside), scene.objects[0])
    given = recipe.ground
    polish = None
    if any(given.specular):
        polish = Reflectance((0.0,) * 3, given.specular, given.roughness)
    ground = msgspec.structs.replace(results.ground(photo, neighbour), polish=polish)
    if not ground.plane.seen_from_above:
        fault = (
            f"photo '{photo}' was taken from below the plane that '{neighbour.name}' stands on, "
            "so that no shadow on it can be seen"
        )
        raise InputError(fault, key="photos", cure="name other photos, or give the photo's `ground` in dataset.yaml")
    if recipe.sun is not None and results.sun_axis(photo, recipe.sun) @ YUP_FROM_CAMERA @ ground.plane.normal <= 0:
        fault = "the sun stands below the ground of the photo"
        raise InputError(fault, key="sun.direction", cure="y of the direction points upward in the photo")
    # materials of the new object, under names of their own
    own = {f"{NEW}{name}": material for name, material in results.known(recipe.table).items()}
    mesh, names, up = results.mesh(recipe.mesh, recipe.material, recipe.up)
    if recipe.at is not None:
        spot = spot_at(scene, ground.plane, neighbour, results.pixel(photo, recipe.at), recipe.size)
    else:
        # extent along the upright axis, and diameter about it
        tall = np.ptp(mesh.vertices @ up)
        wide = 2 * float(np.linalg.norm(np.cross(mesh.vertices - mesh.centre, up), axis=1).max())
        spot = spot_beside(scene, ground.plane, neighbour, recipe.size, wide / tall)
    labels = tuple(f"{NEW}{name}" for name in names)
    factor = results.poses[photo].camera.factor
    stand = partial(stood, NEW, mesh, labels, up, recipe.turn)
    new, found, moved = stood_free(scene, stand, spot, recipe.at is not None, factor)
    scene = msgspec.structs.replace(scene, materials={**scene.materials, **own})
    return InsertionScene(scene, ground, new, spot, found, moved)


def insertion(recipe: kinds.InsertRecipe, results: SolvedSet, photo: str, out: Path, report: Report) -> dict[str, Any]:
    """Write a photo with a further object inserted on the ground of an existing one.

    Args:
        recipe: the recipe to render
        results: the solved data set
        photo: name of the photo
        out: the folder to write to
        report: receives the share that is done, in [0, 1]

    Returns:
        The facts that accompany the picture: place in pixels, displacement in object heights, shadow match, caption.
    """
    there = standing(recipe, results, photo)
    if there.moved:
        log.warning("%s: %s", photo, there.moved)
    seen = results.straightened(photo), results.covered(photo)
    found = inserted(there, *seen, recipe.samples, lambda done: report(done / STEPS))
    # Pixels that the new object does not change keep the photo's values exactly.
    same = (found.coverage[..., None] == 0) & (found.shadow == 1) & (there.ground.polish is None)
    _write(out / photo, np.where(same, results.photo(photo), results.tone(photo)(found.composite)))
    at = results.poses[photo].camera.factor * there.scene.camera.project(there.found.point @ YUP_FROM_CAMERA)
    given = "that of dataset.yaml"
    if results.grounds[photo].ground is None:
        neighbour = recipe.beside or there.scene.objects[0].name
        given = f"where '{neighbour}' would come to rest"
    return {
        "at": at.round(1).tolist(),
        "moved": float(np.linalg.norm(there.found.point - there.spot.point) / there.spot.height),
        "shadow": msgspec.to_builtins(found.match),
        "caption": f"{there.moved} The ground is {given}. {found.match}".strip(),
    }


def staged(
    recipe: kinds.BackgroundRecipe,
    results: SolvedSet,
    photo: str,
    scene: PhotoScene,
    azimuth: float,
    elevation: float = 0.0,
    zoom: float = 1.0,
) -> Float[np.ndarray, "h w 4"]:
    """Render the objects from another view, before the light or a transparent background, on a floor if asked.

    The camera moves about the normal of the floor, or about the upright axis if there is no floor.

    Args:
        recipe: background, floor and samples of the picture
        results: the solved data set
        photo: name of the photo
        scene: the photo's scene
        azimuth: see `orbit`; degrees
        elevation: see `orbit`; degrees
        zoom: see `orbit`

    Returns:
        Linear radiance times coverage, and coverage.
    """
    lit = recipe.background == "light"
    if recipe.floor is None:
        return traced_photo(scene, recipe.samples, orbit(scene, azimuth, elevation, zoom), lit)
    plane = results.ground(photo, scene.objects[0]).plane
    return on_floor(
        scene, plane, recipe.floor, recipe.samples, orbit(scene, azimuth, elevation, zoom, plane.normal), lit
    )


def view(recipe: kinds.ViewRecipe, results: SolvedSet, photo: str, out: Path, report: Report) -> None:
    """Write the objects alone, from another view.

    Args:
        recipe: the recipe to render
        results: the solved data set
        photo: name of the photo
        out: the folder to write to
        report: receives the share that is done, in [0, 1]
    """
    report(0)
    scene = resized(results.scene(photo, recipe.sun, recipe.denoise), recipe.width)
    traced = staged(recipe, results, photo, scene, recipe.azimuth, recipe.elevation, recipe.zoom)
    _write_alone(out / photo, TracedPicture(traced, results.tone(photo)))


def animation(
    recipe: kinds.TurntableRecipe | kinds.MovingLightRecipe, results: SolvedSet, photo: str, out: Path, report: Report
) -> None:
    """Write an animation in which the camera or the light turns once.

    Each frame is a PNG.  All frames are a GIF on white and, if PyAV is installed, an MP4 on white.

    Args:
        recipe: the recipe to render
        results: the solved data set
        photo: name of the photo
        out: the folder to write to
        report: receives the share that is done, in [0, 1]
    """
    scene = resized(results.scene(photo, recipe.sun, recipe.denoise), recipe.width)
    pixels = []
    for k in range(recipe.frames):
        report(k / recipe.frames)
        degrees = 360 * k / recipe.frames
        if isinstance(recipe, kinds.TurntableRecipe):
            traced = staged(recipe, results, photo, scene, degrees)
        else:
            turned = msgspec.structs.replace(scene, light=turned_light(scene.light, degrees))
            traced = traced_photo(turned, recipe.samples)
        pixels.append(TracedPicture(traced, results.tone(photo)).rgba())
    (out / photo).mkdir(parents=True)
    for k, each in enumerate(pixels):
        write_png(out / photo / f"{k:03}.png", each)
    write_gif(out / f"{photo}.gif", pixels, recipe.seconds)
    write_mp4(out / f"{photo}.mp4", pixels, recipe.seconds)


def relight(recipe: kinds.RelightRecipe, results: SolvedSet, photo: str, out: Path, report: Report) -> None:
    """Write the objects in the lights of other photos or of files.

    The light of a photo comes with that photo's tone curve.  The light of a file is exposed for the objects.

    Args:
        recipe: the recipe to render
        results: the solved data set
        photo: name of the photo
        out: the folder to write to
        report: receives the share that is done, in [0, 1]
    """
    scene = resized(results.scene(photo, denoise=recipe.denoise), recipe.width)
    lights = recipe.lights or [name for name in results.photos if name != photo]
    for k, name in enumerate(lights):
        report(k / len(lights))
        lit = msgspec.structs.replace(scene, light=turned_light(results.light(name), recipe.rotate))
        traced = staged(recipe, results, photo, lit, 0.0)
        shown = TracedPicture(traced).exposed() if is_light_file(name) else TracedPicture(traced, results.tone(name))
        _write_alone(out / photo / Path(name).stem, shown)


DRAWN: dict[type, Callable[[Any, SolvedSet, str, Path, Report], dict[str, Any] | None]] = {
    kinds.ResynthesisRecipe: resynthesis,
    kinds.TransferRecipe: resynthesis,
    kinds.InsertRecipe: insertion,
    kinds.ViewRecipe: view,
    kinds.TurntableRecipe: animation,
    kinds.MovingLightRecipe: animation,
    kinds.RelightRecipe: relight,
}


def write_grid(recipe: kinds.GridRecipe, results: SolvedSet, out: Path, progress: Progress) -> None:
    """Write balls of materials (rows) in lights (columns), each column at one exposure.

    Args:
        recipe: the recipe to render
        results: the solved data set
        out: the folder to write to
        progress: receives the number of balls done and their total
    """
    materials = recipe.materials or results.names
    lights = recipe.lights or results.photos
    columns = []
    total = len(materials) * len(lights)
    for k, name in enumerate(lights):
        light = results.light(name)
        balls = []
        for j, material in enumerate(materials):
            progress(k * len(materials) + j, total, f"{material}, {name}")
            balls.append(lit_ball(light, results.materials[material], recipe.size, recipe.samples, recipe.denoise))
        columns.append(TracedPicture(np.concatenate(balls)).exposed().pixels)
    _write_alone(out / "grid", TracedPicture(np.concatenate(columns, axis=1)))
    said = f"denoised: {denoiser()}\n" if recipe.denoise else ""
    write_text(out / "grid.txt", f"rows: {', '.join(materials)}\ncolumns: {', '.join(lights)}\n{said}")
    progress(total, total)


def _write(stem: Path, radiance: np.ndarray) -> None:
    """Write an opaque picture as EXR and PNG, at the photo's own exposure."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    write_rgb_exr(stem.with_name(stem.name + ".exr"), radiance)
    write_png(stem.with_name(stem.name + ".png"), picture(radiance, 1.0))


def _write_alone(stem: Path, traced: TracedPicture) -> None:
    """Write objects as EXR and PNG, transparent outside them."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    traced.to_exr(stem.with_name(stem.name + ".exr"))
    traced.to_png(stem.with_name(stem.name + ".png"))
