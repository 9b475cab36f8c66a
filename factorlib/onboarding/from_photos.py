"""A dataset from photographs alone: `make photos DATASET=mything PHOTOS=<folder>`.

Masks are alpha channels, files beside the photos, or mattes of a network.  Cameras are those in the folder, else those
of structure from motion.  With cameras the shape is the visual hull of the masks, without them a body of revolution if
every mask looks like one.
"""

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt

from factorlib.align.silhouette import with_prior_focal
from factorlib.dataset.paths import Refusal
from factorlib.dataset.sources.external_cameras import READERS, match_images
from factorlib.dataset.sources.source_image import GRID, SourceImage
from factorlib.dataset_draft import check_target, new_dataset, photos_in
from factorlib.errors import InputError, raise_all
from factorlib.geometry.camera import Camera, Pose
from factorlib.images.photo import box_majority, decode_photo, least_factor, open_photo
from factorlib.images.picture import picture, write_png
from factorlib.images.scanlines import MOST_MEGAPIXELS, check_pixels
from factorlib.jsonfile import write_json
from factorlib.labels.label_image import describe_specks
from factorlib.labels.mask_files import read_inside, read_labels_in, read_values
from factorlib.onboarding.light_groups import Kind, kind_of_light
from factorlib.onboarding.matte import MOST_DOUBT, MatteModel, foreground, opaque_pixels
from factorlib.onboarding.parts import PatchObservations, find_parts, observe_patches
from factorlib.onboarding.photo_folder import Cameras
from factorlib.shapes.gaps import mend_gaps
from factorlib.shapes.hull import agreement, agreements, focal_by_hull, hull_box
from factorlib.shapes.lathe import is_revolved
from factorlib.shapes.motion import PhotoForMotion, cameras_by_motion
from factorlib.shapes.outline import Outline

MOST_PIXELS = 1_000_000  # pixels of a photo for mattes and structure from motion
OUTLINE_PIXELS = 40_000  # pixels of a photo whose outline is asked for its symmetry
DISAGREES = 0.8  # a mask's agreement with the hull of the others, as a share of the median one, below which it is named
LENS_ERROR = 0.005  # greatest error of a lens by two coefficients, in widths of the image
MARGINS = (0.05, 0.15)  # margins about the hull's box, in its longer side, of the crops that masks are estimated from
LEAST_VIEWS = 4  # photos of a walk around a thing, from which parts are proposed
MOST_VIEWS = 40  # photos that parts are found from
Report = Callable[[float, str], None]
SHAPE = (
    "photos without known cameras do not tell the shape, and too few of them overlap to find cameras: in `meshes`, "
    'replace `file: "?"` by `lathe: true` (a vase, a bowl, a lamp), `primitive: ball | box | cylinder`, or the path of '
    "a mesh; or give MESHES=<folder>"
)
REVOLVED = (
    "every mask looks like a body of revolution, so `lathe: true` is written: if it is none, write "
    "`primitive: ball | box | cylinder` or `file: <mesh>` instead"
)
UNPLACED = (
    "left out, for structure from motion does not place them: {}; they are blurred, turned, or of another thing, or no "
    "photo overlaps with them: add photos between them and the others, each 10 to 20° from the next"
)
ASSUMED_LIGHT = (
    "one light at rest is assumed: where photos have different ones, delete `illumination: room`; where the thing "
    "turned before a camera at rest, delete `world_from_camera: true`"
)
LIGHT_NOTES: dict[Kind, str] = {
    "world": "all photos show one light at rest, `illumination: room` (lights of their own would explain {:.0%} of "
    "radiance): where they have different ones, delete it",
    "camera": "the thing turned before a camera and a light at rest, `illumination: room` (lights at rest in the "
    "thing's world are wrong by {:.0%} of radiance): where it did not, add `world_from_camera: true` to `cameras`",
    "photo": "each photo has its own light (one for all is wrong by {:.0%} of radiance): give those that share one the "
    "same `illumination`",
}
NAMES = "rename materials and meshes in dataset.yaml now, if at all: another name later makes all steps run again"


class View(msgspec.Struct, frozen=True):
    """A photo averaged down to at most MOST_PIXELS pixels, with the mask of its foreground.

    Attributes:
        small: the photo, its mask, and its camera before any source is read
        size: height and width of the photo's file as displayed
        doubt: doubt of the matte, 0 for a mask that no network made
        pixels: the small photo, sRGB-encoded; None where no network made the mask
        specks: small pieces of the mask far from the thing, in words
    """

    small: PhotoForMotion
    size: tuple[int, int]
    doubt: float
    pixels: UInt8[np.ndarray, "h w 3"] | None
    specks: str = ""

    def outline(self, name: str, image: SourceImage, focal: float | None = None) -> Outline:
        """Return the outline of the foreground with the camera of a source; `focal` replaces its focal length."""
        camera = self.small.camera
        scale = camera.width / (image.size[0] if image.size else self.size[1])
        has_centre = not image.centred and image.size is not None and image.size[1] is not None
        principal_point = (scale * image.camera.principal_point_x, scale * image.camera.principal_point_y)
        camera = Camera(
            camera.width,
            camera.height,
            scale * (focal or image.camera.mean_focal_length()),
            principal_point if has_centre else camera.centre,
        )
        assert image.cam_from_world is not None  # the sources of a folder have a world
        pose = Pose(image.cam_from_world.rotation.matrix(), np.array(image.cam_from_world.translation))
        return Outline(name, self.small.objects.astype(np.int8), camera, pose=pose)


def dataset_from_photos(
    target: Path, photos: Path, meshes: Path | None, model: Path | None, report: Report, whole: bool = False
) -> tuple[list[str], list[str]]:
    """Write the dataset of a folder of photographs, and return what is still missing, and what to look at, in words.

    Args:
        target: the folder to create
        photos: folder of photos
        meshes: folder of meshes; None: the shape is carved from the masks
        model: ONNX file of a matting network; None: that of the extra `masks`
        report: called with the completed share, from 0 to 1, and the current activity
        whole: True for a thing of one material, whose colours are not looked at

    Raises:
        InputError: As `new_dataset` does, and if a photo needs a network that is not installed.
    """
    check_target(target)
    images, masks, source = photos_in(photos)
    cameras = Cameras()
    outlines: list[Outline] = []
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        views = read_views(images, masks, model, folder, lambda share, text: report(share / 2, text))
        visible = {name: view for name, view in views.items() if view.small.objects.any()}
        if not source and not meshes:
            relative = {name: path.relative_to(photos) for name, path in images.items()}
            cameras = cameras_of_motion(visible, relative, folder, report)
            for name in cameras.left_out:
                del views[name], visible[name]
                (folder / "masks" / f"{name}.png").unlink()
            source = cameras if cameras.source else None
        if source:
            cameras, outlines = cameras_of_folder(visible, images, source, folder, report)
        views, outlines = refine_masks(
            views, outlines, model, folder, lambda share, text: report(0.9 + share / 20, text)
        )
        report(0.95, "gaps of the masks")
        whole_outlines, gaps = mend_gaps(outlines)
        proposed = []
        if outlines:
            report(0.95, "lights and parts")
            seen = SeenSurface(whole_outlines, {name: images[name] for name in visible})
            cameras = seen.with_lights(cameras)
            if not (whole or meshes) and len(outlines) >= LEAST_VIEWS:
                proposed = seen.label_parts(folder, lambda share: report(0.95 + share / 20, "parts by colour"))
        if unknown := not cameras.source and not meshes:
            shape = outlined_shape(visible, report)
            cameras = shape if shape.revolved else cameras
        missing = new_dataset(target, photos, folder / "masks", meshes, cameras)
    return missing + [SHAPE] * (unknown and not cameras.revolved), [
        NAMES,
        *cameras.notes,
        *proposed,
        *(str(gap.scaled(views[gap.photo].size[1] / views[gap.photo].small.camera.width)) for gap in gaps),
        *doubtful_masks(views, outlines),
    ]


def read_views(
    images: Mapping[str, Path], masks: Mapping[str, Path], model: Path | None, folder: Path, report: Report
) -> dict[str, View]:
    """Read the photos, and write the mask of each to masks/ in a folder, empty without a foreground.

    Args:
        images: the photos by name
        masks: masks that lie beside them, by the photos' names
        model: ONNX file of a matting network; None: that of the extra `masks`
        folder: a temporary folder
        report: called with the completed share and the current activity

    Raises InputError if masks cannot be read, of all of them together, if a photo needs a network that is not
    installed, or if no photo has a foreground.
    """
    views: dict[str, View] = {}
    faults: list[InputError] = []
    network = None
    (folder / "masks").mkdir()
    for name, path in images.items():
        report(len(views) / len(images), f"{name}: mask")
        opened = open_photo(path, "PHOTOS")
        check_pixels(opened.size, MOST_MEGAPIXELS, path, "PHOTOS")
        mask = None
        if file := masks.get(name):
            try:
                labels = list(read_labels_in(file, "PHOTOS", opened.size))
                mask = np.isin(read_values(file, "PHOTOS"), labels) if labels else read_inside(file, "PHOTOS")
            except InputError as fault:
                faults.append(fault)
        if faults:
            continue
        photo = decode_photo(opened, None, least_factor(opened.height * opened.width, MOST_PIXELS), path)
        pixels = picture(photo.radiance, None if photo.encoding == "linear" else 1.0)
        uncertain = 0.0
        matted = None
        if mask is None:
            mask = opaque_pixels(path)
        if mask is None:
            network = network or MatteModel(model)
            matted = pixels
            matte, uncertain = network(pixels, opened.size)
            mask = foreground(matte)
        write_png(folder / "masks" / f"{name}.png", mask[..., None].astype(np.uint8))
        objects = box_majority(mask, photo.factor)
        camera = Camera(photo.width, photo.height, 1.0, (photo.width / 2, photo.height / 2))
        prior = with_prior_focal(camera, photo.focal_px, "exif")
        small = PhotoForMotion(pixels.mean(axis=2).astype(np.uint8), objects, np.zeros_like(objects), *prior)
        views[name] = View(small, opened.size, uncertain, matted, describe_specks(mask))
    raise_all(faults)
    if not any(view.small.objects.any() for view in views.values()):
        cure = "draw masks: `make new`, then `make label`"
        raise InputError("no photo has a foreground", file=path.parent, key="PHOTOS", cure=cure)
    return views


def cameras_of_folder(
    views: Mapping[str, View], paths: Mapping[str, Path], cameras: Cameras, folder: Path, report: Report
) -> tuple[Cameras, list[Outline]]:
    """Complete the cameras that lie in the folder of the photos, and return the outlines by them, too.

    A focal length that is missing is that at which a hull fits the masks best.  Lenses with radial distortion become
    the key `camera` of their photos.

    Args:
        views: the photos with a foreground
        paths: path of each photo
        cameras: the cameras as they lie there
        folder: a temporary folder
        report: called with the completed share and the current activity
    """

    def outlines(focal: float | None = None) -> list[Outline]:
        """Return the outlines, by another focal length if it is given."""
        return [view.outline(name, images[name], focal) for name, view in views.items() if name in images]

    notes = list(cameras.notes)
    images = match_source(paths, cameras)
    content = json.loads(cameras.files[0].read_text()) if "transforms" in cameras.source else {}
    if content and not any(key in lens for lens in (content, *content["frames"]) for key in ("fl_x", "camera_angle_x")):
        height, width = next(iter(views.values())).size
        file = folder / cameras.files[0].name
        posed = [frame for frame in content["frames"] if frame.get("transform_matrix")]
        content |= {"fl_x": 2.0 * max(width, height), "w": width, "h": height, "frames": posed}
        write_json(file, content)
        cameras = Cameras({"transforms": f"cameras/{file.name}"}, folder, [file])
        images = match_source(paths, cameras)
        focal = focal_by_hull(outlines, max(width, height), lambda share: report(0.5 + 0.4 * share, "focal length"))
        write_json(file, content | {"fl_x": round(focal, 1)})
        notes.append(f"the cameras have no focal length: a hull fits the masks best at {focal:.0f} px, which is used")
        images = match_source(paths, cameras)
    by_photo = {name: distorted_camera(images[name], view.size[1]) for name, view in views.items() if name in images}
    return msgspec.structs.replace(cameras, by_photo=by_photo, notes=notes), outlines()


def match_source(paths: Mapping[str, Path], cameras: Cameras) -> dict[str, SourceImage]:
    """Return the image of each posed photo in a source of cameras, whose files are still where they lie."""
    assert cameras.folder is not None  # a source of files
    kind, place = next(iter(cameras.source.items()))
    refuse = Refusal(cameras.folder, cameras.folder)
    images = READERS[kind](place.removeprefix("cameras/"), refuse)
    matches = match_images({name: str(path) for name, path in paths.items()}, {}, kind, images, refuse)
    return {name: image for name, image in matches.items() if image.posed}


def distorted_camera(image: SourceImage, width: int) -> dict[str, Any]:
    """Return the key `camera` of a photo whose lens distorts, by least squares over its image.

    It is empty for a pinhole, and for a lens that two coefficients do not describe, which `validate` refuses.

    Args:
        image: the photo's image in the source
        width: width of the photo, pixels
    """
    camera = image.camera
    if camera.is_undistorted():
        return {}
    centre = np.array([camera.principal_point_x, camera.principal_point_y])
    pixels = np.indices((GRID, GRID)).reshape(2, -1).T / (GRID - 1) * [camera.width, camera.height]
    slopes = np.asarray(camera.cam_from_img(pixels))
    # pixel − centre = f (1 + k₁ r² + k₂ r⁴) slope, linear in f, f k₁ and f k₂
    powers = (slopes**2).sum(axis=1, keepdims=True) ** np.arange(3)
    design = (slopes[:, :, None] * powers[:, None]).reshape(-1, 3)
    offsets = (pixels - centre).ravel()
    if not np.isfinite(design).all():  # pixels without a ray
        return {}
    focal, *bends = (solution := np.linalg.lstsq(design, offsets)[0]).tolist()
    if np.abs(design @ solution - offsets).max() > LENS_ERROR * camera.width:
        return {}
    return {
        "camera": {
            "focal_px": width / camera.width * focal,
            "principal_point": (width / camera.width * centre).tolist(),
            "distortion": [bend / focal for bend in bends],
        }
    }


def cameras_of_motion(views: Mapping[str, View], paths: Mapping[str, Path], folder: Path, report: Report) -> Cameras:
    """Write the cameras of structure from motion as transforms.json; no source where photos do not overlap.

    Photos that are not placed are left out, if they are fewer than the others.

    Args:
        views: the photos with a foreground
        paths: path of each photo
        folder: a temporary folder
        report: called with the completed share and the current activity
    """
    photos = {name: view.small for name, view in views.items()}
    try:
        registered = cameras_by_motion(photos, lambda share, text: report(0.5 + 0.35 * share, text))
    except InputError as error:
        return Cameras(notes=[f"{error.fault}: {error.cure}"])
    missing = [name for name in photos if name not in registered] if 2 * len(registered) > len(photos) else []
    frames = []
    for name, camera in registered.items():
        height, width = views[name].size
        focal, k1 = camera.distortion or (camera.focal, 0.0)
        world_from_camera = camera.pose.rotation.T
        matrix = np.column_stack([world_from_camera * [1, -1, -1], -world_from_camera @ camera.pose.translation])
        frames.append({
            "file_path": str(paths[name]), "w": width, "h": height, "k1": k1,
            "fl_x": focal * width / photos[name].camera.width, "transform_matrix": matrix.tolist(),
        })  # fmt: skip
    write_json(folder / "transforms.json", {"frames": frames})
    notes = [UNPLACED.format(", ".join(missing))] if missing else []
    files = [folder / "transforms.json"]
    return Cameras({"transforms": "cameras/transforms.json"}, folder, files, notes=notes, left_out=missing)


def outlined_shape(views: Mapping[str, View], report: Report) -> Cameras:
    """Ask whether the mask of each photo, averaged down to OUTLINE_PIXELS, looks like a body of revolution.

    Args:
        views: the photos with a foreground
        report: called with the completed share and the current activity

    Returns:
        No source of cameras, with the answer.
    """
    for k, (name, view) in enumerate(views.items()):
        report(0.9 + 0.1 * k / len(views), f"{name}: symmetry of the outline")
        factor = least_factor(view.small.objects.size, OUTLINE_PIXELS)
        mask = box_majority(view.small.objects, factor).astype(int)
        camera = view.small.camera.window(0, 0, factor, mask.shape[1], mask.shape[0])
        if not is_revolved(Outline(name, mask, camera)):
            return Cameras()
    return Cameras(notes=[REVOLVED], revolved=True)


def refine_masks(
    views: dict[str, View], outlines: list[Outline], model: Path | None, folder: Path, report: Report
) -> tuple[dict[str, View], list[Outline]]:
    """Estimate each network's mask again, from the part of the photo that shows the object.

    A network takes the most conspicuous thing of a picture for its foreground, which may be another object.  So it is
    given the part of the photo that shows the hull of the other photos.  A new mask is used if it agrees better with
    that hull.

    Args:
        views: the photos
        outlines: outlines by known cameras
        model: ONNX file of a matting network; None: that of the extra `masks`
        folder: the folder of the masks, as `read_views` writes it
        report: called with the completed share and the current activity

    Returns:
        The views and the outlines.
    """
    report(0.0, "agreement of the masks")
    overlaps = agreements_of(outlines)
    unlike = differing(overlaps)
    again = [name for name in sorted(overlaps, key=overlaps.__getitem__) if views[name].pixels is not None]
    if not again or len(overlaps) - len(unlike) < 3:
        return views, outlines
    network = MatteModel(model)
    views, by_name = dict(views), {outline.photo: outline for outline in outlines}
    for k, name in enumerate(again):
        report(k / len(again), f"{name}: mask within the hull")
        others = [outline for other, outline in by_name.items() if other not in (name, *unlike)]
        with suppress(InputError):  # all others see it from one side
            views[name], by_name[name] = refine_mask(views[name], by_name[name], others, network, folder)
    return views, list(by_name.values())


def refine_mask(
    view: View, outline: Outline, others: list[Outline], network: MatteModel, folder: Path
) -> tuple[View, Outline]:
    """Return the view and the outline with the best of the masks that crops of the photo give; write a new mask."""
    if (box := hull_box(outline, others)) is None:
        return view, outline
    best = agreement(outline, others)
    for margin in MARGINS:
        mask, doubt = mask_within(view, box, margin, network)
        objects = box_majority(mask, least_factor(mask.size, MOST_PIXELS))
        candidate = Outline(outline.photo, objects.astype(np.int8), outline.camera, pose=outline.pose)
        if objects.any() and (overlap := agreement(candidate, others)) > best:
            best = overlap
            outline = candidate
            view = msgspec.structs.replace(
                view, small=msgspec.structs.replace(view.small, objects=objects), doubt=doubt
            )
            write_png(folder / "masks" / f"{outline.photo}.png", mask[..., None].astype(np.uint8))
    return view, outline


def mask_within(
    view: View, box: Float[np.ndarray, "2 2"], share: float, network: MatteModel
) -> tuple[Bool[np.ndarray, "h w"], float]:
    """Return the mask of a photo, and its doubt, from the part of the photo about a box.

    Args:
        view: the photo
        box: least and largest x and y, in pixels of the small photo
        share: margin about it, in its longer side
        network: the network that made its mask
    """
    assert view.pixels is not None
    factor = least_factor(view.size[0] * view.size[1], MOST_PIXELS)
    margin = share * (box[1] - box[0]).max()
    left, top = np.maximum(box[0] - margin, 0).astype(int)
    right, bottom = np.ceil(box[1] + margin).astype(int)
    part = view.pixels[top:bottom, left:right]
    height, width = (factor * n for n in part.shape[:2])
    matte, doubt = network(np.ascontiguousarray(part), (height, width))
    mask = np.zeros(view.size, bool)
    mask[factor * top : factor * top + height, factor * left : factor * left + width] = foreground(matte)
    return mask, doubt


class SeenSurface:
    """Surface of the hull as photos show it: their lights, and parts by colour.

    Args:
        outlines: outlines by known cameras
        paths: path of each photo with a foreground

    Attributes:
        observed: patches of the hull with their radiance in at most `MOST_VIEWS` photos; None if they share none
    """

    def __init__(self, outlines: list[Outline], paths: Mapping[str, Path]):
        self.outlines = outlines
        self.paths = paths
        self.observed: PatchObservations | None = None
        with suppress(InputError):
            self.observed = observe_patches(outlines[:: -(-len(outlines) // MOST_VIEWS)], self.read)

    def read(self, name: str) -> Float[np.ndarray, "h w 3"]:
        """Return the linear radiance of a photo, averaged down as its outline; NaN where it is clipped."""
        opened = open_photo(self.paths[name], "PHOTOS")
        photo = decode_photo(opened, None, least_factor(opened.height * opened.width, MOST_PIXELS), self.paths[name])
        return np.where(photo.clipped.any(2, keepdims=True), np.nan, photo.radiance)

    def with_lights(self, cameras: Cameras) -> Cameras:
        """Return the source of cameras with the illumination of each photo, and the reason among its notes."""
        if self.observed is None or len(self.outlines) < LEAST_VIEWS:
            kind: Kind = "world"
            note = ASSUMED_LIGHT
        else:
            radiance = self.observed.log_radiance.mean(2)
            kind, spread = kind_of_light(radiance, self.observed.patches.normal, self.observed.rotations)
            note = LIGHT_NOTES[kind].format(spread)
        shared = {} if kind == "photo" else {"illumination": "room"}
        return msgspec.structs.replace(
            cameras,
            source=cameras.source | ({} if kind == "camera" else {"world_from_camera": True}),
            by_photo={name: shared | further for name, further in cameras.by_photo.items()},
            notes=[*cameras.notes, note],
        )

    def label_parts(self, folder: Path, report: Callable[[float], None]) -> list[str]:
        """Write the labels of parts by colour into the masks, and return what to look at, in words.

        Labels of a photo without a camera are unknown, so that parts are proposed only if all photos have one.

        Args:
            folder: the folder of the masks, as `read_views` writes it
            report: called with the completed share
        """
        if lost := sorted(set(self.paths) - {outline.photo for outline in self.outlines}):
            return [f"parts by colour are not proposed, because photos have no camera: {', '.join(lost)}"]
        if self.observed is None:
            return ["parts by colour are not proposed: no two photos show the same surface"]
        surface = find_parts(self.observed, lambda share: report(share / 2))
        if len(surface.shares) == 1:
            return []
        for k, outline in enumerate(self.outlines):
            report((1 + k / len(self.outlines)) / 2)
            file = folder / "masks" / f"{outline.photo}.png"
            mask = read_inside(file, "PHOTOS")
            labels = surface.label(outline, self.read(outline.photo))
            # the nearest label where the mask of the file is larger, at the size of the file
            nearest = distance_transform_edt(labels == 0, return_distances=False, return_indices=True)
            rows, columns = (np.arange(n) * m // n for n, m in zip(mask.shape, labels.shape, strict=True))
            labels = labels[tuple(nearest)][rows][:, columns]
            write_png(file, np.where(mask, labels, 0)[..., None].astype(np.uint8))
        shares = ", ".join(f"label_{k} {share:.0%}" for k, share in enumerate(surface.shares, start=1))
        return [
            f"{len(surface.shares)} parts by colour are proposed as materials ({shares} of the surface): look at the "
            "contact sheet and give them names in dataset.yaml, two that are one material the same name; WHOLE=1 takes "
            "the thing for one material"
        ]


def agreements_of(outlines: list[Outline]) -> dict[str, float]:
    """Return the agreement of each photo's mask with all others; none for cameras that see it from one side."""
    with suppress(InputError):
        if len(outlines) > 2:
            return dict(zip((outline.photo for outline in outlines), agreements(outlines)))
    return {}


def differing(overlaps: dict[str, float]) -> list[str]:
    """Return the photos whose agreement is far below the median."""
    return [name for name, each in overlaps.items() if each < DISAGREES * np.median(list(overlaps.values()))]


def doubtful_masks(views: Mapping[str, View], outlines: list[Outline]) -> list[str]:
    """Name the photos whose masks are to be drawn over, with the reason.

    Args:
        views: the photos
        outlines: outlines by known cameras
    """
    groups = {
        "its border is uncertain": [name for name, view in views.items() if view.doubt > MOST_DOUBT],
        "it differs from what the other photos show": differing(agreements_of(outlines)),
    }
    return [f"mask of {name}: {view.specks}" for name, view in views.items() if view.specks] + [
        f"draw over the mask of {', '.join(names)} in `make label`: {why}" for why, names in groups.items() if names
    ]
