"""Cameras by structure from motion (COLMAP, Schönberger and Frahm 2016), on the CPU.

The steps are SIFT, matching, and incremental mapping. Up to EXHAUSTIVE photos are all matched with each other, of more
those pairs that probably overlap. Either the camera moves about a scene at rest, or an object turns before a camera at
rest. So features on the objects, and all others, are matched among themselves. A model is accepted if a hull of the
objects' masks fits into all of them; beside an object that turns, the background gives cameras at rest. Of accepted
models, the one that registers more photos is kept. Features and matches use all cores, which changes neither; mapping
uses one thread. Seeds are fixed, so the same photos give the same cameras.
"""

import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from itertools import combinations, count
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
import pycolmap
from jaxtyping import Bool, UInt8
from PIL import Image

from factorlib.align.silhouette import TYPICAL_SIGMA, UNKNOWN
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.shapes.hull import hull_overlap
from factorlib.shapes.outline import Outline
from factorlib.shapes.pairs import LARGEST, overlapping_pairs
from factorlib.wholefile import write_text

LEAST_PHOTOS = 3  # least number of registered photos
LEAST_POINTS = 30  # least number of points of an accepted model
LEAST_AGREEMENT = 0.75  # least overlap (IoU) of a coarse hull with the masks, for an accepted model
MOST_SIDE = 1600
MOST_FEATURES = 4000
LEAST_DISTORTION = 2.0  # least distortion that counts, pixels
EXHAUSTIVE = 30  # greatest number of photos that are all matched with each other
FEW = 10  # least number of photos of each hull, of larger sets
ENOUGH = 0.9  # share of a larger set's photos that one region's model must register for the other not to be mapped
POLL = 0.2  # time between reports, s
FEATURE_BYTES = MOST_FEATURES * (6 * 4 + 128)  # of a photo in the database, at most: shapes and descriptors
PAIR_BYTES = 2 * 4096  # of a pair of photos: a page of matches, and one of verified ones
SEED = 0
DATABASE = "features.db"
CURE = (
    "structure from motion needs photos of one scene, each 10 to 20° from the next, with texture on the object or "
    "around it; where the object turns before a camera at rest, photos each 5 to 10° from the next, with masks of the "
    "object alone, and texture on it; without, give `file`, `lathe` or `primitive` meshes"
)
log = logging.getLogger("factorlib.shapes")


class PhotoForMotion(msgspec.Struct, frozen=True):
    """Photo as displayed, in 8 bits of grey, with its masks and prior camera.

    objects       pixels that show objects
    left_out      pixels that are not to be used
    camera        camera at its most probable focal length
    focal_sigma   standard deviation of the logarithm of the focal length; with 0 the focal length is kept
    """

    grey: UInt8[np.ndarray, "h w"]
    objects: Bool[np.ndarray, "h w"]
    left_out: Bool[np.ndarray, "h w"]
    camera: Camera
    focal_sigma: float


class RegisteredCamera(msgspec.Struct, frozen=True):
    """Camera of a photo in the model: focal length in its pixels, and cam_from_world, of unknown scale.

    distortion: focal length and k1 of `distorted_lenses`, if the lens distorts
    """

    focal: float
    pose: Pose
    distortion: tuple[float, float] | None = None


def cameras_by_motion(
    photos: Mapping[str, PhotoForMotion],
    report: Callable[[float, str], None] = lambda share, step: None,
    threads: int = -1,
) -> dict[str, RegisteredCamera]:
    """Estimate cameras by structure from motion (COLMAP); a warning names the photos that cannot be registered.

    Args:
        photos: Photos by name.
        report: Called with the completed share, from 0 to 1, and the current step.
        threads: Number of threads, on which no camera depends; -1: that of the cores.

    Returns:
        Cameras of the registered photos by name.

    Raises:
        InputError: If fewer than three photos are registered.
    """
    models: dict[str, tuple[dict[str, RegisteredCamera], int]] = {}
    with TemporaryDirectory() as folder:
        root = Path(folder)
        known_focals = _extract_features(root, photos, threads, report)
        for begin, region in ((0.2, "on the objects"), (0.6, "beside them")):
            masks = {}
            for name, photo in photos.items():
                masks[name] = (photo.objects if not models else ~photo.objects) & ~photo.left_out
            share = partial(_report_region, report, begin, region)
            models[region] = _map_photos(root / region, photos, masks, known_focals, threads, share)
            if len(photos) > EXHAUSTIVE and len(models[region][0]) >= ENOUGH * len(photos):
                break
    region, (cameras, points) = max(models.items(), key=lambda item: (len(item[1][0]), item[1][1]))
    if len(cameras) < LEAST_PHOTOS:
        fault = f"only {len(cameras)} of {len(photos)} photos can be registered: too few of their features match"
        raise InputError(fault, file="dataset.yaml", key="cameras.sfm", cure=CURE)
    log.info("cameras of %d of %d photos by %d points %s", len(cameras), len(photos), points, region)
    if missing := [name for name in photos if name not in cameras]:
        log.warning(
            "structure from motion does not place %s: nothing overlaps with them; they are aligned by masks alone",
            ", ".join(missing),
        )
    return cameras


def _begin_colmap() -> None:
    """Set COLMAP's seed, and silence its log, which a mapping turns on again; failures are reported here."""
    pycolmap.set_random_seed(SEED)
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value


def _report_region(report: Callable[[float, str], None], begin: float, region: str, share: float, step: str) -> None:
    """Report progress on one of two regions, whose share of the work begins at `begin`."""
    report(begin + 0.4 * share, f"{step} {region}")


def _map_photos(
    root: Path,
    photos: Mapping[str, PhotoForMotion],
    masks: Mapping[str, Bool[np.ndarray, "h w"]],
    known_focals: set[int],
    threads: int,
    report: Callable[[float, str], None],
) -> tuple[dict[str, RegisteredCamera], int]:
    """Build the largest model of features in the masks.

    Args:
        root: Folder to create, beside the features of all photos.
        photos: Photos by name.
        masks: Pixels of each photo whose features are used.
        known_focals: Numbers of the cameras whose focal length is kept.
        threads: Number of threads for matching.
        report: Called with the completed share, from 0 to 1, and the current step.

    Returns:
        Cameras by photo, and the number of points; none if the cameras do not move with the objects.
    """
    _begin_colmap()
    root.mkdir()
    largest = _select_features(root, masks)
    pairs = list(combinations(largest, 2))
    if len(photos) > EXHAUSTIVE:
        chosen = overlapping_pairs([largest[name] for name in photos], lambda share: report(0.1 * share, "pairs"))
        names = list(photos)
        paired = {frozenset((names[i], names[j])) for i, j in chosen}
        pairs = [pair for pair in pairs if frozenset(pair) in paired]
    _match_features(root, pairs, threads, len(photos) > EXHAUSTIVE, report)
    model = _reconstruct(root, len(photos), known_focals, report)
    if model is None or model.num_points3D() < LEAST_POINTS:
        return {}, 0
    report(0.95, "hull of the masks")
    cameras = _read_cameras(model)
    if (overlap := _agreement_with_hulls(photos, cameras)) < LEAST_AGREEMENT:
        words = "cameras by %d points do not move with the objects (hull against masks: %.2f)"
        log.info(words, model.num_points3D(), overlap)
        return {}, 0
    return {name: cameras[name] for name in photos if name in cameras}, model.num_points3D()


def _agreement_with_hulls(photos: Mapping[str, PhotoForMotion], cameras: Mapping[str, RegisteredCamera]) -> float:
    """Return the overlap of a coarse hull of all objects together with their masks.

    A hull is what all its masks contain, and a few wrong ones cut it. So of a larger set it is the median of hulls of
    FEW photos.
    """
    names = sorted(name for name in cameras if photos[name].objects.any())
    groups = max(len(names) // FEW, 1) if len(photos) > EXHAUSTIVE else 1
    overlaps = []
    for k in range(groups):  # an outline keeps maps of distances, so only those of a group are made at once
        outlines = []
        for name in names[k::groups]:
            photo = photos[name]
            part = np.where(photo.left_out, UNKNOWN, photo.objects.astype(int))
            camera = msgspec.structs.replace(photo.camera, focal=cameras[name].focal)
            outlines.append(Outline(name, part, camera, pose=cameras[name].pose))
        overlaps.append(hull_overlap([outline for outline in outlines if outline.is_visible]))
    return float(np.median(overlaps))


def _extract_features(
    root: Path, photos: Mapping[str, PhotoForMotion], threads: int, report: Callable[[float, str], None]
) -> set[int]:
    """Extract SIFT features of all photos, whole, into COLMAP's database in `root`.

    All photos of one size, principal point and focal length share a camera; COLMAP numbers the cameras from 1.

    Returns:
        Numbers of the cameras whose focal length is known.
    """
    _begin_colmap()
    (root / "images").mkdir()
    groups: dict[tuple, list[str]] = {}
    for name, photo in photos.items():
        Image.fromarray(photo.grey).save(root / "images" / f"{name}.png")
        key = photo.grey.shape, photo.camera.centre, photo.camera.focal, photo.focal_sigma
        groups.setdefault(key, []).append(f"{name}.png")
    known_focals = set()
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE")
    pycolmap.Database.open(root / DATABASE).close()
    for number, (((height, width), centre, focal, sigma), group) in enumerate(groups.items(), start=1):
        is_given = sigma < TYPICAL_SIGMA or centre != (width / 2, height / 2)
        reader.camera_params = f"{focal},{centre[0]},{centre[1]}" if is_given else ""
        if sigma == 0:
            known_focals.add(number)
        pycolmap.import_images(root / DATABASE, root / "images", pycolmap.CameraMode.SINGLE, group, reader)
    files = [file for group in groups.values() for file in group]
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False, max_image_size=MOST_SIDE)
    extraction.sift.max_num_features = MOST_FEATURES
    reader.camera_params = ""
    extract = partial(
        pycolmap.extract_features, root / DATABASE, root / "images", files, pycolmap.CameraMode.AUTO, reader,
        extraction, pycolmap.Device.cpu,
    )  # fmt: skip
    _fill_database(extract, root / DATABASE, FEATURE_BYTES * len(files), lambda share: report(0.2 * share, "features"))
    return known_focals


def _fill_database(
    work: Callable[[pycolmap.CancellationToken], None], database: Path, expected: float, report: Callable[[float], None]
) -> None:
    """Run COLMAP's work on a database in a thread, and report its progress by the growth of the database's files.

    Nothing else may open the database meanwhile: another SQLite in this process would release COLMAP's locks, and the
    database would be damaged ("How To Corrupt An SQLite Database File", section 2.2.1).

    Args:
        work: Function of a token by which it is cancelled.
        database: File of the database.
        expected: Bytes by which its files grow.
        report: Called with the completed share, from 0 to 1.
    """
    before = _size(database)
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(1) as thread:
        future = thread.submit(work, token)
        try:
            while not wait([future], POLL).done:
                report(min((_size(database) - before) / expected, 1.0))
        finally:
            token.cancel()
        future.result()


def _size(database: Path) -> int:
    """Return the number of bytes of a database and of its journals."""
    return sum(file.stat().st_size for file in database.parent.glob(f"{database.name}*"))


def _select_features(root: Path, masks: Mapping[str, Bool[np.ndarray, "h w"]]) -> dict[str, UInt8[np.ndarray, "_ 128"]]:
    """Write a database in `root` of the features in the masks, from that of all features beside it.

    Returns:
        Descriptors of the features of the largest scales, by photo, in COLMAP's order.
    """
    shutil.copy(root.parent / DATABASE, root / DATABASE)
    largest = {}
    with pycolmap.Database.open(root.parent / DATABASE) as everything, pycolmap.Database.open(root / DATABASE) as part:
        part.clear_keypoints()
        part.clear_descriptors()
        for image in everything.read_all_images():
            name = Path(image.name).stem
            features = everything.read_keypoints(image.image_id)
            descriptors = everything.read_descriptors(image.image_id)
            columns, rows = features[:, :2].astype(int).T
            inside = masks[name][rows, columns]
            descriptors.data = descriptors.data[inside]
            part.write_keypoints(image.image_id, features[inside])
            part.write_descriptors(image.image_id, descriptors)
            # a feature's shape is a matrix; its scale is the root of the determinant
            a, b, c, d = features[inside, 2:].T
            largest[name] = descriptors.data[np.argsort(-np.abs(a * d - b * c), kind="stable")[:LARGEST]]
    return largest


def _match_features(
    root: Path, pairs: Sequence[tuple[str, str]], threads: int, is_guided: bool, report: Callable[[float, str], None]
) -> None:
    """Match the features of pairs of images, in one call, because COLMAP indexes an image's features anew in each.

    Guided matching seeks more matches near the epipolar lines; where pairs are few, each needs them.
    """
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False, guided_matching=is_guided)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    write_text(root / "pairs.txt", "".join(f"{one}.png {other}.png\n" for one, other in pairs))
    pairing = pycolmap.ImportedPairingOptions(match_list_path=str(root / "pairs.txt"))
    match = partial(pycolmap.match_image_pairs, root / DATABASE, matching, pairing, verification, pycolmap.Device.cpu)
    _fill_database(match, root / DATABASE, PAIR_BYTES * len(pairs), lambda share: report(0.1 + 0.4 * share, "matches"))


def _reconstruct(
    root: Path, images: int, known_focals: set[int], report: Callable[[float, str], None]
) -> pycolmap.Reconstruction | None:
    """Return the largest model of COLMAP's incremental mapping, or None.

    Args:
        root: Folder of the database.
        images: Number of images.
        known_focals: Numbers of the cameras whose focal length is kept.
        report: Called with the completed share, from 0 to 1, and the current step.

    Returns:
        The model.
    """
    counter = count(2)  # the first two photos are registered together

    def report_photo() -> None:
        """Report that one more photo is registered."""
        report(0.5 + 0.45 * min(next(counter) / images, 1.0), "cameras")

    report(0.5, "cameras")
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1,
        random_seed=SEED,
        multiple_models=False,
        min_model_size=LEAST_PHOTOS,
        extract_colors=False,
        ba_refine_focal_length=True,
        ba_refine_principal_point=False,
        constant_cameras=known_focals,
    )
    options.mapper.num_threads = 1
    options.mapper.random_seed = SEED
    options.triangulation.random_seed = SEED
    models = pycolmap.incremental_mapping(
        root / DATABASE, root.parent / "images", root / "models", options, next_image_callback=report_photo
    )
    return max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def _read_cameras(model: pycolmap.Reconstruction) -> dict[str, RegisteredCamera]:
    """Return the camera of each registered photo, by name."""
    cameras = {}
    distortions = distorted_lenses(model)
    for image in model.images.values():
        if image.has_pose:
            motion = image.cam_from_world()
            pose = Pose(motion.rotation.matrix(), np.array(motion.translation))
            focal = float(model.cameras[image.camera_id].focal_length)
            cameras[Path(image.name).stem] = RegisteredCamera(focal, pose, distortions.get(image.camera_id))
    return cameras


def distorted_lenses(model: pycolmap.Reconstruction) -> dict[int, tuple[float, float]]:
    """Find the cameras whose lens distortion moves an observed point by more than `LEAST_DISTORTION` pixels.

    The model of pinhole cameras is left unchanged. A copy is bundle-adjusted with one radial coefficient per camera.

    Returns:
        Focal length and k1, by number of the camera.
    """
    free = pycolmap.Reconstruction(model)
    for camera in free.cameras.values():
        pinhole = camera.params.tolist()
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [*pinhole, 0.0]
    _begin_colmap()
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_principal_point=False)
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(free, options)
    distortions = {}
    for image in free.images.values():
        places = np.array([point.xy for point in image.points2D if point.has_point3D()]).reshape(-1, 2)
        focal, x, y, k = free.cameras[image.camera_id].params.tolist()
        # radial distortion f |k| r³ at the largest observed radius r, with r in units of f
        radius = np.hypot(*(places - (x, y)).T).max(initial=0.0) / focal
        if focal * abs(k) * radius**3 > LEAST_DISTORTION:
            distortions[image.camera_id] = (focal, k)
    return distortions
