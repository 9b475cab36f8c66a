"""Mesh files that scenes refer to: for each part of one material PLY, OpenUSD and, if it is painted, an image."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from factorlib.dataset.schema import MeshEntry, MeshInstance
from factorlib.export.exported_scene import ExportedShape
from factorlib.export.texture_atlas import bake, unwrap
from factorlib.export.usd import SUFFIX, write_usd_mesh
from factorlib.images.picture import write_png
from factorlib.meshes.ply_stl_off import submesh, write_ply
from factorlib.meshes.read_mesh import MeshCache
from factorlib.results.materials import Reflectance
from factorlib.results.poses import ObjectPose
from factorlib.results.surface_table import read_surface
from factorlib.results.texture_table import read_textures
from factorlib.stage import Inputs
from factorlib.tracing.scene import paint, rigid


class MeshFiles:
    """Writer of the meshes of a set, with their refined surfaces, as a file per material.

    A mesh is read once, and written once for each choice of its materials.

    Attributes:
        inputs: the data set's meshes, and the folder of the stage `surface`
        scenes: the folder of the scenes, which file names are relative to
        materials: names by label, from 1
        crease_deg: crease angle for vertex normals, degrees
        solved: reflectances, which colour meshes with detail
        images: material of each image that was written, by its file, relative to `scenes`
    """

    def __init__(
        self,
        inputs: Inputs,
        scenes: Path,
        materials: list[str],
        crease_deg: float,
        solved: Mapping[str, Reflectance],
    ):
        self.scenes = scenes
        self.materials = materials
        self.solved = solved
        surface = read_surface(inputs.folders.get("surface"))
        textures = read_textures(inputs.folders.get("texture"))
        self.read = MeshCache(inputs.mesh, materials, crease_deg, surface.displacements, surface.log_factors, textures)
        self.images: dict[str, str] = {}
        self._stems: dict[tuple, str] = {}  # file names up to the material, relative to the scenes

    def shapes(
        self, obj: MeshInstance, meshes: Mapping[str, MeshEntry], poses: Mapping[str, ObjectPose]
    ) -> list[ExportedShape]:
        """Return one shape per material of the object, and write its files if they are new.

        Files of a mesh's second choice of materials are called <mesh>.2.

        Args:
            obj: the object
            meshes: entries of the meshes by name
            poses: poses of the objects by name
        """
        mesh = self.read.mesh(obj.mesh, meshes[obj.mesh], obj.materials)
        pose = poses[obj.name]
        cam_from_object = rigid(np.array(pose.rotation) * pose.scale, pose.translation)
        names = {label: self.materials[label - 1] for label in mesh.labels}
        key = (obj.mesh, *sorted(obj.materials.items()))
        if key not in self._stems:
            number = 1 + sum(other[0] == obj.mesh for other in self._stems)
            self._stems[key] = f"meshes/{obj.mesh}" + (f".{number}" if number > 1 else "")
            for label, name in names.items():
                part = submesh(mesh, label)
                file = self.scenes / f"{self._stems[key]}.{name}"
                shades = None
                if part.detail is not None:
                    part = unwrap(part)
                    assert part.detail is not None
                    shades = paint(self.solved[name], part.detail)
                    write_png(f"{file}.png", bake(part, np.array(self.solved[name].diffuse)))
                    self.images[f"{self._stems[key]}.{name}.png"] = name
                write_ply(f"{file}.ply", part, shades)
                write_usd_mesh(f"{file}{SUFFIX}", part)
        stem = self._stems[key]
        return [
            ExportedShape(
                f"{obj.name}.{name}",
                f"{stem}.{name}.ply",
                name,
                cam_from_object,
                mesh.open,
                painted=f"{stem}.{name}.png" in self.images,
            )
            for name in names.values()
        ]
