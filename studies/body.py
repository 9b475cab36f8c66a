"""The object of the comparison of methods: a rounded, convex body, its radiance, and the photos of it that all methods see.

Body    |x/a|^p + |y/b|^p + |z/c|^p = 1 (superquadric, Barr 1981), turned at random, another way for each seed.  It is convex, so
        that no part shades or hides another one, and a point is seen exactly where its normal is turned toward the camera.
Frames  Points and normals are in the photo's light frame (x right, y up, z toward the viewer).  A camera that went around the
        body is given by `turn`, view_from_photo, a rotation; the body and its light, a lat-long map, stay where they are.
Photo   one a light, its bodies side by side, all turned alike.  Noise: each radiance times 1 + .01 · normal.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from factorlib.evaluate.ball import diffuse_ball, glossy_ball, light_of_lat_long
from factorlib.generate.shapes import star
from factorlib.light.latlong import turned_map
from factorlib.meshes.mesh import Mesh
from factorlib.results.materials import Reflectance
from factorlib.urm.observations import Observations, read_observations
from studies.spheres import GRAZING, NOISE, in_camera, table_of
from studies.study import Comparison, light_name

RADII, POWER = np.array([0.9, 0.66, 0.76]), 2.7
REACH = 1.05  # half the width that a picture shows
HALVINGS = 60  # of an interval in search of a root
FINER = 2  # samples along a texel's side where a map is turned
Map = Float[np.ndarray, "h w 3"]
Radiance = Float[np.ndarray, "n 3"]


class View(msgspec.Struct, frozen=True):
    """The points of the body that a camera sees, in rows: those of the picture's pixels `inside`.

    points, normals: photo's light frame;  turn: view_from_photo
    """

    inside: Bool[np.ndarray, "h w"]
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    turn: Float[np.ndarray, "3 3"]

    @property
    def normals_in_view(self) -> Float[np.ndarray, "n 3"]:
        """Normals in the camera's own light frame."""
        return self.normals @ self.turn.T

    def picture(self, radiance: Radiance) -> Float[np.ndarray, "h w 3"]:
        """The points' radiance in their pixels, 0 elsewhere."""
        pixels = np.zeros((*self.inside.shape, 3))
        pixels[self.inside] = radiance
        return pixels


def pose(seed: int) -> Float[np.ndarray, "3 3"]:
    """photo_from_body of a world."""
    return Rotation.random(rng=np.random.default_rng([14, seed])).as_matrix()


def turn(azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3 3"]:
    """view_from_photo of a camera that went to the right, then up, about the body.

    >>> turn(90, 0).round(6).tolist()[2]
    [1.0, 0.0, 0.0]
    """
    a, e = np.radians([azimuth_deg, elevation_deg])
    toward = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    return np.stack([right, np.cross(toward, right), toward])


def view(seed: int, size: int, view_from_photo: Float[np.ndarray, "3 3"] = np.eye(3)) -> View:
    """What a camera sees in a picture `size` pixels across; pixels that see the surface at a grazing angle are left out."""
    at, photo_from_body = ((np.arange(size) + 0.5) / size * 2 - 1) * REACH, pose(seed)
    x, y = (v.reshape(-1) for v in np.meshgrid(at, -at))
    body_from_view = (view_from_photo @ photo_from_body).T
    z = _front(np.stack([x, y], axis=-1), body_from_view)
    hit = np.flatnonzero(np.isfinite(z))
    points = np.stack([x, y, z], axis=-1)[hit] @ body_from_view.T
    normals = gradient(points)
    seen = (normals @ body_from_view)[:, 2] > GRAZING
    inside = np.zeros(size * size, bool)
    inside[hit[seen]] = True
    points, normals = (v[seen] @ photo_from_body.T for v in (points, normals))
    return View(inside.reshape(size, size), points, normals, view_from_photo)


def level(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """1 on the surface, less inside; points in the body's frame."""
    return (np.abs(points / RADII) ** POWER).sum(axis=-1)


def gradient(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals, body's frame."""
    normals = np.sign(points) * np.abs(points / RADII) ** (POWER - 1) / RADII
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _front(at: Float[np.ndarray, "n 2"], body_from_view: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " n"]:
    """Largest z, view's frame, at which the lines along z meet the body; NaN where they do not."""

    def along(z: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The level on the lines, convex in z."""
        return level(np.column_stack([at, z]) @ body_from_view.T)

    low, high = np.full(len(at), -2.0), np.full(len(at), 2.0)
    for _ in range(HALVINGS):  # thirds: the lowest level lies between
        a, b = low + (high - low) / 3, high - (high - low) / 3
        left = along(a) < along(b)
        low, high = np.where(left, low, a), np.where(left, b, high)
    deepest = low = (low + high) / 2
    high = np.full(len(at), 2.0)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        within = along(middle) < 1
        low, high = np.where(within, middle, low), np.where(within, high, middle)
    return np.where(along(deepest) < 1, low, np.nan)


def mesh(seed: int) -> Mesh:
    """The same body as triangles, in the photo's light frame, with its own normals."""
    own, photo_from_body = star(lambda direction: level(direction) ** (-1 / POWER)), pose(seed)
    vertices, normals = (v @ photo_from_body.T for v in (own.vertices, gradient(own.vertices)))
    return Mesh(vertices, own.faces, normals, own.face_label)


# ── radiance and photos ──────────────────────────────────────────────────────────────────────────────────────────────


class Scene:
    """The body in one light, seen by one camera: by quadrature of the light's map, as spheres are in other studies, each part once.

    For a camera that went around both, the map is turned into the camera's own frame.  Truth and answers go through the same turn.
    """

    def __init__(self, light: Map, view: View):
        ahead = np.array_equal(view.turn, np.eye(3))
        self.view, self.light = view, light_of_lat_long(light if ahead else turned_map(light, view.turn, FINER))
        self._glossy: dict[float, Radiance] = {}

    @cached_property
    def diffuse(self) -> Radiance:
        """Of white Lambert."""
        return diffuse_ball(self.light, self.view.normals_in_view)

    def of(self, material: Reflectance) -> Radiance:
        """Of a material; its specular part is GGX."""
        radiance, rough = np.asarray(material.diffuse) * self.diffuse, material.roughness
        if not any(material.specular):
            return radiance
        if rough not in self._glossy:
            self._glossy[rough] = glossy_ball(self.light, self.view.normals_in_view, rough)
        return radiance + np.asarray(material.specular) * self._glossy[rough]


class Photos(msgspec.Struct, frozen=True):
    """What all methods see: the body as the photos' camera sees it, and its radiance there by material's name and light."""

    view: View
    radiance: dict[tuple[str, int], Radiance]

    @property
    def materials(self) -> list[str]:
        """By name, in order of their first photo."""
        return list(dict.fromkeys(name for name, _ in self.radiance))

    @property
    def lights(self) -> list[int]:
        """By number."""
        return sorted({light for _, light in self.radiance})


def photographed(case: Comparison, materials: Mapping[str, Reflectance], lights: Mapping[int, Map]) -> Photos:
    """Render the entries of a case, with noise."""
    camera, radiance = view(case.seed, case.size), {}
    scenes = {li: Scene(lights[li], camera) for li in case.lights}
    for m, li in case.entries:
        name = case.names[m]
        exact = scenes[li].of(materials[name])
        noise = np.random.default_rng([15, case.seed, li, m]).standard_normal(exact.shape)
        radiance[name, li] = exact * (1 + NOISE * noise)
    return Photos(camera, radiance)


def observations_of(case: Comparison, photos: Photos) -> dict[str, Observations]:
    """The photos as the stage `urm` writes them, a table a light, by the photo's name."""
    tables, (y, x), normals = {}, np.nonzero(photos.view.inside), in_camera(photos.view.normals)
    for li in case.lights:
        names = case.names_in(li)
        labels = np.repeat([case.material_names.index(name) for name in names], len(normals))
        radiance = np.concatenate([photos.radiance[name, li] for name in names])
        columns = np.concatenate([x + case.size * k for k in range(len(names))])
        turned = np.tile(normals, (len(names), 1))
        tables[light_name(li)] = table_of(case, li, turned, radiance, labels, columns, np.tile(y, len(names)))
    return tables


def read_photos(case: Comparison, folder: Path) -> Photos:
    """What `observations_of` was written to, a file a light."""
    radiance = {}
    for li in case.lights:
        table = read_observations(folder / f"{light_name(li)}.parquet")
        for number in np.unique(table.material):
            radiance[table.materials[number], li] = table.radiance[table.material == number].astype(float)
    return Photos(view(case.seed, case.size), radiance)
