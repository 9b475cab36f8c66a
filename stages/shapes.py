"""Shape estimation: cameras by structure from motion, and meshes from masks.

Meshes are visual hulls, bodies of revolution or primitives.  The stage runs only if dataset.yaml asks for such cameras
or meshes.  Writes shapes.json, and meshes/<mesh>.obj, which later stages read as they read mesh files.
"""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.align.given import camera_of
from factorlib.align.refine import FocalPrior
from factorlib.align.search import focal_prior
from factorlib.align.silhouette import UNKNOWN, silhouette_of_object
from factorlib.dataset.check import ALL_OF_IT
from factorlib.dataset.schema import ExternalCamera, MeshEntry, ObjectEntry, ObjectsSlice, Pose, ShapesSlice
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera
from factorlib.geometry.camera import Pose as PoseArrays
from factorlib.images.exr import read_exr
from factorlib.images.transfer import srgb_encode
from factorlib.jsonfile import write_json
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import entry_of
from factorlib.results.shape_table import FILE, ShapeEntry, ShapesTable
from factorlib.shapes.hull import visual_hull
from factorlib.shapes.lathe import body_of_revolution
from factorlib.shapes.motion import Registered, View, cameras_by_motion
from factorlib.shapes.outline import Outline, Triangles, write_obj
from factorlib.shapes.primitive import primitive
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.shapes")
GOOD = 0.9  # IoU of a shape and its outlines below which a warning is given
FEW = 6  # number of a hull's outlines below which a warning is given: hulls keep what no outline excludes


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Resolution of hulls."""

    cells: Annotated[int, msgspec.Meta(ge=16, le=400)] = 80
    """Number of grid cells along a hull's longest side."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Estimate cameras, then shapes, and write both."""
    slice_ = msgspec.convert(inputs.facts["dataset.shapes"], ShapesSlice)
    photos = {name: Photo(inputs, name, own) for name, own in sorted(slice_.photos.items())}
    cameras: dict[str, ExternalCamera] = {}
    if slice_.sfm:
        views = {name: photo.view() for name, photo in photos.items()}
        placed = cameras_by_motion(views, lambda share, what: progress(0.5 * share, 1, what))
        cameras = {name: photos[name].external(camera, slice_.meshes) for name, camera in placed.items()}
        for name, camera in placed.items():
            if camera.bent:
                focal = camera.bent[0] * photos[name].facts.factor
                k = camera.bent[1]
                log.warning(
                    "%s: its lens bends straight lines; give the photo "
                    "`camera: {focal_px: %.0f, distortion: [%.4f, 0]}` and the picture is straightened",
                    name,
                    focal,
                    k,
                )
    begun = 0.5 if slice_.sfm else 0.0
    found = {}
    (out / "meshes").mkdir()
    for done, (name, entry) in enumerate(sorted(slice_.meshes.items())):
        outlines = [one for photo in photos.values() for one in photo.outlines(name, entry, cameras.get(photo.name))]
        outlines = [one for one in outlines if one.is_seen]
        at = begun + (1 - begun) * done / len(slice_.meshes)
        part = (1 - begun) / len(slice_.meshes)
        try:
            shape = shape_of(entry, outlines, params, _share(at, part, name, progress))
        except InputError as error:
            raise InputError(error.found, file="dataset.yaml", key=f"meshes.{name}", cure=error.cure) from error
        write_obj(out / "meshes" / f"{name}.obj", shape, parts_of(entry))
        extent = tuple(np.ptp(shape.vertices, axis=0).tolist())
        used = sorted({one.photo for one in outlines})
        found[name] = ShapeEntry(kind_of(entry), extent, len(shape.faces), used, shape.overlap)
        if shape.overlap < GOOD:
            log.warning(
                "mesh '%s': the %s covers its outlines by %.0f %% only (IoU): is it of that kind, "
                "and are its masks whole?",
                name,
                kind_of(entry),
                100 * shape.overlap,
            )
    write_json(out / FILE, ShapesTable(cameras, found))
    progress(1, 1)


def _share(begin: float, part: float, name: str, progress: Progress) -> Callable[[float], None]:
    """Return the report of one mesh, whose share of the work begins at `begin` and is `part`."""
    return lambda share: progress(begin + part * share, 1, name)


def kind_of(entry: MeshEntry) -> str:
    """Return the kind of a shape: hull, lathe, ball, box or cylinder."""
    return entry.primitive or ("hull" if entry.hull else "lathe")


def parts_of(entry: MeshEntry) -> list[str]:
    """Return the names of the shape's parts."""
    return list(entry.parts or [ALL_OF_IT])


def shape_of(entry: MeshEntry, outlines: list[Outline], params: Params, report: Callable[[float], None]) -> Triangles:
    """Return the shape of a mesh, estimated from its outlines.

    Args:
        entry: Mesh in dataset.yaml.
        outlines: Outlines of its objects in all photos.
        params: Parameters of the stage.
        report: Receiver of the share that is done.

    Raises:
        InputError: If no photo shows the mesh.
    """
    if not outlines:
        cure = "is its material that of a label in the masks? Else take it out"
        raise InputError("no photo's mask shows it", cure=cure)
    if entry.hull:
        known = [one for one in outlines if one.pose is not None]
        if 2 <= len(known) < FEW:
            words = (
                "a hull of %d outlines is larger than the body wherever they do not show it: "
                "more photos, from more sides"
            )
            log.warning(words, len(known))
        return visual_hull(known, params.cells, len(parts_of(entry)), report)
    if entry.lathe:
        shape = body_of_revolution(outlines, report)
        given = any(one.pose is not None for one in outlines)
        return shape if given else msgspec.structs.replace(shape, vertices=shape.vertices * entry.size)
    assert entry.primitive is not None  # the reader accepts no other mesh without a file
    return primitive(entry.primitive, outlines, report).of_size(entry.size)


class Photo:
    """Photo as written by `masks`, with its objects."""

    def __init__(self, inputs: Inputs, name: str, own: ObjectsSlice):
        self.name = name
        self.own = own
        self.materials = inputs.facts["dataset.materials"]
        self.path = inputs["masks"] / f"{name}.exr"
        self.facts = read_photo_facts(inputs["masks"] / f"{name}.json")

    def view(self) -> View:
        """Return the input of structure from motion: sRGB grey values, mask of objects, left-out pixels, camera."""
        channels = read_exr(self.path)
        # grey values, with the 99th percentile of radiance as white
        radiance = np.stack([channels[c] for c in "RGB"], axis=-1).mean(axis=-1)
        white = max(float(np.quantile(radiance[np.isfinite(radiance)], 0.99)), 1e-12)
        grey = srgb_encode(np.clip(np.nan_to_num(radiance) / white, 0, 1))
        pixels = np.round(grey * 255).astype(np.uint8)
        objects = channels["label"] > 0.5
        return View(pixels, objects, channels["left_out"] > 0.5, *self.camera(None))

    def camera(self, external: ExternalCamera | None) -> tuple[Camera, FocalPrior]:
        """Return the camera at the most probable focal length, and the prior on that."""
        camera, known = camera_of(msgspec.structs.replace(self.own, external=external), self.facts, self.name)
        prior = focal_prior(known.focal, known.source, camera.width, camera.height)
        return msgspec.structs.replace(camera, focal=prior.focal), prior

    def external(self, placed: Registered, meshes: dict[str, MeshEntry]) -> ExternalCamera:
        """Return the camera in pixels of the photo's file, with the poses of hulls.

        Hulls are made in the world frame, so cam_from_world is their pose.
        """
        pose = Pose(**entry_of(placed.pose))
        poses = {obj.name: pose for obj in self.own.objects if obj.mesh in meshes and meshes[obj.mesh].hull}
        return ExternalCamera("sfm", placed.focal * self.facts.factor, None, None, poses)

    def outlines(self, mesh: str, entry: MeshEntry, by_motion: ExternalCamera | None) -> list[Outline]:
        """Return the outline of each of the photo's objects with that mesh.

        Args:
            mesh: Name of the mesh.
            entry: Mesh in dataset.yaml.
            by_motion: Camera from structure from motion, or None.
        """
        outlines = []
        channels = None
        for number, obj in enumerate(self.own.objects, start=1):
            if obj.mesh == mesh:
                channels = channels or read_exr(self.path)
                labels = self._labels(obj, entry)
                external = by_motion or self.own.external
                label = silhouette_of_object(channels, number, sorted(set(labels)), obj.mask is not None).label
                # number, from 1, of the shape's part at each pixel; the first, where parts share a label
                part = np.where(label == UNKNOWN, UNKNOWN, 0)
                for k, own in reversed(list(enumerate(labels, start=1))):
                    part[label == own] = k
                part[(label > 0) & (part == 0)] = UNKNOWN
                pose = obj.pose or (external.poses.get(obj.name) if external else None)
                arrays = PoseArrays(np.array(pose.rotation), np.array(pose.translation)) if pose else None
                outlines.append(Outline(self.name, part, *self.camera(external), arrays))
        return outlines

    def _labels(self, obj: ObjectEntry, entry: MeshEntry) -> list[int]:
        """Return the label of each part of the shape in this photo."""
        made_of: Mapping[str, str | None] = entry.parts or {ALL_OF_IT: entry.material}
        return [self.materials.index({**made_of, **obj.materials}[part]) + 1 for part in parts_of(entry)]
