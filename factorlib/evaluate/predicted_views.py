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

from collections.abc import Iterable, Mapping

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates

from factorlib.evaluate.picture_errors import Channels, ComparedPhoto, flat_colours
from factorlib.evaluate.relighting import displayed_psnr
from factorlib.geometry.camera import Camera
from factorlib.results.poses import ObjectPose

DEPTH_TOLERANCE = 0.01  # of the extent of an object's visible points


class PosedPhoto(msgspec.Struct, frozen=True):
    """A photo with its re-synthesis, the channels of `align`, its camera, and the poses of its objects by name."""

    compared: ComparedPhoto
    geometry: Channels
    camera: Camera
    objects: dict[str, ObjectPose]


def compare_view(photo: PosedPhoto, sources: Iterable[PosedPhoto]) -> dict[str, float]:
    """Score the predicted view of a held-out photo, flat colours, and other photos in its place.

    Args:
        photo: the held-out photo
        sources: the solved photos

    Returns:
        PSNR in dB by picture, and `visible`, the fraction of the pixels whose points a solved photo sees; empty if no
        pixel counts.
    """
    pixels = photo.compared.pixels
    if not pixels.any():
        return {}
    truth = photo.compared.photo[pixels]
    flat = flat_colours(photo.compared)[pixels]
    warped, visible = warp_photos(photo, sources)
    # least squares over visible points: exposure = Σ w·t / Σ w·w
    exposure = np.sum(warped[visible] * truth[visible]) / max(np.sum(warped[visible] ** 2), 1e-300)
    views = {
        "predicted": np.nan_to_num(photo.compared.resynthesis[pixels], posinf=0.0, neginf=0.0),
        "mean_colour": np.broadcast_to(truth.mean(axis=0), truth.shape),
        "flat": flat,
        "nearest_photo": np.where(visible[:, None], exposure * warped, flat),
    }
    scores = {name: displayed_psnr(view, truth) for name, view in views.items()}
    return scores | {"visible": round(float(visible.mean()), 6)}


def describe_views(views: Mapping[str, Mapping[str, float]]) -> str:
    """Describe the scores of held-out photos, means over them, beside those of pictures that need no result."""
    one = len(views) == 1
    photos = (
        f"photo '{next(iter(views))}', which the solve had not seen, is" if one else f"{len(views)} held-out photos are"
    )
    pictures = ("predicted", "nearest_photo", "flat")
    predicted, nearest, flat = (float(np.mean([scores[p] for scores in views.values()])) for p in pictures)
    outcome = "better than both" if predicted > max(nearest, flat) else "NOT better than both"
    return (
        f"{photos} predicted to {predicted:.1f} dB; the nearest photo laid over the mesh"
        f" reaches {nearest:.1f} dB, and flat colours {flat:.1f} dB: the prediction is {outcome}"
    )


def warp_photos(
    photo: PosedPhoto, sources: Iterable[PosedPhoto]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Return, for each counted pixel of a photo, the radiance in the source that sees its point from the nearest side.

    Args:
        photo: the photo
        sources: other photos

    Returns:
        The radiance, 0 where no source sees the point, and a mask of the points that a source sees.
    """
    pixels = photo.compared.pixels
    label = photo.compared.label[pixels]
    points = photo.camera.rays()[pixels] * photo.geometry["depth"][pixels][:, None]
    normals = np.stack([photo.geometry[f"normal.{axis}"][pixels] for axis in "xyz"], axis=-1)
    radiance = np.zeros((len(points), 3))
    nearest = np.full(len(points), -np.inf)  # cosine between the directions to both cameras
    for source in sources:
        for number, (name, pose) in enumerate(photo.objects.items(), start=1):
            rows = np.flatnonzero(np.rint(photo.geometry["object"][pixels]) == number)
            if name in source.objects and not source.objects[name].left_out and len(rows):
                surface = points[rows], normals[rows], label[rows]
                colour, cosine = project_points(*surface, pose, source, source.objects[name])
                nearer = cosine > nearest[rows]
                radiance[rows[nearer]] = colour[nearer]
                nearest[rows[nearer]] = cosine[nearer]
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
    # x = Rᵀ (x_cam − t): points, and unit directions to both cameras, in the object's frame
    on_object = (points - pose.pose.translation) @ pose.pose.rotation
    centres = (-each.pose.translation @ each.pose.rotation for each in (pose, source_pose))
    to_camera, to_source = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (c - on_object for c in centres))
    facing = np.sum(normals @ pose.pose.rotation * to_source, axis=1) > 0
    # rows and columns of the source, in units of its pixels
    x, y, z = source_pose.pose.apply(on_object).T
    place = source.camera.project(np.column_stack([x, y, np.where(z > 0, z, 1.0)])).T[::-1] - 0.5

    def sample(values: np.ndarray, order: int = 1) -> np.ndarray:
        """Interpolate a map of the source at the points."""
        return map_coordinates(values.astype(float), place, order=order, mode="constant", cval=-1.0)

    visible = (
        facing
        & (z > 0)
        & (np.abs(sample(source.geometry["depth"]) - z) <= DEPTH_TOLERANCE * np.linalg.norm(np.ptp([x, y, z], axis=1)))
        & (sample(source.compared.pixels) > 1 - 1e-6)
        & (sample(source.compared.label, order=0) == label)
    )
    colour = np.stack([sample(source.compared.photo[..., channel]) for channel in range(3)], axis=-1)
    return colour, np.where(visible, np.sum(to_camera * to_source, axis=1), -np.inf)
