"""Moulded side chair: a smooth shell with thickness on four splayed, tapered dowel legs with struts.

Object frame: metres, y up, the floor at y = 0, the sitter looks along +z. The chair has the proportions of the
well-known one (47 cm wide at the feet, 52 cm deep, 82 cm high), by formulas of our own. `chair` is the object that is
rendered. `rough_chair` is a mesh that a user might have of it: fewer, flatter faces, thicker legs, and errors of a few
millimetres everywhere. `bend_parts` makes worse ones.
"""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline, PchipInterpolator

from factorlib.geometry import open3d as o3d
from factorlib.meshes.mesh import Mesh, smooth
from factorlib.yamlfile import read_yaml

Part = tuple[np.ndarray, np.ndarray]  # vertices [V, 3], faces [F, 3]

Pair = tuple[float, float]
Radii = tuple[float, float, float]


class ChairDimensions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Contents of chair.yaml, which explains each number."""

    profile: list[Pair]
    half_width: list[Pair]
    curl: list[Pair]
    corners: float
    thickness: float
    tops: list[Pair]
    feet: list[Pair]
    seat_y: float
    leg_radii: Radii
    rough_leg_radii: Radii
    struts: list[tuple[int, float, int, float]]
    strut_radius: float


DIMENSIONS = read_yaml(Path(__file__).with_name("chair.yaml"), ChairDimensions)


def chair() -> dict[str, Part]:
    """Return shell and legs, fine enough to be rendered smooth."""
    return {"shell": shell(64, 96), "legs": legs(24, 14)}


def rough_chair(rng: np.random.Generator) -> dict[str, Part]:
    """Return shell and legs with few faces, bent by about 4 mm in ways that differ from seed to seed."""
    axes = rng.normal(0, 5, (4, 3))
    phases = rng.uniform(0, 2 * np.pi, (4, 1))
    shifts = rng.normal(0, 0.002, (4, 3))

    parts = {"shell": shell(14, 22), "legs": legs(7, 3, radii=DIMENSIONS.rough_leg_radii)}
    return {name: (v + np.sin(v @ axes.T + phases.T) @ shifts, faces) for name, (v, faces) in parts.items()}


def bend_parts(parts: dict[str, Part], rng: np.random.Generator, triangles: int, warp: float) -> dict[str, Part]:
    """Return the parts of a mesh, decimated and bent by four waves of about its length.

    Args:
        parts: Vertices and faces by part.
        rng: Random generator.
        triangles: Number of triangles of each part.
        warp: Approximate largest displacement, as a share of the extent of all parts.

    Returns:
        Vertices and faces by part.
    """
    points = np.concatenate([vertices for vertices, _ in parts.values()])
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    axes = rng.normal(0, 5 / extent, (4, 3))
    phases = rng.uniform(0, 2 * np.pi, (4, 1))
    shifts = rng.normal(0, 1, (4, 3))
    waves = np.sin(points @ axes.T + phases.T) @ shifts
    middle = waves.mean(axis=0)
    deviation = float(np.sqrt(np.square(waves - waves.mean(axis=0)).sum(axis=1).mean()))
    bent = {}
    for name, (vertices, faces) in parts.items():
        places, fewer = decimate(vertices, faces, triangles)
        shift = (np.sin(places @ axes.T + phases.T) @ shifts - middle) * warp * extent / (2 * deviation)
        bent[name] = places + shift, fewer
    return bent


def decimate(vertices: np.ndarray, faces: np.ndarray, triangles: int) -> Part:
    """Decimate a part to about so many triangles, by Open3D's quadric error metrics (Garland and Heckbert 1997)."""
    whole = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces))
    few = whole.remove_duplicated_vertices().simplify_quadric_decimation(triangles)
    return np.asarray(few.vertices), np.asarray(few.triangles)


def label_parts(parts: dict[str, Part], labels: dict[str, int]) -> Mesh:
    """Join all parts to one mesh with material labels, smooth within each part."""
    meshes = [smooth(vertices, faces, labels[name]) for name, (vertices, faces) in parts.items()]
    vertices, faces = join_parts([(mesh.vertices, mesh.faces) for mesh in meshes])
    normals = np.concatenate([mesh.normals for mesh in meshes])
    return Mesh(vertices, faces.astype(np.int32), normals, np.concatenate([mesh.face_label for mesh in meshes]))


def join_parts(parts: Sequence[Part]) -> Part:
    """Join all parts to one."""
    first = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    faces = [faces + offset for (_, faces), offset in zip(parts, first)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def shell(across: int, along: int) -> Part:
    """Return the shell: upper and lower sides, half a thickness off its middle surface, joined by a rounded rim."""
    s, t = np.meshgrid(np.linspace(-1, 1, across + 1), np.linspace(-1, 1, along + 1))
    u = s * np.sqrt(1 - DIMENSIONS.corners * t**2 / 2)
    v = t * np.sqrt(1 - DIMENSIONS.corners * s**2 / 2)
    # normals of the middle surface, by central differences
    middle = middle_surface(u, v)
    step = 1e-4
    by_u = middle_surface(u + step, v) - middle_surface(u - step, v)
    normal = np.cross(by_u, middle_surface(u, v - step) - middle_surface(u, v + step))
    normal /= -np.linalg.norm(normal, axis=-1, keepdims=True)
    upper = middle + normal * DIMENSIONS.thickness / 2
    lower = middle - normal * DIMENSIONS.thickness / 2
    rows, columns = u.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    border = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])  # closed ring
    middle = middle.reshape(-1, 3)[border]
    normal = normal.reshape(-1, 3)[border]
    # rim: half a thickness outward from the border, in the surface
    out = np.cross(np.roll(middle, -1, axis=0) - np.roll(middle, 1, axis=0), normal)
    out *= np.sign(np.sum(out * (middle - middle.mean(axis=0)), axis=1).sum())
    edge = middle + out / np.linalg.norm(out, axis=1, keepdims=True) * DIMENSIONS.thickness / 2
    a = index[:-1, :-1]
    b = index[:-1, 1:]
    c = index[1:, :-1]
    d = index[1:, 1:]
    top = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    rim = 2 * rows * columns + np.arange(len(border))
    count = rows * columns
    faces = [top, top[:, ::-1] + count, band(border, rim), band(rim, border + count)]
    return np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3), edge]), np.concatenate(faces)


def middle_surface(u: Float[np.ndarray, "*n"], v: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
    """Return points of the shell: u from −1 to 1 across, v from −1 (front lip) to 1 (top of the back)."""
    profile = np.array(DIMENSIONS.profile)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    curve = CubicSpline(length / length[-1], profile)
    position = (v + 1) / 2
    z, y = np.moveaxis(curve(position), -1, 0)
    dz, dy = np.moveaxis(curve(position, 1), -1, 0)
    speed = np.hypot(dz, dy)
    width, rise = (
        PchipInterpolator(*np.array(table).T)(position) for table in (DIMENSIONS.half_width, DIMENSIONS.curl)
    )
    lift = rise * np.abs(u) ** 2.4
    return np.stack([u * (width - 0.35 * lift), y - lift * dz / speed, z + lift * dy / speed], axis=-1)


def band(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Triangulate the band between two closed rings of vertex indices, of equal length n; return faces [2n, 3]."""
    a = first
    b = np.roll(first, -1)
    c = second
    d = np.roll(second, -1)
    return np.concatenate([np.stack([a, c, d], -1), np.stack([a, d, b], -1)])


def legs(sides: int, rings: int, radii: Radii = DIMENSIONS.leg_radii) -> Part:
    """Return four legs and the struts between neighbours.

    Args:
        sides: Number of sides of a leg.
        rings: Number of rings of vertices along a leg.
        radii: Radii of a leg at its top, middle and foot.

    Returns:
        Vertices and faces.
    """
    top = [np.array([x, DIMENSIONS.seat_y, z]) for x, z in DIMENSIONS.tops]
    foot = [np.array([x, 0.0, z]) for x, z in DIMENSIONS.feet]
    dowels = [dowel(a, b, radii, sides, rings) for a, b in zip(top, foot, strict=True)]
    for leg, low, other, high in DIMENSIONS.struts:
        ends = top[leg] + low * (foot[leg] - top[leg]), top[other] + high * (foot[other] - top[other])
        dowels.append(dowel(*ends, (DIMENSIONS.strut_radius,) * 3, max(5, sides // 2), 2))
    return join_parts(dowels)


def dowel(start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], radii: Radii, sides: int, rings: int) -> Part:
    """Return a closed round rod.

    Args:
        start: Start of the axis.
        end: End of the axis.
        radii: Radii at start, middle and end.
        sides: Number of sides.
        rings: Number of rings of vertices.

    Returns:
        Vertices and faces.
    """
    axis = (end - start) / np.linalg.norm(end - start)
    across = np.cross(axis, [0.3, 0.2, 1.0])
    across /= np.linalg.norm(across)
    angle = np.arange(sides) / sides * 2 * np.pi
    circle = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across)
    share = np.linspace(0, 1, rings)
    radius = PchipInterpolator([0, 0.5, 1], radii)(share)
    points = start + share[:, None, None] * (end - start) + radius[:, None, None] * circle
    index = np.arange(rings * sides).reshape(rings, sides)
    tube = np.concatenate([band(index[k], index[k + 1]) for k in range(rings - 1)])
    first, last = index[[0, -1]]
    right, right_last = np.roll(index, -1, axis=1)[[0, -1]]
    middles = np.full(sides, rings * sides), np.full(sides, rings * sides + 1)  # centres of the caps
    caps = [np.stack([middles[0], first, right], -1), np.stack([middles[1], right_last, last], -1)]
    return np.concatenate([points.reshape(-1, 3), [start, end]]), np.concatenate([tube, *caps])[:, ::-1]
