"""Export of materials as MaterialX 1.39: nodes of its physically based shading library, and its standard surface.

k_d/π is `oren_nayar_diffuse_bsdf` of roughness 0, exactly.  k_s D G/(4 …) is `generalized_schlick_bsdf` with color0 =
color90 = k_s/w: GGX of the same α and no Fresnel.  A `mix` of weight w adds them, as Mitsuba's `blendbsdf` does.

Programs without these nodes use `standard_surface`.  Its specular layer is a dielectric.  At a very large index of
refraction its Fresnel term is nearly one at every angle, and it leaves 1 − specular for the diffuse part.  The values
are

    specular = max k_s,  specular_color = k_s / max k_s,  specular_IOR = 10⁴,  base_color = k_d / (1 − max k_s)

A painted part of a mesh has two materials more, m_<material>__<mesh>, whose diffuse colour is the mesh's image of k_d
(sRGB, by the texture coordinates `st`) in place of the constant.

MaterialX's renderers differ from the solved model.  They shadow with the height-correlated Smith term and compensate
for the energy of multiple scattering.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath

from factorlib.results.materials import Reflectance

NO_FRESNEL = 1e4  # index of refraction: F0 = 0.9996


def materialx(materials: Mapping[str, Reflectance], images: Mapping[str, Sequence[str]] = {}) -> str:
    """Return a document with two `surfacematerial` per material: m_<name> and m_<name>_standard_surface.

    The second is for programs without the nodes of the first.  Images of painted parts have two materials each as well.

    Args:
        materials: reflectances by name
        images: materials of a mesh's painted parts, by the file of its image of k_d, relative to the document
    """
    document = ET.Element("materialx", version="1.39", colorspace="lin_rec709")
    looks: list[tuple[str, str, str | None]] = [(name, name, None) for name in materials]
    looks += [(f"{name}__{PurePosixPath(file).stem}", name, file) for file, names in images.items() for name in names]
    for title, name, file in looks:
        prefix = f"m_{title.replace('-', '_').replace('.', '_')}"
        if file:
            image = _add(document, "image", f"{prefix}_image", "color3")
            ET.SubElement(image, "input", name="file", type="filename", value=file, colorspace="srgb_texture")
        for add_shader, end, uiname in (
            (_add_nodes, "", title),
            (_add_standard, "_standard_surface", f"{title}, standard surface"),
        ):
            add_shader(document, prefix + end, materials[name], f"{prefix}_image" if file else None)
            shader = _add(document, "surfacematerial", prefix + end, "material")
            shader.set("uiname", uiname)
            _input(shader, "surfaceshader", "surfaceshader", nodename=f"{prefix}{end}_surface")
    ET.indent(document, " ")
    return '<?xml version="1.0"?>\n' + ET.tostring(document, encoding="unicode") + "\n"


def _add_nodes(document: ET.Element, prefix: str, material: Reflectance, image: str | None) -> None:
    weight, diffuse, specular = material.mixture
    lambertian = _add(document, "oren_nayar_diffuse_bsdf", f"{prefix}_diffuse", "BSDF", color=diffuse, roughness=0.0)
    if image:
        _connect(document, lambertian, "color", image, 1 - weight)
    colours = {"color0": specular, "color90": specular}
    schlick = _add(document, "generalized_schlick_bsdf", f"{prefix}_specular", "BSDF", **colours)
    _input(schlick, "roughness", "vector2", value=f"{material.alpha!r}, {material.alpha!r}")
    _input(schlick, "scatter_mode", "string", value="R")
    mix = _add(document, "mix", f"{prefix}_bsdf", "BSDF", mix=weight)
    _input(mix, "fg", "BSDF", nodename=f"{prefix}_specular")
    _input(mix, "bg", "BSDF", nodename=f"{prefix}_diffuse")
    _input(_add(document, "surface", f"{prefix}_surface", "surfaceshader"), "bsdf", "BSDF", nodename=f"{prefix}_bsdf")


def _add_standard(document: ET.Element, prefix: str, material: Reflectance, image: str | None) -> None:
    brightest = max(material.specular)
    base = [value / (1 - brightest) for value in material.diffuse]
    tint = [value / (brightest or 1) for value in material.specular]
    numbers = {"specular": brightest, "specular_roughness": material.roughness, "specular_IOR": NO_FRESNEL}
    colours = {"base_color": base, "specular_color": tint}
    surface = _add(document, "standard_surface", f"{prefix}_surface", "surfaceshader", base=1.0, **colours, **numbers)
    if image:
        _connect(document, surface, "base_color", image, 1 - brightest)


def _connect(document: ET.Element, node: ET.Element, key: str, image: str, share: float) -> None:
    """Replace a constant k_d / share of a node by the image of k_d over the share."""
    scaled = _add(document, "multiply", f"{node.get('name')}_{key}", "color3")
    _input(scaled, "in1", "color3", nodename=image)
    _input(scaled, "in2", "float", value=repr(1 / share if share > 0 else 0.0))
    (constant,) = (each for each in node if each.get("name") == key)
    del constant.attrib["value"]
    constant.set("nodename", str(scaled.get("name")))


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
