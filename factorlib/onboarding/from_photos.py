"""A dataset from photographs alone: `make photos DATASET=mything PHOTOS=<folder>`.

Masks are alpha channels, files beside the photos, or mattes of a network.  Cameras are those in the folder, else those
of structure from motion.  With cameras the shape is the visual hull of the masks.
"""

import json
import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np

from factorlib.align.silhouette import with_prior_focal
from factorlib.dataset.paths import Refusal
from factorlib.dataset.schema import CameraSource, DatasetFile, PhotoEntry
from factorlib.dataset.sources.external_cameras import READERS, match_images
from factorlib.dataset.sources.source_image import GRID, SourceImage, pinhole
from factorlib.dataset_draft import check_target, new_dataset, photos_in
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.images.photo import box_majority, decode_photo, least_factor, open_photo
from factorlib.images.picture import picture, write_png
from factorlib.images.scanlines import MOST_MEGAPIXELS, check_pixels
from factorlib.jsonfile import write_json
from factorlib.labels.mask_files import read_values
from factorlib.onboarding.hull_agreement import agreement, focal_length
from factorlib.onboarding.matte import MOST_DOUBT, MatteModel, alpha_matte, foreground
from factorlib.onboarding.photo_folder import Cameras, PhotoFolder, stem_of
from factorlib.shapes.motion import PhotoForMotion, cameras_by_motion
from factorlib.shapes.outline import Outline

log = logging.getLogger("factorlib.onboarding")
MOST_PIXELS = 1_000_000  # pixels of a photo for mattes and structure from motion
DISAGREES = 0.8  # a mask's agreement with the hull of the others, as a share of the median one, below which it is named
FOCAL_KEYS = ("fl_x", "camera_angle_x")
Report = Callable[[float, str], None]
SHAPE = (
    "photos without known cameras do not tell the shape, and too few of them overlap to find cameras: in `meshes`, "
    'replace `file: "?"` by `lathe: true` (a vase, a bowl, a lamp), `primitive: ball | box | cylinder`, or the path of '
    "a mesh; or give MESHES=<folder>"
)
ONE_LIGHT = (
    "one light at rest is assumed: where photos have different ones, delete `illumination: room`; where the thing "
    "turned before a camera at rest, delete `world_from_camera: true`"
)


class View(msgspec.Struct, frozen=True):
    """A photo averaged down to at most MOST_PIXELS pixels, with the mask of its foreground.

    Attributes:
        small: the photo, its mask, and its camera before any source is read
        size: height and width of the photo's file as displayed
        doubt: doubt of the matte, 0 for a mask that no network made
    """

    small: PhotoForMotion
    size: tuple[int, int]
    doubt: float

    def outline(self, name: str, image: SourceImage, focal: float | None = None) -> Outline:
        """Return the outline of the foreground with the camera of a source; `focal` replaces its focal length."""
        camera = self.small.camera
        scale = camera.width / (image.size[0] if image.size else self.size[1])
        centre = (scale * image.camera.principal_point_x, scale * image.camera.principal_point_y)
        centred = image.centred or image.size is None or image.size[1] is None
        focal = scale * (focal or image.camera.mean_focal_length())
        camera = msgspec.structs.replace(camera, focal=focal, centre=camera.centre if centred else centre)
        assert image.cam_from_world is not None  # the sources of a folder have a world
        pose = Pose(image.cam_from_world.rotation.matrix(), np.array(image.cam_from_world.translation))
        return Outline(name, self.small.objects.astype(int), camera, pose=pose)


def dataset_from_photos(
    target: Path, photos: Path, meshes: Path | None, model: Path | None, report: Report
) -> tuple[list[str], list[str]]:
    """Write the dataset of a folder of photographs, and return what is still missing, and what to look at, in words.

    Args:
        target: the folder to create
        photos: folder of photos
        meshes: folder of meshes; None: the shape is carved from the masks
        model: ONNX file of a matting network; None: that of the extra `masks`
        report: called with the completed share, from 0 to 1, and the current activity

    Raises:
        InputError: As `new_dataset` does, and if a photo needs a network that is not installed.
    """
    check_target(target)
    images, contents = photos_in(photos)
    cameras = Cameras()
    outlines: list[Outline] = []
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        views = read_views(images, contents, model, folder, lambda share, text: report(share / 2, text))
        visible = {name: view for name, view in views.items() if view.small.objects.any()}
        if contents.cameras:
            paths = {name: path.relative_to(photos).as_posix() for name, path in images.items()}
            cameras, outlines = cameras_of_folder(visible, paths, contents.cameras, folder, report)
        elif not meshes:
            cameras, outlines = cameras_of_motion(visible, report)
        report(0.95, "agreement of the masks")
        doubts = doubtful_masks(views, outlines)
        missing = new_dataset(target, photos, folder / "masks", meshes, cameras)
    return missing + [SHAPE] * (not cameras.source and not meshes), [ONE_LIGHT] * bool(contents.cameras) + doubts


def read_views(
    images: Mapping[str, Path], contents: PhotoFolder, model: Path | None, folder: Path, report: Report
) -> dict[str, View]:
    """Read the photos, and write the mask of each to masks/ in a folder; one without a foreground gets none.

    Args:
        images: the photos by name
        contents: the masks beside them
        model: ONNX file of a matting network; None: that of the extra `masks`
        folder: a temporary folder
        report: called with the completed share and the current activity
    """
    views: dict[str, View] = {}
    network = None
    (folder / "masks").mkdir()
    for name, path in images.items():
        report(len(views) / len(images), f"{name}: mask")
        opened = open_photo(path, "PHOTOS")
        check_pixels(opened.size, MOST_MEGAPIXELS, path, "PHOTOS")
        photo = decode_photo(opened, None, least_factor(opened.height * opened.width, MOST_PIXELS), path)
        pixels = picture(photo.radiance, None if photo.encoding == "linear" else 1.0)
        uncertain = 0.0
        if file := contents.masks.get(stem_of(path.name)):
            values = read_values(file, "PHOTOS", opened.size)
            mask = values > (127 if values.max() > 127 else 0)
        elif (alpha := alpha_matte(path)) is not None:
            mask = alpha > 0.5
        else:
            network = network or MatteModel(model)
            matte, uncertain = network(pixels, opened.size)
            mask = foreground(matte)
        if mask.any():
            write_png(folder / "masks" / f"{name}.png", mask[..., None].astype(np.uint8))
        objects = box_majority(mask, photo.factor)
        camera = Camera(photo.width, photo.height, 1.0, (photo.width / 2, photo.height / 2))
        prior = with_prior_focal(camera, photo.focal_px, "exif")
        grey = pixels.mean(axis=2).astype(np.uint8)
        views[name] = View(PhotoForMotion(grey, objects, np.zeros_like(objects), *prior), opened.size, uncertain)
    return views


def cameras_of_folder(
    views: Mapping[str, View], paths: Mapping[str, str], cameras: Cameras, folder: Path, report: Report
) -> tuple[Cameras, list[Outline]]:
    """Complete the cameras that lie in the folder of the photos, and return the outlines by them, too.

    A focal length that is missing is that at which a hull fits the masks best.  Lenses with radial distortion become
    the key `camera` of their photos.

    Args:
        views: the photos with a foreground
        paths: path of each photo in its folder
        cameras: the cameras as they lie there
        folder: a temporary folder
        report: called with the completed share and the current activity
    """

    def outlines(focal: float | None = None) -> list[Outline]:
        """Return the outlines, by another focal length if it is given."""
        return [view.outline(name, images[name], focal) for name, view in views.items() if name in images]

    content = json.loads(cameras.files[0].read_text()) if "transforms" in cameras.source else {}
    if content and not any(key in lens for lens in (content, *content["frames"]) for key in FOCAL_KEYS):
        height, width = next(iter(views.values())).size
        file = folder / cameras.files[0].name
        content |= {"fl_x": 2.0 * max(width, height), "w": width, "h": height}
        write_json(file, content)
        cameras = Cameras({"transforms": f"cameras/{file.name}"}, folder, [file])
        images = match_source(paths, cameras)
        focal = focal_length(outlines, max(width, height), lambda share: report(0.5 + share / 2, "focal length"))
        write_json(file, content | {"fl_x": round(focal, 1)})
        log.warning("the cameras have no focal length: a hull fits the masks best at %.0f px, which is used", focal)
    images = match_source(paths, cameras)
    by_photo: dict[str, dict[str, Any]] = {name: {"illumination": "room"} for name in images}
    for name, view in views.items():
        if name in images and (lens := radial_lens(images[name], view.size[1])):
            by_photo[name]["camera"] = lens
    source = cameras.source | {"world_from_camera": True}
    return msgspec.structs.replace(cameras, source=source, by_photo=by_photo), outlines()


def match_source(paths: Mapping[str, str], cameras: Cameras) -> dict[str, SourceImage]:
    """Return the image of each photo in a source of cameras, whose files are still where they lie."""
    assert cameras.folder is not None  # a source of files
    kind, path = next(iter(cameras.source.items()))
    photos = [PhotoEntry(name, path, "") for name, path in paths.items()]
    spec = DatasetFile(format=1, materials=[], photos=photos, cameras=CameraSource(**cameras.source))
    refuse = Refusal(cameras.folder, cameras.folder)
    return match_images(spec, kind, READERS[kind](path.removeprefix("cameras/"), refuse), refuse)


def radial_lens(image: SourceImage, width: int) -> dict[str, Any] | None:
    """Return the key `camera` of a photo whose camera is no pinhole, by least squares; None for a pinhole.

    Args:
        image: the photo's image in the source
        width: width of the photo, pixels
    """
    camera = image.camera
    with suppress(InputError):
        pinhole(camera, image.key, Refusal(Path(), Path()))
        return None
    centre = np.array([camera.principal_point_x, camera.principal_point_y])
    pixels = np.indices((GRID, GRID)).reshape(2, -1).T / (GRID - 1) * [camera.width, camera.height]
    slopes = np.asarray(camera.cam_from_img(pixels))
    # pixel − centre = f (1 + k₁ r² + k₂ r⁴) slope, linear in f, f k₁ and f k₂
    powers = (slopes**2).sum(axis=1, keepdims=True) ** np.arange(3)
    design = (slopes[:, :, None] * powers[:, None]).reshape(-1, 3)
    focal, *bends = np.linalg.lstsq(design, (pixels - centre).ravel())[0].tolist()
    scale = width / camera.width
    distortion = [round(bend / focal, 5) for bend in bends]
    return {"focal_px": scale * focal, "principal_point": (scale * centre).tolist(), "distortion": distortion}


def cameras_of_motion(views: Mapping[str, View], report: Report) -> tuple[Cameras, list[Outline]]:
    """Return the source `sfm`, and outlines by its cameras; no source where photos do not overlap.

    Args:
        views: the photos with a foreground
        report: called with the completed share and the current activity
    """
    photos = {name: view.small for name, view in views.items()}
    try:
        registered = cameras_by_motion(photos, lambda share, text: report(0.5 + share / 2, text))
    except InputError:
        return Cameras(), []
    outlines = []
    for name, each in registered.items():
        camera = msgspec.structs.replace(photos[name].camera, focal=each.focal)
        outlines.append(Outline(name, photos[name].objects.astype(int), camera, pose=each.pose))
    return Cameras({"sfm": True}), outlines


def doubtful_masks(views: Mapping[str, View], outlines: list[Outline]) -> list[str]:
    """Name the photos whose masks are to be drawn over, with the reason.

    Args:
        views: the photos
        outlines: outlines by known cameras
    """
    overlaps = agreement(outlines) if len(outlines) > 2 else []
    groups = {
        "its border is uncertain": [name for name, view in views.items() if view.doubt > MOST_DOUBT],
        "it differs from what the other photos show": [
            outline.photo for outline, each in zip(outlines, overlaps) if each < DISAGREES * np.median(overlaps)
        ],
    }
    line = "draw over the mask of {} in `make label`: {}"
    return [line.format(", ".join(names), why) for why, names in groups.items() if names]
