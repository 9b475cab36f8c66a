"""Cameras by structure from motion (COLMAP, Schönberger and Frahm 2016), on the CPU.

The steps are SIFT, exhaustive matching, and incremental mapping. Either the camera moves about a scene at rest, or an
object turns before a camera at rest. So features are matched twice: those on the objects, and all others. A model is
accepted if a hull of the objects' masks fits into all of them; beside an object that turns, the background gives
cameras at rest. Of accepted models, the one that registers more photos is kept. Seeds are fixed and one thread is used,
so the same photos give the same cameras.
"""

import logging
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
import pycolmap
from jaxtyping import Bool, UInt8
from PIL import Image

from factorlib.align.refine import FocalPrior
from factorlib.align.search import UNKNOWN_FOCAL
from factorlib.align.silhouette import UNKNOWN
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.shapes.hull import agreement
from factorlib.shapes.outline import Outline
from factorlib.wholefile import write_text

LEAST_PHOTOS = 3  # least number of registered photos
LEAST_POINTS = 30  # least number of points of an accepted model
LEAST_AGREEMENT = 0.75  # least overlap (IoU) of a coarse hull with the masks, for an accepted model
MOST_SIDE = 1600
MOST_FEATURES = 4000
BENT = 2.0  # least distortion that counts, pixels
SEED = 0
log = logging.getLogger("factorlib.shapes")


class View(msgspec.Struct, frozen=True):
    """Photo as displayed, in 8 bits of grey, with its masks and prior camera.

    objects    pixels that show objects
    left_out   pixels that are not to be used
    camera     camera whose principal point is used
    prior      prior of the focal length in pixels of the photo; with a sigma of 0 it is kept
    """

    grey: UInt8[np.ndarray, "h w"]
    objects: Bool[np.ndarray, "h w"]
    left_out: Bool[np.ndarray, "h w"]
    camera: Camera
    prior: FocalPrior


class Registered(msgspec.Struct, frozen=True):
    """Photo registered in the model: focal length in its pixels, and cam_from_world, of unknown scale.

    bent: focal length and k1 of `bent_lenses`, if the lens distorts
    """

    focal: float
    pose: Pose
    bent: tuple[float, float] | None = None


def cameras_by_motion(
    views: Mapping[str, View], report: Callable[[float, str], None] = lambda share, what: None
) -> dict[str, Registered]:
    """Estimate the cameras of photos that overlap; the others are named in a warning.

    Args:
        views: Photos by name.
        report: Function of the share that is done and of the current step.

    Returns:
        Registered photos by name.

    Raises:
        InputError: If fewer than three photos are registered.
    """
    models = {}
    for done, (where, pixels) in enumerate((("on the objects", True), ("beside them", False))):
        kept = {name: (view.objects if pixels else ~view.objects) & ~view.left_out for name, view in views.items()}
        models[where] = _mapped(views, kept, _half(done, where, report))
    where, (placed, points) = max(models.items(), key=lambda item: (len(item[1][0]), item[1][1]))
    if len(placed) < LEAST_PHOTOS:
        found = f"cameras of {len(placed)} of {len(views)} photos are found: too few of their features match"
        cure = (
            "structure from motion needs photos of one scene, each 10 to 20° from the next, with texture on the object "
            "or around it"
        )
        cure += "; without, give `file`, `lathe` or `primitive` meshes"
        raise InputError(found, file="dataset.yaml", key="cameras.sfm", cure=cure)
    log.info("cameras of %d of %d photos by %d points %s", len(placed), len(views), points, where)
    if missing := [name for name in views if name not in placed]:
        log.warning(
            "structure from motion does not place %s: nothing overlaps with them; they are aligned by masks alone",
            ", ".join(missing),
        )
    return placed


def _half(done: int, where: str, report: Callable[[float, str], None]) -> Callable[[float, str], None]:
    """Return the report of one of two models, after `done` others."""
    return lambda share, what: report((done + share) / 2, f"{what} {where}")


def _mapped(
    views: Mapping[str, View], kept: Mapping[str, Bool[np.ndarray, "h w"]], report: Callable[[float, str], None]
) -> tuple[dict[str, Registered], int]:
    """Return the largest model of features at the pixels in `kept`, and its number of points."""
    pycolmap.set_random_seed(SEED)
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # failures are reported below
    with TemporaryDirectory() as folder:
        root = Path(folder)
        database = root / "features.db"
        images = root / "images"
        masks = root / "masks"
        for each in (images, masks):
            each.mkdir()
        extraction = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False, max_image_size=MOST_SIDE)
        extraction.sift.max_num_features = MOST_FEATURES
        groups: dict[tuple, list[str]] = {}
        for name, view in views.items():
            Image.fromarray(view.grey).save(images / f"{name}.png")
            Image.fromarray(kept[name].astype(np.uint8) * 255).save(masks / f"{name}.png.png")
            groups.setdefault((view.grey.shape, view.camera.centre, view.prior), []).append(name)
        kept_focals = set()
        done = count()
        # one camera for all photos of one size, principal point and focal length; COLMAP numbers them from 1
        for number, (((height, width), centre, prior), names) in enumerate(groups.items(), start=1):
            reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE", mask_path=str(masks))
            if prior.sigma < UNKNOWN_FOCAL.sigma or centre != (width / 2, height / 2):
                reader.camera_params = f"{prior.focal},{centre[0]},{centre[1]}"
            if prior.sigma == 0:
                kept_focals.add(number)
            for name in names:
                report(0.2 * next(done) / len(views), "features")
                pycolmap.extract_features(
                    database,
                    images,
                    [f"{name}.png"],
                    pycolmap.CameraMode.SINGLE,
                    reader,
                    extraction,
                    pycolmap.Device.cpu,
                )
                reader.existing_camera_id = number
        matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = SEED
        files = [f"{name}.png" for names in groups.values() for name in names]
        pairing = pycolmap.ImportedPairingOptions(match_list_path=str(root / "pairs.txt"))
        for k, file in enumerate(files[1:], start=1):  # match it with all photos before it
            report(0.2 + 0.4 * k**2 / len(files) ** 2, "matches")
            write_text(root / "pairs.txt", "".join(f"{other} {file}\n" for other in files[:k]))
            pycolmap.match_image_pairs(database, matching, pairing, verification, pycolmap.Device.cpu)
        done = count(2)  # the first two photos are registered together

        def placed_one() -> None:
            """Report that one more photo is registered."""
            report(0.6 + 0.3 * min(next(done) / len(files), 1.0), "cameras")

        report(0.6, "cameras")
        options = pycolmap.IncrementalPipelineOptions(
            num_threads=1,
            random_seed=SEED,
            multiple_models=False,
            min_model_size=LEAST_PHOTOS,
            extract_colors=False,
            ba_refine_focal_length=True,
            ba_refine_principal_point=False,
            constant_cameras=kept_focals,
        )
        options.mapper.num_threads = 1
        options.mapper.random_seed = SEED
        options.triangulation.random_seed = SEED
        models = pycolmap.incremental_mapping(
            database, images, root / "models", options, next_image_callback=placed_one
        )
        best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)
        if best is None or best.num_points3D() < LEAST_POINTS:
            return {}, 0
        report(0.9, "hull of the masks")
        placed = {}
        bent = bent_lenses(best)
        for image in best.images.values():
            if image.has_pose:
                motion = image.cam_from_world()
                pose = Pose(motion.rotation.matrix(), np.array(motion.translation))
                focal = float(best.cameras[image.camera_id].focal_length)
                placed[Path(image.name).stem] = Registered(focal, pose, bent.get(image.camera_id))
    outlines = [outline_of(name, views[name], camera) for name, camera in sorted(placed.items())]
    if (overlap := agreement([one for one in outlines if one.is_seen])) < LEAST_AGREEMENT:
        words = "cameras by %d points do not move with the objects (hull against masks: %.2f)"
        log.info(words, best.num_points3D(), overlap)
        return {}, 0
    return {name: placed[name] for name in views if name in placed}, best.num_points3D()


def bent_lenses(model: pycolmap.Reconstruction) -> dict[int, tuple[float, float]]:
    """Find the cameras whose lens distortion moves an observed point by more than `BENT` pixels.

    The model of pinhole cameras is left unchanged. A copy is bundle-adjusted with one radial coefficient per camera.

    Returns:
        Focal length and k1, by number of the camera.
    """
    free = pycolmap.Reconstruction(model)
    for camera in free.cameras.values():
        pinhole = camera.params.tolist()
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [*pinhole, 0.0]
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_principal_point=False)
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(free, options)
    bent = {}
    for image in free.images.values():
        places = np.array([point.xy for point in image.points2D if point.has_point3D()]).reshape(-1, 2)
        focal, x, y, k = free.cameras[image.camera_id].params.tolist()
        # radial distortion f |k| r³ at the largest observed radius r, with r in units of f
        radius = np.hypot(*(places - (x, y)).T).max(initial=0.0) / focal
        if focal * abs(k) * radius**3 > BENT:
            bent[image.camera_id] = (focal, k)
    return bent


def outline_of(name: str, view: View, placed: Registered) -> Outline:
    """Return the outline of all objects together in a registered photo.

    Args:
        name: Name of the photo.
        view: The photo.
        placed: Its estimated camera.

    Returns:
        The outline.
    """
    part = np.where(view.left_out, UNKNOWN, view.objects.astype(int))
    camera = msgspec.structs.replace(view.camera, focal=placed.focal)
    return Outline(name, part, camera, FocalPrior(placed.focal, 0.0), placed.pose)
