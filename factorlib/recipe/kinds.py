"""Schema of recipes: one struct for each kind of picture, with the fields of the YAML file.

    kind: relight
    photos: [kitchen]
    lights: [hall, my_studio.exr]

Photos, objects, materials and lights have their names in dataset.yaml.  Files are relative to the recipe.
User-supplied materials stand in a table: in the recipe, or in a JSON file like materials.json, of which only the
reflectances are read.
Angles are in degrees, sizes in pixels, colours linear Rec. 709.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec

from factorlib.dataset.schema import GivenMaterial, Share, Vec2
from factorlib.errors import InputError
from factorlib.reading import read_text, reading

Samples = Annotated[int, msgspec.Meta(ge=1, le=65536)]
Pixels = Annotated[int, msgspec.Meta(ge=8, le=8192)]
Frames = Annotated[int, msgspec.Meta(ge=2, le=1000)]
Degrees = Annotated[float, msgspec.Meta(ge=-360, le=360)]
Factor = Annotated[float, msgspec.Meta(ge=0.01, le=100)]
Seconds = Annotated[float, msgspec.Meta(gt=0, le=1200)]  # a GIF shows a frame for 655 s at most
Table = str | dict[str, GivenMaterial] | None  # a file, or materials by name
LIGHT_FILES = (".hdr", ".exr")
BALL = "ball"
MOST_REFLECTED = 0.999  # largest max diffuse + max specular: with more, light between surfaces does not decay
CURE = (
    'write {"materials": {"gold": {"diffuse": [r, g, b], "specular": [r, g, b], "roughness": 0.2}}}, '
    "numbers from 0 to 1"
)


class PhotoRecipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind"):
    """Fields that every kind of recipe has."""

    samples: Samples = 32
    """Samples per pixel of the path tracer; the noise falls with their square root."""
    photos: list[str] = []
    """Photos whose camera, objects and light are used; by default all."""


class ResizedRecipe(PhotoRecipe, frozen=True, kw_only=True):
    """Fields of recipes whose pictures may differ from the photo in size."""

    across: Pixels | None = None
    """Pixels along the longer side of the objects, to which the picture is cropped; by default 640, or as many as the
    photo's file has if these are fewer."""
    width: Pixels | None = None
    """Width of the pictures, which then show the whole frame of the photo."""


class BackgroundRecipe(ResizedRecipe, frozen=True, kw_only=True):
    """Fields of recipes whose objects may stand on a floor, before the light."""

    background: Literal["none", "light"] = "none"
    """Background of the objects: none (transparent), or the light."""
    floor: Share | None = None
    """Reflectance of a grey floor that receives the objects' shadow and fades out around them; by default no floor."""


class ResynthesisRecipe(PhotoRecipe, frozen=True, kw_only=True, tag="resynthesis"):
    """Recipe of a photo with its objects replaced by path-traced ones."""


class ViewedRecipe(BackgroundRecipe, frozen=True, kw_only=True):
    """Fields of recipes whose camera moves about the middle of the objects."""

    azimuth: Degrees = 0.0
    """Angle about the camera's upright axis, to the right in the photo."""
    elevation: Annotated[float, msgspec.Meta(ge=-89, le=89)] = 0.0
    """Angle upward, relative to the photo's camera."""
    zoom: Factor = 1.0
    """Magnification of the objects in the picture."""


class ViewRecipe(ViewedRecipe, frozen=True, kw_only=True, tag="view"):
    """Recipe of the objects from another view; the light stays."""

    azimuth: Degrees = 30.0


class TurntableRecipe(BackgroundRecipe, frozen=True, kw_only=True, tag="turntable"):
    """Recipe of an animation once around the objects; the light stays."""

    frames: Frames = 24
    """Number of pictures in the whole turn."""
    seconds: Seconds = 4.0
    """Duration of the whole turn."""


class MovingLightRecipe(ResizedRecipe, frozen=True, kw_only=True, tag="moving_light"):
    """Recipe of an animation in which the light turns once about the camera's upright axis."""

    frames: Frames = 24
    """Number of pictures in the whole turn."""
    seconds: Seconds = 4.0
    """Duration of the whole turn."""


class RelightRecipe(ViewedRecipe, frozen=True, kw_only=True, tag="relight"):
    """Recipe of the photo's objects in other lights, from the photo's view or from another."""

    lights: list[str] = []
    """Photos whose light is used, or files (.hdr, .exr: lat-long, up is the first row); by default the first photo of
    every other light.  They stand upright in the world of the photo if it has `world_from_camera`, else in its
    camera's frame."""
    rotate: Degrees = 0.0
    """Rotation of those lights about the vertical of that frame."""


class TransferRecipe(PhotoRecipe, frozen=True, kw_only=True, tag="transfer"):
    """Recipe of a photo with other materials on its objects."""

    materials: dict[str, str]
    """Replacement by material of the data set: another material of the data set, or one of `table`."""
    table: Table = None
    """User-supplied materials by name, or a file of them, like materials.json."""


class GroundFields(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Height of the ground; the photo shows its colour."""

    drop: Annotated[float, msgspec.Meta(ge=-10, le=100)] = 0.0
    """Depth of the ground below the plane that is found or given, in heights of the object beside: the height of the
    pedestal on which that stands."""


class InsertRecipe(PhotoRecipe, frozen=True, kw_only=True, tag="insert"):
    """Recipe of a photo with a further object beside an existing one, with its shadow."""

    mesh: str = "ball"
    """`ball`, a mesh of the data set, or a mesh file."""
    material: str | dict[str, str] | None = None
    """Material of the data set or of `table`, or replacements by material for parts of a mesh of the data set.
    By default the mesh keeps its own materials; a file or the ball gets the data set's first."""
    table: Table = None
    """User-supplied materials by name, or a file of them, like materials.json."""
    beside: str | None = None
    """Object on whose ground the new one stands; by default the photo's first."""
    at: Vec2 | None = None
    """Pixel of the photo where the new object touches the ground; by default beside the object, where there is more
    room."""
    size: Factor = 0.5
    """Height of the new object, in heights of that object."""
    turn: Degrees = 0.0
    """Rotation about the ground's normal."""
    up: Literal["x", "y", "z"] = "y"
    """The axis of a mesh file that points upward."""
    ground: GroundFields = GroundFields()
    """Height of the ground."""


AnyRecipe = (
    ResynthesisRecipe | ViewRecipe | TurntableRecipe | MovingLightRecipe | RelightRecipe | TransferRecipe | InsertRecipe
)
KINDS = {kind.__struct_config__.tag: kind for kind in AnyRecipe.__args__}


def recipe_of(facts: dict) -> AnyRecipe:
    """Convert the JSON-able facts of a stage to a recipe."""
    return msgspec.convert(facts, KINDS[facts["kind"]])


def is_light_file(name: str) -> bool:
    """Return True if a light is a file and not a photo's.

    >>> is_light_file("studio.hdr"), is_light_file("kitchen")
    (True, False)
    """
    return name.lower().endswith(LIGHT_FILES)


def is_mesh_file(name: str) -> bool:
    """Return True if a mesh is a file, which has a suffix, and not a mesh of the data set or the ball."""
    return "." in name


FIELDS = GivenMaterial.__struct_fields__  # others of a table are ignored


def read_table(path: Path) -> dict[str, GivenMaterial]:
    """Read the materials of a table by name.

    Raises:
        InputError: The file is not a table of materials, or one reflects more light than arrives.
    """
    text = read_text(path, "a table of materials")
    with reading("a table of materials", path, cure=CURE):
        content = msgspec.json.decode(text)
    materials = content.get("materials") if isinstance(content, dict) else None
    if not isinstance(materials, dict) or not materials:
        raise InputError("the table has no materials", file=path, key="materials", cure=CURE)
    table = {}
    for name, entry in materials.items():
        key = f"materials.{name}"
        try:
            fields = {k: entry[k] for k in entry if k in FIELDS} if isinstance(entry, dict) else entry
            table[name] = msgspec.convert(fields, GivenMaterial)
        except msgspec.ValidationError as error:
            raise InputError(str(error), file=path, key=key, cure=CURE) from None
    return _checked(table, path, "materials")


def materials_of(table: Table, file: Path | None) -> dict[str, GivenMaterial]:
    """Return the materials of a table, which stands in the recipe or in a file; errors as for `read_table`.

    Args:
        table: field of the recipe
        file: the file that it names; for a table in the recipe, the recipe, which errors name
    """
    if isinstance(table, str):
        assert file is not None
        return read_table(file)
    return _checked(table or {}, file, "table")


def _checked(table: dict[str, GivenMaterial], file: Path | None, key: str) -> dict[str, GivenMaterial]:
    """Return the table; InputError if a material reflects more light than arrives."""
    for name, material in table.items():
        total = max(material.diffuse) + max(material.specular)
        if total > MOST_REFLECTED:
            raise InputError(
                f"max diffuse + max specular = {total:.3f}: more light is reflected than arrives",
                file=file,
                key=f"{key}.{name}",
                cure=f"reduce the sum to at most {MOST_REFLECTED}",
            )
    return table
