"""The fixed dataset format as types, and the slices of it that stages receive.

`DatasetFile` and `TruthFile` mirror dataset.yaml and truth.yaml key by key.  The `Meta` of a type states its valid
values and, as `description`, the cure for others.  A stage converts its facts to the `…Slice` structs:
`msgspec.convert(inputs.facts["dataset.photo"], PhotoSlice)`.  Every path is relative to the dataset's folder.  Frames,
units and directions are those of `factorlib.conventions`.
"""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

LEFT_OUT = 255  # mask value of pixels that are neither background nor a material
LONGEST_NAME = 100  # characters of a name; file names contain it, and file systems allow 255 bytes
SOURCES: tuple[Literal["colmap", "transforms", "bop"], ...] = ("colmap", "transforms", "bop")
RAW = (".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")  # suffixes of raw photos
LARGEST = 1e15  # largest absolute value of any number, so that its square keeps its digits
FOCAL_PX = 1.0, 1e7  # range of focal lengths in pixels; a telescope has 1e6
CENTRE_PX = 1e6  # largest coordinate of a principal point in pixels, even of a small crop

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST, description="give a finite number below 1e+15, or none")]
Share = Annotated[float, Meta(ge=0, le=1, description="give a fraction, 0 to 1: reflectance is linear, not 0 to 255")]
Roughness = Annotated[float, Meta(ge=0.1, le=1, description="give 0.1 to 1, the range of the model, or none")]
Exposure = Annotated[float, Meta(ge=-30, le=30, description="give EV, -30 to 30")]
Focal = Annotated[float, Meta(ge=FOCAL_PX[0], le=FOCAL_PX[1], description="give finite pixels, 1 to 1e+07, or none")]
Centre = Annotated[float, Meta(ge=-CENTRE_PX, le=CENTRE_PX, description="give finite pixels, up to 1e+06, or none")]
Bend = Annotated[float, Meta(ge=-10, le=10, description="give k1 and k2 of COLMAP's RADIAL model")]
Size = Annotated[float, Meta(gt=0, le=1e9, description="give its extent in the unit of the set's meshes, more than 0")]
Unit = Annotated[float, Meta(ge=1e-9, le=1e9, description="give the ratio of two units, more than 0: 1e-09 to 1e+09")]
NAMES = "names have 1 to 100 of the characters A-Z a-z 0-9 _ and -, for they name files"
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]+\Z", max_length=LONGEST_NAME, description=NAMES)]
OneOf254 = Meta(min_length=1, max_length=LEFT_OUT - 1, description="give 1 to 254: a mask has no more labels")
AtLeastOne = Meta(min_length=1, description="add at least one: {name: …, image: …, masks: …}")
Vec2 = tuple[Number, Number]
Vec3 = tuple[Number, Number, Number]
Shares = tuple[Share, Share, Share]
Mat3 = tuple[Vec3, Vec3, Vec3]  # rows
MaterialKind = Literal["metal", "fabric", "plastic", "paint", "wood", "stone"]
Masks = str | dict[str, str]  # a label PNG, a COCO json, or {material: PNG}


class _Format(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the structs of user-written files, in which an unknown key is an error."""


class MeshEntry(_Format, frozen=True):
    """A mesh in dataset.yaml: its file, or the kind of shape to estimate, and the materials of its parts.

    A part is an OBJ group or usemtl, or a glTF primitive or material.  Exactly one of file, hull, lathe and primitive
    is given, and either parts or a material; a hull with neither has a part of each material.

    Attributes:
        file: the mesh file
        hull: visual hull of the masks, for known cameras; its parts are visible in the masks
        lathe: body of revolution about y, from its outlines
        primitive: a primitive about y, with proportions from its outlines
        size: longest side of a lathe's or primitive's bounding box, in the unit of the set's meshes
        parts: material by part
        material: material of the whole mesh
    """

    file: str | None = None
    hull: bool = False
    lathe: bool = False
    primitive: Literal["ball", "box", "cylinder"] | None = None
    size: Size = 1.0
    parts: dict[str, str] | None = None
    material: str | None = None

    @property
    def part_materials(self) -> dict[str, str] | str | None:
        """The material of each part, or of the whole; None if the entry names none, which the reader rejects."""
        return self.parts or self.material

    @property
    def is_revolved(self) -> bool:
        """True for a shape that is symmetric about its axis, so that its rotation about it is not observable."""
        return self.lathe or self.primitive in ("ball", "cylinder")


class Intrinsics(_Format, frozen=True):
    """Intrinsics in pixels of the photo as displayed, pixel centres at 0.5; missing ones are estimated.

    Attributes:
        distortion: k1 and k2 of COLMAP's RADIAL model, which `masks` removes
    """

    focal_px: Focal | None = None
    principal_point: tuple[Centre, Centre] | None = None
    distortion: tuple[Bend, Bend] | None = None


class RigidTransform(_Format, frozen=True):
    """The pose cam_from_object: x_cam = rotation · x_object + translation, in the mesh's units."""

    rotation: Mat3
    translation: Vec3


class Keypoint(_Format, frozen=True):
    """A pixel of the photo (x right, y down, pixel centres at 0.5) and the point of the mesh that it shows."""

    pixel: Vec2
    point: Vec3


class MeshInstance(_Format, frozen=True):
    """One instance of a mesh in a photo.

    Attributes:
        name: name of the object
        mesh: name of its mesh
        materials: overrides the materials of the mesh's parts
        mask: the instance's own silhouette
        pose: its pose, if it is known
        keypoints: places from which the search for the pose begins
    """

    name: Name
    mesh: str
    materials: dict[str, str] = {}
    mask: str | None = None
    pose: RigidTransform | None = None
    keypoints: list[Keypoint] = []


class GroundEntry(_Format, frozen=True):
    """The plane that a photo's objects stand on, in its camera frame and the poses' units.

    Attributes:
        normal: points toward the objects
        diffuse: Lambertian reflectance (linear Rec. 709), if it is known
    """

    point: Vec3
    normal: Vec3
    diffuse: Shares | None = None


class PhotoEntry(_Format, frozen=True):
    """A photo in dataset.yaml, with its masks, light, camera and objects.

    Attributes:
        image: path of its file
        masks: a label PNG, a COCO json, or a PNG by material
        encoding: encoding of the values; None is that of the file's format
        illumination: name of its light; by default the photo's name
        world_from_camera: rotation that fixes its light to the world
        camera: known intrinsics
        objects: meshes that the photo shows
        ground: plane on which the objects stand, if it is known
        held_out: true for a photo that is aligned and predicted, but not solved from
    """

    name: Name
    image: str
    masks: Masks
    encoding: Literal["srgb", "linear", "gamma2.2"] | None = None
    illumination: Name | None = None
    world_from_camera: Mat3 | None = None
    camera: Intrinsics | None = None
    objects: list[MeshInstance] = []
    ground: GroundEntry | None = None
    held_out: bool = False

    @property
    def light(self) -> str:
        """The name of the photo's illumination."""
        return self.illumination or self.name


class Similarity(_Format, frozen=True):
    """The similarity world_from_object: x_world = scale · rotation · x_object + translation.

    By default the mesh is in the world's frame.
    """

    scale: Unit = 1.0
    rotation: Mat3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    translation: Vec3 = (0.0, 0.0, 0.0)


class CameraSource(_Format, frozen=True):
    """Source of cameras, and possibly poses: exactly one of colmap, transforms, bop, sfm.

    Attributes:
        colmap: a folder
        transforms: a JSON file
        bop: a folder
        sfm: estimate cameras from the photos by structure from motion
        images: image in the source (BOP: its id) by photo, if the file's name does not identify it
        world_from_object: placement of an object in the source's world, which gives its pose
        world_from_camera: fix lights to the source's world by its rotations, turned upright
        up: the world's axis that points up; None: that of the cameras' common horizon
        obj_ids: BOP's obj_id by mesh
    """

    colmap: str | None = None
    transforms: str | None = None
    bop: str | None = None
    sfm: bool = False
    images: dict[str, str | int] = {}
    world_from_object: dict[str, Similarity] = {}
    world_from_camera: bool = False
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    obj_ids: dict[str, int] = {}
    mesh_unit_mm: Unit = 1.0


class KnownMaterial(_Format, frozen=True):
    """Known reflectance of a material, linear Rec. 709, or its kind alone; a value of None is estimated.

    Attributes:
        kind: metal, fabric, or a dielectric; it chooses the class of the prior on materials
    """

    diffuse: Shares | None = None
    specular: Shares | None = None
    roughness: Roughness | None = None
    kind: MaterialKind | None = None


class MirrorBall(_Format, frozen=True):
    """A chrome ball in a photo, which mirrors the photo's light; `chrome` is the object's name."""

    chrome: Name


class KnownQuantities(_Format, frozen=True):
    """Known quantities: reflectances by material, lights by illumination, exposures by photo.

    Attributes:
        illumination: a mirror ball, or a lat-long map in the frame and layout of the exported ones, known up to one
            factor
        exposure: in EV, for all photos of an illumination; 1 EV more doubles the values in the same light
    """

    materials: dict[str, KnownMaterial] = {}
    illumination: dict[str, str | MirrorBall] = {}
    exposure: dict[str, Exposure] = {}


class DatasetFile(_Format, frozen=True):
    """Content of dataset.yaml, key by key (docs/dataset.md).

    Attributes:
        materials: material of each label, from 1; labels of one name are one material
    """

    format: Annotated[Literal[1], Meta(description="this version reads format: 1")]
    materials: Annotated[list[Name], OneOf254]
    photos: Annotated[list[PhotoEntry], AtLeastOne]
    meshes: dict[Name, MeshEntry] = {}
    cameras: CameraSource | None = None
    known: KnownQuantities = KnownQuantities()
    truth: str | None = None

    @property
    def distinct_materials(self) -> list[str]:
        """The materials, each once."""
        return list(dict.fromkeys(self.materials))


class GivenMaterial(_Format, frozen=True):
    """Reflectance in a file of the user: Lambert k_d, GGX k_s (linear Rec. 709) and roughness, α = roughness²."""

    diffuse: Shares
    specular: Shares
    roughness: Share


class TruthFile(_Format, frozen=True):
    """Content of truth.yaml; its paths are relative to the dataset's folder too."""

    materials: dict[str, GivenMaterial] = {}
    illumination: dict[str, str] = {}
    normals: dict[str, str] = {}
    poses: dict[str, dict[str, RigidTransform]] = {}
    albedo: dict[str, str] = {}

    @property
    def maps(self) -> list[str]:
        """The maps that the file names, sorted."""
        return sorted({*self.illumination.values(), *self.normals.values(), *self.albedo.values()})


class ExternalCamera(msgspec.Struct, frozen=True):
    """The camera of one photo from a source of cameras, in pixels of the source's image.

    Attributes:
        focal_px: None if the source does not give it, as for principal_point
        size: width and height of the source's image; None if unknown; the height is None for a focal length in widths
        poses: cam_from_object by object, in the mesh's units
    """

    source: Literal["colmap", "transforms", "bop", "sfm"]
    focal_px: float | None
    principal_point: Vec2 | None
    size: tuple[float, float | None] | None
    poses: dict[str, RigidTransform]


class Dataset(msgspec.Struct, frozen=True, dict=True):
    """A dataset that has been read and checked.

    Attributes:
        companions: files that a mesh's file refers to (.mtl, glTF buffers), relative to the folder, by mesh
        external: camera from the source of cameras, by photo
        test_photo: photo that only the first solve leaves out, to be predicted; None without one
        up: how the direction that points up is known, in words
    """

    folder: Path
    spec: DatasetFile
    companions: dict[str, list[str]] = {}
    external: dict[str, ExternalCamera] = {}
    truth: TruthFile | None = None
    test_photo: str | None = None
    up: str = ""

    @property
    def name(self) -> str:
        """The name of the data set, which is its folder's."""
        return self.folder.name

    def photo(self, name: str) -> PhotoEntry:
        """Return the entry of a photo; KeyError for an unknown name."""
        return self._photos[name]

    @cached_property
    def _photos(self) -> dict[str, PhotoEntry]:
        return {photo.name: photo for photo in self.spec.photos}


class ObjectMask(msgspec.Struct, frozen=True):
    """An object in the order of dataset.yaml, and its own silhouette, if it has one."""

    name: str
    mask: str | None


class PhotoSlice(msgspec.Struct, frozen=True):
    """Facts that the stage `masks` needs to read a photo and its masks.

    Attributes:
        labels: material of each label of a mask, from 1
        camera: only for a lens with distortion
    """

    image: str
    encoding: Literal["srgb", "linear", "gamma2.2"] | None
    masks: Masks
    labels: list[str]
    focal_px: float | None
    illumination: str
    objects: list[ObjectMask]
    camera: Intrinsics | None = None


class ObjectsSlice(msgspec.Struct, frozen=True):
    """Facts about the objects of a photo: their meshes, its camera, and its camera from a source of cameras."""

    camera: Intrinsics
    objects: list[MeshInstance]
    meshes: dict[str, MeshEntry]
    external: ExternalCamera | None = None


class ShapesSlice(msgspec.Struct, frozen=True):
    """Facts for estimating cameras and shapes from masks: the meshes without a file, and the photos with their objects.

    Attributes:
        sfm: True if cameras are estimated from the photos
    """

    meshes: dict[str, MeshEntry]
    photos: dict[str, ObjectsSlice]
    sfm: bool = False


class LightSlice(msgspec.Struct, frozen=True, omit_defaults=True):
    """The illumination of a photo, and the rotation that fixes it to the world (None: fixed to the camera).

    Attributes:
        held_out: True for a photo that is predicted, and not solved from
        rejoins: True for a held-out photo that the solve of `exchange` uses, once the first solve has predicted it
    """

    illumination: str
    world_from_camera: Mat3 | None
    held_out: bool = False
    rejoins: bool = False


def solved_photos(lights: Mapping[str, LightSlice]) -> list[str]:
    """Return the names of the photos that are not held out, in order."""
    return [name for name, light in lights.items() if not light.held_out]


def with_all_rejoined(lights: Mapping[str, LightSlice]) -> dict[str, LightSlice]:
    """Return the illuminations of a solve in which the photos that rejoin take part."""
    return {
        name: msgspec.structs.replace(light, held_out=light.held_out and not light.rejoins)
        for name, light in lights.items()
    }


class GroundSlice(msgspec.Struct, frozen=True):
    """The ground of a photo, if dataset.yaml gives it."""

    ground: GroundEntry | None


class BallSlice(msgspec.Struct, frozen=True):
    """The photo of a mirror ball, and the ball's material."""

    photo: str
    material: str


class KnownSlice(msgspec.Struct, frozen=True):
    """Known quantities: reflectances by material; maps and mirror balls by illumination; exposures in EV by photo."""

    materials: dict[str, KnownMaterial] = {}
    maps: dict[str, str] = {}
    balls: dict[str, BallSlice] = {}
    exposure: dict[str, float] = {}


class SetSlice(msgspec.Struct, frozen=True):
    """Names, materials, meshes and photos of the set, in the order of dataset.yaml.

    Attributes:
        up: how the direction that points up is known, in words
    """

    name: str
    materials: list[str]
    meshes: dict[str, MeshEntry]
    photos: list[str]
    up: str = ""
