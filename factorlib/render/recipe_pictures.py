"""Rendering of recipes to files: other views, other light, other materials, and inserted objects.

A photo gets <photo>.png (8-bit sRGB) and <photo>.exr (linear), or one pair per light as <photo>/<light>.png and .exr.
An animation is <photo>.gif with its frames <photo>/000.png and so on.  <photo>.json holds the
caption of the picture and other facts about it, if there are any.
"""

import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.images.exr import write_rgb_exr
from factorlib.images.grain import add_grain
from factorlib.images.picture import exposure_of, picture, write_gif, write_png
from factorlib.jsonfile import write_json
from factorlib.meshes.mesh import without_paint
from factorlib.recipe import kinds
from factorlib.recipe.kinds import AnyRecipe, is_light_file
from factorlib.render.ground import floor_rim, height_over, on_floor
from factorlib.render.insertion import LUMINANCE, NEW, GroundSurface, InsertionScene, compare_shadow, insert_object
from factorlib.render.photo_scene import (
    Orbit,
    PhotoScene,
    PlacedMesh,
    TracedPicture,
    before_light,
    crop_to_objects,
    resize_scene,
    rotate_light,
    traced_photo,
)
from factorlib.render.placement import free_placement, spot_beside, standing_mesh, unproject_spot
from factorlib.render.solved_set import SolvedSet
from factorlib.stage import Progress

log = logging.getLogger("factorlib.recipes")
METERED = 4  # samples per pixel of the mask of objects by which a picture is exposed
CONTRADICTED = "the ground that the photo shows is not shaded as the recovered light predicts"
CUT_OUT = (
    "The photo is a cut-out, which shows no ground: the shadow is in the picture's alpha, to be laid over a ground of "
    "your own."
)
PEDESTAL = " (if the photo's objects stand above the floor, lower the ground: `ground: {drop: …}`)"


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
    photos = recipe.photos or results.photos
    refusals = []
    for index, photo in enumerate(photos):
        try:
            progress(index, len(photos), photo)
            report = partial(lambda done, name, share: progress(done + share, len(photos), name), index, photo)
            facts = WRITERS[type(recipe)](recipe, results, photo, out, report) or {}
            if facts:
                write_json(out / f"{photo}.json", facts)
        except InputError as error:
            if recipe.photos:
                raise
            # The recipe names no photos: a photo that cannot be rendered is skipped.
            log.warning("%s: no picture of this photo: %s", photo, error.fault)
            refusals.append(error)
    if len(refusals) == len(photos):
        raise refusals[0]
    progress(len(photos), len(photos))


Report = Callable[[float], None]
View = Callable[..., Float[np.ndarray, "4 4"]]
STILL: Sequence[View] = [Orbit().world_from_camera]


def write_resynthesis(
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
    scene = results.scene(photo)
    if isinstance(recipe, kinds.TransferRecipe):
        table = results.with_table(recipe.table)
        replaced = {old: table[new] for old, new in recipe.materials.items()}
        present = {each.materials[label - 1] for each in scene.objects for label in each.mesh.labels}
        if recipe.photos and not present & replaced.keys():
            log.warning(
                "%s: no object has the material %s, so the picture equals the re-synthesis; its objects have %s",
                photo,
                ", ".join(map(repr, sorted(replaced))),
                ", ".join(sorted(present)),
            )
        objects = []
        for each in scene.objects:
            labels = [label for label in each.mesh.labels if each.materials[label - 1] in replaced]
            objects.append(msgspec.structs.replace(each, mesh=without_paint(each.mesh, labels)))
        materials = {**scene.materials, **replaced}
        scene = msgspec.structs.replace(scene, objects=tuple(objects), materials=materials)
    traced = TracedPicture(traced_photo(scene, recipe.samples), results.tone(photo))
    background = results.photo(photo)
    opacity = results.opacity(photo)
    coverage = traced.coverage[..., 0]
    alpha = 1 - (1 - coverage) * (1 - opacity)
    radiance = straight(traced.composite_over(background * opacity[..., None]), alpha)
    _write_over_photo(out / photo, add_grain(radiance, background, coverage), alpha)


def insertion_scene(recipe: kinds.InsertRecipe, results: SolvedSet, photo: str) -> InsertionScene:
    """Place the new object of a recipe on the ground of a photo.

    Args:
        recipe: the recipe to render
        results: the solved data set
        photo: name of the photo

    Returns:
        The scene with the new object's materials, the ground, and the object's pose.

    Raises:
        InputError: The photo shows no place for the object.
    """
    scene = results.scene(photo)
    neighbour = next((each for each in scene.objects if each.name == recipe.beside), scene.objects[0])
    ground = lowered_ground(results.ground(photo, neighbour), neighbour, recipe.ground.drop)
    if ground.plane.point @ ground.plane.normal >= 0:  # the camera stands at the origin
        raise InputError(
            f"photo '{photo}' was taken from below the plane that '{neighbour.name}' stands on, "
            "so a shadow on it would be invisible",
            key="photos",
            cure="name other photos, or give the photo's `ground` in dataset.yaml",
        )
    mesh, names, up = results.mesh(recipe.mesh, recipe.material, recipe.up)
    if recipe.at is not None:
        requested = unproject_spot(scene, ground.plane, neighbour, results.pixel(photo, recipe.at), recipe.size)
    else:
        wide = 2 * float(np.linalg.norm(np.cross(mesh.vertices - mesh.centre, up), axis=1).max())
        slenderness = wide / np.ptp(mesh.vertices @ up)  # diameter about the upright axis over the extent along it
        requested = spot_beside(scene, ground.plane, neighbour, recipe.size, slenderness)
    stand = partial(standing_mesh, NEW, mesh, tuple(f"{NEW}{name}" for name in names), up, recipe.turn)
    factor = results.poses[photo].camera.factor
    new, spot, moved = free_placement(scene, stand, requested, recipe.at is not None, factor)
    # materials of the new object, under names with a prefix
    new_materials = {f"{NEW}{name}": material for name, material in results.with_table(recipe.table).items()}
    scene = msgspec.structs.replace(scene, materials={**scene.materials, **new_materials})
    return InsertionScene(scene, ground, new, requested, spot, moved)


def lowered_ground(ground: GroundSurface, neighbour: PlacedMesh, drop: float) -> GroundSurface:
    """Return the ground lowered along its normal by `drop` heights of an object."""
    if drop == 0:
        return ground
    plane = ground.plane
    point = plane.point - drop * height_over(plane, neighbour) * plane.normal
    source = f"{ground.source}, lowered by {drop:g} of its heights as the recipe says"
    return msgspec.structs.replace(ground, plane=msgspec.structs.replace(plane, point=point), source=source)


def write_insertion(
    recipe: kinds.InsertRecipe, results: SolvedSet, photo: str, out: Path, report: Report
) -> dict[str, Any]:
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
    insertion = insertion_scene(recipe, results, photo)
    if insertion.moved:
        log.warning("%s: %s", photo, insertion.moved)
    opacity = results.opacity(photo)
    linear = results.linear_photo(photo) * opacity[..., None]
    covered = results.photo_mask(photo)
    result = insert_object(insertion, linear, covered, recipe.samples)
    match = compare_shadow(insertion, result, linear, covered)
    cut_out = CUT_OUT if opacity.min() < 1 else ""
    if cut_out:
        log.warning("%s: %s", photo, cut_out)
    hint = PEDESTAL if match.doubtful and recipe.ground.drop == 0 and results.grounds[photo].ground is None else ""
    if match.doubtful:
        log.warning("%s: do not trust the shadow: %s%s", photo, CONTRADICTED, hint)
    # Pixels that the new object does not change keep the photo's values exactly.
    # Where the photo is transparent, the shadow s lets the share s of what lies behind through.
    through = (1 - result.coverage) * (1 - opacity) * np.minimum(result.shadow @ LUMINANCE, 1)
    radiance = results.tone(photo)(straight(result.composite, 1 - through))
    edited = np.where(result.composite == linear, results.photo(photo), radiance)
    _write_over_photo(out / photo, add_grain(edited, results.photo(photo), result.coverage), 1 - through)
    pixel = results.poses[photo].camera.factor * insertion.scene.camera.project(insertion.spot.point @ YUP_FROM_CAMERA)
    moved = np.linalg.norm(insertion.spot.point - insertion.requested.point) / insertion.spot.height
    return {
        "at": pixel.round(1).tolist(),
        "moved": float(moved),
        "shadow": msgspec.to_builtins(match),
        "caption": f"{insertion.moved} The ground is {insertion.ground.source}. {match}{hint} {cut_out}".strip(),
    }


def framed_scene(
    recipe: kinds.ResizedRecipe, results: SolvedSet, photo: str, scene: PhotoScene, views: Sequence[View]
) -> tuple[PhotoScene, dict[str, Any]]:
    """Return the scene with the camera of the recipe's pictures: the whole frame, or the part with the objects.

    Args:
        recipe: the recipe to render
        results: the solved data set
        photo: name of the photo
        scene: the photo's scene
        views: return the poses of the cameras of all pictures that share the frame

    Returns:
        The scene, and `crop`: left, top, width and height of the part, in pixels of the photo's file.
    """
    if recipe.width is not None:
        return resize_scene(scene, recipe.width), {}
    has_floor = isinstance(recipe, kinds.BackgroundRecipe) and recipe.floor is not None
    plane = results.ground(photo, scene.objects[0]).plane if has_floor else None
    poses = [view(scene, scene.up if plane is None else plane.normal) for view in views]
    factor = results.poses[photo].camera.factor
    rim = None if plane is None else floor_rim(scene, plane)
    cropped, crop = crop_to_objects(scene, recipe.across, factor, poses, rim)
    return cropped, {"crop": [round(factor * each, 2) for each in crop]}


def render_view(
    recipe: kinds.BackgroundRecipe, results: SolvedSet, photo: str, scene: PhotoScene, view: View
) -> Float[np.ndarray, "h w 4"]:
    """Render the objects as `trace_view` does, before the light if the recipe requests that."""
    traced, pose = trace_view(recipe, results, photo, scene, view)
    return before_light(traced, scene, pose) if recipe.background == "light" else traced


def trace_view(
    recipe: kinds.BackgroundRecipe, results: SolvedSet, photo: str, scene: PhotoScene, view: View
) -> tuple[Float[np.ndarray, "h w 4"], Float[np.ndarray, "4 4"]]:
    """Render the objects from another view, on a floor if the recipe requests one.

    The camera moves about the normal of the floor, or about the upright axis if there is no floor.

    Args:
        recipe: floor and samples of the picture
        results: the solved data set
        photo: name of the photo
        scene: the photo's scene
        view: returns the pose of the camera for a scene and the unit axis of the azimuth

    Returns:
        Linear radiance times coverage, and coverage; and the pose of the camera.
    """
    if recipe.floor is None:
        pose = view(scene)
        return traced_photo(scene, recipe.samples, pose), pose
    plane = results.ground(photo, scene.objects[0]).plane
    pose = view(scene, plane.normal)
    return on_floor(scene, plane, recipe.floor, recipe.samples, pose), pose


def meter(
    traced: Float[np.ndarray, "h w 4"], scene: PhotoScene, pose: Float[np.ndarray, "4 4"], floor: float | None
) -> float:
    """Return the exposure of the objects in a picture, at which a floor is no brighter than the grey that it is.

    A hard sun on a floor beside dark objects would otherwise burn it out.
    """
    whole = TracedPicture(traced)
    if not floor:
        return whole.exposure
    alone = traced_photo(scene, METERED, pose)[..., 3]
    exposure = exposure_of(whole.display_radiance, alone > 0.5)
    shows_floor = (alone == 0) & (traced[..., 3] > 0.5)
    return min(exposure, floor * exposure_of(whole.display_radiance, shows_floor)) if shows_floor.any() else exposure


def viewed_scene(recipe: kinds.ViewedRecipe, results: SolvedSet, photo: str) -> tuple[PhotoScene, View, dict[str, Any]]:
    """Return the photo's scene as the recipe's camera frames it, the view of that camera, and the crop."""
    view: View = Orbit(recipe.azimuth, recipe.elevation, recipe.zoom).world_from_camera
    scene, crop = framed_scene(recipe, results, photo, results.scene(photo), [view])
    return scene, view, crop


def write_view(recipe: kinds.ViewRecipe, results: SolvedSet, photo: str, out: Path, report: Report) -> dict[str, Any]:
    """Write the objects alone, from another view.

    Args:
        recipe: the recipe to render
        results: the solved data set
        photo: name of the photo
        out: the folder to write to
        report: receives the share that is done, in [0, 1]

    Returns:
        The crop.
    """
    scene, view, crop = viewed_scene(recipe, results, photo)
    traced = render_view(recipe, results, photo, scene, view)
    _write_transparent(out / photo, TracedPicture(traced, results.tone(photo)))
    return crop


def write_animation(
    recipe: kinds.TurntableRecipe | kinds.MovingLightRecipe, results: SolvedSet, photo: str, out: Path, report: Report
) -> None:
    """Write an animation in which the camera or the light turns once.

    Each frame is a PNG.  All frames are a GIF on white.

    Args:
        recipe: the recipe to render
        results: the solved data set
        photo: name of the photo
        out: the folder to write to
        report: receives the share that is done, in [0, 1]
    """
    turns = 360 * np.arange(recipe.frames) / recipe.frames
    views = [Orbit(float(degrees)).world_from_camera for degrees in turns]
    is_turntable = isinstance(recipe, kinds.TurntableRecipe)
    scene, _ = framed_scene(recipe, results, photo, results.scene(photo), views if is_turntable else STILL)
    pixels = []
    for k, degrees in enumerate(turns):
        report(k / recipe.frames)
        if isinstance(recipe, kinds.TurntableRecipe):
            traced = render_view(recipe, results, photo, scene, views[k])
        else:
            turned = msgspec.structs.replace(scene, light=rotate_light(scene.light, degrees, scene.up))
            traced = traced_photo(turned, recipe.samples)
        pixels.append(TracedPicture(traced, results.tone(photo)).rgba())
    (out / photo).mkdir(parents=True)
    for k, each in enumerate(pixels):
        write_png(out / photo / f"{k:03}.png", each)
    write_gif(out / f"{photo}.gif", pixels, recipe.seconds)


def write_relit(
    recipe: kinds.RelightRecipe, results: SolvedSet, photo: str, out: Path, report: Report
) -> dict[str, Any]:
    """Write the objects in the lights of other photos or of files.

    The light of a photo comes with that photo's tone curve.  The light of a file is exposed for the objects.

    Args:
        recipe: the recipe to render
        results: the solved data set
        photo: name of the photo
        out: the folder to write to
        report: receives the share that is done, in [0, 1]

    Returns:
        The crop, and a caption with the frame in which maps stand.
    """
    scene, view, crop = viewed_scene(recipe, results, photo)
    lights = recipe.lights or results.other_lights(photo)
    for k, name in enumerate(lights):
        report(k / len(lights))
        lit = msgspec.structs.replace(scene, light=rotate_light(results.light(name, photo), recipe.rotate, scene.up))
        traced, pose = trace_view(recipe, results, photo, lit, view)
        exposure = meter(traced, lit, pose, recipe.floor) if is_light_file(name) else None
        traced = before_light(traced, lit, pose) if recipe.background == "light" else traced
        relit = (
            TracedPicture(traced, results.tone(name))
            if exposure is None
            else TracedPicture(traced).with_exposure(exposure)
        )
        _write_transparent(out / photo / Path(name).stem, relit)
    if not any(map(is_light_file, lights)):
        return crop
    has_world = results.lights[photo].world_from_camera is not None
    frame = "the world of the photos" if has_world else "the camera's frame, for the photo has no world"
    return {**crop, "caption": f"Light maps are upright in {frame}, turned by {recipe.rotate:g}°."}


WRITERS: dict[type, Callable[[Any, SolvedSet, str, Path, Report], dict[str, Any] | None]] = {
    kinds.ResynthesisRecipe: write_resynthesis,
    kinds.TransferRecipe: write_resynthesis,
    kinds.InsertRecipe: write_insertion,
    kinds.ViewRecipe: write_view,
    kinds.TurntableRecipe: write_animation,
    kinds.MovingLightRecipe: write_animation,
    kinds.RelightRecipe: write_relit,
}


def straight(premultiplied: Float[np.ndarray, "h w 3"], alpha: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """Return colours with alpha divided out, black where it is 0."""
    return premultiplied / np.where(alpha > 0, alpha, 1)[..., None]


def _write_over_photo(stem: Path, radiance: np.ndarray, alpha: np.ndarray) -> None:
    """Write a picture over a photo as EXR and PNG at the photo's own exposure, opaque unless the photo is a cut-out."""
    if alpha.min() < 1:
        return _write_transparent(stem, TracedPicture(np.dstack([radiance * alpha[..., None], alpha])))
    stem.parent.mkdir(parents=True, exist_ok=True)
    write_rgb_exr(stem.with_name(stem.name + ".exr"), radiance)
    write_png(stem.with_name(stem.name + ".png"), picture(radiance, 1.0))


def _write_transparent(stem: Path, traced: TracedPicture) -> None:
    """Write objects as EXR and PNG, transparent outside them."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    traced.to_exr(stem.with_name(stem.name + ".exr"))
    traced.to_png(stem.with_name(stem.name + ".png"))
