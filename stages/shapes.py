"""Shape estimation: cameras by structure from motion, and meshes from masks.

Meshes are visual hulls, bodies of revolution or primitives.  The stage runs only if dataset.yaml asks for such cameras
or meshes.  Writes shapes.json, and meshes/<mesh>.obj, which later stages read as they read mesh files.
"""

import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.align.input_checks import camera_of_photo
from factorlib.align.silhouette import EXIF_SIGMA, UNKNOWN, silhouette_of_object, with_prior_focal
from factorlib.dataset.check import ALL_OF_IT
from factorlib.dataset.schema import ExternalCamera, MeshEntry, MeshInstance, ObjectsSlice, RigidTransform, ShapesSlice
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.images.exr import read_exr
from factorlib.images.tone import srgb_encode
from factorlib.jsonfile import write_json
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import pose_fields
from factorlib.results.shape_table import FILE, ShapeEntry, ShapesTable
from factorlib.shapes.gaps import mend_gaps
from factorlib.shapes.hull import visual_hull
from factorlib.shapes.lathe import body_of_revolution
from factorlib.shapes.motion import PhotoForMotion, RegisteredCamera, cameras_by_motion
from factorlib.shapes.outline import Outline, Triangles, write_triangles
from factorlib.shapes.primitive import primitive
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.shapes")
GOOD = 0.9  # IoU of a shape and its outlines below which a warning is given
FEW = 6  # number of a hull's outlines below which a warning is given: hulls keep what no outline excludes


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the stage: the resolution of hulls."""

    cells: Annotated[int, msgspec.Meta(ge=16, le=400)] = 80
    """Number of grid cells along a hull's longest side."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Estimate cameras, then shapes, and write both."""
    slice_ = msgspec.convert(inputs.facts["dataset.shapes"], ShapesSlice)
    photos = {name: MaskedPhoto(inputs, name, entry) for name, entry in sorted(slice_.photos.items())}
    cameras: dict[str, ExternalCamera] = {}
    if slice_.sfm:
        cameras = estimate_cameras(photos, slice_.meshes, lambda share, step: progress(0.5 * share, 1, step))
    first_share = 0.5 if slice_.sfm else 0.0
    part = (1 - first_share) / max(len(slice_.meshes), 1)
    shapes = {}
    factors = {name: photo.facts.factor for name, photo in photos.items()}
    (out / "meshes").mkdir()
    for index, (name, entry) in enumerate(sorted(slice_.meshes.items())):
        outlines = [each for photo in photos.values() for each in photo.outlines(name, entry, cameras.get(photo.name))]
        outlines = [outline for outline in outlines if outline.is_visible]
        begin = first_share + part * index
        try:
            report = partial(lambda begin, name, share: progress(begin + part * share, 1, name), begin, name)
            shape = estimate_shape(entry, outlines, params, report, factors)
        except InputError as error:
            raise InputError(error.fault, file="dataset.yaml", key=f"meshes.{name}", cure=error.cure) from error
        write_triangles(out / "meshes" / f"{name}.obj", shape, shape_parts(entry))
        extent = tuple(np.ptp(shape.vertices, axis=0).tolist())
        used = sorted({outline.photo for outline in outlines})
        shapes[name] = ShapeEntry(shape_kind(entry), extent, len(shape.faces), used, shape.overlap)
        if shape.overlap < GOOD:
            log.warning(
                "mesh '%s': the %s covers its outlines by %.0f %% only (IoU): check that the object is of that kind "
                "and that its masks are whole",
                name,
                shape_kind(entry),
                100 * shape.overlap,
            )
    write_json(out / FILE, ShapesTable(cameras, shapes))
    progress(1, 1)


def estimate_cameras(
    photos: Mapping[str, "MaskedPhoto"], meshes: dict[str, MeshEntry], report: Callable[[float, str], None]
) -> dict[str, ExternalCamera]:
    """Return the cameras of structure from motion by photo; warn of lenses that bend straight lines."""
    registered = cameras_by_motion({name: photo.for_motion() for name, photo in photos.items()}, report)
    for name, camera in registered.items():
        if camera.distortion:
            focal, k = camera.distortion
            log.warning(
                "%s: its lens bends straight lines; give the photo "
                "`camera: {focal_px: %.0f, distortion: [%.4f, 0]}` and the picture is straightened",
                name,
                focal * photos[name].facts.factor,
                k,
            )
    return {name: photos[name].external(camera, meshes) for name, camera in registered.items()}


def shape_kind(entry: MeshEntry) -> str:
    """Return the kind of a shape: hull, lathe, ball, box or cylinder."""
    return entry.primitive or ("hull" if entry.hull else "lathe")


def shape_parts(entry: MeshEntry) -> list[str]:
    """Return the names of the shape's parts."""
    return list(entry.parts or [ALL_OF_IT])


def estimate_shape(
    entry: MeshEntry,
    outlines: list[Outline],
    params: Params,
    report: Callable[[float], None],
    factors: Mapping[str, int] = {},
) -> Triangles:
    """Return the shape of a mesh, estimated from its outlines.

    Args:
        entry: Mesh in dataset.yaml.
        outlines: Outlines of its objects in all photos.
        params: Parameters of the stage.
        report: Called with the completed share, from 0 to 1.
        factors: Factor by which each photo was averaged down, for places in messages.

    Raises:
        InputError: If no photo shows the mesh.
    """
    if not outlines:
        raise InputError("no photo's mask shows it", cure="give its material a label in the masks, or remove the mesh")
    if entry.hull:
        posed = [outline for outline in outlines if outline.pose is not None]
        if any(outline.focal_sigma > EXIF_SIGMA for outline in posed):
            cure = "write `camera: {focal_px: …}` of each photo, or give photos with their EXIF"
            raise InputError("a hull needs the focal lengths of its photos, and one is unknown", cure=cure)
        if 2 <= len(posed) < FEW:
            log.warning(
                "a hull of %d outlines is larger than the body where no outline limits it: add photos from more sides",
                len(posed),
            )
        whole, gaps = mend_gaps(posed, lambda share: report(share / 2))
        for gap in gaps:
            log.warning("%s", gap.scaled(factors.get(gap.photo, 1)))
        return visual_hull(whole, params.cells, len(shape_parts(entry)), lambda share: report((1 + share) / 2))
    if entry.lathe:
        shape = body_of_revolution(outlines, report)
        is_posed = any(outline.pose is not None for outline in outlines)
        return shape if is_posed else msgspec.structs.replace(shape, vertices=shape.vertices * entry.size)
    assert entry.primitive is not None  # the reader accepts no other mesh without a file
    return primitive(entry.primitive, outlines, report).with_size(entry.size)


class MaskedPhoto:
    """Photo as written by `masks`, with its objects."""

    def __init__(self, inputs: Inputs, name: str, entries: ObjectsSlice):
        self.name = name
        self.entries = entries
        self.materials = inputs.facts["dataset.materials"]
        self.path = inputs["masks"] / f"{name}.exr"
        self.facts = read_photo_facts(inputs["masks"] / f"{name}.json")

    def for_motion(self) -> PhotoForMotion:
        """Return the input of structure from motion: sRGB grey values, mask of objects, left-out pixels, camera."""
        channels = read_exr(self.path)
        # grey values, with the 99th percentile of radiance as white
        radiance = np.stack([channels[c] for c in "RGB"], axis=-1).mean(axis=-1)
        white = max(float(np.quantile(radiance[np.isfinite(radiance)], 0.99)), 1e-12)
        grey = srgb_encode(np.clip(np.nan_to_num(radiance) / white, 0, 1))
        pixels = np.round(grey * 255).astype(np.uint8)
        objects = channels["label"] > 0.5
        return PhotoForMotion(pixels, objects, channels["left_out"] > 0.5, *self.camera(None))

    def camera(self, external: ExternalCamera | None) -> tuple[Camera, float]:
        """Return the camera at the most probable focal length, and the standard deviation of its logarithm."""
        entries = msgspec.structs.replace(self.entries, external=external)
        camera, known = camera_of_photo(entries, self.facts, self.name)
        return with_prior_focal(camera, known.focal, known.source)

    def external(self, registered: RegisteredCamera, meshes: dict[str, MeshEntry]) -> ExternalCamera:
        """Return the camera in pixels of the photo's file, with the poses of hulls.

        Hulls are made in the world frame, so cam_from_world is their pose.
        """
        pose = RigidTransform(**pose_fields(registered.pose))
        poses = {obj.name: pose for obj in self.entries.objects if obj.mesh in meshes and meshes[obj.mesh].hull}
        return ExternalCamera("sfm", registered.focal * self.facts.factor, None, None, poses)

    def outlines(self, mesh: str, entry: MeshEntry, by_motion: ExternalCamera | None) -> list[Outline]:
        """Return the outline of each of the photo's objects with that mesh.

        Args:
            mesh: Name of the mesh.
            entry: Mesh in dataset.yaml.
            by_motion: Camera from structure from motion, or None.
        """
        outlines = []
        channels = None
        for number, obj in enumerate(self.entries.objects, start=1):
            if obj.mesh == mesh:
                channels = channels or read_exr(self.path)
                labels = self._labels(obj, entry)
                external = by_motion or self.entries.external
                label = silhouette_of_object(channels, number, sorted(set(labels)), obj.mask is not None).label
                # number, from 1, of the shape's part at each pixel; the first, where parts share a label
                part = np.where(label == UNKNOWN, UNKNOWN, 0)
                for k, part_label in reversed(list(enumerate(labels, start=1))):
                    part[label == part_label] = k
                part[(label > 0) & (part == 0)] = UNKNOWN
                pose = obj.pose or (external.poses.get(obj.name) if external else None)
                arrays = Pose(np.array(pose.rotation), np.array(pose.translation)) if pose else None
                outlines.append(Outline(self.name, part, *self.camera(external), arrays))
        return outlines

    def _labels(self, obj: MeshInstance, entry: MeshEntry) -> list[int]:
        """Return the label of each part of the shape in this photo."""
        part_materials: Mapping[str, str | None] = entry.parts or {ALL_OF_IT: entry.material}
        return [self.materials.index({**part_materials, **obj.materials}[part]) + 1 for part in shape_parts(entry)]
