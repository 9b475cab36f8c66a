"""The moulded side chair: a plastic shell on splayed dowel legs, in metres, y up, z toward the sitter's knees.

Shell   A sheet S(u, v) bent along a profile in the y-z plane, v from the front lip (1) to the top of the back (−1),
        u across (±1).  Toward its sides it rises along the profile's normal, which makes the hollow of the seat and the
        embrace of the back.  The outline is a superellipse in (u, v), so its corners are round; the sheet is given
        thickness along its own normals and a half-round rim.  One closed grid: the middle of the upper side is its top
        pole, the middle of the lower side its bottom pole.
Legs    Four tapered dowels, two bars under the seat and four struts that cross below it.

The numbers describe the kind of chair, measured from nothing and nobody's drawing.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline, PchipInterpolator

from factorlib.generate.shapes import closed_grid, smooth
from factorlib.meshes.mesh import Mesh

SHELL, LEGS = 1, 2  # labels of the parts
OUTLINE = 5.0  # exponent of the superellipse: 2 is an ellipse, ∞ a rectangle
FLANK = 2.6  # power of |u| by which the sides rise
PROFILE = np.array([  # z, y from the front lip over the seat to the top of the back
    (0.222, 0.398), (0.212, 0.424), (0.165, 0.440), (0.080, 0.433), (-0.020, 0.422), (-0.098, 0.427), (-0.156, 0.449),
    (-0.198, 0.494), (-0.226, 0.562), (-0.246, 0.642), (-0.262, 0.722), (-0.275, 0.788), (-0.288, 0.826)])  # fmt: skip
ALONG = (0.0, 0.12, 0.30, 0.45, 0.58, 0.75, 0.90, 1.0)  # fractions of the profile's length where the widths stand
HALF_WIDTH = (0.200, 0.224, 0.236, 0.230, 0.214, 0.214, 0.222, 0.212)
RISE = (0.006, 0.030, 0.050, 0.070, 0.078, 0.064, 0.042, 0.028)
TOP, FOOT = np.array([0.120, 0.405, 0.105]), np.array([0.215, 0.012, 0.205])  # axis of the front right leg


class Chair(msgspec.Struct, frozen=True):
    """What distinguishes one model of the chair from another; lengths in metres.

    rows, columns: of the shell's grid, over both sides.  rise: factor on the hollow.  lean_deg: back tilted backward.
    stretch: factors on x, y, z.  taper: foot radius over top radius.  splay: feet further out.
    """

    rows: int = 100
    columns: int = 160
    thickness: float = 0.009
    rise: float = 1.0
    lean_deg: float = 0.0
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    leg_radius: float = 0.0165
    taper: float = 0.62
    splay: float = 0.0
    strut_radius: float = 0.0055
    sides: int = 24


RENDERED = Chair()
GIVEN = Chair(
    rows=30, columns=52, thickness=0.012, rise=0.93, lean_deg=1.2, stretch=(1.012, 0.995, 0.99), leg_radius=0.0160, taper=0.75, splay=0.004,
    strut_radius=0.0060, sides=8,
)  # fmt: skip


def chair(model: Chair = RENDERED) -> Mesh:
    """Shell (label 1) and legs (label 2) as one mesh."""
    return joined(list(parts(model).values()))


def parts(model: Chair = RENDERED) -> dict[str, Mesh]:
    """Shell and legs, each a mesh of its own."""
    return {"shell": shell(model), "legs": legs(model)}


def joined(meshes: list[Mesh]) -> Mesh:
    """One mesh of several that share nothing."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + k for mesh, k in zip(meshes, first)]).astype(np.int32)
    vertices, normals, label = (np.concatenate([getattr(m, name) for m in meshes]) for name in ("vertices", "normals", "face_label"))
    return Mesh(vertices, faces, normals, label)


def shell(model: Chair) -> Mesh:
    """The seat and back, a closed surface."""
    half = model.thickness / 2
    u, v, height = _sheet_grid(model, half / 0.21)
    points = sheet(model, u, v) + height[..., None] * half * sheet_normal(model, u, v)
    zero = np.zeros(())
    middle, up = sheet(model, zero, zero), half * sheet_normal(model, zero, zero)
    return smooth(*_stretched(model, closed_grid(points, middle + up, middle - up)), SHELL)


def _sheet_grid(model: Chair, rim: float):
    """u, v and height in half thicknesses (+1 upper side, −1 lower), [rows, columns], from the middle over the rim to the middle."""
    turn = max(3, model.rows // 12)  # rows around the rim
    flat = (model.rows - turn) // 2
    reach = np.linspace(0, 1, flat + 1)[1:-1] * (1 - rim)
    angle = np.linspace(0, np.pi, turn + 2)
    radius = np.concatenate([reach, 1 - rim + rim * np.sin(angle), reach[::-1]])
    height = np.concatenate([np.ones(flat - 1), np.cos(angle), -np.ones(flat - 1)])
    phi = np.arange(model.columns) / model.columns * 2 * np.pi
    across, along = np.sin(phi), np.cos(phi)
    edge = (np.abs(across) ** OUTLINE + np.abs(along) ** OUTLINE) ** (-1 / OUTLINE)
    roundness = radius[:, None] ** 1.5  # circles in the middle, where corners would crowd, the outline at the rim
    scale = radius[:, None] * ((1 - roundness) + roundness * edge)
    return scale * across, scale * along, np.broadcast_to(height[:, None], scale.shape)


def sheet(model: Chair, u: Float[np.ndarray, "*n"], v: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
    """Points of the sheet; v = 1 is the front lip, −1 the top of the back."""
    along = np.clip((1 - v) / 2, 0, 1)
    profile, slope = _profile(model)
    z, y = np.moveaxis(profile(along), -1, 0)
    dz, dy = np.moveaxis(slope(along), -1, 0)
    length = np.hypot(dz, dy)
    rise = model.rise * PchipInterpolator(ALONG, RISE)(along) * np.abs(u) ** FLANK
    x = u * PchipInterpolator(ALONG, HALF_WIDTH)(along)
    return np.stack([x, y - rise * dz / length, z + rise * dy / length], axis=-1)


def _profile(model: Chair):
    """(z, y) over the fraction of length [0, 1] from the lip, smoothed, and its derivative; the back leans by the model's angle."""
    pivot, angle = PROFILE[6], np.radians(model.lean_deg)
    offset = PROFILE - pivot
    turned = offset @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) + pivot
    points = np.where(np.arange(len(PROFILE))[:, None] > 6, turned, PROFILE)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    curve = CubicSpline(length / length[-1], points)
    return curve, curve.derivative()


def sheet_normal(model: Chair, u: Float[np.ndarray, "*n"], v: Float[np.ndarray, "*n"], step: float = 1e-4) -> Float[np.ndarray, "*n 3"]:
    """Unit normal of the sheet on the side one sits on."""
    across = sheet(model, u + step, v) - sheet(model, u - step, v)
    low, high = np.maximum(v - step, -1), np.minimum(v + step, 1)
    normal = np.cross(sheet(model, u, high) - sheet(model, u, low), across)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def legs(model: Chair) -> Mesh:
    """Dowels, bars and struts."""
    corners = [np.array([sx, 1.0, sz]) for sx, sz in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    foot = FOOT + [model.splay, 0, model.splay]
    tops, feet = [TOP * c for c in corners], [foot * c for c in corners]
    rods = [rod(top, low, model.leg_radius, model.leg_radius * model.taper, model.sides) for top, low in zip(tops, feet)]
    rods += [rod(tops[a], tops[b], 0.011, 0.011, model.sides) for a, b in ((0, 3), (1, 2), (0, 1), (2, 3))]
    for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
        ends = tops[a] + 0.22 * (feet[a] - tops[a]), tops[b] + 0.62 * (feet[b] - tops[b])
        rods.append(rod(*ends, model.strut_radius, model.strut_radius, model.sides))
    return smooth(*_stretched(model, joined(rods)), LEGS)


def rod(start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], radius: float, end_radius: float, sides: int, rings: int = 12) -> Mesh:
    """A round bar that tapers, with half-round ends."""
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [0.3, 0.1, 1.0])
    side /= np.linalg.norm(side)
    round_end = np.linspace(0, np.pi / 2, 4)[1:]
    along = np.concatenate([-np.cos(round_end) * radius, np.linspace(0, np.linalg.norm(end - start), rings)[1:-1],
                            np.linalg.norm(end - start) + np.sin(round_end - round_end[0]) * end_radius])  # fmt: skip
    width = np.concatenate([np.sin(round_end) * radius, np.linspace(radius, end_radius, rings)[1:-1], np.cos(round_end - round_end[0]) * end_radius])
    phi = -np.arange(sides) / sides * 2 * np.pi
    ring = np.cos(phi)[:, None] * side + np.sin(phi)[:, None] * np.cross(axis, side)
    points = start + along[:, None, None] * axis + width[:, None, None] * ring
    return closed_grid(points, start - radius * axis, end + end_radius * axis)


def _stretched(model: Chair, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    return mesh.vertices * np.array(model.stretch), mesh.faces
