"""A material's numbers in the forms that programs read, to be copied from the page."""

from __future__ import annotations

import json
from collections.abc import Sequence

from factorlib.export.gltf import gltf_material
from factorlib.export.materialx import materialx
from factorlib.export.mitsuba import material_xml
from factorlib.results.materials import Reflectance


def forms(name: str, material: Reflectance) -> dict[str, str]:
    """By program: text to paste there.  Numbers are linear; what each program makes of them is in docs/formats.md."""
    numbers = {
        "diffuse": material.diffuse,
        "specular": material.specular,
        "roughness": material.roughness,
        "alpha": material.alpha,
    }
    return {
        "numbers": json.dumps({name: numbers}),
        "Mitsuba": material_xml(name, material),
        "Blender": _blender(name, material),
        "MaterialX": materialx({name: material}),
        "glTF": json.dumps({"name": name, **gltf_material(material)}),
        "three.js": _three(material),
    }


def _blender(name: str, material: Reflectance) -> str:
    """For Blender's Python console: Diffuse BSDF and Glossy BSDF, added."""
    return f"""import bpy
material = bpy.data.materials.new({name!r})
material.use_nodes = True
nodes, links = material.node_tree.nodes, material.node_tree.links
nodes.clear()
diffuse, glossy, total, output = (nodes.new("ShaderNode" + n) for n in ("BsdfDiffuse", "BsdfAnisotropic", "AddShader", "OutputMaterial"))
diffuse.inputs["Color"].default_value = ({_numbers(material.diffuse)}, 1)
glossy.inputs["Color"].default_value = ({_numbers(material.specular)}, 1)
glossy.distribution, glossy.inputs["Roughness"].default_value = "GGX", {material.roughness:.6g}
links.new(diffuse.outputs[0], total.inputs[0])
links.new(glossy.outputs[0], total.inputs[1])
links.new(total.outputs[0], output.inputs["Surface"])
"""


def _three(material: Reflectance) -> str:
    """As glTF's, whose model three.js follows: F0 = 0.04 · intensity · colour at the index of refraction 1.5."""
    of = gltf_material(material)
    metallic, specular = of["pbrMetallicRoughness"], next(iter(of["extensions"].values()))
    lines = [
        f"color: new THREE.Color({_numbers(metallic['baseColorFactor'][:3])})",
        f"metalness: 0, roughness: {metallic['roughnessFactor']:.6g}, ior: 1.5",
        f"specularIntensity: {specular['specularFactor']:.6g}, specularColor: new THREE.Color({_numbers(specular['specularColorFactor'])})",
    ]
    return "new THREE.MeshPhysicalMaterial({ " + ", ".join(lines) + " })"


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)
