"""A solved data set for rendering: scenes of its photos, their lights, grounds and materials."""

import logging

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.dataset.schema import GroundSlice, LightSlice, MeshEntry, MeshInstance, ObjectsSlice
from factorlib.errors import InputError, did_you_mean
from factorlib.export.exported_scene import ALL_BOUNCES, DIRECT
from factorlib.generate.solids import sphere
from factorlib.geometry.ground import Plane
from factorlib.images.exr import read_exr
from factorlib.images.light_map import read_light_map
from factorlib.images.tone import apply_tone, invert_tone
from factorlib.meshes.mesh import Mesh, without_paint
from factorlib.meshes.read_mesh import CREASE_DEG, MeshCache, read_mesh
from factorlib.reading import check_plain
from factorlib.recipe.kinds import BALL, Table, is_light_file, is_mesh_file, materials_of
from factorlib.render.ground import ground_below, level_ground
from factorlib.render.insertion import GroundSurface
from factorlib.render.photo_scene import DistantLight, LightMap, PhotoScene, PlacedMesh, Tone, identity_tone
from factorlib.results.lobe_table import read_photo_light
from factorlib.results.materials import MaterialTable, Reflectance, read_materials, reflectances
from factorlib.results.poses import PhotoPoses, read_poses
from factorlib.results.surface_table import read_surface
from factorlib.results.texture_table import read_textures
from factorlib.stage import Inputs
from factorlib.tracing.scene import rigid

LEAST_HEIGHT = 1e-6  # least height of a mesh to insert, in its radii

log = logging.getLogger("factorlib.render")


class SolvedSet:
    """The solved materials, lights and poses, and the photos; photos and lights are read on demand.

    Attributes:
        inputs: slices materials, objects, light and ground of the data set, and folders of masks, align, surface and
            export
    """

    def __init__(self, inputs: Inputs, crease_deg: float = CREASE_DEG):
        self.inputs = inputs
        self.names: list[str] = inputs.facts["dataset.materials"]
        self.objects = msgspec.convert(inputs.facts["dataset.objects"], dict[str, ObjectsSlice])
        self.lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
        self.grounds = msgspec.convert(inputs.facts["dataset.ground"], dict[str, GroundSlice])
        self.poses: dict[str, PhotoPoses] = read_poses(inputs["align"] / "poses.json")
        file = inputs["export"] / "materials.json"
        self.table: MaterialTable = read_materials(file)
        for name, material in self.table.materials.items():
            if material.total > 1:
                raise InputError(
                    f"max diffuse + max specular = {material.total:.4g}: more light is reflected than arrives",
                    file=file,
                    key=f"materials.{name}",
                    cure="run the stage `export` again",
                )
        self.materials = reflectances(self.table)
        self.photos = list(self.objects)
        surface = read_surface(inputs.folders.get("surface"))
        textures = read_textures(inputs.folders.get("texture"))
        moved = surface.displacements, surface.log_factors
        self._meshes = MeshCache(inputs.mesh, self.names, crease_deg, *moved, textures)
        self._pixels: dict[str, dict[str, np.ndarray]] = {}

    def scene(self, photo: str) -> PhotoScene:
        """Return the photo's objects in their poses and in its light; InputError for a photo without objects."""
        poses = self.poses[photo]
        objects = self.objects[photo]
        if not objects.objects:
            raise InputError(
                f"photo '{photo}' has no objects to render",
                key=f"photos.{photo}.objects",
                cure="name other photos in the recipe",
            )
        for obj in objects.objects:
            if poses.objects[obj.name].left_out:
                log.warning(
                    "%s: the pose of '%s' is doubtful, so the solve left it out, and pictures may misplace it: %s",
                    photo,
                    obj.name,
                    "; ".join(poses.objects[obj.name].doubts),
                )
        height, width = self._masks(photo)["label"].shape
        camera = poses.camera.camera(width, height)
        placed = tuple(self._placed(obj, objects.meshes[obj.mesh], poses) for obj in objects.objects)
        depth = ALL_BOUNCES if self.table.model.interreflection else DIRECT
        return PhotoScene(camera, placed, self.light(photo), self.materials, depth, self.world_from_map(photo)[:, 1])

    def world_from_map(self, photo: str) -> Float[np.ndarray, "3 3"]:
        """Return the rotation from the frame of the photo's exported light to the world of the photo's scene.

        Its second column points up: along −y of the dataset's world, or of the camera if the photo has no world.
        """
        world = self.lights[photo].world_from_camera
        return np.eye(3) if world is None else YUP_FROM_CAMERA @ np.array(world).T @ YUP_FROM_CAMERA

    def photo(self, photo: str) -> Float[np.ndarray, "h w 3"]:
        """Return the photo's linear radiance."""
        channels = self._masks(photo)
        return np.nan_to_num(np.stack([channels[c] for c in "RGB"], axis=-1).astype(float))

    def linear_photo(self, photo: str) -> Float[np.ndarray, "h w 3"]:
        """Return the photo's linear radiance with its tone curve undone."""
        tone = self.table.model.tone.get(photo)
        return invert_tone(self.photo(photo), tone.exponent, tone.pivot) if tone else self.photo(photo)

    def pixel(self, photo: str, pixel: tuple[float, float]) -> tuple[float, float]:
        """Convert a pixel of the photo to pixels of the picture from `masks`; InputError if it lies outside."""
        height, width = self._masks(photo)["label"].shape
        factor = self.poses[photo].camera.factor
        if not (0 <= pixel[0] <= factor * width and 0 <= pixel[1] <= factor * height):
            raise InputError(
                f"pixel {pixel} lies outside photo '{photo}', of {factor * width} × {factor * height} pixels",
                key="at",
                cure="name a pixel that shows the ground",
            )
        return pixel[0] / factor, pixel[1] / factor

    def photo_mask(self, photo: str) -> Bool[np.ndarray, "h w"]:
        """Return a mask of the pixels that show no background: those of a mask, and those that are transparent."""
        channels = self._masks(photo)
        return (channels["label"] > 0) | (channels["left_out"] > 0) | (self.opacity(photo) < 1)

    def opacity(self, photo: str) -> Float[np.ndarray, "h w"]:
        """Return the opacity of the photo's pixels, which is less than 1 in a cut-out."""
        channels = self._masks(photo)
        return channels.get("alpha", np.ones(channels["label"].shape))

    def tone(self, photo: str) -> Tone:
        """Return the photo's tone curve."""
        tone = self.table.model.tone.get(photo)
        return (lambda radiance: apply_tone(radiance, tone.exponent, tone.pivot)) if tone else identity_tone

    def light(self, name: str, photo: str | None = None) -> DistantLight:
        """Return the light of a photo or of a file.

        Args:
            name: name of the photo, or of a file in the recipe
            photo: photo whose objects it lights.  A map stands in its world as its own exported light does, and the
                light of a photo with a world stays fixed to that world.  By default, a map stands in the world of the
                scene and a photo's light in its own camera's axes.
        """
        if is_light_file(name):
            radiance = read_light_map(self.inputs.file(f"recipe file:{name}"))
            return LightMap(radiance) if photo is None else LightMap(radiance, self.world_from_map(photo))
        light = self.lights[name]
        if photo is not None and light.world_from_camera and (here := self.lights[photo].world_from_camera):
            light = msgspec.structs.replace(light, world_from_camera=here)
        return read_photo_light(self.inputs["export"], name, light)

    def other_lights(self, photo: str) -> list[str]:
        """Return the first photo of every light but that of `photo`."""
        first: dict[str, str] = {}
        for name in self.photos:
            first.setdefault(self.lights[name].illumination, name)
        del first[self.lights[photo].illumination]
        return list(first.values())

    def with_table(self, table: Table) -> dict[str, Reflectance]:
        """Return the solved materials, replaced and extended by those of a table."""
        file = self.inputs.file(f"recipe file:{table}") if isinstance(table, str) else None
        entries = materials_of(table, file).items()
        return self.materials | {name: Reflectance(m.diffuse, m.specular, m.roughness) for name, m in entries}

    def ground(self, photo: str, neighbour: PlacedMesh) -> GroundSurface:
        """Return the ground given with the photo, or the plane that the neighbour rests or stands on."""
        ground_entry = self.grounds[photo].ground
        if ground_entry is None and self.lights[photo].world_from_camera is not None:
            plane, source = level_ground(neighbour, self.world_from_map(photo)[:, 1])
            return GroundSurface(plane, source=source)
        if ground_entry is None:
            # up vectors of the cameras of all objects of the mesh, in its frame
            mesh = next(obj.mesh for obj in self.objects[photo].objects if obj.name == neighbour.name)
            poses = [self.poses[each].objects[obj.name] for each, obj in self._objects_of(mesh)]
            trusted = [pose for pose in poses if not pose.left_out] or poses
            uprights = np.stack([np.array(pose.rotation).T @ YUP_FROM_CAMERA[1] for pose in trusted])
            return GroundSurface(
                ground_below(neighbour, uprights), source=f"where '{neighbour.name}' would come to rest"
            )
        normal = YUP_FROM_CAMERA @ np.array(ground_entry.normal)
        plane = Plane(normal / np.linalg.norm(normal), YUP_FROM_CAMERA @ np.array(ground_entry.point))
        return GroundSurface(plane, ground_entry.diffuse, source="that of dataset.yaml")

    def mesh(
        self, name: str, material: str | dict[str, str] | None, up: str
    ) -> tuple[Mesh, tuple[str, ...], np.ndarray]:
        """Return a mesh to insert, its materials by label, and the unit upward direction in its frame.

        A mesh of the data set has its own `parts`.  If these lack a material to be replaced, the mesh is that of the
        first photo, by name, whose object has it.

        Args:
            name: a mesh of the data set, a mesh file, or BALL
            material: a material for the whole mesh, or replacements by material name; None keeps its own
            up: upward axis of a mesh file: x, y or z

        Raises:
            InputError: The mesh does not exist or has no height, or lacks a material to be replaced.
        """
        upward = np.eye(3)["xyz".index(up)]
        first = material if isinstance(material, str) else self.names[0]
        materials: tuple[str, ...] = (first,)
        if name == BALL:
            mesh = sphere(1.0)
        elif is_mesh_file(name):
            file = self.inputs.file(f"recipe file:{name}")
            mesh = read_mesh(file, [first], first, {}, self._meshes.crease_deg)
        else:
            photo, placed = self._placed_with(name, set(material) if isinstance(material, dict) else set())
            upward = placed.world_from_object[:3, :3].T @ self.ground(photo, placed).plane.normal
            mesh = placed.mesh
            materials = placed.materials
            if isinstance(material, str):
                materials = (material,) * len(materials)
            elif material is not None:
                materials = tuple(material.get(each, each) for each in materials)
            mesh = without_paint(
                mesh, [label for label in mesh.labels if materials[label - 1] != self.names[label - 1]]
            )
        if np.ptp(mesh.vertices @ upward) < LEAST_HEIGHT * mesh.radius:
            raise InputError(
                f"the mesh {name!r} has no height",
                key="mesh",
                cure="say which axis of the file points upward, as in `up: z`, or name a mesh that is not flat",
            )
        return mesh, materials, upward

    def _placed_with(self, name: str, required: set[str]) -> tuple[str, PlacedMesh]:
        """Return the first photo with an object of a mesh that has the required materials, and that object.

        The mesh with its materials of `meshes` comes first, then every object of it with its own.
        """
        objects = self._objects_of(name)
        if not objects:
            known = [BALL, *sorted({obj.mesh for each in self.objects.values() for obj in each.objects})]
            raise InputError(f"there is no mesh {name!r}", key="mesh", cure=did_you_mean(name, known))
        plain = [(photo, msgspec.structs.replace(obj, materials={})) for photo, obj in objects[:1]]
        present: set[str] = set()
        for photo, obj in plain + objects:
            placed = self._placed(obj, self.objects[photo].meshes[name], self.poses[photo])
            materials = {self.names[label - 1] for label in placed.mesh.labels}
            if required <= materials:
                return photo, placed
            present |= materials
        wrong = min(required - present, default=min(required))
        raise InputError(
            f"no object of the mesh {name!r} has the materials {', '.join(sorted(required))}",
            key="material",
            cure=did_you_mean(wrong, sorted(present)),
        )

    def _objects_of(self, mesh: str) -> list[tuple[str, MeshInstance]]:
        """Return all objects of a mesh with their photos, sorted by photo name, independent of dataset.yaml's order."""
        return [
            (photo, obj) for photo, each in sorted(self.objects.items()) for obj in each.objects if obj.mesh == mesh
        ]

    def _placed(self, obj: MeshInstance, entry: MeshEntry, poses: PhotoPoses) -> PlacedMesh:
        pose = poses.objects[obj.name]
        mesh = self._meshes.mesh(obj.mesh, entry, obj.materials)
        place = rigid(YUP_FROM_CAMERA @ np.array(pose.rotation), YUP_FROM_CAMERA @ np.array(pose.translation))
        return PlacedMesh(obj.name, mesh, tuple(self.names), place)

    def _masks(self, photo: str) -> dict[str, np.ndarray]:
        if photo not in self._pixels:
            file = self.inputs["masks"] / f"{photo}.exr"
            check_plain(file, "an EXR", most_bytes=None)
            self._pixels = {photo: read_exr(file)}  # Only one photo is held: photos are large.
            for channel in (*"RGB", "label", "left_out"):
                if channel not in self._pixels[photo]:
                    raise InputError(
                        f"has no channel {channel}", file=file, key=channel, cure="run the stage `masks` again"
                    )
        return self._pixels[photo]
