"""Meshes as binary glTF with their materials, and suns as glTF's directional lights.

glTF's metallic-roughness model has GGX of the same α = roughness².  A dielectric with KHR_materials_specular has
F0 = 0.04 · specularFactor · specularColor and F90 = specularFactor, over a diffuse part times 1 − max F.  So

    specularFactor = max k_s,  specularColor = k_s / (0.04 max k_s),  baseColor = k_d / (1 − max k_s),  metallic 0

gives a reflectance at normal incidence of k_d and k_s exactly, and no Fresnel where k_s is grey.  Viewers without the extension
show the default F0 of 0.04.  baseColor stays within one because max k_d + max k_s does.

A directional light of KHR_lights_punctual shines along its node's −z with an illuminance in lux.  Written is the irradiance of the map's
radiance, in whose unit a program that also shows the map wants it.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from factorlib.export.scene import Sun
from factorlib.jsonfile import write_json
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply import submesh
from factorlib.results.materials import Reflectance
from factorlib.wholefile import write_bytes

DIELECTRIC = 0.04
EXTENSION, LIGHTS = "KHR_materials_specular", "KHR_lights_punctual"


def write_glb(path: str | Path, mesh: Mesh, names: Sequence[str], materials: Mapping[str, Reflectance]) -> None:
    """Write `mesh` in its own frame and units, one primitive per material; label k is names[k − 1].

    Detail of reflectance is in vertex colours, by which glTF multiplies the base colour.  Neither may be above 1: the base colour takes the largest
    factor, as far as it can, and vertices that would be brighter still are as bright as that.
    """
    scene, most = trimesh.Scene(), {}
    for label in mesh.labels:
        part, name = submesh(mesh, label), names[label - 1]
        visual = TextureVisuals(material=PBRMaterial(name=name, doubleSided=mesh.open))
        if part.detail is not None:
            brightest = max(gltf_material(materials[name])["pbrMetallicRoughness"]["baseColorFactor"][:3])
            most[name] = min(float(part.detail.max()), 1 / max(brightest, 1e-9))
            shade = np.rint(255 * np.minimum(part.detail / most[name], 1)).astype(np.uint8)
            visual.vertex_attributes["color"] = np.column_stack([shade, shade, shade, np.full_like(shade, 255)])
        geometry = trimesh.Trimesh(part.vertices, part.faces, vertex_normals=part.normals, visual=visual, process=False)
        scene.add_geometry(geometry, geom_name=name, node_name=name)
    exact = partial(_set_materials, materials=materials, most=most)
    write_bytes(path, scene.export(file_type="glb", include_normals=True, tree_postprocessor=exact))


def _set_materials(tree: dict[str, Any], materials: Mapping[str, Reflectance], most: Mapping[str, float]) -> None:
    """Exact numbers, which the mesh library would round to eight bits; most: what base colours are times."""
    for entry in tree["materials"]:
        exact = gltf_material(materials[entry["name"]])
        base, factor = exact["pbrMetallicRoughness"]["baseColorFactor"], most.get(entry["name"], 1.0)
        exact["pbrMetallicRoughness"]["baseColorFactor"] = [*(min(c * factor, 1.0) for c in base[:3]), base[3]]
        entry.update(exact)
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", []), EXTENSION})


def gltf_material(material: Reflectance) -> dict[str, Any]:
    """The part of a glTF material that says how it reflects."""
    brightest = max(material.specular)
    base = np.array(material.diffuse) / (1 - brightest)
    colour = np.array(material.specular) / (DIELECTRIC * brightest) if brightest > 0 else np.ones(3)
    plain = {"baseColorFactor": [*base.tolist(), 1.0], "metallicFactor": 0.0, "roughnessFactor": material.roughness}
    specular = {"specularFactor": brightest, "specularColorFactor": colour.tolist()}
    return {"pbrMetallicRoughness": plain, "extensions": {EXTENSION: specular}}


def write_suns(path: str | Path, suns: Sequence[Sun]) -> None:
    """Write suns as a glTF scene of directional lights, in the frame of the maps: y up."""
    lights, nodes = [], []
    for number, sun in enumerate(suns):
        intensity, (x, y, z) = float(max(sun.irradiance)), sun.direction
        turn = np.array([-y, x, 0.0, 1 + z]) if z > -1 + 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])  # of +z to the sun
        colour = (sun.irradiance / intensity).tolist()
        lights.append({"type": "directional", "color": colour, "intensity": intensity, "name": f"sun {number}"})
        rotation = (turn / np.linalg.norm(turn)).tolist()
        nodes.append({"rotation": rotation, "extensions": {LIGHTS: {"light": number}}, "name": f"sun {number}"})
    scenes = [{"nodes": list(range(len(suns)))}]
    content = {"asset": {"version": "2.0"}, "extensionsUsed": [LIGHTS], "extensions": {LIGHTS: {"lights": lights}}}
    write_json(path, {**content, "nodes": nodes, "scenes": scenes, "scene": 0})
