"""The object of the comparison of methods: an ellipsoid, its radiance, and the photos of it that all methods see.

Body    |x/a|² + |y/b|² + |z/c|² = 1, turned at random, another way for each seed.  It is convex, so that no part shades or hides
        another one, and a point is seen exactly where its normal is turned toward the camera.
Frames  Points and normals are in the photo's light frame (x right, y up, z toward the viewer).  A camera that went around the
        body is given by `turn`, view_from_photo, a rotation; the body and its light, a lat-long map, stay where they are.
Photo   one a light, its bodies side by side, all turned alike.  Noise: each radiance times 1 + .01 · normal.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from factorlib.evaluate.ball import ball, light_of_lat_long
from factorlib.light.latlong import turned_map
from factorlib.meshes.mesh import Mesh
from factorlib.results.materials import Reflectance
from factorlib.urm.observations import Observations
from studies.errors import Map
from studies.spheres import GRAZING, NOISE, in_camera, table_of
from studies.study import Comparison, light_name

RADII = np.array([0.9, 0.66, 0.76])
REACH = 1.05  # half the width that a picture shows
FINER = 2  # samples along a texel's side where a map is turned
Radiance = Float[np.ndarray, "n 3"]


class View(msgspec.Struct, frozen=True):
    """The points of the body that a camera sees, in rows: those of the picture's pixels `inside`.

    points, normals: photo's light frame;  turn: view_from_photo
    """

    inside: Bool[np.ndarray, "h w"]
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    turn: Float[np.ndarray, "3 3"]

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
    return Rotation.from_euler("yx", [-azimuth_deg, elevation_deg], degrees=True).as_matrix()


def view(seed: int, size: int, view_from_photo: Float[np.ndarray, "3 3"] = np.eye(3)) -> View:
    """What a camera sees in a picture `size` pixels across; pixels that see the surface at a grazing angle are left out."""
    at, photo_from_body = ((np.arange(size) + 0.5) / size * 2 - 1) * REACH, pose(seed)
    x, y = (v.reshape(-1) for v in np.meshgrid(at, -at))
    body_from_view = (view_from_photo @ photo_from_body).T
    scaled = body_from_view / RADII[:, None]  # to a ball of radius 1: a quadratic equation in z
    start, along = np.stack([x, y], axis=-1) @ scaled[:, :2].T, scaled[:, 2]
    a, b = along @ along, start @ along
    under = b**2 - a * ((start**2).sum(axis=1) - 1)
    z = (-b + np.sqrt(np.maximum(under, 0))) / a
    points = np.stack([x, y, z], axis=-1) @ body_from_view.T
    normals = points / RADII**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inside = (under > 0) & ((normals @ body_from_view)[:, 2] > GRAZING)
    points, normals = (v[inside] @ photo_from_body.T for v in (points, normals))
    return View(inside.reshape(size, size), points, normals, view_from_photo)


def mesh(seed: int) -> Mesh:
    """The same body as triangles, in the photo's light frame, with its own normals."""
    ball, photo_from_body = trimesh.creation.icosphere(subdivisions=5), pose(seed)
    corners, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    normals = corners / RADII / np.linalg.norm(corners / RADII, axis=1, keepdims=True)
    vertices, normals = (v @ photo_from_body.T for v in (corners * RADII, normals))
    return Mesh(vertices, faces, normals, np.ones(len(faces), np.int16))


def shown(material: Reflectance, light: Map, view: View) -> Radiance:
    """The body in a light, seen by a camera: by quadrature of the light's map, as spheres are in other studies.

    For a camera that went around both, the map is turned into the camera's own frame.  Truth and answers go through the same turn.
    """
    ahead = np.array_equal(view.turn, np.eye(3))
    light = light if ahead else turned_map(light, view.turn, FINER)
    return ball(light_of_lat_long(light), material, view.normals @ view.turn.T)


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
    for m, li in case.entries:
        exact = shown(materials[case.names[m]], lights[li], camera)
        noise = np.random.default_rng([15, case.seed, li, m]).standard_normal(exact.shape)
        radiance[case.names[m], li] = exact * (1 + NOISE * noise)
    return Photos(camera, radiance)


def observations_of(case: Comparison, photos: Photos) -> dict[str, Observations]:
    """The photos as the stage `urm` hands them to `solve`, a table a light, by the photo's name."""
    tables, (y, x), normals = {}, np.nonzero(photos.view.inside), in_camera(photos.view.normals)
    for li in case.lights:
        names = case.names_in(li)
        labels = np.repeat([case.material_names.index(name) for name in names], len(normals))
        radiance = np.concatenate([photos.radiance[name, li] for name in names])
        columns = np.concatenate([x + case.size * k for k in range(len(names))])
        turned = np.tile(normals, (len(names), 1))
        tables[light_name(li)] = table_of(case, li, turned, radiance, labels, columns, np.tile(y, len(names)))
    return tables
