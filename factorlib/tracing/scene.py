"""Mitsuba scenes: materials, meshes, cameras, environment maps, the light that arrives at a point, and denoising.

Frames   The world has y up. A camera is given by world_from_camera, with the camera in OpenCV's axes. If the world is
         the camera's own y-up frame, that matrix is YUP_FROM_CAMERA, and an `envmap` needs no rotation.
Pixels   The reconstruction filter is a box, so that a pixel is the mean over its own square.
Envmap   Mitsuba puts row i of a map at i/(H−1) of the way down, and column j at (j+½)/W: maps in the layout of
         `factorlib.conventions` are resampled to a finer lattice of that kind, and lobes are evaluated at its nodes.
         Interpolation convolves a lobe with a triangle of the node spacing h, of variance h²/6 along each axis.  A lobe
         of sharpness λ has variance 1/λ.  Lobes are first sharpened by that amount at the same energy, so that the
         interpolated map has their energy and width.
Noise    Intel Open Image Denoise (mitsuba-oidn).  Its input is linear radiance and, as guides, the albedo and normal of
         each pixel, which have hardly any noise.  Before denoising, a partly covered pixel gets its foreground colour
         in full, and pixels without coverage get that of the nearest covered one, so that no contour is blurred.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.geometry.camera import Camera
from factorlib.light.latlong import lattice_of_lobes, sample_map
from factorlib.light.lobes import Lobes, lobe_energy
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply_stl_off import write_ply
from factorlib.results.materials import Reflectance
from factorlib.tracing.variant import mitsuba

SAMPLER = "multijitter"
SAMPLES_PER_PASS = 1 << 23
GUIDE_SAMPLES = 8  # samples per pixel of the denoiser's guides
ENVMAP_FINER = 8  # rows of Mitsuba's lattice per row of a map
MITSUBA_FROM_CAMERA = np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's sensors: x left, y up, z forward
Entry = dict[str, Any]
Matrix = Float[np.ndarray, "4 4"]
Image = Float[np.ndarray, "h w c"]
# pitch and yaw of the six views of a cube map
FACE_LOOKS = {"+x": (0, 90), "-x": (0, -90), "+y": (90, 0), "-y": (-90, 0), "+z": (0, 0), "-z": (0, 180)}


def bsdf(material: Reflectance, painted: bool = False) -> dict[str, Any]:
    """Return Mitsuba's `blendbsdf` that evaluates to k_d/π + k_s D G / (4 (n·i)(n·o)), without Fresnel.

    If `painted`, the diffuse part has the colours of the mesh's vertices, which `paint` computes.
    """
    share, diffuse, specular = material.mixture
    conductor = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": material.alpha}
    conductor |= {"specular_reflectance": rgb(specular)}
    if share == 1:
        return conductor
    colour = {"type": "mesh_attribute", "name": "vertex_color"} if painted else rgb(diffuse)
    lambertian = {"type": "diffuse", "reflectance": colour}
    if share == 0:
        return lambertian
    return {"type": "blendbsdf", "weight": share, "bsdf_0": lambertian, "bsdf_1": conductor}


def paint(material: Reflectance, detail: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Return the vertex colours for `bsdf` of a mesh with `detail`, at most 1.

    Mitsuba's diffuse BSDF has no reflectance above 1.
    """
    return np.minimum(detail * np.array(material.mixture[1]), 1.0)


def rgb(value: float | Sequence[float] | Float[np.ndarray, "3"]) -> dict[str, Any]:
    """Return a colour as a Mitsuba dictionary; a single number is grey."""
    return {"type": "rgb", "value": [float(v) for v in np.broadcast_to(value, 3)]}


def transform(matrix: Matrix) -> Any:
    """Convert a 4 × 4 matrix to Mitsuba's transform."""
    return mitsuba().ScalarTransform4f(np.asarray(matrix, dtype=float))


def rigid(rotation: Float[np.ndarray, "3 3"], translation: Sequence[float] | Float[np.ndarray, "3"]) -> Matrix:
    """Return the 4 × 4 matrix of a rotation and a translation."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def shape(
    mesh: Mesh,
    material: Entry,
    world_from_object: Matrix = np.eye(4),
    colours: Float[np.ndarray, "v 3"] | None = None,
) -> Any:
    """Load a mesh as a Mitsuba shape, with its own vertex normals.

    Args:
        mesh: The mesh.
        material: BSDF.
        world_from_object: Transform of the mesh.
        colours: Colours of the vertices.

    Returns:
        A Mitsuba shape.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.ply"
        write_ply(path, mesh, colours)
        entry = {"type": "ply", "filename": str(path), "to_world": transform(world_from_object), "bsdf": material}
        return mitsuba().load_dict(entry)


def painted_shape(mesh: Mesh, material: Reflectance, world_from_object: Matrix = np.eye(4)) -> Any:
    """Load a mesh of one material, with its detail as paint, as a Mitsuba shape."""
    colours = None if mesh.detail is None else paint(material, mesh.detail)
    surface = bsdf(material, painted=colours is not None)
    two_sided = {"type": "twosided", "bsdf": surface} if mesh.open else surface
    return shape(mesh, two_sided, world_from_object, colours)


def sensor(
    camera: Camera,
    world_from_camera: Matrix,
    columns: slice = slice(None),
    near_clip: float = 1e-3,
    alpha: bool = False,
) -> dict[str, Any]:
    """Return the pinhole camera as a Mitsuba sensor, restricted to some columns of its image.

    Args:
        camera: Camera.
        world_from_camera: Transform of the camera.
        columns: Columns to render.
        near_clip: Distance of the near clipping plane; the far one is at 10⁷ times that.
        alpha: Add a fourth channel, the coverage of each pixel.

    Returns:
        A Mitsuba dictionary.
    """
    left, right, _ = columns.indices(camera.width)
    crop = {"crop_offset_x": left, "crop_offset_y": 0, "crop_width": right - left, "crop_height": camera.height}
    cx, cy = camera.centre
    w = camera.width
    h = camera.height
    kind = "rgba" if alpha else "rgb"
    offset = {"x": (w / 2 - cx) / w, "y": (h / 2 - cy) / h}  # along the axes of the picture, not of the sensor
    film = {"type": "hdrfilm", "width": w, "height": h, "rfilter": {"type": "box"}, "pixel_format": kind, **crop}
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.focal))),
        "near_clip": near_clip,
        "far_clip": 1e7 * near_clip,
        **{f"principal_point_offset_{axis}": value for axis, value in offset.items() if value},
        "to_world": transform(world_from_camera @ MITSUBA_FROM_CAMERA),
        "sampler": {"type": SAMPLER},
        "film": film,
    }


def render_scene(
    entries: Entry, view: Entry, spp: int, seed: int, max_depth: int, hide_emitters: bool = False
) -> Image:
    """Render the radiance of a scene in the picture of a `sensor`.

    Args:
        entries: Mitsuba objects by name.
        view: Sensor.
        spp: Least number of samples per pixel.
        seed: Seed.
        max_depth: 2 for direct light alone, −1 for all bounces.
        hide_emitters: Hide the light itself, where alpha is then 0.

    Returns:
        Radiance and, if the sensor has it, alpha.
    """
    return _render(entries, view, spp, seed, {"type": "path", "max_depth": max_depth, "hide_emitters": hide_emitters})


def render_guides(entries: Entry, view: Entry, spp: int, seed: int) -> Image:
    """Render alpha (channel 3), albedo (4 to 6) and normal (7 to 9), which guide the denoiser; arguments as above.

    A rendering with these channels takes twice as long as one without, and they need few samples.
    """
    path = {"type": "path", "max_depth": 1, "hide_emitters": True}
    return _render(entries, view, spp, seed, {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal", "picture": path})


def _render(entries: Entry, view: Entry, spp: int, seed: int, integrator: Entry) -> Image:
    """Render many samples in several passes of stratified samples, so that no pass needs much memory."""
    mi = mitsuba()
    # load objects one by one: the lights of a nested dictionary come in a random order, which changes the noise
    loaded = {n: mi.load_dict(e, parallel=False) if isinstance(e, dict) else e for n, e in entries.items()}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": view, **loaded}, parallel=False)
    passes = -(-spp * view["film"]["crop_height"] * view["film"]["crop_width"] // SAMPLES_PER_PASS)
    images = [mi.render(scene, seed=passes * seed + k, spp=-(-spp // passes)) for k in range(passes)]
    return np.mean([np.array(image, dtype=np.float64) for image in images], axis=0)


def render_denoised(entries: Entry, view: Entry, spp: int, seed: int, max_depth: int) -> Image:
    """Render objects without the light behind them, and denoise; arguments as for `render_scene`."""
    picture = render_scene(entries, view, spp, seed, max_depth, hide_emitters=True)
    return denoise_picture(picture, render_guides(entries, view, min(spp, GUIDE_SAMPLES), seed))


def envmap(lat_long: Float[np.ndarray, "h w 3"], finer: int = ENVMAP_FINER) -> dict[str, Any]:
    """Return an emitter of a lat-long map in the world's frame, bilinear between the map's texel centres."""
    height, width = lat_long.shape[:2]
    return envmap_of_nodes(sample_map(lat_long, node_directions(finer * height + 1, finer * width)))


def envmap_of_nodes(radiance: Float[np.ndarray, "h w 3"]) -> dict[str, Any]:
    """Return an emitter of radiance at `node_directions`."""
    return {"type": "envmap", "bitmap": mitsuba().Bitmap(radiance.astype(np.float32))}


def node_directions(height: int, width: int) -> Float[np.ndarray, "h w 3"]:
    """Return directions of the nodes of Mitsuba's `envmap`, in its own (y-up) frame.

    Row i is at i/(H−1) of the way down, column j at (j+½)/W of the way around.
    """
    theta = np.arange(height) / (height - 1) * np.pi
    phi = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi
    sin = np.sin(theta)[:, None]
    return np.stack(np.broadcast_arrays(sin * np.sin(phi), np.cos(theta)[:, None], sin * np.cos(phi)), axis=-1)


def incident_light(
    entries: Entry, world_from_light: Matrix, height: int, spp: int, seed: int, max_depth: int = -1
) -> Image:
    """Render the radiance that arrives at the origin of the light frame (y-up) as a lat-long map of [height, 2·height].

    Six square views of 90° along the light frame's axes are averaged over 8 × 8 directions a texel.

    Args:
        entries: Mitsuba objects by name.
        world_from_light: Transform of the light frame.
        height: Rows of the map.
        spp: Least number of samples per pixel.
        seed: Seed.
        max_depth: 2 for direct light alone, −1 for all bounces, 1 for emitters alone.

    Returns:
        Radiance.
    """
    size = 2 * height
    camera = Camera(size, size, size / 2, (size / 2, size / 2))
    faces = {}
    for number, (name, (pitch, yaw)) in enumerate(FACE_LOOKS.items()):
        world_from_camera = rigid(world_from_light[:3, :3] @ look_rotation(pitch, yaw), world_from_light[:3, 3])
        faces[name] = render_scene(entries, sensor(camera, world_from_camera), spp, 6 * seed + number, max_depth)
    fine = 8 * height, 16 * height
    directions = lat_long_directions(*fine)
    weight = lat_long_solid_angles(*fine)[:, None, None]
    weighted, total = (
        array.reshape(height, 8, 2 * height, 8, -1).sum(axis=(1, 3))
        for array in (cube_map_lookup(faces, directions) * weight, np.broadcast_to(weight, (*fine, 1)))
    )
    return weighted / total


def look_rotation(pitch_deg: float, yaw_deg: float) -> Float[np.ndarray, "3 3"]:
    """Return world_from_camera of a camera that looks along +z, rotated toward +x by yaw, then upward by pitch."""
    pitch, yaw = np.radians([pitch_deg, yaw_deg])
    forward = np.array([np.cos(pitch) * np.sin(yaw), np.sin(pitch), np.cos(pitch) * np.cos(yaw)])
    right = np.array([-np.cos(yaw), 0.0, np.sin(yaw)])
    return np.stack([right, np.cross(forward, right), forward], axis=-1)


def cube_map_lookup(faces: dict[str, np.ndarray], directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Look up each direction in the faces of a cube map, by the nearest pixel."""
    largest = np.abs(directions).argmax(axis=-1)
    values = np.zeros(directions.shape)
    for name, (pitch, yaw) in FACE_LOOKS.items():
        axis = "xyz".index(name[1])
        sign = 1 if name[0] == "+" else -1
        hit = (largest == axis) & (sign * directions[..., axis] > 0)
        x, y, z = np.moveaxis(directions[hit] @ look_rotation(pitch, yaw), -1, 0)
        size = len(faces[name])
        column, row = ((np.stack([x, y]) / z + 1) / 2 * size).astype(int).clip(0, size - 1)
        values[hit] = faces[name][row, column]
    return values


def denoise_picture(
    picture: Float[np.ndarray, "h w 4"], guides: Float[np.ndarray, "h w 10"]
) -> Float[np.ndarray, "h w 4"]:
    """Denoise linear radiance times coverage; coverage is left unchanged.

    Args:
        picture: radiance and coverage
        guides: result of `render_guides`
    """
    os.environ["OIDN_DEFAULT_DEVICE"] = "cpu"  # the same bytes with and without a GPU
    mitsuba()  # the denoiser uses its thread pool
    import mitsuba_oidn

    coverage = picture[..., 3:]
    if not (coverage.any() and guides[..., 3].any()):
        return picture
    radiance, _ = np.split(_foreground(picture), [3], axis=-1)
    _, albedo, normal = np.split(_foreground(guides), [4, 7], axis=-1)
    aids = map(np.ascontiguousarray, (radiance, albedo.clip(0, 1), normal))
    clean = mitsuba_oidn.denoise(*aids, hdr=True, clean_aux=True).clip(0)
    clean *= picture[..., :3].any(axis=(0, 1))  # a channel without light stays dark
    return np.concatenate([clean * coverage, coverage], axis=-1)


def _foreground(picture: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    """Divide by the coverage, channel 3; pixels without coverage get the values of the nearest covered one."""
    coverage = picture[..., 3:4]
    row, column = distance_transform_edt(coverage[..., 0] <= 0, return_distances=False, return_indices=True)
    return (picture / np.where(coverage > 0, coverage, 1))[row, column].astype(np.float32)


NARROWEST = 0.5  # least variance, in h², of a lobe at the nodes: a narrower one would fall between them


def sharpen_lobes(lobes: Lobes, spacing: float) -> Lobes:
    """Return narrower lobes that linear interpolation between nodes widens back to `lobes`; energy is kept.

    `spacing` is the distance of the nodes in radians.
    """
    # variance 1/λ − h²/6, at the same energy
    variance = np.maximum(1 / lobes.sharpness - spacing**2 / 6, NARROWEST * spacing**2)
    factor = np.asarray(lobe_energy(lobes.sharpness) / lobe_energy(1 / variance))
    return Lobes(lobes.axis, 1 / variance, lobes.weight * factor[:, None])


def mitsuba_map(lobes: Lobes, height: int, width: int) -> Float[np.ndarray, "h w 3"]:
    """Evaluate a light at the nodes of Mitsuba's `envmap`.

    Args:
        lobes: the light, in its own frame
        height: rows of the map
        width: columns of the map

    Returns:
        Radiance at the nodes, in the lobes' frame turned y-up.
    """
    narrowed = sharpen_lobes(lobes, np.pi / (height - 1))
    theta = np.arange(height)[:, None] / (height - 1) * np.pi
    phi = (np.arange(width)[:, None] + 0.5) / width * 2 * np.pi
    return lattice_of_lobes(narrowed, height, width, lambda _: (theta, phi, np.ones(1)))
