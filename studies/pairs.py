"""Pairs of pictures of a made set: is a new object in a photograph told apart from a true one?

Usage: `python -m studies.pairs build/eames …`

One picture of a pair is made by what was recovered, the other by what is true. Written to build/studies/pairs:
pairs.csv and pictures/.

Both are made by the recipe `insert`, with the same mesh, samples, and pixel at which the object touches the ground.
True are the light of the photograph, infinitely far away as the recipe takes it, the materials, and the plane on which
the true poses and lenses put the chairs.  So a pair shows what recovering costs, and not what the recipe leaves out,
such as walls near by.

Observer   mean ΔE (CIE 1976, after a blur of σ = 1 pixel) over the object, or over the ground that either picture
           changes, whichever is larger. A pair is told apart where it is above the just noticeable difference, 2.3
           (Mahy, Van Eycken and Oosterlinck, 1994), and above the floor: that of two truths of different noise, or of
           two pictures by what was recovered.
Cause      the same with one factor recovered and the others true.  The factor per channel between materials and lights,
           which no photograph tells, is first moved from the lights to the materials, so it counts as theirs.
"""

import csv
import io
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import msgspec
import numpy as np
import typer
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, gaussian_filter

from factorlib import load_result
from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.dataset.read import read_dataset
from factorlib.dataset.schema import Dataset
from factorlib.errors import InputError
from factorlib.evaluate.truth import read_true_light
from factorlib.generate.eames import SET
from factorlib.generate.folder import focal_px_of_35mm, write_obj
from factorlib.generate.solids import SHAPES
from factorlib.images.picture import picture, png_bytes
from factorlib.jsonfile import write_json
from factorlib.reading import read_text
from factorlib.recipe.kinds import InsertRecipe
from factorlib.render.ground import Plane
from factorlib.render.insertion import GroundSurface, InsertionResult, inserted
from factorlib.render.photo_scene import DistantLight, PlacedMesh
from factorlib.render.recipe_pictures import insertion_scene
from factorlib.render.solved_set import SolvedSet
from factorlib.results.materials import Reflectance
from factorlib.results.poses import AS_IT_IS
from factorlib.stage import Inputs
from factorlib.wholefile import write_bytes, write_text
from studies.errors import factor_of, times
from studies.measured.tools import ROOT

GIVEN = {"chrome": Reflectance((0.0,) * 3, (0.7,) * 3, 0.15), "chalk": Reflectance((0.7,) * 3, (0.0,) * 3, 1.0)}
TABLE = "given.json"
MESHES = ("ball", "chair", "vase.obj", "blob.obj")  # the file of GIVEN, which nobody recovers
NOTICED = 2.3
CHANGED = 1.0
BLUR = 1.0  # ΔE; ΔE; pixels
AROUND = 1.4
LEAST = 60  # half a window's width in the object's larger extent, and in pixels at least
PLACES = 100  # that are tried for an object
FACTORS = ("light", "material", "ground")
XYZ_OF_RGB = np.array(
    [[0.4124564, 0.2126729, 0.0193339], [0.3575761, 0.7151522, 0.119192], [0.1804375, 0.072175, 0.9503041]]
)
Picture = Float[np.ndarray, "h w 3"]
Mask = Bool[np.ndarray, "h w"]
Both = tuple[Picture, Picture]
Sets = tuple[SolvedSet, SolvedSet]  # by what was recovered, and by the truth
replace = msgspec.structs.replace


class Truth(SolvedSet):
    """Set of `factorlib.generate eames` with its true materials, lights, poses and lenses.

    The meshes are the solve's.
    """

    def __init__(self, inputs: Inputs, dataset: Dataset):
        super().__init__(inputs)
        if dataset.truth is None or set(dataset.spec.meshes) != {"chair"}:
            cure = "make one: python -m factorlib.generate eames --seed N --out FOLDER"
            raise InputError("it is no set of chairs with a truth", file=dataset.folder, cure=cure)
        self.truth = dataset.truth
        self.folder = dataset.folder
        lens = {shot.name: shot.focal_35mm for shot in SET.shots}
        self.table = replace(self.table, model=replace(self.table.model, tone={}))
        true = self.truth.materials.items()
        self.materials = {name: Reflectance(m.diffuse, m.specular, m.roughness) for name, m in true}
        for photo, found in self.poses.items():
            height, width = self._masks(photo)["label"].shape
            focal = focal_px_of_35mm(lens[photo], width, height)
            middle = (width / 2, height / 2)
            camera = replace(found.camera, focal_px=focal, principal_point=middle)
            poses = self.truth.poses[photo].items()
            places = {n: {"rotation": p.rotation, "translation": p.translation, "scale": AS_IT_IS} for n, p in poses}
            objects = {name: replace(found.objects[name], **place) for name, place in places.items()}
            self.poses[photo] = replace(found, camera=camera, objects=objects)

    def light(self, name: str) -> DistantLight:
        """Return the true map of a photo's light."""
        return read_true_light(self.folder / self.truth.illumination[name], name).astype(float)

    def ground(self, photo: str, neighbour: PlacedMesh) -> GroundSurface:
        """Return the plane y = 0 of a chair's own frame, on which it stands."""
        pose = self.truth.poses[photo][neighbour.name]
        normal = YUP_FROM_CAMERA @ np.array(pose.rotation)[:, 1]
        return GroundSurface(Plane(normal, YUP_FROM_CAMERA @ np.array(pose.translation)))


def write_files(folder: Path) -> dict[str, Path]:
    """Write what recipes of pairs name: the table of GIVEN, and the meshes that are no set's; as files of `Inputs`."""
    files = {name: folder / name for name in (TABLE, *MESHES) if "." in name}
    write_json(files[TABLE], {"materials": GIVEN})
    for body, path in ((SHAPES[path.stem](), path) for path in files.values() if path.stem in SHAPES):
        write_obj(path, {"all": (body.vertices, body.faces, body.normals)})
    return {f"recipe file:{name}": path for name, path in files.items()}


def chosen(sets: Mapping[str, Sets], count: int, samples: int, seed: int) -> Iterator[tuple[str, str, InsertRecipe]]:
    """Draw sets, photos and recipes of pairs, by a seed alone.

    Photos, meshes and materials are about equally often, places, sizes and turns at random.

    sets: what was recovered, and the truth

    A place where the recipe would refuse or move the object in either is drawn anew; InputError where that happens
    `PLACES` times.
    """
    rng = np.random.default_rng(seed)
    shots = [(name, photo) for name, of in sets.items() for photo in of[0].photos]
    numbers = np.arange(count)
    for shot, mesh, number in np.column_stack([rng.permutation(numbers) for _ in range(3)]):
        name, photo = shots[shot % len(shots)]
        results = sets[name][0]
        materials = [*sets[name][0].materials, *GIVEN]
        camera = results.scene(photo).camera
        factor = results.poses[photo].camera.factor
        what = {"mesh": MESHES[mesh % len(MESHES)], "material": materials[number % len(materials)], "table": TABLE}
        for _ in range(PLACES):
            at = rng.uniform((0.15, 0.6), (0.85, 0.95)) * (camera.width, camera.height) * factor
            size, turn = rng.uniform((0.3, 0.0), (0.5, 360.0)).tolist()
            recipe = InsertRecipe(**what, at=tuple(at.tolist()), size=size, turn=turn, samples=samples)
            try:
                if any(insertion_scene(recipe, of, photo).moved for of in sets[name]):
                    continue
            except InputError:
                continue
            yield name, photo, recipe
            break
        else:
            raise InputError(f"photo '{photo}' has no place for an object", key="photos", cure="name another set")


def drawn(photo: str, recipe: InsertRecipe, recovered: SolvedSet, truth: SolvedSet) -> tuple[Both, dict[str, Any]]:
    """Return the window of the photo about the object, linear, by what was recovered and by the truth.

    The second value is how they differ (`scores`).
    """
    sets = {True: recovered, False: truth}
    ours = insertion_scene(recipe, recovered, photo)
    true = insertion_scene(recipe, truth, photo)
    factor = factor_of(recovered.materials, truth.materials)
    materials = {name: times(m, factor) for name, m in ours.scene.materials.items()}
    scene = replace(ours.scene, materials=materials, light=ours.scene.light.scaled(1 / factor))
    places = {True: replace(ours, scene=scene), False: true}
    pixels = [of.scene.camera.project(of.new.vertices @ YUP_FROM_CAMERA) for of in (ours, true)]
    low = np.concatenate(pixels).min(axis=0)
    high = np.concatenate(pixels).max(axis=0)
    half = max(AROUND * (high - low).max(), LEAST)
    size = (scene.camera.width, scene.camera.height)
    ends = np.clip(np.rint([(low + high) / 2 - half, (low + high) / 2 + half]), 0, size).astype(int)
    left, top = ends[0].tolist()
    width, height = (ends[1] - ends[0]).tolist()
    window = slice(top, top + height), slice(left, left + width)

    def traced(light: bool, material: bool, ground: bool, seed: int = 1) -> tuple[Picture, InsertionResult]:
        """Trace the window with these factors recovered, the others true."""
        here = places[ground]
        seen = sets[light].straightened(photo)[window]
        lit = {"light": places[light].scene.light, "materials": places[material].scene.materials}
        scene = replace(here.scene, camera=here.scene.camera.window(left, top, 1.0, width, height), **lit)
        covered = recovered.covered(photo)[window]
        found = inserted(replace(here, scene=scene), seen, covered, recipe.samples, seed=seed)
        return sets[light].tone(photo)(found.composite), found

    mine, found = traced(True, True, True)
    right, other = traced(False, False, False)
    for side, of in ((True, found), (False, other)):  # the reflectance of each ground, found in its own light
        places[side] = replace(places[side], ground=replace(places[side].ground, diffuse=tuple(of.ground.tolist())))
    parts = {name: traced(*(name == each for each in FACTORS))[0] for name in FACTORS}
    again = traced(True, True, True, seed=2)[0], traced(False, False, False, seed=2)[0]
    body = np.maximum(found.coverage, other.coverage) > 0.5
    return (mine, right), scores((mine, right), again, parts, recovered.photo(photo)[window], body)


def scores(pair: Both, again: Both, parts: Mapping[str, Picture], photo: Picture, body: Mask) -> dict[str, Any]:
    """Measure the difference of a pair's pictures, by what was recovered and by the truth, in a window of the photo.

    again: both with other noise;  parts: with one factor recovered, by name;  body: the object's pixels
    """
    lab = cielab(pair[0])
    true = cielab(pair[1])
    before = cielab(photo)
    changed = (difference(lab, before) > CHANGED) | (difference(true, before) > CHANGED)
    region = binary_dilation(body | changed, iterations=2)
    ground = region & ~binary_dilation(body)

    def error(picture: Picture, than: Picture) -> float:
        of = difference(cielab(picture), than)
        return float(max(of[where].mean() for where in (body, ground) if where.any()))

    by = {"difference": error(pair[0], true), "floor": max(error(again[0], lab), error(again[1], true))}
    by |= {name: error(picture, true) for name, picture in parts.items()}
    told = {"told_apart": by["difference"] > max(NOTICED, by["floor"])}
    return by | told | {"cause": max(parts, key=by.__getitem__)}


def cielab(radiance: Picture) -> Picture:
    """Return L*, a*, b* of what a screen shows of linear Rec. 709 (white D65), blurred as an eye does.

    >>> cielab(np.ones((3, 3, 3)))[1, 1].round(2).tolist()
    [100.0, 0.0, 0.0]
    """
    t = gaussian_filter(np.clip(radiance, 0, 1), (BLUR, BLUR, 0)) @ (XYZ_OF_RGB / XYZ_OF_RGB.sum(axis=0))
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def difference(a: Picture, b: Picture) -> Float[np.ndarray, "h w"]:
    """Return ΔE (CIE 1976) of each pixel of two pictures in CIELAB."""
    return np.linalg.norm(a - b, axis=-1)


def main(
    results: Annotated[list[Path], typer.Argument(help="results of made sets of chairs, such as build/eames")],
    count: Annotated[int, typer.Option(min=1, help="pairs")] = 20,
    samples: Annotated[int, typer.Option(min=1, help="a pixel")] = 256,
    seed: Annotated[int, typer.Option(min=0, help="of what is inserted where")] = 39,
) -> None:
    """Make pairs, and a table of how they differ."""
    home = ROOT / "build/studies/pairs"
    rows = []
    sets = {}
    (home / "pictures").mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as folder:
        files = write_files(Path(folder))
        for result in results:
            loaded = load_result(result)
            inputs = replace(loaded._solved.inputs, files=loaded._solved.inputs.files | files)
            dataset = read_dataset(ROOT / read_text(loaded.folder / "dataset.txt", "a path").strip())
            sets[loaded.folder.name] = SolvedSet(inputs), Truth(inputs, dataset)
        for name, photo, recipe in chosen(sets, count, samples, seed):
            both, numbers = drawn(photo, recipe, *sets[name])
            pair = f"{len(rows) + 1:02}-{name}-{photo}"
            rows.append({"pair": pair, "object": f"{recipe.material} {Path(recipe.mesh).stem}", **numbers})
            for kind, radiance in zip(("inserted", "true"), both, strict=True):
                write_bytes(home / "pictures" / f"{pair}-{kind}.png", png_bytes(picture(radiance, 1.0)))
            print(f"  {pair}, {rows[-1]['object']}: ΔE {numbers['difference']:.1f}", flush=True)
    table = io.StringIO()
    writer = csv.DictWriter(table, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(home / "pairs.csv", table.getvalue())
    print(f"{sum(row['told_apart'] for row in rows)} of {len(rows)} pairs are told apart: {home / 'pairs.csv'}")


if __name__ == "__main__":
    try:
        typer.run(main)
    except InputError as error:
        sys.exit(f"error: {error}")
