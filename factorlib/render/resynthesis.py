"""What was solved, as the reflection operator shows it: a photo again, on the normals and views of its aligned meshes, and balls.

A ball is seen from the front, orthographically: every normal that faces the viewer, once; the same picture is a reflectance map.
Frame: the photo's camera (x right, y down, z forward); a ball's view is (0, 0, −1).
"""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import binary_closing
from scipy.spatial import cKDTree

from factorlib.conventions import FRONT
from factorlib.geometry.sphere import ball_normals
from factorlib.reflection.operator import MaterialLike
from factorlib.render.reflect import Reflector, Report, silently
from factorlib.urm.observations import Observations

Channels = Mapping[str, Float[np.ndarray, "h w"]]
STEP = 0.55  # between nodes on a ball, in α
LONGEST_STEP = 0.1  # radians
NARROW = 1000.0  # sharpness of lobes whose highlights a spline does not follow
RIM = np.pi / 2 - 1e-3  # radians: the largest θ, where a surface is still seen
MARGIN = 4  # nodes beyond an end
GAP = 6  # cells: the widest gap between observed normals that counts as observed


class Surroundings(msgspec.Struct, frozen=True):
    """What a photo's n observations have of the light (their visibility) and of the surfaces that hide it.

    sent    G_d and G_s of `factorlib.inference.interreflection`, in the unit of the picture over the factor of the materials' gauge; None: nothing
    """

    seen: Observations
    sent: Float[np.ndarray, "n 6"] | None = None


def resynthesised(
    reflector: Reflector,
    materials: Sequence[MaterialLike],
    photo: Channels,
    geometry: Channels,
    report: Report = silently,
    around: Surroundings | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """Linear radiance; zero outside the mask, and where no mesh lies under it.

    materials: label k is materials[k − 1];  photo: channel label;  geometry: channels normal.x/y/z, view.x/y/z, and detail, where diffuse reflectance has some
    around:    shadows the picture, and lights what is in shadow
    """
    label = np.rint(photo["label"]).astype(int)
    normal, view = (np.stack([geometry[f"{kind}.{a}"] for a in "xyz"], axis=-1) for kind in ("normal", "view"))
    label[~(np.abs(normal).max(axis=-1) > 0)] = 0
    picture, total, before = np.zeros((*label.shape, 3)), int((label > 0).sum()), 0

    def of_all(done: float, _: float) -> None:
        report(before + done, total)

    for k, material in enumerate(materials, start=1):
        pixels = label == k
        unit = [of[pixels].astype(float) for of in (normal, view)]
        unit = [of / np.linalg.norm(of, axis=-1, keepdims=True) for of in unit]
        visibility, sent, place = (None,) * 3 if around is None else around_pixels(around, k - 1, *np.nonzero(pixels))
        detail = geometry["detail"][pixels].astype(float) if "detail" in geometry else np.ones(len(unit[0]))
        shown = reflector(material, unit[0], unit[1], of_all, visibility, place, detail)
        if sent is not None:
            bounced = (
                np.array(material.diffuse) * detail[:, None] * sent[:, :3] + np.array(material.specular) * sent[:, 3:]
            )
            shown += bounced * (np.sum(unit[0] * unit[1], 1, keepdims=True) > 0)
        picture[pixels] = shown
        before += int(pixels.sum())
    return picture


def around_pixels(
    around: Surroundings, material: int, y: Int[np.ndarray, " n"], x: Int[np.ndarray, " n"]
) -> tuple[UInt8[np.ndarray, "n k"] | None, Float[np.ndarray, "n 6"] | None, Float[np.ndarray, "n 3"] | None]:
    """Return what pixels of a material see and are sent, and where they lie: as the nearest observed pixel of it; None for all, nothing, the middle."""
    rows = np.flatnonzero(around.seen.material == material)
    of = around.seen.take(rows)
    if len(of) == 0 or len(x) == 0:
        return None, None, None
    nearest = cKDTree(np.column_stack([of.x, of.y])).query(np.column_stack([x, y]))[1]
    sent = None if around.sent is None else around.sent[rows[nearest]]
    place = None if of.place is None else of.place[nearest]
    return None if of.visibility is None else of.visibility[nearest], sent, place


def balls(reflector: Reflector, material: MaterialLike, sizes: Sequence[int]) -> list[Float[np.ndarray, "size size 3"]]:
    """Radiance of balls of several sizes, in pixels across, which share what is computed; zero beside a ball."""
    shapes = [ball_normals(size) for size in sizes]
    normals = np.concatenate([own for own, _ in shapes]) * (1, -1, -1)  # in the camera's frame
    radiance = front_radiance(reflector, material, normals)
    pictures = []
    for _, inside in shapes:
        pictures.append(np.zeros((*inside.shape, 3)))
        pictures[-1][inside], radiance = np.split(radiance, [inside.sum()])
    return pictures


def front_radiance(
    reflector: Reflector, material: MaterialLike, normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Interpolate the radiance toward the viewer, a smooth function of the normal alone, by cubic splines.

    The nodes, in the angle θ from the viewer and the azimuth φ, lie STEP widths α of a highlight apart: the error falls as their fourth power.
    Lobes narrower than NARROW, and normals fewer than the nodes, are left to the operator.
    """
    step = np.clip(STEP * float(material.roughness) ** 2, 1e-3, LONGEST_STEP)
    rings = int(np.ceil(np.pi / 2 / step))
    if 4 * rings**2 >= len(normals):
        return reflector(material, normals, np.broadcast_to(FRONT, normals.shape))
    narrow = reflector.lobes.sharpness > NARROW
    wide, sharp = (Reflector(reflector.operator, reflector.lobes.take(of)) for of in (~narrow, narrow))
    # nodes: θ = h/2, 3h/2, …, π/2, and φ = 0 … 2π
    theta = (np.arange(rings) + 0.5) / (rings - 0.5) * RIM
    phi = np.arange(4 * rings) * (np.pi / 2 / rings)
    sin, cos = np.sin(theta)[:, None], np.cos(theta)[:, None]
    nodes = np.stack(np.broadcast_arrays(sin * np.cos(phi), sin * np.sin(phi), -cos), axis=-1)
    values = wide(material, nodes.reshape(-1, 3), np.broadcast_to(FRONT, (nodes.size // 3, 3))).reshape(nodes.shape)
    # beyond the pole lies θ < 0 at φ + π, beyond φ = 2π the beginning
    across = np.roll(values[MARGIN - 1 :: -1], 2 * rings, axis=1)
    values = np.pad(np.concatenate([across, values]), ((0, 0), (MARGIN, MARGIN), (0, 0)), mode="wrap")
    theta = np.concatenate([-theta[MARGIN - 1 :: -1], theta])
    phi = np.arange(-MARGIN, 4 * rings + MARGIN) * (np.pi / 2 / rings)
    at = np.arccos(-normals[:, 2]), np.arctan2(normals[:, 1], normals[:, 0]) % (2 * np.pi)
    splines = [RectBivariateSpline(theta, phi, channel, s=0) for channel in np.moveaxis(values, -1, 0)]
    smooth = np.stack([spline.ev(*at) for spline in splines], axis=-1).clip(0)
    return smooth + sharp(material, normals, np.broadcast_to(FRONT, normals.shape))


def observed_cells(normals: Float[np.ndarray, "n 3"], size: int) -> Bool[np.ndarray, "size size"]:
    """Pixels of a ball where a normal was seen; gaps as wide as the spacing of so few normals are closed."""
    cells = np.zeros((size, size), bool)
    if len(normals) == 0:
        return cells
    column, row = (np.clip(((normals[:, k] + 1) / 2 * size).astype(int), 0, size - 1) for k in (0, 1))
    cells[row, column] = True
    gap = int(np.clip(np.ceil(size / np.sqrt(len(normals))), 1, GAP))
    closed = binary_closing(np.pad(cells, gap), np.ones((3, 3)), iterations=gap)[gap:-gap, gap:-gap]
    return closed & ball_normals(size)[1]
