"""Photo with the results of the stages `masks` and `align`: channels, camera, and objects with their poses."""

from pathlib import Path

import msgspec

from factorlib.align.refine import FocalPrior
from factorlib.align.search import focal_prior
from factorlib.align.silhouette import Channels, Silhouette, silhouette_of_object
from factorlib.dataset.schema import ObjectsSlice
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster
from factorlib.images.exr import read_exr
from factorlib.meshes.mesh import Mesh, scaled
from factorlib.meshes.read import MeshesOnce
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import SEARCHED, ObjectEntry, PhotoPoses


class AlignedObject(msgspec.Struct, frozen=True):
    """Object of a photo: name of its mesh, mesh as in its file, mask, and entry of poses.json."""

    mesh_name: str
    mesh: Mesh
    silhouette: Silhouette
    entry: ObjectEntry

    def caster(self) -> Caster:
        """Return the ray caster of the mesh with the proportions of its pose."""
        return Caster(scaled(self.mesh, self.entry.scale))

    @property
    def moves(self) -> bool:
        """True if the pose was searched; a given pose may not move."""
        return self.entry.source in SEARCHED


class AlignedPhoto(msgspec.Struct, frozen=True):
    """Photo with its camera and objects.

    prior     prior of the focal length, before alignment
    objects   objects by name, in the order of dataset.yaml
    """

    channels: Channels
    camera: Camera
    prior: FocalPrior
    objects: dict[str, AlignedObject]


def aligned_photo(masks: Path, photo: str, slice_: ObjectsSlice, poses: PhotoPoses, meshes: MeshesOnce) -> AlignedPhoto:
    """Read a photo with its masks, camera and objects.

    Args:
        masks: Folder with the results of the stage `masks`.
        photo: Name of the photo.
        slice_: Entries of dataset.yaml that the photo needs.
        poses: The photo's entry of poses.json.
        meshes: Reader of meshes.

    Returns:
        The photo.
    """
    channels = read_exr(masks / f"{photo}.exr")
    facts = read_photo_facts(masks / f"{photo}.json")
    height, width = channels["label"].shape
    camera = poses.camera.camera(width, height)
    objects = {}
    source = poses.camera.focal_source
    before = {"exif": facts.focal_px, "estimated": None}.get(source, camera.focal)
    prior = focal_prior(before, source, width, height)
    for number, own in enumerate(slice_.objects, start=1):
        mesh = meshes.mesh(own.mesh, slice_.meshes[own.mesh], own.materials)
        silhouette = silhouette_of_object(channels, number, mesh.labels, own.mask is not None)
        objects[own.name] = AlignedObject(own.mesh, mesh, silhouette, poses.objects[own.name])
    return AlignedPhoto(channels, camera, prior, objects)
