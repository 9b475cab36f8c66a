"""A photo synthesised again from what was solved: light and materials, on the normals and views of its aligned meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.render.reflect import Reflector, Shadows
from factorlib.urm.observations import Observations

Channels = Mapping[str, Float[np.ndarray, "h w"]]
Report = Callable[[float, float], None]


def resynthesised(
    reflector: Reflector,
    materials: Sequence,
    photo: Channels,
    geometry: Channels,
    report: Report = lambda done, total: None,
    seen: Observations | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """Linear radiance; zero outside the mask, and where no mesh lies under it.

    materials: label k is materials[k − 1];  photo: channel label;  geometry: channels normal.x/y/z, view.x/y/z
    seen:      the photo's observations, where their visibility shadows the picture
    """
    label = np.rint(photo["label"]).astype(int)
    normal, view = (np.stack([geometry[f"{kind}.{a}"] for a in "xyz"], axis=-1) for kind in ("normal", "view"))
    label[~(np.abs(normal).max(axis=-1) > 0)] = 0
    picture, total, before = np.zeros((*label.shape, 3)), int((label > 0).sum()), 0
    for k, material in enumerate(materials, start=1):
        pixels = label == k
        shadows = None if seen is None else shadows_at(seen, k - 1, *np.nonzero(pixels))
        picture[pixels] = reflector(material, _unit(normal[pixels]), _unit(view[pixels]), _onward(report, before, total), shadows)
        before += int(pixels.sum())
    return picture


def shadows_at(seen: Observations, material: int, y: Int[np.ndarray, " n"], x: Int[np.ndarray, " n"]) -> Shadows | None:
    """What pixels of a material see: what the nearest observed pixel of it does; None where that is everything."""
    of = seen.take(seen.material == material)
    if of.visibility is None or len(of) == 0 or len(x) == 0:
        return None
    nearest = cKDTree(np.column_stack([of.x, of.y])).query(np.column_stack([x, y]))[1]
    return Shadows(of.visibility, fibonacci_sphere(of.visibility.shape[1]), nearest)


def _onward(report: Report, before: int, total: int) -> Report:
    """Of the whole picture, from a material's own count."""
    return lambda done, _: report(before + done, total)


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    vectors = np.asarray(vectors, dtype=float)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
