"""Materials of one's own: a JSON file like materials.json, of which only the reflectances are read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec

from factorlib.errors import InputError
from factorlib.reading import read_text, reading

MOST_REFLECTED = 0.999  # max diffuse + max specular: a surface that reflects more than arrives never comes to rest with light between surfaces
CURE = 'write {"materials": {"gold": {"diffuse": [r, g, b], "specular": [r, g, b], "roughness": 0.2}}}, numbers from 0 to 1'

Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Colour = tuple[Share, Share, Share]


class OwnMaterial(msgspec.Struct, frozen=True):
    """Lambert k_d and GGX k_s per channel (linear Rec. 709), and roughness with α = roughness²; what else the file says is passed over."""

    diffuse: Colour
    specular: Colour
    roughness: Share


def read_table(path: Path) -> dict[str, OwnMaterial]:
    """By name; InputError for a file that is no such table, or has a material that reflects more light than arrives."""
    text = read_text(path, "a table of materials")
    with reading("a table of materials", path, cure=CURE):
        content = msgspec.json.decode(text)
    materials = content.get("materials") if isinstance(content, dict) else None
    if not isinstance(materials, dict) or not materials:
        raise InputError("it holds no materials", file=path, key="materials", cure=CURE)
    return {name: _material(name, entry, path) for name, entry in materials.items()}


def _material(name: str, entry: Any, path: Path) -> OwnMaterial:
    try:
        material = msgspec.convert(entry, OwnMaterial)
    except msgspec.ValidationError as error:
        raise InputError(str(error), file=path, key=f"materials.{name}", cure=CURE) from None
    total = max(material.diffuse) + max(material.specular)
    if total > MOST_REFLECTED:
        found = f"max diffuse + max specular = {total:.3f}: more light is reflected than arrives"
        raise InputError(found, file=path, key=f"materials.{name}", cure=f"at most {MOST_REFLECTED}")
    return material
