"""Scores of predicted views of held-out photos, beside pictures that need neither materials nor light.

predicted      the re-synthesis, as it is
mean_colour    the photo's own mean colour
flat           each material in its own mean colour in the photo
nearest_photo  solved photos, warped through the meshes (projective texturing).  A point takes the value of the photo
               of the same object that sees it from the nearest direction, times one exposure for the whole view.
               Points that no photo sees have the colour of `flat`.

The score is the PSNR of clip(e L, 0, 1)^(1/2.2), e = 0.5 / mean of the photo's radiance, as in the relit set score.  It
is over the photo's pixels that count (`factorlib.evaluate.picture_errors`).

A photo sees a point if the surface faces its camera, its depth map has the point's depth there, and its pixels there
count and have the point's material.  Objects of one name are the same object.
"""

from collections.abc import Iterable

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates

from factorlib.evaluate.picture_errors import Channels, ComparedPhoto, flat_colours
from factorlib.evaluate.relighting import displayed_psnr
from factorlib.results.metrics import ViewScores
from factorlib.results.poses import ObjectPose, PhotoPoses

DEPTH_TOLERANCE = 0.01  # of the extent of an object's visible points


class PosedPhoto(msgspec.Struct, frozen=True):
    """A photo with its re-synthesis, its poses, and the channels of `align`."""

    compared: ComparedPhoto
    poses: PhotoPoses
    geometry: Channels


def compare_view(photo: PosedPhoto, sources: Iterable[PosedPhoto]) -> ViewScores | None:
    """Score the predicted view of a held-out photo beside flat colours and other photos; None if no pixel counts.

    Args:
        photo: the held-out photo
        sources: the solved photos
    """
    pixels = photo.compared.pixels
    if not pixels.any():
        return None
    truth = photo.compared.photo[pixels]
    flat = flat_colours(photo.compared)[pixels]
    warped, visible = warp_photos(photo, sources)
    # least squares: s = Σ w·t / Σ w·w over visible points
    scale = np.sum(warped[visible] * truth[visible]) / max(np.sum(warped[visible] ** 2), 1e-300)
    views = {
        "predicted": np.nan_to_num(photo.compared.resynthesis[pixels], posinf=0.0, neginf=0.0),
        "mean_colour": np.broadcast_to(truth.mean(axis=0), truth.shape),
        "flat": flat,
        "nearest_photo": np.where(visible[:, None], scale * warped, flat),
    }
    scores = {name: displayed_psnr(view, truth) for name, view in views.items()}
    return ViewScores(**scores, visible=round(float(visible.mean()), 6))


def warp_photos(
    photo: PosedPhoto, sources: Iterable[PosedPhoto]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Return, for each counted pixel of a photo, the radiance in the source that sees its point from the nearest direction.

    Args:
        photo: the photo
        sources: other photos

    Returns:
        The radiance, 0 where no source sees the point, and a mask of the points that a source sees.
    """
    rows, columns = np.nonzero(photo.compared.pixels)
    height, width = photo.compared.label.shape
    rays = photo.poses.camera.camera(width, height).rays()[rows, columns]
    points = rays * photo.geometry["depth"][rows, columns, None]
    normals = np.stack([photo.geometry[f"normal.{axis}"][rows, columns] for axis in "xyz"], axis=-1)
    label = photo.compared.label[rows, columns]
    number = np.rint(photo.geometry["object"][rows, columns])
    radiance = np.zeros((len(points), 3))
    nearest = np.full(len(points), -np.inf)  # cosine between the directions to both cameras
    for source in sources:
        for k, (name, pose) in enumerate(photo.poses.objects.items(), start=1):
            chosen = np.flatnonzero(number == k)
            source_pose = source.poses.objects.get(name)
            if source_pose is None or source_pose.left_out or not len(chosen):
                continue
            surface = points[chosen], normals[chosen], label[chosen]
            colour, cosine = project_points(*surface, pose, source, source_pose)
            better = cosine > nearest[chosen]
            radiance[chosen[better]] = colour[better]
            nearest[chosen[better]] = cosine[better]
    return radiance, nearest > -np.inf


def project_points(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    label: Float[np.ndarray, " n"],
    pose: ObjectPose,
    source: PosedPhoto,
    source_pose: ObjectPose,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Look up points of an object in another photo.

    Args:
        points: points in the frame of the first camera
        normals: normals of the surface there, in the same frame
        label: their materials
        pose: the object's pose in the first photo
        source: the other photo
        source_pose: the object's pose in it

    Returns:
        Interpolated radiance, and the cosine between the directions to both cameras: −inf for points that the photo
        does not see.
    """
    # x = (Rᵀ (x_cam − t)) / s: points and both cameras in the object's frame
    on_object = (points - pose.pose.translation) @ pose.pose.rotation / np.array(pose.scale)
    to_camera, to_source = (
        -each.pose.translation @ each.pose.rotation / np.array(each.scale) - on_object for each in (pose, source_pose)
    )
    norms = np.linalg.norm(to_camera, axis=1) * np.linalg.norm(to_source, axis=1)
    cosine = np.sum(to_camera * to_source, axis=1) / np.maximum(norms, 1e-300)
    projected = source_pose.pose.apply(on_object * np.array(source_pose.scale))
    z = projected[:, 2]
    height, width = source.compared.label.shape
    camera = source.poses.camera.camera(width, height)
    place = camera.project(np.where(z[:, None] > 0, projected, 1.0)).T[::-1] - 0.5  # rows and columns

    def sample(values: np.ndarray, order: int = 1) -> np.ndarray:
        """Interpolate a map of the source at the points."""
        return map_coordinates(values.astype(float), place, order=order, mode="constant", cval=-1.0)

    tolerance = DEPTH_TOLERANCE * np.linalg.norm(np.ptp(projected, axis=0))
    facing = np.sum(normals @ pose.pose.rotation * np.array(pose.scale) * to_source, axis=1) > 0
    visible = facing & (z > 0) & (np.abs(sample(source.geometry["depth"]) - z) <= tolerance)
    visible &= (sample(source.compared.pixels) > 1 - 1e-6) & (sample(source.compared.label, order=0) == label)
    colour = np.stack([sample(source.compared.photo[..., channel]) for channel in range(3)], axis=-1)
    return colour, np.where(visible, cosine, -np.inf)
