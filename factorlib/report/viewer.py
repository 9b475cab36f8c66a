"""Data of the page's relighting viewer: meshes, reflectances and lights, as numbers that a browser reads.

The viewer evaluates the same integral as the pipeline, Lambert + GGX, in the camera frame turned y-up
(`YUP_FROM_CAMERA`).  Lights are lobes; the browser draws them into a cube map and integrates over that.  Its texels are
interpolated linearly, which widens a lobe, so lobes are first sharpened to compensate.  Self-occlusion is stored at the
vertices, which are therefore close together, for a number of directions.
"""

import base64
from collections.abc import Collection, Mapping
from typing import Any

import msgspec
import numpy as np
import trimesh
from jaxtyping import Float, Int

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.dataset.schema import LightSlice, ObjectsSlice
from factorlib.export.gltf_writer import GltfPart, read_parts_of_glb, variant_name
from factorlib.geometry import open3d as o3d
from factorlib.geometry.camera import Pose
from factorlib.geometry.occlusion import LIFT, Occluders, SurfacePoints
from factorlib.geometry.raster import unit
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.images.tone import srgb_decode, srgb_encode
from factorlib.light.lobes import Lobes
from factorlib.meshes.mesh import Mesh, area_vectors
from factorlib.meshes.subdivision import subdivide
from factorlib.report.artifacts import Artifacts
from factorlib.results.lobe_table import read_lobes
from factorlib.results.materials import SolvedMaterial
from factorlib.tracing.scene import sharpen_lobes

MOST_TRIANGLES = 150_000  # triangles of all meshes together: about 3 MB of page
LONGEST = 0.08  # longest edge, in extents of the mesh
LEAST_DIRECTIONS = 32  # least number of directions of a vertex's visibility
MOST_DIRECTIONS = 256  # largest number of directions of a vertex's visibility
MOST_VERTICES = 8_000  # vertices of a mesh with visibility in MOST_DIRECTIONS: less than 1 MB of page
PAINT = "diffuse"  # attribute of vertices: diffuse reflectance of a painted part
FACES = (32, 64, 128, 256)  # possible numbers of texels across a face of the cube map
FINE_ENOUGH = 0.7  # largest texel, in widths 1/√λ of the sharpest lobe


def viewer_data(
    run: Artifacts, lights: Mapping[str, LightSlice], objects: Mapping[str, ObjectsSlice], exposure: Mapping[str, float]
) -> dict[str, Any] | None:
    """Return the viewer's data; None if no light or no material was exported.

    Strings of numbers are base64, little-endian.

    objects    see `_objects`
    meshes     see `_objects`
    materials  reflectances by name
    lights     by name: face, texels across a face of the cube map; lobes, float32, 7 per lobe: axis (y-up), sharpness,
               weight
    photos     name; light; rotation, y-up light from y-up camera, row by row; gain on the light, per channel; exposure

    Args:
        run: results of the run
        lights: light slices of the photos
        objects: object slices of the photos
        exposure: display exposure of each photo
    """
    lobes = run.read(read_lobes, "export", "lobes.parquet")
    table = run.exported.materials
    materials = {name: table[name].reflectance for name in run.set.materials if name in table}
    if not lobes or not materials:
        return None
    photos = []
    for name in [name for name in run.set.photos if lights[name].illumination in lobes]:
        world = lights[name].world_from_camera
        turn = YUP_FROM_CAMERA @ (np.eye(3) if world is None else np.array(world)) @ YUP_FROM_CAMERA.T
        photo = {"name": name, "light": lights[name].illumination, "rotation": turn.ravel().tolist()}
        photos.append(photo | {"gain": run.exposures.get(name, (1.0,) * 3), "exposure": exposure[name]})
    light_data = {name: _light(each) for name, each in lobes.items()}
    return {**_objects(run, objects), "materials": materials, "lights": light_data, "photos": photos}


def _light(lobes: Lobes) -> dict[str, Any]:
    texel = FINE_ENOUGH / np.sqrt(lobes.sharpness.max(initial=1.0))
    face = next((n for n in FACES if texel_spacing(n) <= texel), FACES[-1])
    lobes = sharpen_lobes(lobes, texel_spacing(face)).rotate(YUP_FROM_CAMERA)
    return {"face": face, "lobes": _base64(np.column_stack([lobes.axis, lobes.sharpness, lobes.weight]), "<f4")}


def texel_spacing(face: int) -> float:
    """Return the mean angle between texels of a cube map, in radians.

    >>> round(texel_spacing(64), 4)
    0.0226
    """
    return float(np.sqrt(4 * np.pi / (6 * face**2)))


# ── Meshes ───────────────────────────────────────────────────────────────────────────────────────────────────────────


class ViewedObject(msgspec.Struct, frozen=True):
    """An object of a photo, or a mesh with its own materials that no photo shows in a trusted pose."""

    photo: str | None
    name: str
    mesh: str
    variant: str = ""
    pose: Pose = Pose(YUP_FROM_CAMERA.T, np.zeros(3))


def _objects(run: Artifacts, objects: Mapping[str, ObjectsSlice]) -> dict[str, list[dict[str, Any]]]:
    """Return all objects that can be viewed, and their meshes.

    objects  photo, name; mesh, its index; materials, by part; painted, by part; rotation, y-up camera from object, row
             by row; eye, unit vector from the object to that camera
    meshes   name and `_mesh`
    """
    files = {name: file for name in sorted(run.set.meshes) if (file := run.folders["export"] / f"{name}.glb").exists()}
    parts = {name: dict(sorted(read_parts_of_glb(file).items())) for name, file in files.items()}
    loaded = {name: trimesh.load_scene(file, process=False).geometry for name, file in files.items()}
    for name, geometry in loaded.items():
        _set_paint(geometry, parts[name], run.exported.materials)
    entries = _viewed_objects(run, objects, files)
    kinds = sorted({each.mesh for each in entries})
    triangles = sum(len(part.faces) for name in kinds for part in loaded[name].values())
    share = min(1.0, MOST_TRIANGLES / max(1, triangles))
    meshes = [_mesh(loaded[name], share) for name in kinds]
    placed = []
    for each in entries:
        mesh = kinds.index(each.mesh)
        worn = {name: part.materials.get(each.variant, part.materials[""]) for name, part in parts[each.mesh].items()}
        painted = {name for name, part in loaded[each.mesh].items() if PAINT in part.vertex_attributes}
        toward = -(YUP_FROM_CAMERA @ each.pose.apply(meshes[mesh][1][None])[0])
        length = np.linalg.norm(toward)
        placed.append(
            {
                "photo": each.photo,
                "name": each.name,
                "mesh": mesh,
                "materials": list(worn.values()),
                "painted": [k in painted and name == parts[each.mesh][k].materials[""] for k, name in worn.items()],
                "rotation": (YUP_FROM_CAMERA @ each.pose.rotation).ravel().tolist(),
                "eye": (toward / length).tolist() if length > 0 else [0.0, 0.0, 1.0],
            }
        )
    return {
        "objects": placed,
        "meshes": [{"name": name, **mesh} for name, (mesh, _) in zip(kinds, meshes, strict=True)],
    }


def _viewed_objects(run: Artifacts, objects: Mapping[str, ObjectsSlice], meshes: Collection[str]) -> list[ViewedObject]:
    """Return the objects of all photos in trusted poses, and the meshes of which there is none."""
    entries = []
    for photo in (name for name in run.set.photos if name in run.poses):
        for obj in objects[photo].objects:
            entry = run.poses[photo].objects.get(obj.name)
            if obj.mesh in meshes and entry is not None and not entry.left_out:
                variant = variant_name(obj.materials)
                entries.append(ViewedObject(photo, obj.name, obj.mesh, variant, entry.pose))
    return entries + [ViewedObject(None, name, name) for name in meshes if all(name != each.mesh for each in entries)]


def _set_paint(
    meshes: Mapping[str, trimesh.Trimesh], parts: Mapping[str, GltfPart], table: Mapping[str, SolvedMaterial]
) -> None:
    """Set the diffuse reflectance at the vertices, the attribute PAINT, of the parts that have a texture.

    Args:
        meshes: the parts as a mesh library reads them, with texture coordinates from the lower left corner, by name
        parts: their materials
        table: the exported materials
    """
    for name, part in parts.items():
        visual: Any = meshes[name].visual
        if (texture := getattr(visual.material, "baseColorTexture", None)) is None:
            continue
        image = np.asarray(texture.convert("RGB"))
        size = np.array(image.shape[1::-1])
        column, row = ((visual.uv * [1, -1] + [0, 1]) * size).astype(int).clip(0, size - 1).T
        core = 1 - max(table[part.materials[""]].reflectance.specular)  # the base colour is k_d / (1 − max k_s)
        meshes[name].vertex_attributes[PAINT] = (
            core * np.array(part.base_colour) * srgb_decode(image[row, column] / 255)
        )


def _mesh(parts: Mapping[str, trimesh.Trimesh], share: float) -> tuple[dict[str, Any], Float[np.ndarray, "3"]]:
    """Return a mesh, with at most `share` of its triangles, and its centre.

    vertices         uint16, 3 per vertex, v / 32767.5 − 1 in radii of the mesh from its centre
    normals          int16, times 32767
    diffuse          uint8, 3 per vertex, diffuse reflectance of painted parts, sRGB-encoded; None if no part is
    parts            by name, in order: triangles, uint32, 3 per triangle
    open             true if the mesh has a border; every triangle then occurs twice, once for either side
    sight            see `_sight`
    simplified_from  number of triangles before simplification, if it was simplified
    """
    vertices = np.concatenate([part.vertices for part in parts.values()])
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices - centre, axis=-1).max()) or 1.0
    pieces = [_simplify(part, share) for _, part in sorted(parts.items())]
    vertices, normals, faces, colours = zip(*pieces, strict=True)
    first = np.cumsum([0, *map(len, vertices)])
    labels = np.arange(1, len(pieces) + 1, dtype=np.int16)
    mesh = Mesh(
        (np.vstack(vertices) - centre) / radius,
        np.vstack([face + start for face, start in zip(faces, first, strict=False)]),
        unit(np.vstack(normals)),
        np.repeat(labels, [len(face) for face in faces]),
        any(bool(part.visual.material.doubleSided) for part in parts.values()),  # type: ignore[union-attr]
        np.vstack(colours) if any(PAINT in part.vertex_attributes for part in parts.values()) else None,
    )
    # subdivide so that shadows fall between vertices, less finely if there would be too many
    longest = LONGEST * np.ptp(mesh.vertices, axis=0).max()
    most = max(MOST_VERTICES // (1 + mesh.open), len(mesh.vertices))
    while len((fine := subdivide(mesh, longest)).vertices) > most:
        longest *= 2
    mesh = fine
    sides = _both_sides(mesh) if mesh.open else mesh
    packed = {
        "vertices": _base64(np.rint((np.clip(sides.vertices, -1, 1) + 1) * 32767.5), "<u2"),
        "normals": _base64(np.rint(32767 * sides.normals), "<i2"),
        "diffuse": None if sides.detail is None else _base64(np.rint(255 * srgb_encode(sides.detail.clip(0, 1))), "u1"),
        "parts": [_base64(sides.faces[sides.face_label == label], "<u4") for label in labels],
        "open": mesh.open,
        "sight": _sight(mesh, sides),
        "simplified_from": sum(len(part.faces) for part in parts.values()) if share < 1 else None,
    }
    return packed, centre


def _both_sides(mesh: Mesh) -> Mesh:
    """Return the mesh with its triangles oriented by their normals, followed by a reversed copy.

    Vertex v of a mesh of V vertices is v + V, with the opposite normal, in the copy.
    """
    turned = np.einsum("fd,fkd->f", area_vectors(mesh.vertices, mesh.faces), mesh.normals[mesh.faces]) < 0
    faces = np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)
    return Mesh(
        np.vstack([mesh.vertices, mesh.vertices]),
        np.vstack([faces, faces[:, ::-1] + len(mesh.vertices)]),
        np.vstack([mesh.normals, -mesh.normals]),
        np.tile(mesh.face_label, 2),
        detail=None if mesh.detail is None else np.tile(mesh.detail, (2, 1)),
    )


def _sight(mesh: Mesh, sides: Mesh) -> dict[str, Any]:
    """Return the directions that an object occludes at its own vertices, as pairs of vertex and direction.

    `mesh` occludes; the vertices are those of `sides`, the mesh as the viewer gets it.  Pairs are in the order of the
    vertices.

    directions  float32, 3 per direction: evenly spread, at most `MOST_DIRECTIONS`, fewer for many vertices
    counts      uint16, per vertex: its number of pairs, for directions in front of it alone
    hidden      uint8, per pair: index of the direction
    met         uint16, or uint32 for many vertices, per pair: index of a vertex at the occluder; the number of vertices
                if it is the inside of the mesh, which is black
    """
    directions = fibonacci_sphere(
        int(np.clip(MOST_DIRECTIONS * MOST_VERTICES // len(sides.vertices), LEAST_DIRECTIONS, MOST_DIRECTIONS))
    )
    occluders = Occluders([mesh], [Pose(np.eye(3), np.zeros(3))])
    single = len(mesh.vertices)
    # start points, lifted off the surface along the area-weighted vertex normal
    outward = np.zeros_like(sides.vertices)
    np.add.at(outward, sides.faces.T, area_vectors(sides.vertices, sides.faces))
    outward = unit(outward * np.where(np.sum(outward * sides.normals, 1, keepdims=True) < 0, -1, 1))
    points = SurfacePoints(sides.vertices + LIFT * mesh.radius * outward, outward, np.ones(len(outward), bool))
    pairs = []
    for vertex, k, face, turned in occluders.hidden_from(points, sides.normals, directions):
        hit_vertex = mesh.faces[face, 0].astype(np.int64)
        # a hit on the back of a triangle is on the mesh's other side, or inside a closed mesh, which is black
        is_back = np.sum(occluders.hit_normals(face, turned) * mesh.normals[hit_vertex], 1) < 0
        hit_vertex = np.where(
            (face < 0) | is_back & (not mesh.open), len(outward), hit_vertex + np.where(is_back, single, 0)
        )
        pairs.append(np.stack([vertex, k, hit_vertex])[:, np.sum(sides.normals[vertex] * directions[k], 1) > 0])
    vertex, k, hit_vertex = np.concatenate(pairs, axis=1)
    return {
        "directions": _base64(directions, "<f4"),
        "counts": _base64(np.bincount(vertex, minlength=len(outward)), "<u2"),
        "hidden": _base64(k, "u1"),
        "met": _base64(hit_vertex, "<u2" if len(outward) < 1 << 16 else "<u4"),
    }


def _simplify(
    part: trimesh.Trimesh, share: float
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], Float[np.ndarray, "v 3"]]:
    """Return vertices, normals, triangles and paint of a part, with `share` of its triangles by quadric error."""
    diffuse = np.asarray(part.vertex_attributes.get(PAINT, np.zeros((len(part.vertices), 3))))
    if share == 1.0:
        return part.vertices, part.vertex_normals, part.faces, diffuse
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(part.vertices), o3d.utility.Vector3iVector(part.faces))
    mesh.vertex_colors = o3d.utility.Vector3dVector(diffuse)
    mesh = mesh.merge_close_vertices(1e-7 * float(np.ptp(part.vertices, axis=0).max()))
    mesh = mesh.simplify_quadric_decimation(max(16, int(share * len(part.faces)))).compute_vertex_normals()
    arrays = (mesh.vertices, mesh.vertex_normals, mesh.triangles, mesh.vertex_colors)
    return tuple(np.asarray(each) for each in arrays)  # type: ignore[return-value]


def _base64(values: np.ndarray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values.astype(kind)).tobytes()).decode("ascii")
