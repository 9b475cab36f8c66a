"""Export of meshes as binary glTF with materials and their variants, and of suns as directional lights.

glTF's metallic-roughness model has GGX of the same α = roughness², with Schlick's Fresnel term from F0 to F90, over a
diffuse part times 1 − max F.  A dielectric has F90 = 1 and F0 = 0.04, which KHR_materials_specular multiplies by
specularColor.  The solved k_s has no Fresnel term: it is F averaged over the angles of the photos, which is F0 + ADDED
for plastics.  So k_s = 0.04 + ADDED is the ordinary dielectric, which viewers without the extension show as well, and

    F0 = k_s − ADDED,  but in proportion to k_s below the ordinary dielectric, where the difference would reach 0
    specularFactor = 1,  specularColor = F0 / 0.04,  baseColor = k_d / (1 − max k_s),  metallic 0

baseColor is at most one because max k_d + max k_s is.  A k_s above that of any dielectric with little k_d is a metal:
metallic 1, and baseColor = k_d + k_s, because a metal has no diffuse part.  Without k_s specularFactor is 0.

A directional light of KHR_lights_punctual shines along its node's −z with an illuminance in lux.  The value written is
the irradiance in the unit of the map's radiance, as a program that also shows the map needs it.
"""

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from factorlib.export.exported_scene import Sun
from factorlib.export.texture_atlas import UNKNOWN_PIXEL, Atlas, make_atlas
from factorlib.images.picture import data_uri
from factorlib.jsonfile import write_json
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply_stl_off import submesh
from factorlib.reading import read_bytes
from factorlib.results.materials import Reflectance
from factorlib.wholefile import write_bytes

DIELECTRIC = 0.04  # F0 of glTF's dielectric
ADDED = 1 / 75  # k_s − F0 of Lambert + GGX fitted to plastics with Fresnel (docs/formats.md)
# Largest F0 of a dielectric, that of an index of refraction of 1.8 (the range of "specular" of Burley 2012).
MOST_DIELECTRIC = 0.08
METAL = 0.25  # largest max k_d / max k_s of a material written as a metal
EXTENSION = "KHR_materials_specular"
LIGHTS = "KHR_lights_punctual"
VARIANTS = "KHR_materials_variants"


def write_glb(
    path: str | Path,
    mesh: Mesh,
    names: Sequence[str],
    materials: Mapping[str, Reflectance],
    variants: Mapping[str, Mesh] = {},
    atlas: Atlas | None = None,
) -> None:
    """Write a mesh in its own frame and units, with the materials of its parts.

    Detail of diffuse reflectance becomes an image of the base colour of all parts, on the mesh of the atlas.

    Args:
        path: the file to write
        mesh: the mesh
        names: label k is names[k − 1]
        materials: reflectances by name
        variants: the mesh with other labels and detail of the same faces, by variant name (KHR_materials_variants)
        atlas: atlas of the mesh, if it or a variant has detail; None to make one
    """
    versions = [mesh, *variants.values()]
    exported = versions
    if any(each.detail is not None for each in versions):
        atlas = atlas or make_atlas(versions, mesh, UNKNOWN_PIXEL * float(np.ptp(mesh.vertices, axis=0).max()))
        exported = [atlas.dress(each) for each in versions]
    # one primitive per combination of the faces' own label and their labels in each variant
    choices, choice = np.unique([each.face_label for each in exported], axis=1, return_inverse=True)
    split = msgspec.structs.replace(exported[0], face_label=choice.reshape(-1) + 1)
    looks = [_looks(each, names, materials, atlas) for each in versions]
    scene = trimesh.Scene()
    parts: dict[str, list[dict[str, Any]]] = {}
    for label, selected in enumerate(choices.T, start=1):
        chosen = [names[k - 1] for k in selected]
        name = chosen[0] if chosen[0] not in parts else f"{chosen[0]} {label}"
        part = submesh(split, label)
        visual = TextureVisuals(part.uv, PBRMaterial(name=name))
        geometry = trimesh.Trimesh(part.vertices, part.faces, vertex_normals=part.normals, visual=visual, process=False)
        scene.add_geometry(geometry, geom_name=name, node_name=name)
        parts[name] = [{"doubleSided": part.open, **look[k]} for look, k in zip(looks, selected, strict=True)]
    exact = partial(_set_materials, parts=parts, variants=list(variants))
    write_bytes(path, scene.export(file_type="glb", include_normals=True, tree_postprocessor=exact))


def _looks(
    mesh: Mesh, names: Sequence[str], materials: Mapping[str, Reflectance], atlas: Atlas | None
) -> dict[int, dict[str, Any]]:
    """Return the material of the file for each label of a mesh; one that is painted has an image as data URI."""
    painted = [label for label in mesh.labels if submesh(mesh, label).detail is not None]
    looks = {}
    for label in mesh.labels:
        name = names[label - 1]
        looks[label] = {"name": name, **gltf_material(materials[name], label in painted)}
    if atlas is not None and painted:
        colours = np.zeros((len(names), 3))
        for label, look in looks.items():
            colours[label - 1] = look["pbrMetallicRoughness"]["baseColorFactor"][:3]
        image = data_uri(atlas.bake(mesh, colours))
        for label in painted:
            core = looks[label]["pbrMetallicRoughness"]
            looks[label]["pbrMetallicRoughness"] = core | {"baseColorFactor": [1.0] * 4, "baseColorTexture": image}
    return looks


def _set_materials(
    tree: dict[str, Any], parts: Mapping[str, Sequence[dict[str, Any]]], variants: Sequence[str]
) -> None:
    """Set the materials, variants and images of a glTF tree exactly.

    The mesh library rounds numbers to eight bits, and knows neither variants nor their images.  `parts` gives the
    materials of each mesh by name: its own first, then one per variant.
    """
    tree["materials"] = materials = []
    images: list[str] = []
    for mesh in tree["meshes"]:
        numbers = []
        for entry in parts[mesh["name"]]:
            core = entry["pbrMetallicRoughness"]
            if image := core.get("baseColorTexture"):
                if image not in images:
                    images.append(image)
                core = core | {"baseColorTexture": {"index": images.index(image)}}
            entry = entry | {"pbrMetallicRoughness": core}
            if entry not in materials:
                materials.append(entry)
            numbers.append(materials.index(entry))
        (primitive,) = mesh["primitives"]
        primitive["material"] = numbers[0]
        if variants:
            mappings = [
                {"material": k, "variants": [v for v, other in enumerate(numbers[1:]) if other == k]}
                for k in sorted(set(numbers[1:]))
            ]
            primitive["extensions"] = {VARIANTS: {"mappings": mappings}}
    if images:
        tree["images"] = [{"uri": image} for image in images]
        tree["textures"] = [{"source": number} for number in range(len(images))]
    if variants:
        tree["extensions"] = {VARIANTS: {"variants": [{"name": name} for name in variants]}}
    extensions = {*tree.get("extensionsUsed", []), *(name for each in materials for name in each.get("extensions", ()))}
    if used := sorted(extensions | ({VARIANTS} if variants else set())):
        tree["extensionsUsed"] = used


def variant_name(overrides: Mapping[str, str]) -> str:
    """Return the name of a variant that gives parts of a mesh other materials.

    >>> variant_name({"shell": "white", "legs": "black"})
    'legs: black, shell: white'
    """
    return ", ".join(f"{part}: {material}" for part, material in sorted(overrides.items()))


class GltfPart(msgspec.Struct, frozen=True):
    """Part of a file from `write_glb`.

    Attributes:
        materials: name of its own material under "", and those of the variants under their names
        base_colour: base colour of its own material, which a texture multiplies
    """

    materials: dict[str, str]
    base_colour: list[float]


def read_parts_of_glb(path: str | Path) -> dict[str, GltfPart]:
    """Read the parts of a file from `write_glb`, by name."""
    data = read_bytes(path, "a glTF file")
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])  # the JSON chunk
    names = [entry["name"] for entry in tree["materials"]]
    variants = [entry["name"] for entry in tree.get("extensions", {}).get(VARIANTS, {}).get("variants", [])]
    parts = {}
    for mesh in tree["meshes"]:
        (primitive,) = mesh["primitives"]
        materials = {"": names[primitive["material"]]}
        for each in primitive.get("extensions", {}).get(VARIANTS, {}).get("mappings", []):
            materials |= {variants[v]: names[each["material"]] for v in each["variants"]}
        core = tree["materials"][primitive["material"]]["pbrMetallicRoughness"]
        parts[mesh["name"]] = GltfPart(materials, core["baseColorFactor"][:3])
    return parts


def gltf_material(material: Reflectance, painted: bool = False) -> dict[str, Any]:
    """Return the reflectance part of a glTF material.

    A `painted` material has a texture, which holds detail of k_d.  It is never written as a metal.
    """
    brightest = max(material.specular)
    mostly_specular = brightest - ADDED > MOST_DIELECTRIC and max(material.diffuse) <= METAL * brightest
    if mostly_specular and not painted:
        base = np.add(material.diffuse, material.specular)
        metal = {"baseColorFactor": [*base.tolist(), 1.0], "metallicFactor": 1.0}
        return {"pbrMetallicRoughness": metal | {"roughnessFactor": material.roughness}}
    base = np.array(material.diffuse) / (1 - brightest)
    ordinary = DIELECTRIC + ADDED
    f0 = np.maximum(
        np.array(material.specular) - ADDED, np.minimum(material.specular, ordinary) * DIELECTRIC / ordinary
    )
    plain = {"baseColorFactor": [*base.tolist(), 1.0], "metallicFactor": 0.0, "roughnessFactor": material.roughness}
    specular = {"specularFactor": float(brightest > 0), "specularColorFactor": (f0 / DIELECTRIC).tolist()}
    return {"pbrMetallicRoughness": plain, "extensions": {EXTENSION: specular}}


def write_suns(path: str | Path, suns: Sequence[Sun]) -> None:
    """Write suns as a glTF scene of directional lights, in the y-up frame of the maps."""
    lights = []
    nodes = []
    for number, sun in enumerate(suns):
        intensity = float(max(sun.irradiance))
        x, y, z = sun.direction
        # quaternion (x, y, z, w) that turns +z to the sun
        turn = np.array([-y, x, 0.0, 1 + z]) if z > -1 + 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])
        colour = (sun.irradiance / intensity).tolist()
        lights.append({"type": "directional", "color": colour, "intensity": intensity, "name": f"sun {number}"})
        rotation = (turn / np.linalg.norm(turn)).tolist()
        nodes.append({"rotation": rotation, "extensions": {LIGHTS: {"light": number}}, "name": f"sun {number}"})
    scenes = [{"nodes": list(range(len(suns)))}]
    content = {"asset": {"version": "2.0"}, "extensionsUsed": [LIGHTS], "extensions": {LIGHTS: {"lights": lights}}}
    write_json(path, {**content, "nodes": nodes, "scenes": scenes, "scene": 0})
