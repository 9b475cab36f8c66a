"""A COLMAP model, text or binary: COLMAP's frames and pixels are this project's, so nothing is converted."""

from __future__ import annotations

import pycolmap

from factorlib.dataset.check import Refusal
from factorlib.dataset.sources.shot import Shot


def colmap_shots(path: str, refuse: Refusal) -> list[Shot]:
    """The registered images of the model in the dataset's folder `path`, by name."""
    try:
        model = pycolmap.Reconstruction(str(refuse.folder / path))
    except (ValueError, RuntimeError) as error:
        found = f"{path!r} is not readable as a COLMAP model ({str(error).split('] ', 1)[-1].splitlines()[0]})"
        refuse("cameras.colmap", found, "name the folder of cameras, images and points3D (.bin or .txt), such as sparse/0")
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    return [_shot(image, model.cameras[image.camera_id]) for image in images]


def _shot(image: pycolmap.Image, camera: pycolmap.Camera) -> Shot:
    return Shot(
        image=image.name,
        camera=camera,
        size=(camera.width, camera.height),
        key=f"cameras.colmap: {image.name}",
        cam_from_world=image.cam_from_world(),
    )
