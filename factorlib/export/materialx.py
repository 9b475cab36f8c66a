"""Materials as MaterialX 1.39, with the nodes of its physically based shading library.

k_d/π is `oren_nayar_diffuse_bsdf` of roughness 0, exactly.  k_s D G/(4 …) is `generalized_schlick_bsdf` with color0 =
color90 = k_s/w: GGX of the same α and no Fresnel.  A `mix` of weight w adds them, as Mitsuba's `blendbsdf` does.
Different from what was solved: MaterialX's renderers shadow with the height-correlated Smith term and give back the
energy of multiple scattering, so rough speculars come out a few percent brighter.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

from factorlib.results.materials import Reflectance
from factorlib.wholefile import write_text


def write_materialx(path: str | Path, materials: Mapping[str, Reflectance]) -> None:
    """Write one `surfacematerial` per material, under its own name."""
    document = ET.Element("materialx", version="1.39", colorspace="lin_rec709")
    for name, material in materials.items():
        _add_material(document, f"m_{name.replace('-', '_')}", name, material)
    ET.indent(document, " ")
    write_text(path, '<?xml version="1.0"?>\n' + ET.tostring(document, encoding="unicode") + "\n")


def _add_material(document: ET.Element, prefix: str, name: str, material: Reflectance) -> None:
    weight = max(material.specular) / material.total if material.total > 0 else 0.0
    diffuse = [v / (1 - weight) if weight < 1 else 0.0 for v in material.diffuse]
    specular = [v / weight if weight > 0 else 0.0 for v in material.specular]
    _add(document, "oren_nayar_diffuse_bsdf", f"{prefix}_diffuse", "BSDF", color=diffuse, roughness=0.0)
    schlick = _add(document, "generalized_schlick_bsdf", f"{prefix}_specular", "BSDF", color0=specular, color90=specular)
    _input(schlick, "roughness", "vector2", value=f"{material.alpha!r}, {material.alpha!r}")
    _input(schlick, "scatter_mode", "string", value="R")
    mix = _add(document, "mix", f"{prefix}_bsdf", "BSDF", mix=weight)
    _input(mix, "fg", "BSDF", nodename=f"{prefix}_specular")
    _input(mix, "bg", "BSDF", nodename=f"{prefix}_diffuse")
    _input(_add(document, "surface", f"{prefix}_surface", "surfaceshader"), "bsdf", "BSDF", nodename=f"{prefix}_bsdf")
    shader = _add(document, "surfacematerial", prefix, "material")
    shader.set("uiname", name)
    _input(shader, "surfaceshader", "surfaceshader", nodename=f"{prefix}_surface")


def _add(document: ET.Element, category: str, name: str, kind: str, **inputs: float | list[float]) -> ET.Element:
    node = ET.SubElement(document, category, name=name, type=kind)
    for key, value in inputs.items():
        if isinstance(value, float):
            _input(node, key, "float", value=repr(value))
        else:
            _input(node, key, "color3", value=", ".join(repr(float(v)) for v in value))
    return node


def _input(node: ET.Element, name: str, kind: str, **source: str) -> None:
    ET.SubElement(node, "input", name=name, type=kind, **source)
