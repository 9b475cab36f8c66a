"""Evaluation: re-synthesis compared with the photos, and all other results with the ground truth if there is one.

Writes metrics.json (`factorlib.results.metrics` describes its keys) and verdict.txt.  No other stage reads the truth.
For the report it writes illumination/<light>.exr (the true map) and spheres/<light>_{truth,estimate}.exr.
"""

from itertools import count
from pathlib import Path

import msgspec
import numpy as np

from factorlib.dataset.schema import LightSlice, TruthFile, solved_photos, with_all_rejoined
from factorlib.evaluate.ball import OctahedralLight, octahedral_light
from factorlib.evaluate.comparison_gauge import material_components
from factorlib.evaluate.picture_errors import ComparedPhoto, combine_photo, compare_photos
from factorlib.evaluate.predicted_views import PosedPhoto, compare_view
from factorlib.evaluate.relighting import (
    compare_lights,
    compare_relighting,
    compare_relit_set,
    mirrored_directions,
    sphere_row,
)
from factorlib.evaluate.truth import (
    albedo_errors,
    average_albedo,
    average_normals,
    compare_materials,
    normal_error,
    pose_error,
    read_true_albedo,
    read_true_light,
    read_true_normals,
)
from factorlib.evaluate.verdict import VerdictInputs, ball_changes, verdict, verdict_text
from factorlib.images.exr import LAT_LONG, read_exr, read_rgb_exr, write_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.light.lobes import is_hard, lobe_energy
from factorlib.render.resynthesis import paint_shading
from factorlib.results.exchange import with_exchange
from factorlib.results.lobe_table import read_lobes
from factorlib.results.materials import Reflectance, read_materials, read_uncertainty, reflectances
from factorlib.results.metrics import AlbedoErrors, Counts, Metrics, NormalError, PoseError, ResynthesisErrors, Verdict
from factorlib.results.photos import read_photos
from factorlib.results.poses import read_poses
from factorlib.results.surface_table import read_surface
from factorlib.stage import Inputs, Progress
from factorlib.urm.extract import observed_pixels, read_geometry
from factorlib.wholefile import write_text

NO_TRUTH = "the dataset names no truth"
NO_MATERIAL = "no photo shows a material"
MISSING = {
    "materials": "the truth says nothing about materials that were seen",
    "relighting": "the truth lacks materials or lights",
    "relit_set": "the truth lacks materials or lights",
    "light": "the truth names no illumination of this set",
    "normals": "the truth has no normals for these photos",
    "poses": "the truth has no poses of these objects",
    "albedo": "the truth has no albedo of these photos",
}


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Empty parameters: metrics cannot be tuned."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Compare results with the photos and the truth, and write metrics.json."""
    first = inputs
    inputs = with_exchange(first)
    slices = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    lights = with_all_rejoined(slices) if inputs["solve"] != first["solve"] else slices
    truth = msgspec.convert(inputs.facts["dataset.truth"], TruthFile | None)
    materials = inputs.facts["dataset.materials"]
    counter = count()
    held_out = [name for name, light in slices.items() if light.held_out]
    total = 2 * len(solved_photos(lights)) + 3 * len(held_out) + (len(MISSING) if truth else 0) + 1

    def read_photo(name: str) -> ComparedPhoto:
        """Return a photo and its re-synthesis; `compare_photos` reads each twice."""
        progress(next(counter), total, f"re-synthesis of {name}")
        return _read_photo(inputs, name)

    def read_prediction(name: str) -> ComparedPhoto:
        """Return a held-out photo and its prediction, by the solve that did not use it."""
        progress(next(counter), total, f"prediction of {name}")
        return _read_photo(first, name, predicted=True) if slices[name].rejoins else _read_photo(inputs, name)

    resynthesis = compare_photos(solved_photos(lights), materials, read_photo)
    # connected components of the graph of materials and lights
    observed = _observed_materials(resynthesis, lights)
    component = material_components({light: names for light, names in observed.items() if names})
    predictions = {name: read_prediction(name) for name in held_out}
    sections = dict.fromkeys(MISSING) | {"views": _views(first, predictions, solved_photos(slices))}
    sections["held_out"] = compare_photos(held_out, materials, read_prediction) if held_out else None
    if truth:
        true = {n: Reflectance(m.diffuse, m.specular, m.roughness) for n, m in truth.materials.items()}
        estimates = reflectances(read_materials(inputs["export"] / "materials.json"))  # in the exported lights' gauge
        true_lights, estimated_lights = _lights(inputs, truth, out)
        compute = {
            "materials": lambda: compare_materials(estimates, true, component),
            "relighting": lambda: compare_relighting(estimates, true, estimated_lights, true_lights, observed),
            "relit_set": lambda: compare_relit_set(estimates, true, estimated_lights, true_lights),
            "light": lambda: compare_lights(estimated_lights, true_lights, _mirrored_directions(inputs, lights)),
            "normals": lambda: _normals(inputs, truth, lights),
            "poses": lambda: _poses(inputs, truth),
            "albedo": lambda: _albedo(inputs, truth, estimates),
        }
        for name, section in compute.items():
            progress(next(counter), total, name)
            sections[name] = section()
    progress(next(counter), total, "verdict")
    sections["verdict"] = _verdict(inputs, observed)
    counts = Counts(len(lights), len(materials), len(observed), len(set(component.values())))
    reasons = {name: why if truth else NO_TRUTH for name, why in MISSING.items() if not sections[name]}
    reasons |= {} if sections["verdict"] else {"verdict": NO_MATERIAL}
    write_json(out / "metrics.json", Metrics(set=counts, resynthesis=resynthesis, **sections, reasons=reasons))
    if sections["verdict"]:
        write_text(out / "verdict.txt", verdict_text(sections["verdict"], sections["views"]))
    progress(total, total)


def _read_photo(inputs: Inputs, name: str, predicted: bool = False) -> ComparedPhoto:
    """Return a photo and its re-synthesis; if `predicted`, that of the first solve, which `render` did not draw."""
    photo = read_exr(inputs["masks"] / f"{name}.exr")
    geometry = read_geometry(inputs["align"], inputs.folders.get("surface"), name, inputs.folders.get("texture"))
    if predicted:
        model = read_materials(inputs["solve"] / "materials.json").model
        return combine_photo(photo, geometry, paint_shading(inputs["shading"], name, geometry, model))
    return combine_photo(photo, geometry, read_rgb_exr(inputs["render"] / "resynthesis" / f"{name}.exr"))


def _views(
    inputs: Inputs, predictions: dict[str, ComparedPhoto], solved: list[str]
) -> dict[str, dict[str, float]] | None:
    """Return the scores of predicted views, by held-out photo; None without any."""
    poses = read_poses(inputs["align"] / "poses.json")

    def posed(name: str, photo: ComparedPhoto) -> PosedPhoto:
        """Return a photo with its camera, poses and the maps of `align`."""
        camera = poses[name].camera.camera(*photo.label.shape[::-1])
        return PosedPhoto(photo, read_geometry(inputs["align"], None, name), camera, poses[name].objects)

    views = {
        name: compare_view(posed(name, photo), (posed(source, _read_photo(inputs, source)) for source in solved))
        for name, photo in predictions.items()
    }
    return {name: scores for name, scores in views.items() if scores} or None


def _observed_materials(resynthesis: ResynthesisErrors, lights: dict[str, LightSlice]) -> dict[str, list[str]]:
    """Return the observed materials of each light."""
    materials: dict[str, dict[str, None]] = {slice_.illumination: {} for slice_ in lights.values()}
    for name, photo in resynthesis.photos.items():
        materials[lights[name].illumination] |= dict.fromkeys(photo.materials)
    return {light: list(names) for light, names in materials.items()}


def _verdict(inputs: Inputs, observed: dict[str, list[str]]) -> Verdict | None:
    """Return the verdict on the result's reliability; None without observed materials.

    Args:
        inputs: Inputs of the stage.
        observed: Names of the observed materials, by light.
    """
    table = read_materials(inputs["export"] / "materials.json")
    uncertainty = read_uncertainty(inputs["solve"] / "uncertainty.json")
    names_observed = {m for names in observed.values() for m in names}
    files = inputs["export"] / "illumination"
    materials = {name: solved for name, solved in table.materials.items() if name in names_observed}
    lights = {name: octahedral_light(read_rgb_exr(files / f"{name}.exr")) for name, names in observed.items() if names}
    if not (materials and uncertainty.photos):
        return None
    poses = read_poses(inputs["align"] / "poses.json")
    contours, overlaps = (
        {
            photo: {n: value for n, obj in entry.objects.items() if (value := getattr(obj, measure)) is not None}
            for photo, entry in poses.items()
        }
        for measure in ("contour_error", "silhouette_iou")
    )
    errors = ball_changes(materials, lights)
    misfit = (uncertainty.unexplained, uncertainty.photos)
    surface = read_surface(inputs.folders.get("surface")).disagreement
    lobes = read_lobes(inputs["export"] / "lobes.parquet")
    hard = [name for name, of in lobes.items() if is_hard(of.axis, (of.weight.T * lobe_energy(of.sharpness)).sum(0))]
    lit_hard = frozenset(m for light in hard for m in observed.get(light, ()))
    return verdict(VerdictInputs(errors, *misfit, contours, uncertainty.residual_sigma, overlaps, surface, lit_hard))


def _lights(
    inputs: Inputs, truth: TruthFile, out: Path
) -> tuple[dict[str, OctahedralLight], dict[str, OctahedralLight]]:
    """Return the true lights and those of them that are estimated, and write maps and spheres of the latter."""
    true = {}
    estimated = {}
    for name, path in truth.illumination.items():
        true[name] = octahedral_light(read_true_light(inputs.file(path), name))
        if (file := inputs["export"] / "illumination" / f"{name}.exr").exists():
            estimated[name] = octahedral_light(read_rgb_exr(file))
            for kind in ("illumination", "spheres"):
                (out / kind).mkdir(exist_ok=True)
            write_rgb_exr(out / "illumination" / f"{name}.exr", read_rgb_exr(inputs.file(path)), LAT_LONG)
            for kind, light in (("truth", true[name]), ("estimate", estimated[name])):
                write_rgb_exr(out / "spheres" / f"{name}_{kind}.exr", sphere_row(light))
    return true, estimated


def _geometry(inputs: Inputs, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normals and view directions [h, w, 3] of a photo, in its camera frame, and its observed pixels [h, w]."""
    geometry = read_geometry(inputs["align"], inputs.folders.get("surface"), name, inputs.folders.get("texture"))
    normal, view = (np.stack([geometry[f"{kind}.{a}"] for a in "xyz"], axis=-1) for kind in ("normal", "view"))
    return normal, view, observed_pixels(read_exr(inputs["masks"] / f"{name}.exr"), geometry)


def _mirrored_directions(inputs: Inputs, lights: dict[str, LightSlice]) -> dict[str, np.ndarray]:
    """Return, by light, a mask of the directions that an observed pixel mirrors."""
    mirrored: dict[str, np.ndarray] = {}
    for name, slice_ in lights.items():
        normal, view, pixels = _geometry(inputs, name)
        frame = np.eye(3) if slice_.world_from_camera is None else np.array(slice_.world_from_camera)
        hit = mirrored_directions(normal[pixels], view[pixels], frame)
        mirrored[slice_.illumination] = mirrored.get(slice_.illumination, False) | hit
    return mirrored


def _normals(inputs: Inputs, truth: TruthFile, lights: dict[str, LightSlice]) -> dict[str, NormalError] | None:
    """Return the errors of normals, by photo; None without true normals."""
    errors = {}
    photos = read_photos(inputs["masks"] / "photos.json")
    for name in [name for name in lights if name in truth.normals]:
        true = read_true_normals(inputs.file(truth.normals[name]), name, photos[name].original_size)
        normal, _, pixels = _geometry(inputs, name)
        errors[name] = normal_error(normal, average_normals(true, photos[name].factor), pixels)
    return {name: error for name, error in errors.items() if error} or None


def _albedo(inputs: Inputs, truth: TruthFile, estimates: dict[str, Reflectance]) -> AlbedoErrors | None:
    """Return the errors of albedo over the observed pixels; None without true albedo of them."""
    names = list(inputs.facts["dataset.materials"])
    diffuse = np.array([estimates[name].diffuse if name in estimates else (np.nan,) * 3 for name in names])
    columns = []
    for name, entry in read_photos(inputs["masks"] / "photos.json").items():
        if name not in truth.albedo:
            continue
        true = read_true_albedo(inputs.file(truth.albedo[name]), name, entry.original_size)
        true = average_albedo(true, entry.factor)
        photo = read_exr(inputs["masks"] / f"{name}.exr")
        geometry = read_geometry(inputs["align"], inputs.folders.get("surface"), name, inputs.folders.get("texture"))
        detail = np.stack([geometry.get(f"detail.{c}", np.ones(true.shape[:2])) for c in "RGB"], axis=-1)
        material = np.rint(photo["label"]).astype(int) - 1
        pixels = observed_pixels(photo, geometry) & (detail > 0).any(axis=-1) & (true > 0).all(axis=-1)
        pixels &= np.isfinite(diffuse[material, 0])
        flat = diffuse[material[pixels]]
        columns.append((flat * detail[pixels], flat, true[pixels], material[pixels]))
    if not columns:
        return None
    *kinds, true, material = map(np.concatenate, zip(*columns))
    return albedo_errors(kinds, true, material, names)


def _poses(inputs: Inputs, truth: TruthFile) -> dict[str, dict[str, PoseError]] | None:
    """Return the errors of poses, by photo and object; None without true poses of these objects."""
    estimated = read_poses(inputs["align"] / "poses.json")
    errors: dict[str, dict[str, PoseError]] = {}
    for photo, objects in truth.poses.items():
        for name, pose in objects.items():
            if photo in estimated and name in estimated[photo].objects:
                errors.setdefault(photo, {})[name] = pose_error(estimated[photo].objects[name], pose)
    return errors or None
