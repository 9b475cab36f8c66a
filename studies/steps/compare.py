"""How far a method's predictions are from photos that were not taken: writes <case>.json, and into <case>/ pictures and shots.json.

Three kinds of pictures of the body, each compared with the truth by DSSIM inside the body's outline, after the tone map of
`factorlib.evaluate.picture` at an exposure that takes the truth's white to 1:

    novel_view      every photographed entry, from `VIEWS`: the first shares a part of what it sees with the photo, the second little
    novel_light     every photographed material in the true lights of the world that no photo was taken in, from the photos' side
    novel_material  every material of the world that was not photographed, in the light of every photo, from the photos' side

each in the three gauges of `factorlib.evaluate.gauge`: nothing scaled beyond the one factor that no photo tells, which the true
materials fix; one number for all pictures of the kind (`_scaled`); one for each channel and picture (`_balanced`).

The rest are the errors of the reflectances that a method states, those of three spheres in the lights that it states, and the
processor seconds that it took.  What a method does not state has no score.  photo-<material>-<light>.png is what was seen, <shot>.png a
prediction, <shot>-truth.png the truth beside it; shots.json has their DSSIM.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import UInt8

from factorlib.evaluate.ball import light_of_lat_long
from factorlib.evaluate.gauge import gauge_factors
from factorlib.evaluate.picture import picture_error, white_of
from factorlib.images.picture import picture, png_bytes, read_png, write_png
from factorlib.jsonfile import read_json, write_json
from factorlib.results.materials import Reflectance, read_materials
from factorlib.stage import Inputs, Progress
from studies.body import Map, Photos, Radiance, Scene, View, read_photos, turn, view
from studies.errors import PARTS, light_errors, maps_of, material_errors
from studies.methods import Prediction, grey, in_gauge, intrinsic, lambertian_part, projective, rendered
from studies.spheres import materials_of, read_maps
from studies.steps import Params
from studies.steps.optimise import Optimised
from studies.study import Comparison, Score, Setting, case_name, named
from studies.study import World as Lights

VIEWS = {"side": (70.0, 15.0), "back": (160.0, -10.0)}  # azimuth and elevation of the camera, degrees
FRONT = {"front": (0.0, 0.0)}  # the photos' own side
KINDS = ("novel_view", "novel_light", "novel_material")
SUFFIXES = {"none": "", "scalar_per_set": "_scaled", "channel_per_photo": "_balanced"}
INSTANT = {"projective": projective, "intrinsic": intrinsic, "grey": grey}  # methods that take less than a second
LEAST = 96  # pixels across a picture of a sheet: smaller ones are enlarged
MOST_COLUMNS = 6

Pixels = UInt8[np.ndarray, "h w 3"]


class Asked(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A photo that was not taken: what kind of prediction it asks for, of which material in which light, from where.

    photo: the light of the photo that shows the material, or None where no photo does
    """

    kind: str
    material: str
    light: int
    view: str
    photo: int | None

    @property
    def name(self) -> str:
        """The name of its picture's file."""
        return f"{self.kind}-{self.material}-light{self.light}-{self.view}"


class ScoredShot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a method's picture of it scores; dssim: nothing scaled."""

    asked: Asked
    dssim: float


class Shot(msgspec.Struct, frozen=True):
    """The true photo and the predicted one, as radiance; white: radiance that both are shown with as white."""

    asked: Asked
    view: View
    truth: Radiance
    predicted: Radiance
    white: float

    def dssim(self, factor: np.ndarray | float = 1.0) -> float:
        """Of the prediction times a factor."""
        pictures = (self.view.picture(radiance) for radiance in (self.predicted * factor, self.truth))
        return picture_error(*pictures, self.view.inside, self.white).dssim


class World(msgspec.Struct, frozen=True):
    """The truth: all materials by name and all lights by number, those that no photo shows among them."""

    materials: dict[str, Reflectance]
    lights: dict[int, Map]


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Compare with the truth."""
    facts = inputs.facts
    case, lights = msgspec.convert(facts["dataset.case"], Comparison), msgspec.convert(facts["dataset.worlds"], Lights)
    world = World(materials_of(case.seed), read_maps(inputs["worlds"], case.seed, range(lights.lights)))
    photos = read_photos(case, inputs["observe"] / inputs.photo)
    folder = inputs["optimise" if case.method == "mitsuba" else "solve"] / inputs.photo
    prediction, seconds = answer(case, photos, folder, world.materials)
    taken, home = shots(case, world, prediction), out / inputs.photo
    write_json(out / f"{inputs.photo}.json", score_of(world, prediction, taken, seconds))
    home.mkdir()
    for (material, light), radiance in photos.radiance.items():
        white = white_of(photos.view.picture(radiance), photos.view.inside)
        write_png(home / f"{photo_name(material, light)}.png", pixels_of(photos.view, radiance, white))
    for shot in taken:
        write_png(home / f"{shot.asked.name}-truth.png", pixels_of(shot.view, shot.truth, shot.white))
        write_png(home / f"{shot.asked.name}.png", pixels_of(shot.view, shot.predicted, shot.white))
    write_json(home / "shots.json", [ScoredShot(shot.asked, shot.dssim()) for shot in taken])


def answer(
    case: Comparison, photos: Photos, folder: Path, truths: Mapping[str, Reflectance]
) -> tuple[Prediction, float]:
    """A method's answer, and the processor seconds that it took; folder: what its step wrote, where it takes more than an instant."""
    if case.method in INSTANT:
        start = time.process_time()
        return INSTANT[case.method](photos, truths), round(time.process_time() - start, 3)
    if case.method == "mitsuba":
        end = msgspec.convert(read_json(folder / "optimised.json"), Optimised, str_keys=True)
        lights = {li: np.array(of) for li, of in end.lights.items()}
        return rendered(*in_gauge(end.materials, lights, truths)), end.processor
    table = {name: m.reflectance for name, m in read_materials(folder / "materials.json").materials.items()}
    return rendered(*in_gauge(table, maps_of(folder, case.lights), truths)), read_json(folder / "seconds.json")


def shots(case: Comparison, world: World, prediction: Prediction) -> list[Shot]:
    """All that is asked, and answered."""
    cameras = {name: view(case.seed, case.size, turn(*at)) for name, at in (VIEWS | FRONT).items()}
    scenes = {(li, name): Scene(world.lights[li], c) for li in world.lights for name, c in cameras.items()}
    taken = []
    for a in asked(case, world):
        camera, truth = cameras[a.view], scenes[a.light, a.view].of(world.materials[a.material])
        if a.kind == "novel_view":
            predicted = prediction.new_view(a.material, a.light, camera)
        elif a.kind == "novel_light":
            predicted = prediction.new_light(a.material, world.lights[a.light], camera)
        else:
            predicted = prediction.new_material(world.materials[a.material], a.light, camera)
        if predicted is not None:
            taken.append(Shot(a, camera, truth, predicted, white_of(camera.picture(truth), camera.inside)))
    return taken


def asked(case: Comparison, world: World) -> Iterator[Asked]:
    """What is asked of all methods in a case."""
    names, unseen = list(world.materials), sorted(world.lights.keys() - set(case.lights))
    others = [name for name in names if name not in case.material_names]
    yield from (Asked("novel_view", names[m], li, side, li) for side in VIEWS for m, li in case.entries)
    yield from (Asked("novel_light", n, li, "front", case.lights[0]) for n in case.material_names for li in unseen)
    yield from (Asked("novel_material", name, li, "front", None) for name in others for li in case.lights)


def score_of(world: World, prediction: Prediction, taken: Sequence[Shot], seconds: float) -> Score:
    """taken: as `shots` makes them;  seconds: of the processor, that the answer took."""
    score = Score({"processor": seconds})
    for kind in KINDS:
        if of_kind := [shot for shot in taken if shot.asked.kind == kind]:
            samples = [[getattr(shot, part) for shot in of_kind] for part in ("predicted", "truth", "white")]
            for gauge, factors in gauge_factors(*samples, below_white=True).items():
                errors = [shot.dssim(f) for shot, f in zip(of_kind, factors, strict=True)]
                score |= Score({kind + SUFFIXES[gauge]: float(np.mean(errors))})
    if prediction.materials:  # of a Lambertian method k_d alone, against the true k_d
        truths = lambertian_part(world.materials) if prediction.lambertian else world.materials
        stated = PARTS[:1] if prediction.lambertian else PARTS
        score |= material_errors(prediction.materials, truths, dict.fromkeys(prediction.materials, 0), stated)
    if prediction.lights:
        maps = [{li: of[li] for li in prediction.lights} for of in (prediction.lights, world.lights)]
        score |= light_errors(*(named({li: light_of_lat_long(m) for li, m in of.items()}) for of in maps))
    return score


# ── pictures for people ──────────────────────────────────────────────────────────────────────────────────────────────


def photo_name(material: str, light: int) -> str:
    """The name of a photo's file."""
    return f"photo-{material}-light{light}"


def pixels_of(view: View, radiance: Radiance, white: float) -> Pixels:
    """8-bit sRGB, white where there is no body."""
    pixels = picture(view.picture(np.maximum(radiance, 0)), 1 / white)
    pixels[~view.inside] = 255
    return pixels


def read_shots(folder: Path) -> list[ScoredShot]:
    """The shots.json of a case."""
    return msgspec.convert(read_json(folder / "shots.json"), list[ScoredShot])


def sheets(settings: Sequence[Setting], seeds: Sequence[int], scores: Path) -> dict[str, tuple[str, bytes]]:
    """PNG files by name, with captions: a sheet for each kind of picture, a row for each method."""
    captions = {
        "novel_view": "New views, in the light of a photo.",
        "novel_light": "New light: the material in another light than the photo's.",
        "novel_material": "Materials that no photo shows, in the light of a photo.",
    }
    folders = {s.label: scores / case_name(s.name, seeds[0]) for s in settings}
    answered = {label: {shot.asked.name for shot in read_shots(folder)} for label, folder in folders.items()}
    first, files = next(iter(folders.values())), {}
    for kind, caption in captions.items():
        every = [shot.asked for shot in read_shots(first) if shot.asked.kind == kind]
        some = [every[k] for k in np.unique(np.linspace(0, len(every) - 1, MOST_COLUMNS).round().astype(int))]
        rows = {} if kind == KINDS[2] else {"photo": [first / f"{photo_name(a.material, a.photo)}.png" for a in some]}
        rows["truth"] = [first / f"{a.name}-truth.png" for a in some]
        for label, folder in folders.items():
            rows[label] = [folder / f"{a.name}.png" if a.name in answered[label] else None for a in some]
        columns = ", ".join(f"{a.material} ({a.view}, light {a.light})" for a in some)
        about = f"Rows: {', '.join(rows)}.  Columns: {columns}.  Seed {seeds[0]}; each column at its truth's exposure, nothing scaled."
        pixels = sheet([[None if file is None else read_png(file) for file in row] for row in rows.values()])
        files[f"{kind}.png"] = (f"{caption}  {about}", png_bytes(pixels))
    return files


def sheet(rows: Sequence[Sequence[Pixels | None]]) -> Pixels:
    """Rows of equally large pictures, small ones enlarged; grey where there is none."""
    size = next(len(cell) for row in rows for cell in row if cell is not None)
    larger, none = max(1, LEAST // size), np.full((size, size, 3), 128, np.uint8)
    spaced = [
        [np.pad(none if c is None else c, ((1, 1), (1, 1), (0, 0)), constant_values=255) for c in row] for row in rows
    ]
    whole = np.concatenate([np.concatenate(row, axis=1) for row in spaced])
    return whole.repeat(larger, axis=0).repeat(larger, axis=1)
