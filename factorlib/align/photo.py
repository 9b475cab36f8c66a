"""A photo as the stages `masks` and `align` left it: its channels, its camera, and its objects where they were found."""

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
    """An object of a photo: the name of its mesh, the mesh as its file has it, its mask, and its entry of poses.json."""

    mesh_name: str
    mesh: Mesh
    silhouette: Silhouette
    entry: ObjectEntry

    def caster(self) -> Caster:
        """The mesh with the proportions that its pose was found with."""
        return Caster(scaled(self.mesh, self.entry.scale))

    @property
    def moves(self) -> bool:
        """Whether its pose was searched; one that was given may not move."""
        return self.entry.source in SEARCHED


class AlignedPhoto(msgspec.Struct, frozen=True):
    """prior: what was known of the focal length before it was found;  objects: by name, in the order of dataset.yaml."""

    channels: Channels
    camera: Camera
    prior: FocalPrior
    objects: dict[str, AlignedObject]


def aligned_photo(masks: Path, photo: str, slice_: ObjectsSlice, poses: PhotoPoses, meshes: MeshesOnce) -> AlignedPhoto:
    """The photo by the files of the stage `masks` in the folder `masks`, and its entry of poses.json."""
    channels, facts = read_exr(masks / f"{photo}.exr"), read_photo_facts(masks / f"{photo}.json")
    height, width = channels["label"].shape
    camera, objects = poses.camera.camera(width, height), {}
    source = poses.camera.focal_source
    before = {"exif": facts.focal_px, "estimated": None}.get(source, camera.focal)
    prior = focal_prior(before, source, width, height)
    for number, own in enumerate(slice_.objects, start=1):
        mesh = meshes.mesh(own.mesh, slice_.meshes[own.mesh], own.materials)
        silhouette = silhouette_of_object(channels, number, mesh.labels, own.mask is not None)
        objects[own.name] = AlignedObject(own.mesh, mesh, silhouette, poses.objects[own.name])
    return AlignedPhoto(channels, camera, prior, objects)
