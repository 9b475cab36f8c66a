"""A result in Python: `factorlib.load_result("build/eames")`.

    r = factorlib.load_result("build/eames")
    r.materials["red"].roughness, r.materials["red"].stderr.roughness
    r.environment("kitchen").rotate(90).to_exr("kitchen.exr")
    r.relight("kitchen/yellow_chair", "garden")    # a picture, shown by a notebook
    r.render(view="terrace", azimuth=40).to_png("terrace.png")
    r.insert("kitchen", mesh="chair", material="black", size=0.7).save("pictures")      # as by a recipe

An error for an unknown name lists the known ones.  Pictures are path-traced, as those of recipes.
"""

from __future__ import annotations

import base64
import html
import logging
import os
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import msgspec
import numpy as np
from jaxtyping import Float
from PIL import Image

from factorlib.errors import InputError, did_you_mean
from factorlib.geometry.camera import rotation_of_vector
from factorlib.images.exr import LAT_LONG, read_rgb_exr, write_hdr, write_rgb_exr
from factorlib.images.light_map import read_light_map
from factorlib.images.picture import data_uri, picture
from factorlib.jsonfile import read_json
from factorlib.light.latlong import rotate_map
from factorlib.reading import check_plain
from factorlib.recipe import kinds
from factorlib.recipe.kinds import KINDS, AnyRecipe, is_light_file
from factorlib.recipe.read_recipe import check_recipe, files_of
from factorlib.render.photo_scene import (
    DistantLight,
    LightMap,
    Orbit,
    PhotoScene,
    TracedPicture,
    identity_tone,
    resize_scene,
    traced_photo,
)
from factorlib.render.recipe_pictures import draw
from factorlib.render.solved_set import SolvedSet
from factorlib.results.exchange import with_exchange
from factorlib.results.materials import SolvedMaterial
from factorlib.stage import Inputs, silent
from factorlib.wholefile import write_bytes
from factorlib.yamlfile import convert

T = TypeVar("T")
STAGES = "masks", "align", "export"
# slices of the data set that the stage `recipes` receives
SLICES = {
    "dataset.materials",
    "dataset.objects",
    "dataset.light",
    "dataset.ground",
}
MARK = "dataset.txt"
SAMPLES = 32  # default samples per pixel
LONGEST_SIDE = 480  # longer side of a photo in a notebook, pixels
log = logging.getLogger("factorlib.result")


def load_result(folder: str | Path) -> Result:
    """Load the result in a folder such as build/eames, or called eames in build/.

    The folder is relative to the current one, or else to one above it.  The result is self-contained: the data set is
    not read and may have changed or be gone.  The folder may be a copy (`cp -rL build/eames …`).

    Raises:
        InputError: There is no result, or it is incomplete.
    """
    if not isinstance(folder, str | os.PathLike):
        raise InputError(
            f"a result is named by a path, not by {type(folder).__name__} {folder!r}",
            cure='name its folder, as in load_result("build/eames")',
        )
    # the current folder and those above it, because a notebook runs in its own folder
    places = [Path(*k * [".."]) for k in range(len(Path.cwd().parts))]
    candidates = [path for place in places for path in (place / folder, place / "build" / folder)]
    result = next((path for path in candidates if os.path.isfile(path / MARK)), None)
    if result is None:
        inside = (parent for path in candidates if os.path.exists(path) for parent in path.parents)
        if whole := next((parent for parent in inside if os.path.isfile(parent / MARK)), None):
            raise InputError("this is a part of a result", file=folder, cure=f'load_result("{whole}") loads the whole')
        results = (sorted(str(path.parent) for path in place.glob(f"build/*/{MARK}")) for place in places)
        known = next(filter(None, results), None)
        raise InputError(
            "there is no result here",
            file=folder,
            cure=did_you_mean(str(folder), known) if known else "make all DATASET=<name> makes one",
        )
    if missing := [stage for stage in STAGES if not (result / stage).exists()]:
        cure = f"make all DATASET={Path((result / MARK).read_text(encoding='utf-8', errors='replace').strip()).name}"
        raise InputError(f"the result is incomplete: {missing[0]} is missing", file=result, cure=cure)
    stages = [stage for stage in (*STAGES, "shapes", "surface", "texture", "exchange") if (result / stage).is_dir()]
    folders = {stage: (result / stage).resolve() for stage in stages}
    file = result / "export" / "dataset.json"
    source = folders["export"] / "source"
    facts = read_json(file) if file.is_file() else {}
    if not (isinstance(facts, dict) and facts.keys() >= SLICES):
        raise InputError(
            "the result has no facts of its data set", file=file, cure=f"make export DATASET={result.name}"
        )
    files = {path.relative_to(source).as_posix(): path for path in sorted(source.rglob("*")) if path.is_file()}
    return Result(result, SolvedSet(with_exchange(Inputs(folders, facts, files))))


class UnknownName(InputError, KeyError):
    """An InputError that is also a KeyError, so that `get` and `in` work as for any mapping."""


class Named(Mapping[str, T]):
    """A mapping whose error for a missing name lists the known ones."""

    def __init__(self, kind: str, table: Mapping[str, T]):
        self._kind = kind
        self._table = table

    def __getitem__(self, name: str) -> T:
        if not isinstance(name, str) or name not in self._table:
            raise UnknownName(f"there is no {self._kind} {name!r}", cure=did_you_mean(str(name), self._table))
        return self._table[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._table)

    def __len__(self) -> int:
        return len(self._table)

    def __repr__(self) -> str:
        return f"{self._kind}s: {', '.join(self._table)}"


class Result:
    """The solution of a data set.

    Attributes:
        materials: by name, with `diffuse`, `specular` (linear Rec. 709), `roughness` and their standard errors `stderr`
        photos: names of the photos
        objects: names of the objects, as in dataset.yaml, or <photo>/<object> if several photos have one of that name
    """

    def __init__(self, folder: Path, solved: SolvedSet):
        self.folder = folder
        self._solved = solved
        self.materials: Named[SolvedMaterial] = Named(
            "material", {name: solved.table.materials[name] for name in solved.names}
        )
        self.photos = solved.photos

    @property
    def objects(self) -> list[str]:
        """Names of all objects, as <photo>/<object>."""
        return [f"{photo}/{obj.name}" for photo, each in self._solved.objects.items() for obj in each.objects]

    def environment(self, name: str) -> Environment:
        """Return the exported environment map of a photo's light (`docs/formats.md`); InputError for an unknown photo.

        It is in the light's own frame, which is the world's if the photo has `world_from_camera`.  It does not include
        the photo's exposure.
        """
        light = self._solved.lights[self._photo(name)].illumination
        path = self._solved.inputs.folders["export"] / "illumination" / f"{light}.exr"
        check_plain(path, "an environment map", most_bytes=None)
        return Environment(read_rgb_exr(path).astype(float))

    def render(
        self,
        view: str,
        azimuth: float = 0.0,
        elevation: float = 0.0,
        zoom: float = 1.0,
        width: int | None = None,
        samples: int = SAMPLES,
    ) -> Picture:
        """Render the objects of a photo in its light, from its camera or another view.

        Args:
            view: name of the photo
            azimuth: angle of the camera about the objects' middle, to the right; degrees
            elevation: angle of the camera about the objects' middle, upward; degrees
            zoom: magnification of the objects
            width: width of the picture in pixels; None is the photo's
            samples: samples per pixel

        Raises:
            InputError: The photo is unknown, or a number is out of range.
        """
        photo = self._photo(view)
        _check(kinds.ViewRecipe, azimuth=azimuth, elevation=elevation, zoom=zoom, width=width, samples=samples)
        scene = resize_scene(self._solved.scene(photo), width)
        traced = traced_photo(scene, samples, Orbit(azimuth, elevation, zoom).world_from_camera(scene))
        return Picture(traced, self._solved.tone(photo), photo)

    def relight(
        self, name: str, light: str | Path | Environment, width: int | None = None, samples: int = SAMPLES
    ) -> Picture:
        """Render an object, as its photo shows it, in another light.

        If several photos have an object of that name, the first is used; a warning and the picture's `about` name it.

        Args:
            name: name of the object
            light: name of a photo, a file (.hdr, .exr), or an `Environment`
            width: width of the picture in pixels; None is the photo's
            samples: samples per pixel

        Raises:
            InputError: A name is unknown, a file is not a light map, or a number is out of range.
        """
        photo, obj = self._object(name)
        light = str(light) if isinstance(light, Path) else light
        _check(kinds.RelightRecipe, width=width, samples=samples)
        scene = resize_scene(self._solved.scene(photo), width)
        objects = tuple(each for each in scene.objects if each.name == obj)
        traced = traced_photo(msgspec.structs.replace(scene, objects=objects, light=self._light(light, photo)), samples)
        light_photo = light if isinstance(light, str) and light in self.photos else None
        about = f"{photo}/{obj} in {light if isinstance(light, str) else 'a given light'}"
        return Picture(traced, identity_tone if light_photo is None else self._solved.tone(light_photo), about)

    def insert(self, photo: str, **fields: Any) -> RenderedFiles:
        """Insert a further object on the ground of a photo, with its shadow.

        Args:
            photo: name of the photo
            **fields: fields of the recipe `insert` (`docs/recipes.md`): mesh, material, beside, at, size, turn, …;
                files are relative to the current folder

        Raises:
            InputError: A name or field is unknown, or the object has no place.
        """
        return self._render_recipe("insert", photo, fields)

    def turntable(self, photo: str, **fields: Any) -> RenderedFiles:
        """Render one turn around the objects of a photo, as GIF and frames.

        Args:
            photo: name of the photo
            **fields: fields of the recipe `turntable`

        Raises:
            InputError: As for `insert`.
        """
        return self._render_recipe("turntable", photo, fields)

    def transfer(self, photo: str, materials: Mapping[str, str], **fields: Any) -> RenderedFiles:
        """Render a photo with other materials on its objects.

        Args:
            photo: name of the photo
            materials: new material by old one
            **fields: fields of the recipe `transfer`

        Raises:
            InputError: As for `insert`.
        """
        return self._render_recipe("transfer", photo, {"materials": materials, **fields})

    def _render_recipe(self, kind: str, photo: str, fields: dict[str, Any]) -> RenderedFiles:
        """Render a recipe for one photo."""
        recipe = _check(KINDS[kind], photos=[photo], **fields)
        path = Path(kind)
        inputs = self._solved.inputs
        objects = {name: each.objects for name, each in self._solved.objects.items()}
        lights = {light.illumination for light in self._solved.lights.values()}
        check_recipe(recipe, path, objects, lights, self._solved.names)
        recipe_files = {f"recipe file:{name}": file for name, file in files_of(recipe, path).items()}
        solved = SolvedSet(msgspec.structs.replace(inputs, files=inputs.files | recipe_files))
        with TemporaryDirectory() as out:
            draw(recipe, solved, Path(out), silent)
            files = sorted(path for path in Path(out).rglob("*") if path.is_file())
            return RenderedFiles({path.relative_to(out).as_posix(): path.read_bytes() for path in files})

    def scene(self, photo: str) -> PhotoScene:
        """Return the photo's camera, objects and light, for custom pictures (`factorlib.render.photo_scene`)."""
        return self._solved.scene(self._photo(photo))

    def _photo(self, name: str) -> str:
        return Named("photo", {photo: photo for photo in self.photos})[name]

    def _object(self, name: str) -> tuple[str, str]:
        known = {f"{photo}/{obj}": (photo, obj) for photo, obj in (each.split("/") for each in self.objects)}
        short = {obj: (photo, obj) for photo, obj in reversed(known.values())}  # keeps the first photo that has it
        place = Named("object", {**short, **known})[name]
        if name not in known and len(others := [each for each, (_, obj) in known.items() if obj == name]) > 1:
            log.warning("'%s' could be %s: that of '%s' is used", name, " or ".join(others), place[0])
        return place

    def _light(self, light: str | Environment, photo: str) -> DistantLight:
        """Return a light as it stands in a photo; maps are upright in its world, as exported ones are."""
        if isinstance(light, str) and is_light_file(light):
            light = Environment(read_light_map(Path(light)))
        if isinstance(light, Environment):
            return LightMap(light.lat_long, self._solved.world_from_map(photo))
        return self._solved.light(self._photo(light), photo)

    def __repr__(self) -> str:
        return f"{self.folder}: {len(self.photos)} photos, {self.materials!r}"

    def _repr_html_(self) -> str:
        parts = ("diffuse", "specular", "roughness")
        rows = []
        for name, material in self.materials.items():
            pairs = [[np.atleast_1d(getattr(each, part)) for each in (material, material.stderr)] for part in parts]
            cells = [", ".join(f"{value:.3f} ± {error:.3f}" for value, error in zip(*p, strict=True)) for p in pairs]
            rows.append((html.escape(name), *cells))
        lines = [("th", ("material", *parts)), *(("td", row) for row in rows)]
        table = "".join(f"<tr>{''.join(f'<{tag}>{cell}</{tag}>' for cell in cells)}</tr>" for tag, cells in lines)
        about = html.escape(f"{self.folder}: photos {', '.join(self.photos)}")
        return f"<p>{about}</p><table>{table}</table>"


def _check(kind: type[AnyRecipe], **fields: Any) -> AnyRecipe:
    """Return the recipe with these fields; InputError for an unknown name and a value out of range."""
    plain = {key: value.item() if isinstance(value, np.generic) else value for key, value in fields.items()}
    return convert(plain, kind, str(kind.__struct_config__.tag))


class Environment(msgspec.Struct, frozen=True):
    """A lat-long environment map.

    Attributes:
        lat_long: [h, 2h, 3], linear Rec. 709; the top row is up (+y), the middle of the picture toward the viewer (+z)
    """

    lat_long: Float[np.ndarray, "h w 3"]

    def rotate(self, degrees: float) -> Environment:
        """Return the map turned about the upright axis; at 90° the viewer's side (+z) goes to the right (+x)."""
        rotation = rotation_of_vector(np.radians(degrees) * np.array([0.0, 1.0, 0.0]))
        return Environment(rotate_map(self.lat_long, rotation))

    def to_exr(self, path: str | Path) -> None:
        """Write the map as OpenEXR's lat-long environment."""
        write_rgb_exr(path, self.lat_long, LAT_LONG)

    def to_hdr(self, path: str | Path) -> None:
        """Write the map as Radiance HDR: eight bits per channel with a common exponent."""
        write_hdr(path, self.lat_long)

    def __repr__(self) -> str:
        size = f"{self.lat_long.shape[1]} × {len(self.lat_long)}"
        return f"Environment, {size}, radiance at most {self.lat_long.max():.4g}"

    def _repr_html_(self) -> str:
        return _image(picture(self.lat_long))


class Picture(TracedPicture, frozen=True):
    """A path-traced picture that notebooks display, darkened if it would be overexposed.

    Attributes:
        about: description of the picture
    """

    about: str = ""

    def __repr__(self) -> str:
        return f"Picture of {self.about}, {self.pixels.shape[1]} × {len(self.pixels)}"

    def _repr_html_(self) -> str:
        return _image(self.rgba(min(1.0, self.exposure))) + f"<br>{html.escape(self.about)}"


class RenderedFiles(dict[str, bytes]):
    """The files that a recipe makes of a photo, by name.

    They are PNG (8-bit sRGB), EXR (linear) and, for an animation, a GIF and its frames.
    """

    def save(self, folder: str | Path) -> None:
        """Write the files into a folder, which is created if needed; existing files are replaced."""
        for name, data in self.items():
            (path := Path(folder, name)).parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, data)

    def __repr__(self) -> str:
        return f"Files: {', '.join(name for name in self if '/' not in name)}"

    def _repr_html_(self) -> str:
        name = next(name for kind in (".gif", ".png") for name in self if name.endswith(kind))
        kind = name[-3:]
        data = self[name]
        if kind == "png":  # a photo at full size, reduced for the notebook
            reduced = Image.open(BytesIO(data)).convert("RGB")
            memory = BytesIO()
            kind = "jpeg"
            reduced.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
            reduced.save(memory, "JPEG", quality=90)
            data = memory.getvalue()
        image = f'<img src="data:image/{kind};base64,{base64.b64encode(data).decode("ascii")}">'
        return f"{image}<br>{html.escape(repr(self))}"


def _image(pixels: np.ndarray) -> str:
    return f'<img src="{data_uri(pixels)}">'
