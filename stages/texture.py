"""Albedo textures: the paint of each material on each mesh, from all photos, in the lights that `solve` estimated.

Every pixel observes the factor of its surface point on the diffuse reflectance, once light and specular part are known
(`factorlib.inference.surface.texture`).  A texture is kept if it predicts photos that it was not estimated from.

Writes texture.json, and if a texture is kept, factors.parquet and photos/<photo>.exr: the factors at every pixel.
"""

from collections.abc import Callable, Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from factorlib.dataset.schema import LightSlice, ObjectsSlice, solved_photos
from factorlib.images.exr import read_exr, write_exr
from factorlib.images.tone import invert_tone
from factorlib.inference.surface.aligned_photo import AlignedPhoto, pixel_on_mesh, read_aligned_photos, visible_meshes
from factorlib.inference.surface.surface_turns import Surfaces
from factorlib.inference.surface.texture import STIFFNESSES, TextureSamples, observe_texture, select_texture
from factorlib.jsonfile import write_json
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.read_mesh import CREASE_DEG, MeshCache
from factorlib.meshes.subdivision import SubdividedMesh, subdivided_mesh
from factorlib.render.resynthesis import read_shading
from factorlib.results.materials import MaterialTable, read_materials
from factorlib.results.surface_table import DetailEvidence, read_surface
from factorlib.results.texture_table import FACTORS, FILE, TextureEvidence, TextureTable, write_factors
from factorlib.stage import Inputs, Progress
from factorlib.urm.extract import Channels, observed_pixels, read_geometry

FINEST, COARSEST = 0.004, 0.04  # range of the longest edge, in units of the mesh's extent
EDGE_PIXELS = 2.0  # longest edge, in pixels of a typical photo
CLUSTER_PIXELS = 16  # side of the blocks of pixels whose residuals are correlated
DETAIL = ("detail.R", "detail.G", "detail.B")
# Edge of the trial's meshes, in units of their extent, and its step between rows and columns of pixels.
TRIAL_EDGE, TRIAL_STEP = 0.02, 2
TRIAL_GAIN = 0.03  # share of the loss by which a trial has to be better than a flat colour
Key = tuple[str, str]  # names of a mesh and of a material
Factors = dict[Key, Float[np.ndarray, "v 3"]]


class Estimate(NamedTuple):
    """Texture of one material of one mesh, None if it is not kept, and the evidence."""

    factor: Float[np.ndarray, "v 3"] | None
    evidence: TextureEvidence

    @property
    def promising(self) -> bool:
        """True if photos are predicted better than by a flat colour, by TRIAL_GAIN of the loss."""
        with_texture, flat = self.evidence.by.held_out_loss_with, self.evidence.by.held_out_loss_without
        return with_texture is not None and flat is not None and with_texture < (1 - TRIAL_GAIN) * flat


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Choice of albedo textures, and their resolution."""

    albedo: Literal["auto", "off"] = "auto"
    """Albedo textures; auto: used if they predict photos that they were not estimated from."""
    edge: Annotated[float, msgspec.Meta(ge=0.5, le=100)] = EDGE_PIXELS
    """Longest edge of the textured mesh, in pixels of a typical photo."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress, before: TextureTable | None = None) -> None:
    """Estimate the texture of every material on every mesh, and write those that are kept.

    Args:
        params: Parameters of the stage.
        inputs: Inputs of the stage.
        out: Folder to write to.
        progress: Called with the completed work, its total and the current activity.
        before: Earlier result, whose kept textures alone are estimated again, no softer; None to choose.
    """
    names = inputs.facts["dataset.materials"]
    slices = msgspec.convert(inputs.facts["dataset.objects"], dict[str, ObjectsSlice])
    surface = read_surface(inputs.folders.get("surface"))
    read = MeshCache(inputs.mesh, names, CREASE_DEG, surface.displacements, surface.log_factors)
    meshes = visible_meshes(read, slices)
    if params.albedo == "off" or not meshes:
        write_json(out / FILE, TextureTable())
        return
    photos = read_aligned_photos(inputs, slices)
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    total = 2 * len(solved_photos(lights)) + 2 * len(meshes) + len(photos)
    steps = count()

    def report(activity: str) -> None:
        """Report that a piece of work begins or ends."""
        progress(next(steps), total, activity)

    solved = SolvedPhotos(inputs, photos, lights, read_materials(inputs["solve"] / "materials.json"), report)
    # a coarse trial, then the promising ones at the photos' resolution
    estimates: dict[Key, Estimate] = {}
    rejected = [each for each in before.textures if not each.kept] if before else []
    decided = {(each.mesh, each.material): each.by.stiffness for each in before.textures if each.kept} if before else {}
    promising = set(decided)
    if before is None:
        coarse = {name: subdivided_mesh(mesh, TRIAL_EDGE) for name, mesh in meshes.items()}
        estimates = solved.estimate(coarse, None, TRIAL_STEP)
        promising = {key for key, trial in estimates.items() if trial.promising}
    visible = [name for name in meshes if any(mesh == name for mesh, _ in promising)]
    longest = {name: longest_edge(name, meshes[name], photos, params.edge) for name in visible}
    fine = {name: subdivided_mesh(meshes[name], edge) for name, edge in longest.items()}
    if promising:
        estimates |= solved.estimate(fine, promising, 1, decided)
    kept = {key: estimates[key].factor for key in sorted(promising)}
    factors = {key: factor.astype(np.float32) for key, factor in kept.items() if factor is not None}
    longest = {name: longest[name] for name, _ in factors}
    evidence = [*rejected, *(estimate.evidence for estimate in estimates.values())]
    write_json(out / FILE, TextureTable(longest, sorted(evidence, key=lambda each: (each.mesh, each.material))))
    if factors:
        write_factors(out / FACTORS, factors)
        (out / "photos").mkdir()
        for name, photo in photos.items():
            report(f"{name}: texture")
            write_exr(
                out / "photos" / f"{name}.exr", detail_channels(photo, solved.geometry(name), fine, factors, names)
            )
    progress(total, total)


class SolvedPhotos(msgspec.Struct, frozen=True):
    """Photos with what `align` and `solve` estimated.

    Attributes:
        inputs: Inputs of the stage.
        photos: Photos as `align` left them.
        lights: Illumination of each photo.
        table: Solved materials.
        report: Called with the current activity.
    """

    inputs: Inputs
    photos: dict[str, AlignedPhoto]
    lights: dict[str, LightSlice]
    table: MaterialTable
    report: Callable[[str], None]

    def geometry(self, name: str) -> Channels:
        """Return the maps of a photo, with the normals and the detail of `surface`."""
        return read_geometry(self.inputs["align"], self.inputs.folders.get("surface"), name)

    def estimate(
        self,
        fine: dict[str, SubdividedMesh],
        keys: set[Key] | None,
        step: int,
        decided: Mapping[Key, float | None] = {},
    ) -> dict[Key, Estimate]:
        """Return the texture of each mesh and material, and the evidence.

        Args:
            fine: Subdivided meshes.
            keys: Meshes and materials; None for all.
            step: Step between the used rows and columns of the photos.
            decided: Least stiffness of each texture; 0 for others.
        """

        def observe(name: str) -> list[tuple[Key, TextureSamples]]:
            """Return what a photo observes."""
            samples = list(self.observe(name, fine, keys, step))
            self.report(f"{name}: observations of paint")
            return samples

        observed: dict[Key, list[TextureSamples]] = {}
        for samples_by_key in self.inputs.map(observe, sorted(solved_photos(self.lights))):
            for key, samples in samples_by_key:
                observed.setdefault(key, []).append(samples)
        estimates = {}
        for name, mesh in fine.items():
            self.report(f"texture of {name}")
            laplacian = mesh.laplacian()
            for key in sorted(key for key in observed if key[0] == name):
                # from stiff to soft, so that the same lights give the same texture as before
                candidates = [a for a in STIFFNESSES if a >= (decided.get(key) or 0)]
                factor, decision, stiffness = select_texture(observed[key], laplacian, candidates)
                by = DetailEvidence.from_decision(decision, stiffness)
                estimates[key] = Estimate(factor, TextureEvidence(*key, factor is not None, len(observed[key]), by))
        return estimates

    def observe(
        self, name: str, fine: dict[str, SubdividedMesh], keys: set[Key] | None, step: int
    ) -> Iterator[tuple[Key, TextureSamples]]:
        """Yield what the pixels of a photo observe of each mesh and material; arguments as in `estimate`."""
        names = self.inputs.facts["dataset.materials"]
        photo = read_exr(self.inputs["masks"] / f"{name}.exr")
        geometry = self.geometry(name)
        clipped = np.any([photo[f"clipped.{c}"] > 0.5 for c in "RGB"], axis=0)
        selected = observed_pixels(photo, geometry) & ~clipped & (np.indices(clipped.shape) % step == 0).all(0)
        if keys is not None:
            selected &= np.isin(np.rint(photo["label"]), [1 + names.index(material) for _, material in keys])
        y, x = np.nonzero(selected)
        radiance = np.stack([photo[c][y, x] for c in "RGB"], axis=-1).astype(float)
        if tone := self.table.model.tone.get(name):
            radiance = invert_tone(radiance, tone.exponent, tone.pivot)
        label = np.where(selected, np.rint(photo["label"]), 0).astype(int)
        parts = read_shading(self.inputs["shading"], name).astype(float)
        cosine = np.sum([geometry[f"normal.{a}"] * geometry[f"view.{a}"] for a in "xyz"], axis=0).clip(0, 1)[y, x]
        cluster = (y // CLUSTER_PIXELS) * label.shape[1] + x // CLUSTER_PIXELS
        for mesh, rows, operator in attach_to_meshes(self.photos[name], np.column_stack([x, y]), fine):
            of_rows = label[y[rows], x[rows]]
            for number in np.unique(of_rows).tolist():
                key = mesh, names[number - 1]
                if keys is None or key in keys:
                    places = np.flatnonzero(of_rows == number)
                    pixels = rows[places]
                    diffuse, specular = (part[y[pixels], x[pixels]] for part in parts)
                    observed = radiance[pixels], diffuse, specular, cosine[pixels]
                    yield key, observe_texture(*observed, (operator[places], cluster[pixels]))


def longest_edge(name: str, mesh: Mesh, photos: dict[str, AlignedPhoto], pixels: float) -> float:
    """Return the longest edge of a textured mesh, in units of its extent, from the size of the photos' pixels on it."""
    pixel = pixel_on_mesh(name, mesh, photos)
    return COARSEST if pixel is None else float(np.clip(pixels * pixel, FINEST, COARSEST))


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
    geometry: Channels,
    fine: dict[str, SubdividedMesh],
    factors: Factors,
    names: list[str],
) -> Channels:
    """Return detail.R, .G, .B of a photo: the texture, elsewhere the detail of `surface`; 0 without a mesh."""
    shape = geometry["object"].shape
    y, x = np.nonzero(geometry["object"] > 0.5)
    label = np.rint(geometry["label"][y, x]).astype(int)
    values = np.stack([geometry.get(channel, np.ones(shape))[y, x] for channel in DETAIL], 1)
    for mesh, rows, operator in attach_to_meshes(photo, np.column_stack([x, y]), fine):
        for material in np.unique(label[rows]).tolist():
            if (mesh, names[material - 1]) in factors:
                one = np.flatnonzero(label[rows] == material)
                values[rows[one]] = operator[one] @ factors[mesh, names[material - 1]]
    picture = np.zeros((*shape, 3), np.float32)
    picture[y, x] = values
    return dict(zip(DETAIL, np.moveaxis(picture, -1, 0)))
