"""Export of meshes as binary glTF with materials and their variants, and of suns as directional lights.

glTF's metallic-roughness model has GGX of the same α = roughness².  A dielectric with KHR_materials_specular has F0 =
0.04 · specularFactor · specularColor and F90 = specularFactor, over a diffuse part times 1 − max F.  The values

    specularFactor = max k_s,  specularColor = k_s / (0.04 max k_s),  baseColor = k_d / (1 − max k_s),  metallic 0

give a reflectance at normal incidence of exactly k_d and k_s, and no Fresnel term if k_s is grey.  baseColor is at most
one because max k_d + max k_s is.  Viewers without the extension show the default F0 of 0.04, which would turn a metal
into black plastic.  A material with max k_d at most METAL times max k_s is therefore written without k_d, as baseColor
= k_s, metallic 1.  All viewers then show F0 = k_s and F90 = 1.

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
from factorlib.export.texture_atlas import bake, unwrap
from factorlib.images.picture import data_uri
from factorlib.jsonfile import write_json
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply_stl_off import submesh
from factorlib.reading import read_bytes
from factorlib.results.materials import Reflectance
from factorlib.wholefile import write_bytes

DIELECTRIC = 0.04  # F0 of glTF's dielectric
METAL = 0.02  # largest max k_d / max k_s of a material written as a metal
EXTENSION = "KHR_materials_specular"
LIGHTS = "KHR_lights_punctual"
VARIANTS = "KHR_materials_variants"


def write_glb(
    path: str | Path,
    mesh: Mesh,
    names: Sequence[str],
    materials: Mapping[str, Reflectance],
    variants: Mapping[str, Mesh] = {},
) -> None:
    """Write a mesh in its own frame and units, with the materials of its parts.

    Detail of diffuse reflectance becomes an image, which glTF multiplies by the base colour.  Neither may exceed 1.
    The base colour takes the largest factor up to that limit; brighter texels are clamped.

    Args:
        path: the file to write
        mesh: the mesh
        names: label k is names[k − 1]
        materials: reflectances by name
        variants: the mesh with other labels and detail of the same faces, by variant name (KHR_materials_variants)
    """
    # one primitive per combination of the faces' own label and their labels in each variant
    versions = [mesh, *variants.values()]
    choices, choice = np.unique([each.face_label for each in versions], axis=1, return_inverse=True)
    split = [msgspec.structs.replace(each, face_label=choice.reshape(-1) + 1) for each in versions]
    scene = trimesh.Scene()
    parts: dict[str, list[dict[str, Any]]] = {}
    images: list[str] = []
    for label, selected in enumerate(choices.T, start=1):
        alike = [submesh(each, label) for each in split]
        if any(each.detail is not None for each in alike):
            alike = [unwrap(each) for each in alike]
        chosen = [names[k - 1] for k in selected]
        name = chosen[0] if chosen[0] not in parts else f"{chosen[0]} {label}"
        part = alike[0]
        visual = TextureVisuals(part.uv, PBRMaterial(name=name))
        geometry = trimesh.Trimesh(part.vertices, part.faces, vertex_normals=part.normals, visual=visual, process=False)
        scene.add_geometry(geometry, geom_name=name, node_name=name)
        parts[name] = [
            _entry(each, materials[each], painted, images) for each, painted in zip(chosen, alike, strict=True)
        ]
    exact = partial(_set_materials, parts=parts, variants=list(variants), images=images)
    write_bytes(path, scene.export(file_type="glb", include_normals=True, tree_postprocessor=exact))


def _entry(name: str, material: Reflectance, part: Mesh, images: list[str]) -> dict[str, Any]:
    """Return a material of the file for a part; its image, if it is painted, is added to `images`."""
    exact = gltf_material(material, part.detail is not None)
    core = exact["pbrMetallicRoughness"]
    if part.detail is not None:
        base = core["baseColorFactor"][:3]
        # values of the image in [0, 1]; the base colour takes their largest value, up to 1 itself
        factor = min(float(part.detail.max()), 1 / max(*base, 1e-9))
        core["baseColorFactor"] = [*(min(c * factor, 1.0) for c in base), 1.0]
        image = data_uri(bake(part, 1 / factor))
        if image not in images:
            images.append(image)
        core["baseColorTexture"] = {"index": images.index(image)}
    return {"name": name, "doubleSided": part.open, **exact}


def _set_materials(
    tree: dict[str, Any],
    parts: Mapping[str, Sequence[dict[str, Any]]],
    variants: Sequence[str],
    images: Sequence[str],
) -> None:
    """Set the materials, variants and images of a glTF tree exactly.

    The mesh library rounds numbers to eight bits, and knows neither variants nor their images.  `parts` gives the
    materials of each mesh by name: its own first, then one per variant.
    """
    tree["materials"] = materials = []
    if images:
        tree["images"] = [{"uri": image} for image in images]
        tree["textures"] = [{"source": number} for number in range(len(images))]
    for mesh in tree["meshes"]:
        numbers = []
        for entry in parts[mesh["name"]]:
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
    if brightest > 0 and max(material.diffuse) <= METAL * brightest and not painted:
        metal = {"baseColorFactor": [*material.specular, 1.0], "metallicFactor": 1.0}
        return {"pbrMetallicRoughness": metal | {"roughnessFactor": material.roughness}}
    base = np.array(material.diffuse) / (1 - brightest)
    colour = np.array(material.specular) / (DIELECTRIC * brightest) if brightest > 0 else np.ones(3)
    plain = {"baseColorFactor": [*base.tolist(), 1.0], "metallicFactor": 0.0, "roughnessFactor": material.roughness}
    specular = {"specularFactor": brightest, "specularColorFactor": colour.tolist()}
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
