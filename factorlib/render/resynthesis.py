"""A photo synthesised again from what was solved: light and materials, on the normals and views of its aligned meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.render.reflect import Reflector, Shadows
from factorlib.urm.observations import Observations

Channels = Mapping[str, Float[np.ndarray, "h w"]]
Report = Callable[[float, float], None]


class Surroundings(msgspec.Struct, frozen=True):
    """What a photo's n observations have of the light (their visibility) and of the surfaces that hide it.

    sent    G_d and G_s of `factorlib.model.interreflection`, in the unit of the picture over the factor of the materials' gauge; None: nothing
    """

    seen: Observations
    sent: Float[np.ndarray, "n 6"] | None = None


def resynthesised(
    reflector: Reflector,
    materials: Sequence,
    photo: Channels,
    geometry: Channels,
    report: Report = lambda done, total: None,
    around: Surroundings | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """Linear radiance; zero outside the mask, and where no mesh lies under it.

    materials: label k is materials[k − 1];  photo: channel label;  geometry: channels normal.x/y/z, view.x/y/z
    around:    shadows the picture, and lights what is in shadow
    """
    label = np.rint(photo["label"]).astype(int)
    normal, view = (np.stack([geometry[f"{kind}.{a}"] for a in "xyz"], axis=-1) for kind in ("normal", "view"))
    label[~(np.abs(normal).max(axis=-1) > 0)] = 0
    picture, total, before = np.zeros((*label.shape, 3)), int((label > 0).sum()), 0
    for k, material in enumerate(materials, start=1):
        pixels = label == k
        unit_normal, unit_view = _unit(normal[pixels]), _unit(view[pixels])
        shadows, sent = (None, None) if around is None else around_pixels(around, k - 1, *np.nonzero(pixels))
        shown = reflector(material, unit_normal, unit_view, _onward(report, before, total), shadows)
        if sent is not None:
            bounced = np.array(material.diffuse) * sent[:, :3] + np.array(material.specular) * sent[:, 3:]
            shown += bounced * (np.sum(unit_normal * unit_view, 1, keepdims=True) > 0)
        picture[pixels] = shown
        before += int(pixels.sum())
    return picture


def around_pixels(
    around: Surroundings, material: int, y: Int[np.ndarray, " n"], x: Int[np.ndarray, " n"]
) -> tuple[Shadows | None, Float[np.ndarray, "n 6"] | None]:
    """What pixels of a material see and are sent: what the nearest observed pixel of it is; None for all and for nothing."""
    rows = np.flatnonzero(around.seen.material == material)
    of = around.seen.take(rows)
    if of.visibility is None or len(of) == 0 or len(x) == 0:
        return None, None
    nearest = cKDTree(np.column_stack([of.x, of.y])).query(np.column_stack([x, y]))[1]
    sent = None if around.sent is None else around.sent[rows[nearest]]
    return Shadows(of.visibility, fibonacci_sphere(of.visibility.shape[1]), nearest), sent


def _onward(report: Report, before: int, total: int) -> Report:
    """Of the whole picture, from a material's own count."""
    return lambda done, _: report(before + done, total)


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    vectors = np.asarray(vectors, dtype=float)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
