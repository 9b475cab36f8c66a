"""Radiance by the reflection operator: surface points in a light of many lobes, a photo again, and balls.

Occlusion scales each lobe by the share that a point sees (`factorlib.light.visibility`), for the diffuse part each
channel of all lobes, whose share is a mean of theirs.  A light of finite distance
changes angles and weights for points away from the middle (`factorlib.light.distance`).  Both are as in the solve.

A photo is rendered on the normals and views of its aligned meshes.  A ball is seen from the front, orthographically: it
shows every normal that faces the viewer once.  The same picture is a reflectance map.  Frame: the photo's camera (x
right, y down, z forward); a ball's view is (0, 0, −1).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.interpolate import RectBivariateSpline
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from factorlib.conventions import FRONT
from factorlib.geometry.sphere import ball_normals, fibonacci_sphere
from factorlib.images.exr import read_exr
from factorlib.images.tone import apply_tone
from factorlib.inference.model.interreflection import bounced_light
from factorlib.light.distance import finite_distance_cosines
from factorlib.light.lobes import Lobes, lobe_energy
from factorlib.light.visibility import cosine_weights, highlight_weights, kernel, visible_share, widened_sharpness
from factorlib.reflection import Operator
from factorlib.results.materials import Model, Reflectance
from factorlib.urm.extract import with_surface_normals
from factorlib.urm.observations import Observations, read_observations

PAIRS_AT_ONCE = 1 << 18  # pairs of a point and a lobe in one batch

Report = Callable[[float, float], None]  # points done, their total


def silently(done: float, total: float) -> None:
    """Ignore a progress report."""


class PointEffects(msgspec.Struct, frozen=True):
    """Effects that differ between points of a surface; None where a model has none.

    Attributes:
        visibility: visibility of the directions of `fibonacci_sphere(k)`, 0 hidden to 255 visible; None is all visible
        place: position relative to the middle, as `factorlib.light.distance` takes it; None is the middle
    """

    visibility: UInt8[np.ndarray, "n k"] | None = None
    place: Float[np.ndarray, "n 3"] | None = None


class Reflector:
    """One light, reflected by any number of materials and points.

    The lobes are in the frame of the normals and views.
    """

    def __init__(self, operator: Operator, lobes: Lobes, curvature: float = 0.0):
        self.operator = operator
        self.curvature = curvature
        self.lobes = lobes.take(lobes.weight.max(axis=1) > 0)
        self.axis = self._tensor(self.lobes.axis)
        self.weight = self._tensor(self.lobes.weight)
        self.sharpness = self._tensor(self.lobes.sharpness)

    def __call__(
        self,
        material: Reflectance,
        normals: Float[np.ndarray, "n 3"],
        views: Float[np.ndarray, "n 3"],
        report: Report = silently,
        effects: PointEffects = PointEffects(),
    ) -> Float[np.ndarray, "n 3"]:
        """Return the radiance that points reflect toward the viewer, the sum of `parts`."""
        diffuse, specular = self.parts(material, normals, views, report, effects)
        return diffuse + specular

    def parts(
        self,
        material: Reflectance,
        normals: Float[np.ndarray, "n 3"],
        views: Float[np.ndarray, "n 3"],
        report: Report = silently,
        effects: PointEffects = PointEffects(),
    ) -> Float[np.ndarray, "2 n 3"]:
        """Return the diffuse and the specular radiance of points; float64, zero where a normal faces away.

        Args:
            material: diffuse and specular reflectance, and roughness
            normals: unit normals
            views: unit directions toward the viewer
            report: receives the number of points done and their total
            effects: visibility and position of the points
        """
        result = np.zeros((2, len(normals), 3))
        step = max(1, PAIRS_AT_ONCE // max(len(self.sharpness), 1))
        optional = msgspec.structs.astuple(effects)
        with torch.no_grad():
            for i in range(0, len(normals) if len(self.sharpness) else 0, step):
                rows = slice(i, i + step)
                tensors = (None if values is None else self._tensor(values[rows]) for values in optional)
                radiance = self._radiance(material, self._tensor(normals[rows]), self._tensor(views[rows]), *tensors)
                result[:, rows] = radiance.double().numpy()
                report(min(i + step, len(normals)), len(normals))
        return result

    def _sampled(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return k directions, widened lobes there [k, p], and the light there over its largest value [k, 3]."""
        directions = torch.from_numpy(fibonacci_sphere(count)).float()
        lobes = kernel(directions, self.axis.float(), self.sharpness.float())
        wide = widened_sharpness(self.sharpness.double(), count).numpy()
        factor = lobe_energy(self.lobes.sharpness) / lobe_energy(wide)
        light = lobes @ torch.from_numpy(self.lobes.weight * factor[:, None]).float()
        return directions, lobes, light / light.amax(0).clamp_min(1e-30)

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(np.require(values, requirements=["C", "W"]), dtype=self.operator.dtype)

    def _radiance(
        self,
        material: Reflectance,
        normals: Float[Tensor, "n 3"],
        views: Float[Tensor, "n 3"],
        visibility: Float[Tensor, "n k"] | None,
        place: Float[Tensor, "n 3"] | None,
    ) -> Float[Tensor, "2 n 3"]:
        parts = material.diffuse, material.specular, material.roughness
        kd, ks, roughness = (torch.tensor(part, dtype=self.operator.dtype) for part in parts)
        # cosines n·o per point, n·z and o·z per point and lobe; shares of each lobe that a point receives
        no = (normals * views).sum(-1)
        nz = (normals @ self.axis.T).clamp(-1, 1)
        oz = (views @ self.axis.T).clamp(-1, 1)
        larger: float | Tensor = 1.0
        if place is not None and self.curvature > 0:
            nz, oz, larger = finite_distance_cosines(place, normals, views, self.axis, self.curvature)
        # diffuse and specular part, summed over lobes; the shadow of the diffuse one is a share of each channel
        diffuse = kd * ((larger * self.operator.diffuse(self.sharpness, nz)) @ self.weight)
        specular = torch.zeros_like(diffuse)
        if visibility is not None:
            directions, lobes, light = self._sampled(visibility.shape[1])
            visible = visibility.float() / 255
            diffuse *= visible_share(visible, cosine_weights(normals.float(), directions), light)
            weights = highlight_weights(normals.float(), views.float(), directions, float(roughness))
            larger = larger * visible_share(visible, weights, lobes).to(self.operator.dtype)
        if bool(ks.any()):
            specular = ks * ((larger * self.operator.specular(roughness, self.sharpness, no, nz, oz)) @ self.weight)
        return torch.stack([diffuse, specular]) * (no[:, None] > 0)


Channels = Mapping[str, Float[np.ndarray, "h w"]]
GRID = 3  # spacing of the pixels that are evaluated on smooth surfaces
# Largest differences of normals there, in α: between four nodes, and from their interpolation.
LARGEST_SPREAD = 0.5
LARGEST_ERROR = 0.1
STEP = 0.55  # spacing of nodes on a ball, in α
LONGEST_STEP = 0.1  # largest spacing of nodes, radians
NARROW = 1000.0  # sharpness above which a spline does not follow a lobe's highlight
RIM = np.pi / 2 - 1e-3  # largest θ of a node, radians: the surface is still visible there
MARGIN = 4  # periodic nodes beyond each end
SHADING = [f"{part}.{channel}" for part in ("diffuse", "specular") for channel in "RGB"]  # channels of `shading`


class Surroundings(msgspec.Struct, frozen=True):
    """Visibility, position and bounced radiance of a photo's n observations.

    Attributes:
        observations: the observations, with their visibility
        bounced: G_d and G_s of `factorlib.inference.model.interreflection`, in the unit of the picture; None is zero
    """

    observations: Observations
    bounced: Float[np.ndarray, "n 6"] | None = None


def read_surroundings(folders: Mapping[str, Path], photo: str, model: Model) -> Surroundings | None:
    """Read visibility, bounced radiance and positions of a photo's observations; None if the model uses none.

    Args:
        folders: folders of the stages `urm` and, if there is one, `surface`
        photo: name of the photo
        model: effects that the solve included
    """
    if not (model.self_shadowing or model.distance):
        return None
    table = with_surface_normals(read_observations(folders["urm"] / f"{photo}.parquet"), folders.get("surface"))
    if not model.self_shadowing:
        table = msgspec.structs.replace(table, visibility=None, occluder=None)
    return Surroundings(table, bounced_light(table, table.radiance.astype(float)) if model.interreflection else None)


def resynthesise(
    reflector: Reflector,
    materials: Sequence[Reflectance],
    photo: Channels,
    geometry: Channels,
    report: Report = silently,
    surroundings: Surroundings | None = None,
) -> Float[np.ndarray, "2 h w 3"]:
    """Return the photo's diffuse and specular radiance; zero outside the mask and where no mesh lies under it.

    Args:
        reflector: the light
        materials: label k is materials[k − 1]
        photo: channel label
        geometry: channels normal.x/y/z and view.x/y/z
        report: receives the number of pixels done and their total
        surroundings: occlusion and bounces; None for neither
    """
    label = np.rint(photo["label"]).astype(int)
    normal, view = (np.stack([geometry[f"{kind}.{a}"] for a in "xyz"], axis=-1) for kind in ("normal", "view"))
    label[~(np.abs(normal).max(axis=-1) > 0)] = 0
    pictures = np.zeros((2, *label.shape, 3))
    total = int((label > 0).sum())
    before = 0

    def report_pixels(done: float, _: float) -> None:
        """Report progress over all materials."""
        report(before + done, total)

    for k, material in enumerate(materials, start=1):
        pixels = label == k
        normals, views = (_unit(vectors[pixels].astype(float)) for vectors in (normal, view))
        visibility, bounced, place = nearest_surroundings(surroundings, k - 1, *np.nonzero(pixels))
        nodes, weights = interpolation_nodes(pixels, normals, views, material.roughness**2)
        effects = PointEffects(*(None if values is None else values[nodes] for values in (visibility, place)))
        at_nodes = reflector.parts(material, normals[nodes], views[nodes], report_pixels, effects)
        radiance = np.stack([weights @ part for part in at_nodes])
        if bounced is not None:
            facing = np.sum(normals * views, 1, keepdims=True) > 0
            radiance += reflect_bounces(material, bounced) * facing
        pictures[:, pixels] = radiance
        before += int(pixels.sum())
        report_pixels(0, 0)
    return pictures


def read_shading(folder: Path, photo: str) -> Float[np.ndarray, "2 h w 3"]:
    """Read the diffuse and the specular radiance of a photo's pixels from the folder of the stage `shading`."""
    channels = read_exr(folder / f"{photo}.exr")
    return np.stack([np.stack([channels[name] for name in SHADING[k : k + 3]], axis=-1) for k in (0, 3)])


def paint_shading(shading: Path, photo: str, geometry: Channels, model: Model) -> Float[np.ndarray, "h w 3"]:
    """Return a photo's radiance: its shading, with the detail of its diffuse reflectance and its tone curve.

    Args:
        shading: folder of the stage `shading`
        photo: name of the photo
        geometry: its maps, with channels detail.R, .G, .B where reflectance has detail
        model: model of the solve
    """
    diffuse, specular = read_shading(shading, photo)
    if "detail.R" in geometry:
        diffuse = diffuse * np.stack([geometry[f"detail.{channel}"] for channel in "RGB"], axis=-1)
    tone = model.tone.get(photo)
    return apply_tone(diffuse + specular, tone.exponent, tone.pivot) if tone else diffuse + specular


def reflect_bounces(material: Reflectance, bounced: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "2 n 3"]:
    """Return the diffuse and the specular radiance of bounces, k_d G_d and k_s G_s."""
    return np.stack([np.array(material.diffuse) * bounced[:, :3], np.array(material.specular) * bounced[:, 3:]])


def interpolation_nodes(
    pixels: Bool[np.ndarray, "h w"], normals: Float[np.ndarray, "n 3"], views: Float[np.ndarray, "n 3"], alpha: float
) -> tuple[Int[np.ndarray, " m"], csr_array]:
    """Select the pixels that the operator is evaluated at, and the weights that interpolate the others.

    The nodes of a grid of GRID pixels are evaluated.  A pixel between them is interpolated bilinearly if three things
    hold: its four nodes lie in the mask and face the viewer, their normals differ by less than LARGEST_SPREAD α, and
    its own normal differs from the interpolated one by less than LARGEST_ERROR α.  Highlights, of width α, are then
    smooth.  All other pixels are evaluated.

    Args:
        pixels: mask of n pixels
        normals: unit normals
        views: unit directions toward the viewer
        alpha: α of the material

    Returns:
        Numbers of the evaluated pixels, and weights [n, m] of their values.
    """
    y, x = np.nonzero(pixels)
    number = np.full((pixels.shape[0] + GRID, pixels.shape[1] + GRID), -1)
    number[y, x] = np.arange(len(y))
    # numbers and weights of the four nodes about each pixel
    top, left = y - y % GRID, x - x % GRID
    down, right = y % GRID / GRID, x % GRID / GRID
    corners = np.stack([number[top + i, left + j] for i in (0, GRID) for j in (0, GRID)], axis=1)
    shares = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=1)
    rows = np.flatnonzero((corners >= 0).all(1))
    at_corners = normals[corners[rows]]
    spread = np.linalg.norm(at_corners - at_corners[:, :1], axis=-1).max(1)
    error = np.linalg.norm(_unit(np.einsum("nk,nkc->nc", shares[rows], at_corners)) - normals[rows], axis=-1)
    facing = np.einsum("nkc,nc->nk", at_corners, views[rows]).min(1) > 0
    smooth = rows[(spread < LARGEST_SPREAD * alpha) & (error < LARGEST_ERROR * alpha) & facing]
    # grid nodes have a weight of 1 at themselves
    evaluated = np.ones(len(y), bool)
    evaluated[smooth] = (y[smooth] % GRID == 0) & (x[smooth] % GRID == 0)
    nodes = np.flatnonzero(evaluated)
    column = np.zeros(len(y), int)
    column[nodes] = np.arange(len(nodes))
    between = smooth[~evaluated[smooth]]
    values = np.concatenate([np.ones(len(nodes)), shares[between].reshape(-1)])
    row = np.concatenate([nodes, np.repeat(between, 4)])
    columns = np.concatenate([column[nodes], column[corners[between]].reshape(-1)])
    return nodes, csr_array((values, (row, columns)), (len(y), len(nodes)))


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def nearest_surroundings(
    surroundings: Surroundings | None, material: int, y: Int[np.ndarray, " n"], x: Int[np.ndarray, " n"]
) -> tuple[UInt8[np.ndarray, "n k"] | None, Float[np.ndarray, "n 6"] | None, Float[np.ndarray, "n 3"] | None]:
    """Look up visibility, bounced radiance and position of the nearest observed pixel of the same material.

    Args:
        surroundings: the photo's observations; None if the model has neither occlusion nor bounces
        material: index of the material, from 0
        y: rows of the pixels
        x: columns of the pixels

    Returns:
        Visibility, bounced radiance and position; each is None if it is unknown.
    """
    if surroundings is None:
        return None, None, None
    observations = surroundings.observations
    rows = np.flatnonzero(observations.material == material)
    if len(rows) == 0 or len(x) == 0:
        return None, None, None
    pixels = np.column_stack([observations.x[rows], observations.y[rows]])
    nearest = rows[cKDTree(pixels).query(np.column_stack([x, y]))[1]]
    values = observations.visibility, surroundings.bounced, observations.place
    visibility, bounced, place = (None if each is None else each[nearest] for each in values)
    return visibility, bounced, place


def render_ball(reflector: Reflector, material: Reflectance, size: int) -> Float[np.ndarray, "size size 3"]:
    """Render the radiance of a ball of `size` pixels' width; zero outside the ball."""
    normals, inside = ball_normals(size)
    picture = np.zeros((size, size, 3))
    picture[inside] = front_radiance(reflector, material, normals * (1, -1, -1))  # in the camera's frame
    return picture


def front_radiance(
    reflector: Reflector, material: Reflectance, normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Interpolate the radiance toward the viewer, a smooth function of the normal alone, by cubic splines.

    The nodes lie on a grid of the angle θ from the viewer and the azimuth φ.  Their spacing is STEP times α, the width
    of a highlight, and the error falls as its fourth power.  The operator itself evaluates lobes narrower than NARROW.
    It also evaluates all lobes if there are fewer normals than nodes.

    Args:
        reflector: the light
        material: the reflectance
        normals: unit normals, camera frame
    """
    step = np.clip(STEP * float(material.roughness) ** 2, 1e-3, LONGEST_STEP)
    rings = int(np.ceil(np.pi / 2 / step))
    if 4 * rings**2 >= len(normals):
        return reflector(material, normals, np.broadcast_to(FRONT, normals.shape))
    narrow = reflector.lobes.sharpness > NARROW
    wide, sharp = (Reflector(reflector.operator, reflector.lobes.take(part)) for part in (~narrow, narrow))
    # nodes: θ = h/2, 3h/2, …, RIM, and φ from 0 to 2π
    theta = (np.arange(rings) + 0.5) / (rings - 0.5) * RIM
    phi = np.arange(4 * rings) * (np.pi / 2 / rings)
    sin = np.sin(theta)[:, None]
    cos = np.cos(theta)[:, None]
    nodes = np.stack(np.broadcast_arrays(sin * np.cos(phi), sin * np.sin(phi), -cos), axis=-1)
    values = wide(material, nodes.reshape(-1, 3), np.broadcast_to(FRONT, (nodes.size // 3, 3))).reshape(nodes.shape)
    # margins: θ < 0 continues at φ + π beyond the pole, and φ is periodic
    across = np.roll(values[MARGIN - 1 :: -1], 2 * rings, axis=1)
    values = np.pad(np.concatenate([across, values]), ((0, 0), (MARGIN, MARGIN), (0, 0)), mode="wrap")
    theta = np.concatenate([-theta[MARGIN - 1 :: -1], theta])
    phi = np.arange(-MARGIN, 4 * rings + MARGIN) * (np.pi / 2 / rings)
    angles = np.arccos(-normals[:, 2]), np.arctan2(normals[:, 1], normals[:, 0]) % (2 * np.pi)
    splines = [RectBivariateSpline(theta, phi, channel, s=0) for channel in np.moveaxis(values, -1, 0)]
    smooth = np.stack([spline.ev(*angles) for spline in splines], axis=-1).clip(0)
    return smooth + sharp(material, normals, np.broadcast_to(FRONT, normals.shape))
