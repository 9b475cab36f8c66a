"""Albedo textures: the paint of each material on each mesh, from all photos, in the lights that `solve` estimated.

Every pixel observes the factor of its surface point on the diffuse reflectance, once light and specular part are known
(`factorlib.inference.texture`).  A texture is kept if it predicts photos that it was not estimated from.

Writes texture.json, and if a texture is kept, factors.parquet and photos/<photo>.exr: the factors at every pixel.
"""

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from factorlib.dataset.schema import LightSlice, ObjectsSlice, solved_photos
from factorlib.images.exr import read_exr, write_exr
from factorlib.images.tone import invert_tone
from factorlib.inference.aligned_photo import AlignedPhoto, read_aligned_photos, visible_meshes
from factorlib.inference.surface_turns import Surfaces
from factorlib.inference.texture import TextureSamples, observe_texture, select_texture
from factorlib.jsonfile import write_json
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.read_mesh import CREASE_DEG, MeshCache
from factorlib.meshes.subdivision import SubdividedMesh, subdivided_mesh
from factorlib.reflection import reflection_operator
from factorlib.render.resynthesis import Reflector, read_surroundings, resynthesise_parts
from factorlib.results.lobe_table import read_photo_light
from factorlib.results.materials import MaterialTable, read_materials, select_materials
from factorlib.results.surface_table import DetailEvidence, read_surface
from factorlib.results.texture_table import FACTORS, FILE, TextureEvidence, TextureTable, write_factors
from factorlib.stage import Inputs, Progress
from factorlib.urm.extract import observed_pixels, read_geometry

FINEST, COARSEST = 0.004, 0.04  # range of the longest edge, in units of the mesh's extent
EDGE_PIXELS = 2.0  # longest edge, in pixels of a typical photo
CLUSTER_PIXELS = 16  # side of the blocks of pixels whose residuals are correlated
DETAIL = ("detail.R", "detail.G", "detail.B")
Factors = dict[tuple[str, str], Float[np.ndarray, "v 3"]]


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Choice of albedo textures, and their resolution."""

    albedo: Literal["auto", "off"] = "auto"
    """Albedo textures; auto: used if they predict photos that they were not estimated from."""
    edge: Annotated[float, msgspec.Meta(ge=0.5, le=100)] = EDGE_PIXELS
    """Longest edge of the textured mesh, in pixels of a typical photo."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Estimate the texture of every material on every mesh, and write those that are kept."""
    names = inputs.facts["dataset.materials"]
    slices = msgspec.convert(inputs.facts["dataset.objects"], dict[str, ObjectsSlice])
    table = read_materials(inputs["solve"] / "materials.json")
    surface = read_surface(inputs.folders.get("surface"))
    read = MeshCache(inputs.mesh, names, CREASE_DEG, surface.displacements, surface.log_factors)
    meshes = visible_meshes(read, slices)
    if params.albedo == "off" or not meshes:
        write_json(out / FILE, TextureTable())
        return
    photos = read_aligned_photos(inputs, slices)
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    fine = {name: subdivided_mesh(mesh, longest_edge(name, mesh, photos, params.edge)) for name, mesh in meshes.items()}
    steps = count()
    fitted = sorted(solved_photos(lights))
    total = len(fitted) + len(meshes) + len(photos)
    observed: dict[tuple[str, str], list[TextureSamples]] = {}

    def observe(name: str) -> list[tuple[tuple[str, str], TextureSamples]]:
        """Return what a photo observes."""
        samples = list(observe_photo(inputs, name, lights[name], (photos[name], fine), table))
        progress(next(steps), total, f"{name}: light and highlights")
        return samples

    for pixels in inputs.map(observe, fitted):
        for key, samples in pixels:
            observed.setdefault(key, []).append(samples)
    factors: Factors = {}
    evidence = []
    for name, mesh in fine.items():
        progress(next(steps), total, f"texture of {name}")
        for key in sorted(key for key in observed if key[0] == name):
            values, decision, stiffness = select_texture(observed[key], mesh.laplacian())
            by = DetailEvidence.from_decision(decision, stiffness)
            evidence.append(TextureEvidence(*key, values is not None, len(observed[key]), by))
            if values is not None:
                factors[key] = values.astype(np.float32)
    longest = {name: longest_edge(name, meshes[name], photos, params.edge) for name, _ in factors}
    write_json(out / FILE, TextureTable(longest, evidence))
    if factors:
        write_factors(out / FACTORS, factors)
        (out / "photos").mkdir()
        for name, photo in photos.items():
            progress(next(steps), total, f"{name}: texture")
            geometry = read_geometry(inputs["align"], inputs.folders.get("surface"), name)
            write_exr(out / "photos" / f"{name}.exr", detail_channels(photo, geometry, fine, factors, names))
    progress(total, total)


def longest_edge(name: str, mesh: Mesh, photos: dict[str, AlignedPhoto], pixels: float) -> float:
    """Return the longest edge of a textured mesh, in units of its extent, from the size of the photos' pixels on it."""
    extent = float(np.ptp(mesh.vertices[np.unique(mesh.faces)], axis=0).max())
    sizes = []
    for photo in photos.values():
        for number, entry in enumerate(photo.objects.objects, start=1):
            depth = photo.geometry["depth"][np.rint(photo.geometry["object"]) == number]
            if entry.mesh == name and len(depth):
                scale = float(np.mean(photo.poses.objects[entry.name].scale))
                sizes.append(float(np.median(depth)) / photo.poses.camera.focal_px / (scale * extent))
    return float(np.clip(pixels * np.median(sizes), FINEST, COARSEST)) if sizes else COARSEST


def observe_photo(
    inputs: Inputs,
    name: str,
    light: LightSlice,
    surface: tuple[AlignedPhoto, dict[str, SubdividedMesh]],
    table: MaterialTable,
) -> Iterator[tuple[tuple[str, str], TextureSamples]]:
    """Yield what the pixels of a photo observe of each mesh and material."""
    names = inputs.facts["dataset.materials"]
    aligned, fine = surface
    photo = read_exr(inputs["masks"] / f"{name}.exr")
    geometry = read_geometry(inputs["align"], inputs.folders.get("surface"), name)
    y, x = np.nonzero(observed_pixels(photo, geometry) & ~np.any([photo[f"clipped.{c}"] > 0.5 for c in "RGB"], axis=0))
    radiance = np.stack([photo[c][y, x] for c in "RGB"], axis=-1).astype(float)
    if tone := table.model.tone.get(name):
        radiance = invert_tone(radiance, tone.exponent, tone.pivot)
    materials = select_materials(table, names, inputs["solve"] / "materials.json")
    reflector = Reflector(
        reflection_operator("network", weights=inputs["train"]),
        read_photo_light(inputs["solve"], name, light),
        table.model.curvature(light.illumination),
    )
    around = read_surroundings(inputs.folders, name, table.model)
    bare = {channel: values for channel, values in geometry.items() if channel not in DETAIL}
    diffuse, specular = (
        part[y, x] for part in resynthesise_parts(reflector, materials, photo, bare, surroundings=around)
    )
    cosine = sum(geometry[f"normal.{a}"][y, x] * geometry[f"view.{a}"][y, x] for a in "xyz").clip(0, 1)
    label = np.rint(photo["label"][y, x]).astype(int)
    cluster = (y // CLUSTER_PIXELS) * geometry["depth"].shape[1] + x // CLUSTER_PIXELS
    for mesh, rows, operator in attach_to_meshes(aligned, np.column_stack([x, y]), fine):
        for material in np.unique(label[rows]).tolist():
            one = np.flatnonzero(label[rows] == material)
            pixels = rows[one]
            observed = radiance[pixels], diffuse[pixels], specular[pixels], cosine[pixels]
            yield (mesh, names[material - 1]), observe_texture(*observed, (operator[one], cluster[pixels]))


def attach_to_meshes(
    photo: AlignedPhoto, pixels: Int[np.ndarray, "n 2"], fine: dict[str, SubdividedMesh]
) -> Iterator[tuple[str, Int[np.ndarray, " r"], csr_array]]:
    """Yield each mesh that pixels (x, y) show, the rows of these pixels, and their barycentric coordinates [r, v]."""
    surfaces = Surfaces(fine)
    positions = photo.attach(pixels, surfaces)
    visible = positions.share.any(1)
    for mesh, first in surfaces.first_nodes.items():
        nodes = fine[mesh].nodes
        rows = np.flatnonzero(visible & (positions.node[:, 0] >= first) & (positions.node[:, 0] < first + nodes))
        if len(rows):
            numbers = np.repeat(np.arange(len(rows)), 3), (positions.node[rows] - first).reshape(-1)
            yield mesh, rows, csr_array((positions.share[rows].reshape(-1), numbers), (len(rows), nodes))


def detail_channels(
    photo: AlignedPhoto,
    geometry: dict[str, Float[np.ndarray, "h w"]],
    fine: dict[str, SubdividedMesh],
    factors: Factors,
    names: list[str],
) -> dict[str, Float[np.ndarray, "h w"]]:
    """Return detail.R, .G, .B of a photo: the texture, elsewhere the detail of `surface`; 0 without a mesh."""
    y, x = np.nonzero(photo.geometry["object"] > 0.5)
    label = np.rint(photo.geometry["label"][y, x]).astype(int)
    values = np.stack([geometry.get(channel, np.ones(photo.geometry["object"].shape))[y, x] for channel in DETAIL], 1)
    for mesh, rows, operator in attach_to_meshes(photo, np.column_stack([x, y]), fine):
        for material in np.unique(label[rows]).tolist():
            if (mesh, names[material - 1]) in factors:
                one = np.flatnonzero(label[rows] == material)
                values[rows[one]] = operator[one] @ factors[mesh, names[material - 1]]
    picture = np.zeros((*photo.geometry["object"].shape, 3), np.float32)
    picture[y, x] = values
    return dict(zip(DETAIL, np.moveaxis(picture, -1, 0)))
