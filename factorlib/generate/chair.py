"""The moulded side chair: a smooth shell with thickness on four splayed, tapered dowel legs with struts.

Object frame: metres, y up, the floor at y = 0, the sitter looks along +z; made after the proportions of the well-known
chair (47 cm wide at the feet, 52 cm deep, 82 cm high) by formulas of our own.  `chair` is the one that is photographed;
`rough_chair` what a user might have of it: fewer, flatter faces, thicker legs, and a few millimetres off everywhere.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline, PchipInterpolator

from factorlib.generate.shapes import smooth
from factorlib.meshes.mesh import Mesh
from factorlib.yamlfile import read_yaml

Part = tuple[np.ndarray, np.ndarray]  # vertices [V, 3], faces [F, 3]

Pair = tuple[float, float]


class Shape(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What chair.yaml says, where each number is explained."""

    profile: list[Pair]
    half_width: list[Pair]
    curl: list[Pair]
    corners: float
    thickness: float
    tops: list[Pair]
    feet: list[Pair]
    seat_y: float
    leg_radii: tuple[float, float, float]
    rough_leg_radii: tuple[float, float, float]
    struts: list[tuple[int, float, int, float]]
    strut_radius: float


SHAPE = read_yaml(Path(__file__).with_name("chair.yaml"), Shape)


def chair() -> dict[str, Part]:
    """shell and legs, fine enough to be rendered smooth."""
    return {"shell": shell(64, 96), "legs": legs(24, 14)}


def rough_chair(rng: np.random.Generator) -> dict[str, Part]:
    """shell and legs with few faces, bent by about 4 mm in ways that differ from seed to seed."""
    axes, phases = rng.normal(0, 5, (4, 3)), rng.uniform(0, 2 * np.pi, (4, 1))
    shifts = rng.normal(0, 0.002, (4, 3))

    def bent(part: Part) -> Part:
        """The part, its vertices moved by smooth waves."""
        vertices, faces = part
        return vertices + np.sin(vertices @ axes.T + phases.T) @ shifts, faces

    return {"shell": bent(shell(14, 22)), "legs": bent(legs(7, 3, radii=SHAPE.rough_leg_radii))}


def labelled(parts: dict[str, Part], labels: dict[str, int]) -> Mesh:
    """One mesh of all parts, smooth within each, with their material labels."""
    meshes = [smooth(vertices, faces, labels[name]) for name, (vertices, faces) in parts.items()]
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, first)]).astype(np.int32),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        face_label=np.concatenate([mesh.face_label for mesh in meshes]),
    )


def shell(across: int, along: int) -> Part:
    """The shell's upper and lower sides, half a thickness off its middle surface, joined by a rounded rim."""
    s, t = np.meshgrid(np.linspace(-1, 1, across + 1), np.linspace(-1, 1, along + 1))
    u, v = s * np.sqrt(1 - SHAPE.corners * t**2 / 2), t * np.sqrt(1 - SHAPE.corners * s**2 / 2)
    middle, step = middle_surface(u, v), 1e-4
    normal = np.cross(
        middle_surface(u + step, v) - middle_surface(u - step, v),
        middle_surface(u, v - step) - middle_surface(u, v + step),
    )
    normal /= -np.linalg.norm(normal, axis=-1, keepdims=True)
    upper, lower = middle + normal * SHAPE.thickness / 2, middle - normal * SHAPE.thickness / 2
    border = ring(*u.shape)
    outward = rim_outward(middle.reshape(-1, 3)[border], normal.reshape(-1, 3)[border])
    edge = middle.reshape(-1, 3)[border] + outward * SHAPE.thickness / 2
    return stitched(upper, lower, edge, border)


def middle_surface(u: Float[np.ndarray, "*n"], v: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
    """A point of the shell: u from −1 to 1 across, v from −1 (front lip) to 1 (top of the back)."""
    profile = np.array(SHAPE.profile)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    curve = CubicSpline(length / length[-1], profile)
    at = (v + 1) / 2
    (z, y), (dz, dy) = np.moveaxis(curve(at), -1, 0), np.moveaxis(curve(at, 1), -1, 0)
    speed = np.hypot(dz, dy)
    width, rise = (PchipInterpolator(*np.array(table).T)(at) for table in (SHAPE.half_width, SHAPE.curl))
    lift = rise * np.abs(u) ** 2.4
    return np.stack([u * (width - 0.35 * lift), y - lift * dz / speed, z + lift * dy / speed], axis=-1)


def ring(rows: int, columns: int) -> np.ndarray:
    """Indices of the border of a grid, once around."""
    index = np.arange(rows * columns).reshape(rows, columns)
    return np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])


def rim_outward(points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit directions out of a closed border, in the surface."""
    along = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    out = np.cross(along, normal)
    out *= np.sign(np.sum(out * (points - points.mean(axis=0)), axis=1).sum())
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def stitched(upper: np.ndarray, lower: np.ndarray, edge: np.ndarray, border: np.ndarray) -> Part:
    """Two grids of points and the edge between their borders as one closed surface, wound outward."""
    rows, columns = upper.shape[:2]
    count = rows * columns
    index = np.arange(count).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    top = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    rim = 2 * count + np.arange(len(border))
    bands = [band(border, rim), band(rim, border + count)]
    vertices = np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3), edge])
    return vertices, np.concatenate([top, top[:, ::-1] + count, *bands])


def band(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Triangles between two closed rings of as many points."""
    a, b, c, d = first, np.roll(first, -1), second, np.roll(second, -1)
    return np.concatenate([np.stack([a, c, d], -1), np.stack([a, d, b], -1)])


def legs(sides: int, rings: int, radii: tuple[float, float, float] = SHAPE.leg_radii) -> Part:
    """Four legs and the struts between neighbours."""
    top = [np.array([x, SHAPE.seat_y, z]) for x, z in SHAPE.tops]
    foot = [np.array([x, 0.0, z]) for x, z in SHAPE.feet]
    dowels = [dowel(a, b, radii, sides, rings) for a, b in zip(top, foot, strict=True)]
    for one, low, other, high in SHAPE.struts:
        ends = top[one] + low * (foot[one] - top[one]), top[other] + high * (foot[other] - top[other])
        dowels.append(dowel(*ends, (SHAPE.strut_radius,) * 3, max(5, sides // 2), 2))
    first = np.cumsum([0] + [len(vertices) for vertices, _ in dowels])
    return np.concatenate([d[0] for d in dowels]), np.concatenate([d[1] + offset for d, offset in zip(dowels, first)])


def dowel(
    start: Float[np.ndarray, "3"],
    end: Float[np.ndarray, "3"],
    radii: tuple[float, float, float],
    sides: int,
    rings: int,
) -> Part:
    """A closed round rod of radius `radii` at its start, middle and end."""
    axis = (end - start) / np.linalg.norm(end - start)
    across = np.cross(axis, [0.3, 0.2, 1.0])
    across /= np.linalg.norm(across)
    angle = np.arange(sides) / sides * 2 * np.pi
    circle = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across)
    at = np.linspace(0, 1, rings)
    radius = PchipInterpolator([0, 0.5, 1], radii)(at)
    points = start + at[:, None, None] * (end - start) + radius[:, None, None] * circle
    index = np.arange(rings * sides).reshape(rings, sides)
    tube = np.concatenate([band(index[k], index[k + 1]) for k in range(rings - 1)])
    last = rings * sides
    right = np.roll(index, -1, axis=1)
    caps = [
        np.stack([np.full(sides, last), index[0], right[0]], -1),
        np.stack([np.full(sides, last + 1), right[-1], index[-1]], -1),
    ]
    return np.concatenate([points.reshape(-1, 3), [start, end]]), np.concatenate([tube, *caps])[:, ::-1]
