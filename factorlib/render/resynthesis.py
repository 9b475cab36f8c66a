"""What was solved, as the reflection operator shows it: a photo again, on the normals and views of its aligned meshes, and balls.

A ball is seen from the front, orthographically: every normal that faces the viewer, once; the same picture is a reflectance map.
Frame: the photo's camera (x right, y down, z forward); a ball's view is (0, 0, −1).
"""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_closing
from scipy.spatial import cKDTree

from factorlib.conventions import FRONT
from factorlib.dataset.schema import LightSlice
from factorlib.geometry.sphere import ball_normals, fibonacci_sphere
from factorlib.light.lobes import Lobes
from factorlib.reflection.operator import MaterialLike
from factorlib.render.reflect import Reflector, Report, Shadows, silently
from factorlib.results.lobes import read_lobes
from factorlib.results.materials import read_exposures
from factorlib.urm.observations import Observations

log = logging.getLogger("factorlib.render")
Channels = Mapping[str, Float[np.ndarray, "h w"]]
GAP = 6  # cells: the widest gap between observed normals that counts as observed


def light_of(exported: Path, photo: str, light: LightSlice) -> Lobes:
    """The light of a photo as pictures are made in it: lobes in the photo's own camera axes, its exposure included.

    exported: the folder of `export`'s result, whose gauge the light is in
    """
    lobes = read_lobes(exported / "lobes.parquet")[light.illumination]
    if len(lobes) == 0:
        log.warning("%s: nothing is known of its light: its pictures are black", photo)
    if light.world_from_camera is not None:
        lobes = lobes.turned(np.array(light.world_from_camera).T)
    return lobes.scaled(np.array(read_exposures(exported / "exposures.json").get(photo, 1.0)))


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
        shadows, sent, place = (None,) * 3 if around is None else around_pixels(around, k - 1, *np.nonzero(pixels))
        detail = geometry["detail"][pixels].astype(float) if "detail" in geometry else np.ones(len(unit[0]))
        shown = reflector(material, unit[0], unit[1], of_all, shadows, place, detail)
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
) -> tuple[Shadows | None, Float[np.ndarray, "n 6"] | None, Float[np.ndarray, "n 3"] | None]:
    """Return what pixels of a material see and are sent, and where they lie: as the nearest observed pixel of it; None for all, nothing, the middle."""
    rows = np.flatnonzero(around.seen.material == material)
    of = around.seen.take(rows)
    if len(of) == 0 or len(x) == 0:
        return None, None, None
    nearest = cKDTree(np.column_stack([of.x, of.y])).query(np.column_stack([x, y]))[1]
    sent = None if around.sent is None else around.sent[rows[nearest]]
    place = None if of.place is None else of.place[nearest]
    if of.visibility is None:
        return None, sent, place
    return Shadows(of.visibility, fibonacci_sphere(of.visibility.shape[1]), nearest), sent, place


def ball(reflector: Reflector, material: MaterialLike, size: int) -> Float[np.ndarray, "size size 3"]:
    """Radiance; zero beside the ball."""
    normals, inside = ball_normals(size)
    normals = normals * (1, -1, -1)  # in the camera's frame
    picture = np.zeros((size, size, 3))
    picture[inside] = reflector(material, normals, np.broadcast_to(FRONT, normals.shape))
    return picture


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
