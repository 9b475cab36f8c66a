"""What a recipe may say: one struct for each kind of picture, its fields those of the YAML file.

    kind: relight
    photos: [kitchen]
    lights: [hall, my_studio.exr]

Photos, objects, materials and lights go by their names in dataset.yaml; files are relative to the recipe.  Materials of one's own stand in
a table, a JSON file like materials.json, of which only the reflectances are read.
Angles are in degrees, sizes in pixels, colours linear Rec. 709.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec

from factorlib.dataset.schema import Share, Shares, Vec2, Vec3
from factorlib.errors import InputError
from factorlib.reading import read_text, reading

Samples = Annotated[int, msgspec.Meta(ge=1, le=65536)]
Pixels = Annotated[int, msgspec.Meta(ge=8, le=8192)]
Frames = Annotated[int, msgspec.Meta(ge=2, le=1000)]
Degrees = Annotated[float, msgspec.Meta(ge=-360, le=360)]
Factor = Annotated[float, msgspec.Meta(ge=0.01, le=100)]
Seconds = Annotated[float, msgspec.Meta(gt=0, le=1200)]  # a GIF shows a frame for 655 s at most
LIGHT_FILES, BALL = (".hdr", ".exr"), "ball"
MOST_REFLECTED = 0.999  # max diffuse + max specular: a surface that reflects more than arrives never comes to rest with light between surfaces
DENOISER = "mitsuba_oidn"  # as it is imported
CURE = 'write {"materials": {"gold": {"diffuse": [r, g, b], "specular": [r, g, b], "roughness": 0.2}}}, numbers from 0 to 1'


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind"):
    """The fields that every kind has."""

    samples: Samples = 256
    """Samples per pixel of the path tracer: noise falls as their square root."""
    denoise: bool = False
    """Whether what is left of the noise is taken out by Intel Open Image Denoise (the extra `denoise`)."""


class AssumedSun(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sun that takes the place of the recovered ones; the light as a whole keeps its energy, in each channel."""

    direction: Vec3
    """Toward the sun, in the frame of the photo's exported light (illumination/<name>.exr, lights.json): x right, y up, z toward the viewer
    for a light fixed to the camera, the same turn of the world for one fixed to it."""
    strength: Annotated[float, msgspec.Meta(ge=0, le=1)]
    """Share of the light's energy (the integral of its radiance over the sphere) that the sun holds."""
    size: Annotated[float, msgspec.Meta(ge=0.05, le=90)] = 0.53
    """Diameter in degrees."""


class OfPhotos(Recipe, frozen=True, kw_only=True):
    """The fields of kinds that make pictures of each photo."""

    photos: list[str] = []
    """Photos whose camera, objects and light are used; all of them where none is named."""
    sun: AssumedSun | None = None
    """A sun that is assumed, in the light of the one photo that the recipe names."""


class Sized(OfPhotos, frozen=True, kw_only=True):
    """The fields of kinds whose pictures need not be the photo's size."""

    width: Pixels | None = None
    """Width of the pictures; without it that of the photo as the pipeline works on it."""


class Backdropped(Sized, frozen=True, kw_only=True):
    """The fields of kinds that show what is beside the objects."""

    background: Literal["none", "light"] = "none"
    """What is seen beside the objects: nothing (transparent), or the light."""
    floor: Share | None = None
    """Reflectance of a grey floor that takes the objects' shadow and fades out around them; none where it is not given."""


class Resynthesis(OfPhotos, frozen=True, kw_only=True, tag="resynthesis"):
    """The photo with its objects replaced by path-traced ones."""


class View(Backdropped, frozen=True, kw_only=True, tag="view"):
    """The objects from another side: the camera is moved about their middle; the light stays."""

    azimuth: Degrees = 30.0
    """Angle about the camera's upright axis, to the right as the photo's camera sees it."""
    elevation: Annotated[float, msgspec.Meta(ge=-89, le=89)] = 0.0
    """Angle upward, added to the photo's own."""
    zoom: Factor = 1.0
    """Factor on the size in the picture."""


class Turntable(Backdropped, frozen=True, kw_only=True, tag="turntable"):
    """An animation once around the objects; the light stays."""

    frames: Frames = 24
    """Pictures of the whole turn."""
    seconds: Seconds = 4.0
    """Of the whole turn."""


class MovingLight(Sized, frozen=True, kw_only=True, tag="moving_light"):
    """An animation in which the light turns once about the camera's upright axis, so that highlights move."""

    frames: Frames = 24
    """Pictures of the whole turn."""
    seconds: Seconds = 4.0
    """Of the whole turn."""


class Relight(Backdropped, frozen=True, kw_only=True, tag="relight"):
    """The photo's objects in other lights."""

    lights: list[str] = []
    """Photos whose light is used, or files (.hdr, .exr: lat-long, up is the first row); all other photos where none is named."""
    rotate: Degrees = 0.0
    """Turn of those lights about the camera's upright axis."""


class Transfer(OfPhotos, frozen=True, kw_only=True, tag="transfer"):
    """The photo with other materials on its objects."""

    materials: dict[str, str]
    """Material of the data set -> the one that takes its place: another of the data set, or one of `table`."""
    table: str | None = None
    """File of materials of one's own, like materials.json."""


class Polish(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a ground reflects beside its diffuse colour, which the photo shows."""

    specular: Shares = (0.0, 0.0, 0.0)
    """k_s of a ground that reflects, such as a polished floor."""
    roughness: Share = 0.3
    """Of that reflection."""


class Insert(OfPhotos, frozen=True, kw_only=True, tag="insert"):
    """A further object in the photo, standing beside one that is there, with its shadow."""

    mesh: str = "ball"
    """`ball`, a mesh of the data set, or a mesh file."""
    material: str | dict[str, str] | None = None
    """Material of the data set or of `table`, or own material -> another for parts of a mesh of the data set; without it the mesh's own, and for a
    file or ball the data set's first."""
    table: str | None = None
    """File of materials of one's own, like materials.json."""
    beside: str | None = None
    """Object on whose ground it stands; without it the photo's first."""
    at: Vec2 | None = None
    """Pixel of the photo where it touches the ground; without it beside the object, where there is more room."""
    size: Factor = 0.5
    """Its height, in heights of that object."""
    turn: Degrees = 0.0
    """Turn about the ground's normal."""
    up: Literal["x", "y", "z"] = "y"
    """The axis of a mesh file that points upward."""
    ground: Polish = Polish()
    """What the ground reflects beside its diffuse colour."""


class Grid(Recipe, frozen=True, kw_only=True, tag="grid"):
    """Balls of every material in every light, in one picture: rows are materials, columns lights, those that no photo shows included."""

    materials: list[str] = []
    """Materials of the data set; all where none is named."""
    lights: list[str] = []
    """Photos whose light is used, or files; all photos where none is named."""
    size: Pixels = 128
    """Of a ball's picture."""


AnyRecipe = Resynthesis | View | Turntable | MovingLight | Relight | Transfer | Insert | Grid
KINDS = {kind.__struct_config__.tag: kind for kind in AnyRecipe.__args__}


def recipe_of(facts: dict) -> AnyRecipe:
    """A recipe from its JSON-able facts, as a stage is handed them."""
    return msgspec.convert(facts, KINDS[facts["kind"]])


def is_light_file(name: str) -> bool:
    """Return whether a light is a file, not a photo's.

    >>> is_light_file("studio.hdr"), is_light_file("kitchen")
    (True, False)
    """
    return name.lower().endswith(LIGHT_FILES)


def is_mesh_file(name: str) -> bool:
    """Return whether a mesh is a file, not one of the data set or the ball: it has a suffix."""
    return "." in name


class OwnMaterial(msgspec.Struct, frozen=True):
    """Lambert k_d and GGX k_s per channel (linear Rec. 709), and roughness with α = roughness²; what else the file says is passed over."""

    diffuse: Shares
    specular: Shares
    roughness: Share


def read_table(path: Path) -> dict[str, OwnMaterial]:
    """Read the materials by name; raises InputError for a file that is no such table, or has a material that reflects more light than arrives."""
    text = read_text(path, "a table of materials")
    with reading("a table of materials", path, cure=CURE):
        content = msgspec.json.decode(text)
    materials = content.get("materials") if isinstance(content, dict) else None
    if not isinstance(materials, dict) or not materials:
        raise InputError("it holds no materials", file=path, key="materials", cure=CURE)
    table = {}
    for name, entry in materials.items():
        key = f"materials.{name}"
        try:
            table[name] = msgspec.convert(entry, OwnMaterial)
        except msgspec.ValidationError as error:
            raise InputError(str(error), file=path, key=key, cure=CURE) from None
        total = max(table[name].diffuse) + max(table[name].specular)
        if total > MOST_REFLECTED:
            found = f"max diffuse + max specular = {total:.3f}: more light is reflected than arrives"
            raise InputError(found, file=path, key=key, cure=f"at most {MOST_REFLECTED}")
    return table
