"""Cameras by structure from motion (COLMAP, Schönberger and Frahm 2016), on the CPU: SIFT, exhaustive matching, incremental mapping.

Photos may show things at rest seen by a camera that moves, or a thing that turns before a camera at rest.  So features are matched twice,
those on the objects and all others.  A model is believed where a hull of the objects' masks fits into all of them: beside a thing that
turns, the background gives cameras that stand still.  Of those believed, the one that places more photos is kept.  Seeds are fixed and one thread is used: the same
photos give the same cameras.
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

LEAST_PHOTOS = 3
LEAST_POINTS = 30  # of a model that is believed
LEAST_AGREEMENT = 0.75  # overlap (IoU) of a coarse hull with the masks, of a model that is believed
MOST_SIDE, MOST_FEATURES = 1600, 4000
BENT = 2.0  # pixels
SEED = 0
log = logging.getLogger("factorlib.shapes")


class View(msgspec.Struct, frozen=True):
    """A photo as displayed, in 8 bits of grey, and what is known of it.

    objects   pixels that show objects;  left_out: pixels that are not to be used
    camera    its principal point is used;  prior: of the focal length, in pixels of the photo; of sigma 0, it is kept
    """

    grey: UInt8[np.ndarray, "h w"]
    objects: Bool[np.ndarray, "h w"]
    left_out: Bool[np.ndarray, "h w"]
    camera: Camera
    prior: FocalPrior


class Registered(msgspec.Struct, frozen=True):
    """A photo that has a place in the model: its focal length in its pixels, and cam_from_world, the world being of no known scale.

    bent: focal length and k1 of `bent_lenses`, where the lens distorts
    """

    focal: float
    pose: Pose
    bent: tuple[float, float] | None = None


def cameras_by_motion(
    views: Mapping[str, View], report: Callable[[float, str], None] = lambda share, what: None
) -> dict[str, Registered]:
    """The cameras of the photos that overlap, by name; the others are named in a warning.

    Raises InputError where fewer than three do.
    """
    models = {}
    for done, (where, pixels) in enumerate((("on the objects", True), ("beside them", False))):
        kept = {name: (view.objects if pixels else ~view.objects) & ~view.left_out for name, view in views.items()}
        models[where] = _mapped(
            views, kept, lambda share, what, d=done, w=where: report((d + share) / 2, f"{what} {w}")
        )
    where, (placed, points) = max(models.items(), key=lambda item: (len(item[1][0]), item[1][1]))
    if len(placed) < LEAST_PHOTOS:
        found = f"cameras of {len(placed)} of {len(views)} photos are found: too few of their features match"
        cure = "structure from motion needs photos of one scene, each 10 to 20° from the next, with texture on the object or around it"
        cure += "; without, give `file`, `lathe` or `primitive` meshes"
        raise InputError(found, file="dataset.yaml", key="cameras.sfm", cure=cure)
    log.info("cameras of %d of %d photos by %d points %s", len(placed), len(views), points, where)
    if missing := [name for name in views if name not in placed]:
        log.warning("structure from motion does not place %s: nothing overlaps with them; they are aligned by masks alone",
                    ", ".join(missing))  # fmt: skip
    return placed


def _mapped(
    views: Mapping[str, View], kept: Mapping[str, Bool[np.ndarray, "h w"]], report: Callable[[float, str], None]
) -> tuple[dict[str, Registered], int]:
    """The largest model of features at the pixels that are `kept`, and how many points it has."""
    pycolmap.set_random_seed(SEED)
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # what goes wrong is said below
    with TemporaryDirectory() as folder:
        root = Path(folder)
        database, images, masks = root / "features.db", root / "images", root / "masks"
        for each in (images, masks):
            each.mkdir()
        extraction = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False, max_image_size=MOST_SIDE)
        extraction.sift.max_num_features = MOST_FEATURES
        groups: dict[tuple, list[str]] = {}
        for name, view in views.items():
            Image.fromarray(view.grey).save(images / f"{name}.png")
            Image.fromarray(kept[name].astype(np.uint8) * 255).save(masks / f"{name}.png.png")
            groups.setdefault((view.grey.shape, view.camera.centre, view.prior), []).append(name)
        kept_focals, done = set(), count()
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
                    database, images, [f"{name}.png"], pycolmap.CameraMode.SINGLE, reader, extraction, pycolmap.Device.cpu
                )  # fmt: skip
                reader.existing_camera_id = number
        matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = SEED
        files = [f"{name}.png" for names in groups.values() for name in names]
        pairing = pycolmap.ImportedPairingOptions(match_list_path=str(root / "pairs.txt"))
        for k, file in enumerate(files[1:], start=1):  # with all before it
            report(0.2 + 0.4 * k**2 / len(files) ** 2, "matches")
            write_text(root / "pairs.txt", "".join(f"{other} {file}\n" for other in files[:k]))
            pycolmap.match_image_pairs(database, matching, pairing, verification, pycolmap.Device.cpu)
        done = count(2)  # the first two photos are placed together

        def placed_one() -> None:
            """Say that one more photo has its place."""
            report(0.6 + 0.3 * min(next(done) / len(files), 1.0), "cameras")

        report(0.6, "cameras")
        options = pycolmap.IncrementalPipelineOptions(
            num_threads=1, random_seed=SEED, multiple_models=False, min_model_size=LEAST_PHOTOS, extract_colors=False,
            ba_refine_focal_length=True, ba_refine_principal_point=False, constant_cameras=kept_focals,
        )  # fmt: skip
        options.mapper.num_threads, options.mapper.random_seed, options.triangulation.random_seed = 1, SEED, SEED
        models = pycolmap.incremental_mapping(
            database, images, root / "models", options, next_image_callback=placed_one
        )
        best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)
        if best is None or best.num_points3D() < LEAST_POINTS:
            return {}, 0
        report(0.9, "hull of the masks")
        placed, bent = {}, bent_lenses(best)
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
    """Focal length and k1 of the cameras, by number, whose lens moves an observed point by more than `BENT` pixels.

    The model of pinholes is left as it is; its bundle is adjusted once more with one coefficient a camera.
    """
    free = pycolmap.Reconstruction(model)
    for camera in free.cameras.values():
        pinhole = camera.params.tolist()
        camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_RADIAL, [*pinhole, 0.0]
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_principal_point=False)
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(free, options)
    bent = {}
    for image in free.images.values():
        places = np.array([point.xy for point in image.points2D if point.has_point3D()]).reshape(-1, 2)
        focal, x, y, k = free.cameras[image.camera_id].params.tolist()
        radius = np.hypot(*(places - (x, y)).T).max(initial=0.0) / focal
        if focal * abs(k) * radius**3 > BENT:
            bent[image.camera_id] = (focal, k)
    return bent


def outline_of(name: str, view: View, placed: Registered) -> Outline:
    """Return what is seen of all objects together, by the camera that was found."""
    part = np.where(view.left_out, UNKNOWN, view.objects.astype(int))
    camera = msgspec.structs.replace(view.camera, focal=placed.focal)
    return Outline(name, part, camera, FocalPrior(placed.focal, 0.0), placed.pose)
