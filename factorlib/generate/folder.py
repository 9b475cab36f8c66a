"""Writers of a data set: photos as cameras write them, label masks, truth, and the YAML files."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

from factorlib.dataset.schema import LEFT_OUT
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, Maps, rasterise
from factorlib.images.exif import FILM_DIAGONAL
from factorlib.images.exr import FIXED_DATE, LAT_LONG, encode_pixels, write_exr, write_rgb_exr
from factorlib.images.photo import box_sum
from factorlib.images.tone import srgb_encode
from factorlib.meshes.mesh import Mesh
from factorlib.results.materials import Reflectance
from factorlib.wholefile import write_bytes, write_text
from factorlib.yamlfile import yaml_text

Image = Float[np.ndarray, "h w 3"]
Poses = Mapping[str, Mapping[str, Pose]]  # cam_from_object by photo and object
SUBPIXELS = 4  # number of rays per pixel and side that determine its label


def write_photo(path: Path, radiance: Image, focal_35mm: float | None = None, quality: int = 95) -> None:
    """Write a photo: linear float for .exr; sRGB, clipped at 1, for .png (16 bits) and .jpg (8 bits).

    Args:
        path: File to write.
        radiance: Linear radiance.
        focal_35mm: Focal length for the EXIF data of a .jpg, 35 mm equivalent.
        quality: Quality of a .jpg.
    """
    if path.suffix == ".exr":
        return write_rgb_exr(path, radiance)
    values = srgb_encode(np.clip(radiance, 0, 1))
    kind, top = (np.uint16, 65535) if path.suffix == ".png" else (np.uint8, 255)
    attributes: dict[str, Any] = {"DateTime": FIXED_DATE, "Software": "factorlib", "oiio:ColorSpace": "sRGB"}
    if path.suffix == ".jpg":
        attributes |= {"Compression": f"jpeg:{quality}", "jpeg:subsampling": "4:4:4"}
    if focal_35mm is not None:
        attributes["Exif:FocalLengthIn35mmFilm"] = round(focal_35mm)
    write_bytes(path, encode_pixels(path, (values * top + 0.5).astype(kind), attributes))


def focal_px_of_35mm(focal_35mm: float, width: int, height: int) -> float:
    """Convert a 35 mm equivalent in whole millimetres to pixels, by the convention of CIPA DCG-001.

    Args:
        focal_35mm: 35 mm equivalent, to be rounded.
        width: Width of the photo.
        height: Height of the photo.

    Returns:
        Focal length in pixels.
    """
    return round(focal_35mm) / FILM_DIAGONAL * float(np.hypot(width, height))


def write_labels(path: Path, labels: Int[np.ndarray, "h w"]) -> None:
    """Write labels as a one-channel 8-bit PNG: 0 background, k the k-th material, 255 left out."""
    write_bytes(path, encode_pixels(path, labels.astype(np.uint8)[..., None]))


def write_light(path: Path, lat_long: Image) -> None:
    """Write a map of linear radiance, lat-long as in `factorlib.conventions`, as EXR."""
    write_rgb_exr(path, lat_long, LAT_LONG)


def write_normals(path: Path, normal: Image) -> None:
    """Write unit normals in the camera frame, 0 where there is no object, as EXR."""
    write_exr(path, {f"normal.{axis}": normal[..., k] for k, axis in enumerate("xyz")})


def write_mask_and_truth(out: Path, name: str, labels: Int[np.ndarray, "h w"], light: Image, maps: Maps) -> None:
    """Write the mask of one photo and its truth: light and normals.

    Args:
        out: Folder of the data set.
        name: Name of the photo.
        labels: Labels of the mask.
        light: Light map, in the photo's units.
        maps: Rendered maps of the true geometry.
    """
    write_labels(out / f"masks/{name}.png", labels)
    write_light(out / f"truth/{name}_light.exr", light)
    write_normals(out / f"truth/{name}_normal.exr", maps.normal)


def write_obj(path: Path, parts: Mapping[str, tuple[np.ndarray, ...]]) -> None:
    """Write parts as groups of a Wavefront OBJ.

    `parts` maps names to vertices [V, 3], faces [F, 3] and, optionally, normals [V, 3]. With normals, numbers have nine
    digits.
    """
    lines = []
    first = 1
    for name, (vertices, faces, *normals) in parts.items():
        digits, corner = (".9g", "{0}//{0}") if normals else (".5f", "{0}")
        lines += [f"g {name}", *("v " + " ".join(f"{x:{digits}}" for x in v) for v in vertices)]
        lines += ["vn " + " ".join(f"{x:.9g}" for x in n) for n in (normals[0] if normals else [])]
        lines += ["f " + " ".join(corner.format(k) for k in face) for face in np.asarray(faces) + first]
        first += len(vertices)
    write_text(path, "\n".join(lines) + "\n")


def label_pixels(meshes: Sequence[Mesh], camera: Camera, poses: list[Pose]) -> Int[np.ndarray, "h w"]:
    """Return the material label of each pixel; 255 if the pixel with a margin of a quarter shows several materials.

    Args:
        meshes: Meshes.
        camera: Camera.
        poses: Pose of each mesh.

    Returns:
        Labels.
    """
    return whole_pixels(_subpixels(meshes, camera, poses).label)


def object_masks(meshes: Sequence[Mesh], camera: Camera, poses: list[Pose]) -> list[Bool[np.ndarray, "h w"]]:
    """Return masks of the pixels of which each object fills at least half.

    Args:
        meshes: Meshes.
        camera: Camera.
        poses: Pose of each mesh.

    Returns:
        One mask for each object.
    """
    number = _subpixels(meshes, camera, poses).object[SUBPIXELS:-SUBPIXELS, SUBPIXELS:-SUBPIXELS]
    inside = number.reshape(camera.height, SUBPIXELS, camera.width, SUBPIXELS)
    return [(inside == k + 1).mean(axis=(1, 3)) >= 0.5 for k in range(len(poses))]


def albedo_map(
    meshes: Sequence[Mesh], materials: Sequence[Reflectance], camera: Camera, poses: Sequence[Pose]
) -> Image:
    """Return k_d at each pixel: the mean over those of its subpixels that show a mesh, 0 if there are none.

    Args:
        meshes: Meshes with detail.
        materials: Materials in the order of their labels.
        camera: Camera.
        poses: Pose of each mesh.

    Returns:
        Albedo.
    """
    fine = camera.window(0, 0, 1 / SUBPIXELS, camera.width * SUBPIXELS, camera.height * SUBPIXELS)
    diffuse = np.array([material.diffuse for material in materials])
    albedo = np.zeros((fine.height, fine.width, 3))
    nearest = np.full(albedo.shape[:2], np.inf)
    for mesh, pose in zip(meshes, poses, strict=True):
        hits = Caster(mesh).cast(fine, pose)
        visible = hits.depth < nearest
        nearest[visible] = hits.depth[visible]
        # detail at the corners, interpolated by barycentric coordinates
        face = hits.face[visible]
        weight = np.column_stack([1 - hits.uv[visible].sum(axis=1), hits.uv[visible]])
        detail = np.einsum("nk,nkc->nc", weight, np.asarray(mesh.detail)[mesh.faces[face]])
        albedo[visible] = detail * diffuse[mesh.face_label[face] - 1]
    covered = box_sum(np.isfinite(nearest), SUBPIXELS)
    return box_sum(albedo, SUBPIXELS) / np.maximum(covered, 1)[..., None]


def _subpixels(meshes: Sequence[Mesh], camera: Camera, poses: list[Pose]) -> Maps:
    """Render maps on a grid SUBPIXELS times finer, with a border of one pixel."""
    window = camera.window(-1, -1, 1 / SUBPIXELS, (camera.width + 2) * SUBPIXELS, (camera.height + 2) * SUBPIXELS)
    return rasterise(meshes, window, poses)


def whole_pixels(fine: Int[np.ndarray, "hh ww"]) -> Int[np.ndarray, "h w"]:
    """Reduce labels of subpixels, with a border of one pixel, to labels of pixels.

    A pixel gets the label on which all its subpixels and the nearest ones around it agree, else 255.
    """
    windows = np.lib.stride_tricks.sliding_window_view(fine, (SUBPIXELS + 2, SUBPIXELS + 2))
    windows = windows[SUBPIXELS - 1 :: SUBPIXELS, SUBPIXELS - 1 :: SUBPIXELS]
    height, width = (n // SUBPIXELS - 2 for n in fine.shape)
    windows = windows[:height, :width]
    low = windows.min(axis=(-2, -1))
    return np.where(low == windows.max(axis=(-2, -1)), low, LEFT_OUT)


def write_yaml(path: Path, value: dict[str, Any], comment: str) -> None:
    """Write nested mappings as YAML below a comment.

    Numbers have six decimals; those below 1e-4 become 0.

    Args:
        path: File to write.
        value: Mapping.
        comment: First line.
    """
    write_text(path, f"# {comment}\n{yaml_text(_round_floats(value))}")


def _round_floats(value: Any) -> Any:
    """Round all floats of nested mappings and lists."""
    if isinstance(value, dict):
        return {key: _round_floats(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_round_floats(item) for item in value]
    return (round(float(value), 6) if abs(value) >= 1e-4 else 0.0) if isinstance(value, float) else value


def pose_entry(pose: Pose) -> dict[str, Any]:
    """Return cam_from_object in the form of dataset.yaml and truth.yaml."""
    rotation = [[round(float(v), 6) for v in row] for row in pose.rotation]
    return {"rotation": rotation, "translation": [float(v) for v in pose.translation]}


def write_records(
    out: Path, comment: str, materials: Mapping[str, Any], meshes: dict[str, Any], photos: list[Any], poses: Poses
) -> None:
    """Write dataset.yaml and truth/truth.yaml of a generated data set.

    The latter names maps of albedo if there are any.

    Args:
        out: Folder of the data set.
        comment: First line of dataset.yaml.
        materials: Materials by name.
        meshes: Entries of meshes by name.
        photos: Entries of photos.
        poses: Poses by photo and object.
    """
    record = {"format": 1, "materials": list(materials), "meshes": meshes, "photos": photos}
    write_yaml(out / "dataset.yaml", record | {"truth": "truth/truth.yaml"}, comment)
    truth = {
        "materials": {name: msgspec.to_builtins(material) for name, material in materials.items()},
        "illumination": {name: f"truth/{name}_light.exr" for name in poses},
        "normals": {name: f"truth/{name}_normal.exr" for name in poses},
        "poses": {photo: {name: pose_entry(pose) for name, pose in each.items()} for photo, each in poses.items()},
    }
    albedo = {name: f"truth/{name}_albedo.exr" for name in poses}
    if any((out / file).is_file() for file in albedo.values()):
        truth["albedo"] = albedo
    comment = "What the photos were made of; lights in the units of their photos, seen from the objects"
    write_yaml(out / "truth/truth.yaml", truth, comment)
