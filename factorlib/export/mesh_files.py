"""Mesh files that scenes refer to: a PLY for each part of one material, and an image of a painted mesh."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from factorlib.dataset.schema import MeshEntry, MeshInstance, ObjectsSlice
from factorlib.export.exported_scene import ExportedShape
from factorlib.export.mitsuba import paint_range
from factorlib.export.texture_atlas import UNKNOWN_PIXEL, Atlas, make_atlas
from factorlib.images.picture import write_png
from factorlib.inference.surface.aligned_photo import AlignedPhoto, pixel_on_mesh
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply_stl_off import submesh, write_ply
from factorlib.meshes.read_mesh import MeshCache
from factorlib.results.materials import PaintRange, Reflectance
from factorlib.results.poses import ObjectPose
from factorlib.results.surface_table import read_surface
from factorlib.results.texture_table import read_textures
from factorlib.stage import Inputs
from factorlib.tracing.scene import paint, rigid


class MeshFiles:
    """Writer of the meshes of a set, with their refined surfaces, as a file per material.

    A mesh is read once, and written once for each choice of its materials.

    Attributes:
        inputs: the data set's meshes, and the folders of the stages `surface` and `texture`
        scenes: the folder of the scenes, which file names are relative to
        materials: names by label, from 1
        crease_deg: crease angle for vertex normals, degrees
        solved: reflectances, which colour meshes with detail
        images: materials of the painted parts of each mesh, by its image's file, relative to `scenes`
    """

    def __init__(
        self,
        inputs: Inputs,
        scenes: Path,
        materials: list[str],
        crease_deg: float,
        solved: Mapping[str, Reflectance] = {},
    ):
        self.scenes = scenes
        self.materials = materials
        self.solved = solved
        surface = read_surface(inputs.folders.get("surface"))
        refined = (inputs.mesh, materials, crease_deg, surface.displacements, surface.log_factors)
        self.read = MeshCache(*refined, read_textures(inputs.folders.get("texture")))
        self.images: dict[str, list[str]] = {}
        self._undivided = MeshCache(*refined)
        self._atlases: dict[str, Atlas | None] = {}
        self._stems: dict[tuple, str] = {}  # file names up to the material, relative to the scenes

    def atlas(
        self, name: str, slices: Mapping[str, ObjectsSlice], photos: Mapping[str, AlignedPhoto] = {}
    ) -> Atlas | None:
        """Return the atlas of a mesh for all choices of its materials; None if it is not painted.

        Args:
            name: the mesh
            slices: objects of each photo
            photos: photos as `align` left them, by whose pixels the texels are sized
        """
        if name not in self._atlases:
            entry = next(each.meshes[name] for each in slices.values() if name in each.meshes)
            overrides = [{}, *(o.materials for each in slices.values() for o in each.objects if o.mesh == name)]
            choices = [self._undivided.mesh(name, entry, each) for each in overrides]
            painted = self.read.mesh(name, entry)
            pixel = pixel_on_mesh(name, painted, photos) or UNKNOWN_PIXEL
            pixel *= float(np.ptp(painted.vertices[np.unique(painted.faces)], axis=0).max())
            plain = all(self.read.mesh(name, entry, each).detail is None for each in overrides)
            self._atlases[name] = None if plain else make_atlas(choices, painted, pixel)
        return self._atlases[name]

    def paint_ranges(
        self, slices: Mapping[str, ObjectsSlice], table: Mapping[str, Reflectance]
    ) -> dict[str, PaintRange]:
        """Return the brightest paint of each material on the meshes of all photos."""
        parts: dict[str, list[Mesh]] = {name: [] for name in table}
        looks = {(o.mesh, *sorted(o.materials.items())): (o, each) for each in slices.values() for o in each.objects}
        for obj, each in looks.values():
            mesh = self.read.mesh(obj.mesh, each.meshes[obj.mesh], obj.materials)
            for label in mesh.labels:
                parts.setdefault(self.materials[label - 1], []).append(submesh(mesh, label))
        return {name: paint_range(material, parts[name]) for name, material in table.items()}

    def shapes(
        self, obj: MeshInstance, meshes: Mapping[str, MeshEntry], poses: Mapping[str, ObjectPose]
    ) -> list[ExportedShape]:
        """Return one shape per material of the object, and write its files if they are new.

        Files of a mesh's second choice of materials are called <mesh>.2.  `atlas` must have been called for its mesh.

        Args:
            obj: the object
            meshes: entries of the meshes by name
            poses: poses of the objects by name
        """
        mesh = self.read.mesh(obj.mesh, meshes[obj.mesh], obj.materials)
        pose = poses[obj.name]
        cam_from_object = rigid(np.array(pose.rotation), pose.translation)
        key = (obj.mesh, *sorted(obj.materials.items()))
        if key not in self._stems:
            number = 1 + sum(other[0] == obj.mesh for other in self._stems)
            self._stems[key] = f"meshes/{obj.mesh}" + (f".{number}" if number > 1 else "")
            self._write(self._stems[key], mesh, self._atlases.get(obj.mesh))
        stem = self._stems[key]
        image = f"{stem}.png"
        return [
            ExportedShape(
                f"{obj.name}.{name}",
                f"{stem}.{name}.ply",
                name,
                cam_from_object,
                mesh.open,
                image if name in self.images.get(image, ()) else "",
            )
            for name in (self.materials[label - 1] for label in mesh.labels)
        ]

    def _write(self, stem: str, mesh: Mesh, atlas: Atlas | None) -> None:
        """Write the parts of a mesh, and the image and the coloured vertices of those that are painted."""
        exported = mesh if atlas is None else atlas.dress(mesh)
        for label in mesh.labels:
            file = self.scenes / f"{stem}.{self.materials[label - 1]}"
            part = submesh(exported, label)
            write_ply(f"{file}.ply", part)
            fine = submesh(mesh, label)
            if fine.detail is not None:
                shades = paint(self.solved[self.materials[label - 1]], fine.detail)
                write_ply(f"{file}.vertices.ply", fine, shades)
                self.images.setdefault(f"{stem}.png", []).append(self.materials[label - 1])
        if atlas is not None and f"{stem}.png" in self.images:
            colours = diffuse_by_label(self.materials, self.solved)
            write_png(self.scenes / f"{stem}.png", atlas.bake(mesh, colours))


def diffuse_by_label(names: Sequence[str], materials: Mapping[str, Reflectance]) -> np.ndarray:
    """Return k_d of each label, from 1; black for materials that were not solved."""
    return np.array([materials[name].diffuse if name in materials else (0.0,) * 3 for name in names])
