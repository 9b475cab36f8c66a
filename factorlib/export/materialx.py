"""Export of materials as MaterialX 1.39: nodes of its physically based shading library, and its standard surface.

k_d/π is `oren_nayar_diffuse_bsdf` of roughness 0, exactly.  k_s D G/(4 …) is `generalized_schlick_bsdf` with color0 =
color90 = k_s/w: GGX of the same α and no Fresnel.  A `mix` of weight w adds them, as Mitsuba's `blendbsdf` does.

Programs without these nodes use `standard_surface`.  Its specular layer is a dielectric.  At a very large index of
refraction its Fresnel term is nearly one at every angle, and it leaves 1 − specular for the diffuse part.  The values
are

    specular = max k_s,  specular_color = k_s / max k_s,  specular_IOR = 10⁴,  base_color = k_d / (1 − max k_s)

MaterialX's renderers differ from the solved model.  They shadow with the height-correlated Smith term and compensate
for the energy of multiple scattering (measured by `factorlib.export.other_renderers`).
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

from factorlib.results.materials import Reflectance

NO_FRESNEL = 1e4  # index of refraction: F0 = 0.9996


def materialx(materials: Mapping[str, Reflectance]) -> str:
    """Return a document with two `surfacematerial` per material: m_<name> and m_<name>_standard_surface.

    The second is for programs without the nodes of the first.
    """
    document = ET.Element("materialx", version="1.39", colorspace="lin_rec709")
    for name, material in materials.items():
        prefix = f"m_{name.replace('-', '_')}"
        for add_shader, end, title in (
            (_add_nodes, "", name),
            (_add_standard, "_standard_surface", f"{name}, standard surface"),
        ):
            add_shader(document, prefix + end, material)
            shader = _add(document, "surfacematerial", prefix + end, "material")
            shader.set("uiname", title)
            _input(shader, "surfaceshader", "surfaceshader", nodename=f"{prefix}{end}_surface")
    ET.indent(document, " ")
    return '<?xml version="1.0"?>\n' + ET.tostring(document, encoding="unicode") + "\n"


def _add_nodes(document: ET.Element, prefix: str, material: Reflectance) -> None:
    weight, diffuse, specular = material.mixture
    _add(document, "oren_nayar_diffuse_bsdf", f"{prefix}_diffuse", "BSDF", color=diffuse, roughness=0.0)
    colours = {"color0": specular, "color90": specular}
    schlick = _add(document, "generalized_schlick_bsdf", f"{prefix}_specular", "BSDF", **colours)
    _input(schlick, "roughness", "vector2", value=f"{material.alpha!r}, {material.alpha!r}")
    _input(schlick, "scatter_mode", "string", value="R")
    mix = _add(document, "mix", f"{prefix}_bsdf", "BSDF", mix=weight)
    _input(mix, "fg", "BSDF", nodename=f"{prefix}_specular")
    _input(mix, "bg", "BSDF", nodename=f"{prefix}_diffuse")
    _input(_add(document, "surface", f"{prefix}_surface", "surfaceshader"), "bsdf", "BSDF", nodename=f"{prefix}_bsdf")


def _add_standard(document: ET.Element, prefix: str, material: Reflectance) -> None:
    brightest = max(material.specular)
    base = [value / (1 - brightest) for value in material.diffuse]
    tint = [value / (brightest or 1) for value in material.specular]
    numbers = {"specular": brightest, "specular_roughness": material.roughness, "specular_IOR": NO_FRESNEL}
    colours = {"base_color": base, "specular_color": tint}
    _add(document, "standard_surface", f"{prefix}_surface", "surfaceshader", base=1.0, **colours, **numbers)


def _add(document: ET.Element, category: str, name: str, kind: str, **inputs: float | Sequence[float]) -> ET.Element:
    node = ET.SubElement(document, category, name=name, type=kind)
    for key, value in inputs.items():
        if isinstance(value, Sequence):
            _input(node, key, "color3", value=", ".join(repr(float(v)) for v in value))
        else:
            _input(node, key, "float", value=repr(float(value)))
    return node


def _input(node: ET.Element, name: str, kind: str, **source: str) -> None:
    ET.SubElement(node, "input", {"name": name, "type": kind, **source})
