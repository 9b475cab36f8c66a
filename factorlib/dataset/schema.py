"""The fixed dataset format as types, and the slices of it that stages are handed.

`DatasetFile` and `TruthFile` mirror dataset.yaml and truth.yaml key by key; the `Meta` of a type says which values it may
have and, as its `description`, how to mend another one.  The `…Slice` structs are what a stage converts its facts to:
`msgspec.convert(inputs.facts["dataset.photo"], PhotoSlice)`.  Every path is relative to the dataset's folder.  Frames, units and
directions are those of `factorlib.conventions`.
"""

from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

LEFT_OUT = 255  # mask value of pixels that are neither background nor a material
MAX_MATERIALS = LEFT_OUT - 1
LONGEST_NAME = 100  # characters; names of files are made of it, and file systems allow these 255 bytes
SOURCES = ("colmap", "transforms", "bop")
RAW = (".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")  # suffixes of raw photos
LARGEST = 1e15  # of any number: what is larger loses its digits in the squares that are taken of it
FOCAL_PX = 1.0, 1e7  # a telescope has 1e6
CENTRE_PX = 1e6  # a principal point from the photo's corner, even of a small crop

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
OneOf254 = Meta(min_length=1, max_length=MAX_MATERIALS, description="give 1 to 254: a mask has no more labels")
AtLeastOne = Meta(min_length=1, description="add at least one: {name: …, image: …, masks: …}")
Vec2 = tuple[Number, Number]
Vec3 = tuple[Number, Number, Number]
Shares = tuple[Share, Share, Share]
Mat3 = tuple[Vec3, Vec3, Vec3]  # rows
Masks = str | dict[str, str]  # a label PNG, a COCO json, or {material: PNG}


class _Format(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A piece of a file a user writes: an unknown key is an error."""


class MeshEntry(_Format):
    """A mesh of several parts (OBJ group or usemtl, glTF primitive or material -> material), or of one material.

    Exactly one of: file;  hull: the visual hull of the masks, where cameras are known (its parts are named here and seen in the masks);
    lathe: a body of revolution from its outlines, about y;  primitive: one whose proportions the outlines say, about y.
    size: the longest side of a lathe's or primitive's bounding box, in the unit of the set's meshes
    """

    file: str | None = None
    hull: bool = False
    lathe: bool = False
    primitive: Literal["ball", "box", "cylinder"] | None = None
    size: Size = 1.0
    parts: dict[str, str] | None = None
    material: str | None = None

    @property
    def made_of(self) -> dict[str, str] | str | None:
        """The material of each part, or that of all; None where the entry names none, which the reader refuses."""
        return self.parts or self.material

    @property
    def revolved(self) -> bool:
        """Whether it looks the same however it is turned about its axis, so that photos do not say which of its sides they show."""
        return self.lathe or self.primitive in ("ball", "cylinder")


class Camera(_Format):
    """Intrinsics in pixels of the photo as displayed, pixel centres at 0.5; what is not given is sought.

    distortion: k1 and k2 of COLMAP's RADIAL model, which `masks` undoes
    """

    focal_px: Focal | None = None
    principal_point: tuple[Centre, Centre] | None = None
    distortion: tuple[Bend, Bend] | None = None


class Pose(_Format):
    """cam_from_object: x_cam = rotation · x_object + translation, in the mesh's units."""

    rotation: Mat3
    translation: Vec3


class Keypoint(_Format):
    """A pixel of the photo (x right, y down, pixel centres at 0.5) and the point of the mesh that it shows."""

    pixel: Vec2
    point: Vec3


class ObjectEntry(_Format):
    """One instance of a mesh in a photo; `materials` overrides the mesh's parts, `mask` is its own silhouette."""

    name: Name
    mesh: str
    materials: dict[str, str] = {}
    mask: str | None = None
    pose: Pose | None = None
    keypoints: list[Keypoint] = []


class Ground(_Format):
    """The plane that a photo's objects stand on, in its camera frame and the poses' units; the normal points toward them.

    diffuse: its Lambertian reflectance (linear Rec. 709), where it is known
    """

    point: Vec3
    normal: Vec3
    diffuse: Shares | None = None


class PhotoEntry(_Format):
    """One photo.  `illumination` defaults to the photo's name; `world_from_camera` fixes its light to the world."""

    name: Name
    image: str
    masks: Masks
    encoding: Literal["srgb", "linear", "gamma2.2"] | None = None
    illumination: Name | None = None
    world_from_camera: Mat3 | None = None
    camera: Camera | None = None
    objects: list[ObjectEntry] = []
    ground: Ground | None = None

    @property
    def light(self) -> str:
        """The name of the illumination that the photo is in."""
        return self.illumination or self.name


class Similarity(_Format):
    """world_from_object: x_world = scale · rotation · x_object + translation; as it stands, the mesh lies in the world's frame."""

    scale: Unit = 1.0
    rotation: Mat3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    translation: Vec3 = (0.0, 0.0, 0.0)


class CameraSource(_Format):
    """Where cameras, and perhaps poses, are known from: exactly one of colmap, transforms, bop, sfm.

    colmap, bop: a folder; transforms: a json; sfm: they are found from the photos by structure from motion.  images: photo -> its image in the source (BOP: its id), where the file's
    name does not tell.  world_from_object: object -> where it lies in the source's world; its pose is the source's then.
    world_from_camera: the source's rotations fix lights to its world.  obj_ids: mesh -> BOP's obj_id.
    """

    colmap: str | None = None
    transforms: str | None = None
    bop: str | None = None
    sfm: bool = False
    images: dict[str, str | int] = {}
    world_from_object: dict[str, Similarity] = {}
    world_from_camera: bool = False
    obj_ids: dict[str, int] = {}
    mesh_unit_mm: Unit = 1.0


class KnownMaterial(_Format):
    """The reflectance of a material, linear Rec. 709; what is None is found."""

    diffuse: Shares
    specular: Shares | None = None
    roughness: Roughness | None = None


class MirrorBall(_Format):
    """The object of a photo that is a chrome ball: what it mirrors is the photo's light."""

    chrome: Name


class Known(_Format):
    """What is known of the set's unknowns: reflectances by the material's name, lights by the illumination's, exposures by the photo's.

    illumination: a lat-long map in the frame and layout of the exported ones, whose radiance is known but for one factor, or a mirror ball
    exposure: in EV, of all photos of an illumination, beside each other: a photo of 1 EV more has twice the values in the same light
    """

    materials: dict[str, KnownMaterial] = {}
    illumination: dict[str, str | MirrorBall] = {}
    exposure: dict[str, Exposure] = {}


class DatasetFile(_Format):
    """dataset.yaml."""

    format: Annotated[Literal[1], Meta(description="this version reads format: 1")]
    materials: Annotated[list[Name], OneOf254]
    photos: Annotated[list[PhotoEntry], AtLeastOne]
    meshes: dict[Name, MeshEntry] = {}
    cameras: CameraSource | None = None
    known: Known = Known()
    truth: str | None = None


class TrueMaterial(_Format):
    """Lambert k_d, GGX k_s (linear Rec. 709) and roughness in [0, 1]."""

    diffuse: Shares
    specular: Shares
    roughness: Share


class TruthFile(_Format):
    """truth.yaml; its paths are relative to the dataset's folder too."""

    materials: dict[str, TrueMaterial] = {}
    illumination: dict[str, str] = {}
    normals: dict[str, str] = {}
    poses: dict[str, dict[str, Pose]] = {}

    @property
    def maps(self) -> list[str]:
        """The maps it names, in a fixed order."""
        return sorted({*self.illumination.values(), *self.normals.values()})


class ExternalCamera(msgspec.Struct, frozen=True):
    """The camera of one photo by a source of cameras, in the source's own pixels: of an image of `size` (width, height).

    size: None where the source does not say it, the height None where only the width counts (a focal length in widths);
    principal_point: None where the source does not say it; poses: object -> cam_from_object, in the mesh's units
    """

    source: Literal["colmap", "transforms", "bop", "sfm"]
    focal_px: float
    principal_point: Vec2 | None
    size: tuple[float, float | None] | None
    poses: dict[str, Pose]


class Dataset(msgspec.Struct, frozen=True, dict=True):
    """A dataset that has been read and checked.

    companions: mesh -> the files its file draws in (.mtl, glTF buffers), relative to the folder
    external: photo -> its camera by the source of cameras
    """

    folder: Path
    spec: DatasetFile
    companions: dict[str, list[str]] = {}
    external: dict[str, ExternalCamera] = {}
    truth: TruthFile | None = None

    @property
    def name(self) -> str:
        """Name of the data set: its folder's."""
        return self.folder.name

    def photo(self, name: str) -> PhotoEntry:
        """The entry of a photo; KeyError where there is none of that name."""
        return self._photos[name]

    @cached_property
    def _photos(self) -> dict[str, PhotoEntry]:
        return {photo.name: photo for photo in self.spec.photos}


class ObjectMask(msgspec.Struct, frozen=True):
    """An object in the order of dataset.yaml and its own silhouette, if it has one."""

    name: str
    mask: str | None


class PhotoSlice(msgspec.Struct, frozen=True):
    """The slice needed to read a photo and its masks."""

    image: str
    encoding: Literal["srgb", "linear", "gamma2.2"] | None
    masks: Masks
    focal_px: float | None
    illumination: str
    objects: list[ObjectMask]
    camera: Camera | None = None  # where its lens distorts


class ObjectsSlice(msgspec.Struct, frozen=True):
    """The slice needed to lay meshes over a photo: its camera, its objects, the meshes these use, and what else is known."""

    camera: Camera
    objects: list[ObjectEntry]
    meshes: dict[str, MeshEntry]
    external: ExternalCamera | None = None


class ShapesSlice(msgspec.Struct, frozen=True):
    """The slice needed to find cameras and shapes from masks: the meshes that have no file, and the photos with their objects.

    sfm: whether cameras are found from the photos
    """

    meshes: dict[str, MeshEntry]
    photos: dict[str, ObjectsSlice]
    sfm: bool = False


class LightSlice(msgspec.Struct, frozen=True):
    """The illumination that a photo is in, and the rotation that fixes it to the world (None: fixed to the camera)."""

    illumination: str
    world_from_camera: Mat3 | None


class GroundSlice(msgspec.Struct, frozen=True):
    """The ground of a photo, where dataset.yaml gives it."""

    ground: Ground | None


class BallSlice(msgspec.Struct, frozen=True):
    """The photo of a mirror ball, and the ball's material."""

    photo: str
    material: str


class KnownSlice(msgspec.Struct, frozen=True):
    """What is known: reflectances by material; maps and mirror balls by illumination; exposures in EV by photo."""

    materials: dict[str, KnownMaterial] = {}
    maps: dict[str, str] = {}
    balls: dict[str, BallSlice] = {}
    exposure: dict[str, float] = {}


class SetSlice(msgspec.Struct, frozen=True):
    """The set as a whole, in the order of dataset.yaml."""

    name: str
    materials: list[str]
    meshes: dict[str, MeshEntry]
    photos: list[str]
