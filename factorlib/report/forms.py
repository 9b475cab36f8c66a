"""A material's numbers in the forms that programs read, to be copied from the page."""

from __future__ import annotations

import json

from factorlib.export.gltf import gltf_material
from factorlib.export.mitsuba import material_xml
from factorlib.results.materials import Reflectance


def forms(name: str, material: Reflectance) -> dict[str, str]:
    """By program: text to paste there.  Numbers are linear; what each program makes of them is in docs/formats.md."""
    numbers = {"diffuse": material.diffuse, "specular": material.specular, "roughness": material.roughness, "alpha": material.alpha}
    return {
        "numbers": json.dumps({name: numbers}),
        "Mitsuba": material_xml(name, material),
        "glTF": json.dumps({"name": name, **gltf_material(material)}),
        "three.js": _three(material),
    }


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


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)
