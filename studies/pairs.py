"""Pairs of pictures of a rendered set: can an inserted object be told from a true one?

`python -m studies.pairs build/eames` writes pairs.csv and pictures/ to build/studies/pairs.  It traces seven windows a
pair.

One picture of a pair is made by the recovered light, materials and ground, the other by the true ones.  Both are made
by the recipe `insert`, with the same mesh, samples, and pixel at which the object touches the ground.  The truth is the
light of the photograph, infinitely far away as the recipe takes it, the materials, and the plane on which the true
poses and lenses put the chairs.  So a pair shows the errors of recovery, and not the recipe's simplifications, such as
walls near by.

Observer   mean ΔE (CIE 1976, after a blur of σ = 1 pixel) over the object, or over the ground that either picture
           changes, whichever is larger. A pair is told apart where it is above the just noticeable difference, 2.3
           (Mahy, Van Eycken and Oosterlinck, 1994), and above the floor: that of two pictures which differ by noise
           alone.
Cause      the same with one factor recovered and the others true.  The factor per channel between materials and lights,
           which no photograph tells, is first moved from the lights to the materials, so it counts as theirs.
"""

import sys
from argparse import ArgumentParser
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, gaussian_filter

from factorlib import load_result
from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.dataset.read_dataset import read_dataset
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
from factorlib.render.insertion import GroundSurface, InsertionResult, insert_object
from factorlib.render.photo_scene import DistantLight, LightMap, PlacedMesh
from factorlib.render.recipe_pictures import insertion_scene
from factorlib.render.solved_set import SolvedSet
from factorlib.results.materials import Reflectance
from factorlib.stage import Inputs
from factorlib.wholefile import write_bytes, write_text
from studies.measured.tools import ROOT
from studies.recovery_errors import gauge_factor, scale_reflectance

GIVEN = {"chrome": Reflectance((0.0,) * 3, (0.7,) * 3, 0.15), "chalk": Reflectance((0.7,) * 3, (0.0,) * 3, 1.0)}
TABLE = "given.json"  # the file of GIVEN, which nobody recovers
MESHES = ("ball", "chair", "vase.obj", "blob.obj")
NOTICEABLE = 2.3  # ΔE
CHANGED = 1.0  # ΔE
BLUR = 1.0  # pixels
AROUND = 1.4  # half a window's width in the object's larger extent
LEAST = 60  # the same in pixels
TRIALS = 100  # places that are tried for an object
FACTORS = ("light", "material", "ground")
XYZ_OF_RGB = np.array(
    [[0.4124564, 0.2126729, 0.0193339], [0.3575761, 0.7151522, 0.119192], [0.1804375, 0.072175, 0.9503041]]
)
Image = Float[np.ndarray, "h w 3"]
replace = msgspec.structs.replace


class Pair(NamedTuple):
    """Images of one window: by the recovered light, materials and ground, and by the true ones."""

    recovered: Image
    true: Image


class TrueSet(SolvedSet):
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
        for photo, estimate in self.poses.items():
            height, width = self._masks(photo)["label"].shape
            focal = focal_px_of_35mm(lens[photo], width, height)
            camera = replace(estimate.camera, focal_px=focal, principal_point=(width / 2, height / 2))
            objects = {
                n: replace(estimate.objects[n], rotation=p.rotation, translation=p.translation)
                for n, p in self.truth.poses[photo].items()
            }
            self.poses[photo] = replace(estimate, camera=camera, objects=objects)

    def light(self, name: str, photo: str | None = None) -> DistantLight:
        """Return the true map of a photo's light."""
        return LightMap(read_true_light(self.folder / self.truth.illumination[name], name).astype(float))

    def ground(self, photo: str, neighbour: PlacedMesh) -> GroundSurface:
        """Return the plane y = 0 of a chair's own frame, on which it stands."""
        pose = self.truth.poses[photo][neighbour.name]
        normal = YUP_FROM_CAMERA @ np.array(pose.rotation)[:, 1]
        return GroundSurface(Plane(normal, YUP_FROM_CAMERA @ np.array(pose.translation)))


def write_files(folder: Path) -> dict[str, Path]:
    """Write the table of materials GIVEN and the meshes that no set has; return their paths as files of `Inputs`."""
    files = {name: folder / name for name in (TABLE, *MESHES) if "." in name}
    write_json(files[TABLE], {"materials": GIVEN})
    for body, path in ((SHAPES[path.stem](), path) for path in files.values() if path.stem in SHAPES):
        write_obj(path, {"all": (body.vertices, body.faces, body.normals)})
    return {f"recipe file:{name}": path for name, path in files.items()}


def sample_recipes(
    recovered: SolvedSet, truth: SolvedSet, count: int, samples: int, seed: int
) -> Iterator[tuple[str, InsertRecipe]]:
    """Draw photos and recipes of pairs, by a seed alone.

    Photos, meshes and materials are about equally often, places, sizes and turns at random.  A place where the recipe
    would refuse or move the object in either is drawn anew; InputError if that happens `TRIALS` times.
    """
    rng = np.random.default_rng(seed)
    photos = list(recovered.photos)
    materials = [*recovered.materials, *GIVEN]
    for k, mesh, material in np.column_stack([rng.permutation(count) for _ in range(3)]):
        photo = photos[k % len(photos)]
        camera = recovered.scene(photo).camera
        factor = recovered.poses[photo].camera.factor
        fields = {"mesh": MESHES[mesh % len(MESHES)], "material": materials[material % len(materials)], "table": TABLE}
        for _ in range(TRIALS):
            at = rng.uniform((0.15, 0.6), (0.85, 0.95)) * (camera.width, camera.height) * factor
            size, turn = rng.uniform((0.3, 0.0), (0.5, 360.0)).tolist()
            recipe = InsertRecipe(**fields, at=tuple(at.tolist()), size=size, turn=turn, samples=samples)
            with suppress(InputError):
                if not any(insertion_scene(recipe, solved, photo).moved for solved in (recovered, truth)):
                    yield photo, recipe
                    break
        else:
            raise InputError(f"photo '{photo}' has no place for an object", key="photos", cure="name another set")


def render_pair(
    photo: str, recipe: InsertRecipe, recovered: SolvedSet, truth: SolvedSet
) -> tuple[Pair, dict[str, Any]]:
    """Return the window of the photo about the object, linear, and the scores of the pair (`score`)."""
    sets = Pair(recovered, truth)
    scenes = [insertion_scene(recipe, solved, photo) for solved in sets]
    factor = gauge_factor(recovered.materials, truth.materials)
    scene = scenes[0].scene
    materials = {name: scale_reflectance(m, factor) for name, m in scene.materials.items()}
    scenes[0] = replace(scenes[0], scene=replace(scene, materials=materials, light=scene.light.scale(1 / factor)))
    left, top, right, bottom = _window(scenes)
    window = slice(top, bottom), slice(left, right)

    def trace(light: bool, material: bool, ground: bool, seed: int = 1) -> tuple[Image, InsertionResult]:
        """Trace the window with these factors true, the others recovered."""
        insertion = scenes[ground]
        lit = {"light": scenes[light].scene.light, "materials": scenes[material].scene.materials}
        camera = insertion.scene.camera.window(left, top, 1.0, right - left, bottom - top)
        insertion = replace(insertion, scene=replace(insertion.scene, camera=camera, **lit))
        background = sets[light].linear_photo(photo)[window]
        result = insert_object(insertion, background, recovered.photo_mask(photo)[window], recipe.samples, seed=seed)
        return sets[light].tone(photo)(result.composite), result

    (image, result), (true_image, true_result) = trace(False, False, False), trace(True, True, True)
    for k, each in enumerate((result, true_result)):  # the reflectance of each ground, estimated in its own light
        scenes[k] = replace(scenes[k], ground=replace(scenes[k].ground, diffuse=tuple(each.ground.tolist())))
    parts = {name: trace(*(name != each for each in FACTORS))[0] for name in FACTORS}
    pair = Pair(image, true_image)
    repeated = Pair(*(trace(true, true, true, seed=2)[0] for true in (False, True)))
    body = np.maximum(result.coverage, true_result.coverage) > 0.5
    return pair, score(pair, repeated, parts, recovered.photo(photo)[window], body)


def _window(scenes: list) -> list[int]:
    """Return left, top, right and bottom of a square about the objects of the scenes, inside the photo."""
    camera = scenes[0].scene.camera
    pixels = np.concatenate([s.scene.camera.project(s.new.vertices @ YUP_FROM_CAMERA) for s in scenes])
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    half = max(AROUND * (high - low).max(), LEAST)
    corners = np.rint([(low + high) / 2 - half, (low + high) / 2 + half])
    return np.clip(corners, 0, (camera.width, camera.height)).astype(int).reshape(-1).tolist()


def score(
    pair: Pair, repeated: Pair, parts: Mapping[str, Image], photo: Image, body: Bool[np.ndarray, "h w"]
) -> dict[str, Any]:
    """Measure the difference of a pair's images in a window of the photo.

    Args:
        pair: Images of the pair.
        repeated: The same with other noise.
        parts: Images with one factor recovered, by its name.
        photo: The photo without the object.
        body: Pixels of the object.
    """
    recovered, true, before = (cielab(image) for image in (*pair, photo))
    changed = (paired_difference(recovered, before) > CHANGED) | (paired_difference(true, before) > CHANGED)
    ground = binary_dilation(body | changed, iterations=2) & ~binary_dilation(body)

    def error(image: Image, reference: Image) -> float:
        errors = paired_difference(cielab(image), reference)
        return float(max(errors[region].mean() for region in (body, ground) if region.any()))

    whole = error(pair.recovered, true)
    floor = max(error(repeated.recovered, recovered), error(repeated.true, true))
    errors = {name: error(image, true) for name, image in parts.items()}
    verdict = {"told_apart": whole > max(NOTICEABLE, floor), "cause": max(errors, key=errors.__getitem__)}
    return {"difference": whole, "floor": floor, **errors, **verdict}


def cielab(radiance: Image) -> Image:
    """Return L*, a*, b* of linear Rec. 709 (white D65) on a screen, blurred as by an eye.

    >>> cielab(np.ones((3, 3, 3)))[1, 1].round(2).tolist()
    [100.0, 0.0, 0.0]
    """
    t = gaussian_filter(np.clip(radiance, 0, 1), (BLUR, BLUR, 0)) @ (XYZ_OF_RGB / XYZ_OF_RGB.sum(axis=0))
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def paired_difference(a: Image, b: Image) -> Float[np.ndarray, "h w"]:
    """Return ΔE (CIE 1976) of each pixel of two pictures in CIELAB."""
    return np.linalg.norm(a - b, axis=-1)


def main(build: Path, count: int, samples: int, seed: int) -> None:
    """Render pairs, and write a table of their differences."""
    out = ROOT / "build/studies/pairs"
    rows = []
    (out / "pictures").mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as folder:
        result = load_result(build)
        inputs = replace(result._solved.inputs, files=result._solved.inputs.files | write_files(Path(folder)))
        dataset = read_dataset(ROOT / read_text(result.folder / "dataset.txt", "a path").strip())
        sets = SolvedSet(inputs), TrueSet(inputs, dataset)
        for photo, recipe in sample_recipes(*sets, count, samples, seed):
            pair, scores = render_pair(photo, recipe, *sets)
            name = f"{len(rows) + 1:02}-{result.folder.name}-{photo}"
            rows.append({"pair": name, "object": f"{recipe.material} {Path(recipe.mesh).stem}", **scores})
            for kind, image in zip(("inserted", "true"), pair, strict=True):
                write_bytes(out / "pictures" / f"{name}-{kind}.png", png_bytes(picture(image, 1.0)))
            print(f"  {name}, {rows[-1]['object']}: ΔE {scores['difference']:.1f}", flush=True)
    lines = [",".join(map(str, row)) for row in (rows[0], *(row.values() for row in rows))]
    write_text(out / "pairs.csv", "\n".join([*lines, ""]))
    print(f"{sum(row['told_apart'] for row in rows)} of {len(rows)} pairs are told apart: {out / 'pairs.csv'}")


if __name__ == "__main__":
    parser = ArgumentParser(description=main.__doc__)
    parser.add_argument("build", type=Path, help="results of a rendered set of chairs, such as build/eames")
    for name, default, meaning in (("count", 20, "pairs"), ("samples", 256, "a pixel"), ("seed", 39, "of the objects")):
        parser.add_argument(f"--{name}", type=int, default=default, help=meaning)
    try:
        main(**vars(parser.parse_args()))
    except InputError as error:
        sys.exit(f"error: {error}")
