"""Reading of a dataset: YAML to types, then every check that needs no pixel.

The module imports nothing heavy, because a run with nothing to do passes here too.  Only a dataset that names a source
of cameras pays for pycolmap (0.2 s).
"""

import logging
import mmap
import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from factorlib.dataset.check import check_dataset, check_lights, check_truth
from factorlib.dataset.gltf_header import buffer_path, read_header
from factorlib.dataset.paths import Refusal, file_exists, path_on_disk
from factorlib.dataset.schema import Dataset, DatasetFile, ExternalCamera, MirrorBall, PhotoEntry, TruthFile
from factorlib.errors import InputError, raise_all
from factorlib.reading import check_plain, path_inside, read_text, reading
from factorlib.yamlfile import MOST_BYTES, convert, parse_yaml, read_yaml

FILE = "dataset.yaml"
RESERVED = ("studies", "bench", "store", "docs")  # folders of build/ that are not datasets
MTLLIB = re.compile(rb"^mtllib[ \t]+([^\r\n]+)", re.MULTILINE)
log = logging.getLogger("factorlib.dataset")
UNKNOWN = "?"
OPEN = "left_open"  # placeholder for `?` in a draft
PATHS = re.compile(  # keys of paths
    r".*\.(image|mask|file|colmap|transforms|bop)|.*\.masks(\.[^.]+)?|truth|known\.illumination\.[^.]+"
)
NO_PHOTO = "none"  # word of HELD_OUT for no photo
# Least number of photos that share a light from which one is left out of the first solve, which loses little by that.
FEWEST_WITH_TEST = 8
MOST_NAMED = 20  # open places or photos that an error lists


def read_dataset(path: str | Path) -> Dataset:
    """Read the dataset in a folder, or of a dataset.yaml.

    A missing truth.yaml, or one that names missing maps, is a warning, because only comparisons with the truth need it.

    Raises:
        InputError: Anything else is wrong; the error names file, key and cure.
    """
    with reading("a dataset", path, "DATASET"):
        file = Path(path) / FILE if Path(path).is_dir() else Path(path)
    if not file_exists(file, "DATASET"):
        raise InputError("there is no such dataset", file=file, cure=f"name a folder with a {FILE} in it")
    folder = Path(os.path.abspath(file)).parent
    if folder.name in RESERVED:
        raise InputError(
            f"a dataset cannot be called {folder.name!r}", file=file, cure="rename its folder: build/ uses that name"
        )
    spec, faults = read_draft(file)
    raise_all(faults)
    external: dict[str, ExternalCamera] = {}
    refuse = Refusal(file, file.parent)
    up = origin_of_up(spec)
    companions = {
        name: _companions(mesh.file, f"meshes.{name}.file", refuse) for name, mesh in spec.meshes.items() if mesh.file
    }
    if spec.cameras is not None and not spec.cameras.sfm:
        from factorlib.dataset.sources.external_cameras import external_cameras

        spec, external = external_cameras(spec, file)
    check_lights(spec.photos, file)
    truth = _read_truth(spec, file)
    return Dataset(folder=folder, spec=spec, companions=companions, external=external, truth=truth, up=up)


def hold_out(dataset: Dataset, names: Sequence[str]) -> Dataset:
    """Return the dataset with further photos held out, as if dataset.yaml said `held_out: true` for each.

    If neither names any, the photo of `choose_test_photo` is predicted first and then solved with the others.

    Args:
        dataset: the dataset
        names: names of photos; one text may hold several, separated by commas or blanks; `none` for no photo

    Raises:
        InputError: A photo does not exist, or every photo would be held out.
    """
    chosen = " ".join(names).replace(",", " ").split()
    photos = [msgspec.structs.replace(p, held_out=p.held_out or p.name in chosen) for p in dataset.spec.photos]
    known = [photo.name for photo in photos]
    if not chosen and not any(photo.held_out for photo in photos):
        return msgspec.structs.replace(dataset, test_photo=choose_test_photo(dataset.spec))
    if chosen == [NO_PHOTO] and NO_PHOTO not in known:
        return dataset
    unknown = [f"there is no photo {name!r}" for name in chosen if name not in known]
    if unknown or all(photo.held_out for photo in photos):
        raise InputError(
            unknown[0] if unknown else "every photo is held out, so that none is left to solve from",
            key="HELD_OUT",
            cure=f"name some of the dataset's photos, but not all, separated by commas, or {NO_PHOTO}; "
            f"they are {_enumerate(known)}",
        )
    return msgspec.structs.replace(dataset, spec=msgspec.structs.replace(dataset.spec, photos=photos))


def choose_test_photo(spec: DatasetFile) -> str | None:
    """Return the photo that the first solve leaves out and predicts; None if too few photos share a light.

    It is the middle one of the light that most photos share, in the order of dataset.yaml: its neighbours on both sides
    see its surfaces.  Another photo in this light shows each of its objects, and none of these is a mirror ball.
    """
    by_light: dict[str, list[PhotoEntry]] = {}
    for photo in spec.photos:
        by_light.setdefault(photo.light, []).append(photo)
    group = max(by_light.values(), key=len)
    balls = {light.chrome for light in spec.known.illumination.values() if isinstance(light, MirrorBall)}
    shown = Counter(obj.name for photo in group for obj in photo.objects if obj.name not in balls)
    eligible = [p.name for p in group if p.objects and all(shown[obj.name] > 1 for obj in p.objects)]
    return eligible[len(eligible) // 2] if eligible and len(group) >= FEWEST_WITH_TEST else None


def origin_of_up(spec: DatasetFile) -> str:
    """Describe how up is known, from a dataset as it is written: by whom worlds of lights are turned upright."""
    if any(photo.world_from_camera for photo in spec.photos):
        return "dataset.yaml gives the world (`world_from_camera`), whose −y is taken to point up"
    if spec.cameras is not None and spec.cameras.world_from_camera:
        if spec.cameras.up:
            return f"`cameras.up: {spec.cameras.up}` in dataset.yaml says so"
        return "it is the cameras' common horizon, as of photos that are held level; `cameras.up` sets another"
    return "each light is fixed to its camera, and up is the upper edge of the photo, as if it was held level"


def _enumerate(names: Sequence[str]) -> str:
    """Format the first names and the number of further ones."""
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def read_draft(file: Path) -> tuple[DatasetFile, list[InputError]]:
    """Read a dataset.yaml that may be unfinished, with a placeholder for each `?`, and all its faults.

    Open places are one fault, and faults that follow from them are omitted.

    Raises:
        InputError: The file is not a dataset.yaml.
    """
    if file.is_symlink() and not Path(os.path.realpath(file)).is_relative_to(os.path.realpath(file.parent)):
        raise InputError("is a link that leads outside the dataset", file=file, cure="put the file itself there")
    text = read_text(file, "a YAML file", most_bytes=MOST_BYTES)
    places: list[str] = []
    value = _fill_placeholders(parse_yaml(text, file), "", places, file.parent)
    faults = []
    if places:
        number = f"{len(places)} places are" if len(places) > 1 else "one place is"
        cure = "write what belongs there, in place of `?`"
        faults.append(InputError(f"{number} left open: {_enumerate(places)}", file=file, key=places[0], cure=cure))
    try:
        spec = with_parts_of_hulls(convert(value, DatasetFile, file, text=text))
    except InputError as error:
        raise_all(faults + _independent_faults(error, places))
    try:
        check_dataset(spec, file)
    except InputError as error:
        faults += _independent_faults(error, places)
    return spec, faults


def with_parts_of_hulls(spec: DatasetFile) -> DatasetFile:
    """Return the dataset with a part of each material for hulls that have neither parts nor a material."""
    parts = {name: name for name in spec.materials}
    open_hulls = {name: mesh for name, mesh in spec.meshes.items() if mesh.hull and not mesh.part_materials}
    filled = {name: msgspec.structs.replace(mesh, parts=parts) for name, mesh in open_hulls.items()}
    return msgspec.structs.replace(spec, meshes=spec.meshes | filled)


def _independent_faults(error: InputError, places: list[str]) -> list[InputError]:
    """Return the faults that are neither open places nor consequences of them."""

    def follows(fault: InputError) -> bool:
        """Return True if a fault is an open place or follows from one."""
        return ("materials[0]" in places and fault.fault.startswith("unknown material")) or any(
            _is_within(place, fault.key) or _is_within(fault.key, place) for place in places
        )

    return [fault for fault in getattr(error, "faults", [error]) if not follows(fault)]


def _is_within(key: str | None, other: str | None) -> bool:
    return key is not None and (key == other or key.startswith((f"{other}.", f"{other}[")))


def _fill_placeholders(value: Any, key: str, places: list[str], folder: Path) -> Any:
    """Replace each `?`, which `make new` writes, by a placeholder and add its key to `places`; spell paths as the disk.

    Args:
        value: a value, or tree of values, of a YAML file
        key: its key
        places: keys of `?`
        folder: folder that paths are relative to
    """
    if isinstance(value, dict):
        return {
            name: _fill_placeholders(item, f"{key}.{name}" if key else name, places, folder)
            for name, item in value.items()
        }
    if isinstance(value, list):
        return [_fill_placeholders(item, f"{key}[{index}]", places, folder) for index, item in enumerate(value)]
    if value == UNKNOWN:
        places.append(key)
        return OPEN
    return path_on_disk(folder, value) if isinstance(value, str) and PATHS.fullmatch(key) else value


def _read_truth(spec: DatasetFile, file: Path) -> TruthFile | None:
    if spec.truth is None:
        return None
    truth_file = file.parent / spec.truth
    if not file_exists(truth_file, "truth"):
        log.warning("%s: truth: there is no %s: nothing is compared with the truth", file, spec.truth)
        return None
    truth = read_yaml(truth_file, TruthFile)
    check_truth(truth, spec, truth_file, file.parent)
    for path in truth.maps:
        if not file_exists(file.parent / path, "truth"):
            log.warning("%s: there is no %s: nothing is compared with the truth", truth_file, path)
            return None
    return truth


def _companions(path: str, key: str, refuse: Refusal) -> list[str]:
    """Return the files that a mesh refers to: an OBJ's .mtl, a glTF's buffers, but not their textures.

    They belong to the mesh's content: a change of one changes the mesh.  An .mtl that is missing or not a plain file is
    left out, because the names of parts are in the OBJ itself.  A missing glTF buffer is an error, and so is any
    companion that is too large or outside the dataset.
    """
    file = refuse.folder / path
    suffix = Path(path).suffix.lower()
    is_obj = suffix == ".obj"
    names = []
    if is_obj and check_plain(file, "an OBJ", key):
        with (
            reading("an OBJ", file, key),
            file.open("rb") as stream,
            mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as text,
        ):
            if text.find(b"mtllib") >= 0:
                names = [match[1].decode("utf-8", "replace").strip() for match in MTLLIB.finditer(text)]
    elif suffix in (".gltf", ".glb"):
        header = read_header(file, key)
        try:
            paths = [buffer_path(buffer.uri) for buffer in header.buffers if buffer.uri is not None]
        except ValueError as error:
            refuse(key, f"{file.name} {error}", "export it again, with its buffers beside it or as one .glb")
        names = [path for path in paths if path is not None]
    companions = sorted({str(PurePosixPath(path).parent / name.replace("\\", "/")) for name in names})
    for companion in companions:
        try:
            path_inside(refuse.folder, companion)
        except ValueError as error:
            refuse(key, f"{file.name} names {companion[:80]!r}, which {error}", "copy that file beside the mesh")
    if is_obj:
        companions = [companion for companion in companions if os.path.isfile(refuse.folder / companion)]
    for companion in companions:
        refuse.refuse_if(
            not os.path.lexists(refuse.folder / companion),
            key,
            f"the mesh names {companion!r}, which is not there",
            "copy it beside the mesh, or export one .glb",
        )
        check_plain(refuse.folder / companion, "an .mtl" if is_obj else "a glTF buffer", key)
    return companions
