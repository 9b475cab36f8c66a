"""Five shapes without any symmetry, of some 20,000 triangles each, and coarse, warped copies of them.

Photographs of them have one right pose.

blob    a smooth body with broad bumps                  hook    a tapering tube along a space curve
stack   three boxes, each turned and moved, sharp edges
chair   a chair with one arm: shell 1, legs and arm 2   jug     body 1, handle and spout 2

None looks the same from two sides. But a smooth body of one material and its mirror image have the same outline when
seen from opposite sides from far away, so a mirrored mask of the first three is hard to tell.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from jaxtyping import Float

from factorlib.generate.chair import decimate, dowel, legs, shell
from factorlib.generate.solids import blob, revolve
from factorlib.meshes.mesh import Mesh, closed_grid
from factorlib.meshes.read_mesh import CREASE_DEG, usable
from factorlib.meshes.triangle_soup import TriangleSoup

Part = tuple[np.ndarray, np.ndarray, int]  # vertices [V, 3], faces [F, 3], label

ROWS = 100
COLUMNS = 100
ROUGH_TRIANGLES = 500
WARP = 0.03  # the largest shift of a vertex, in the mesh's extent
BOXES = (((1.0, 0.45, 0.7), (0, 0, 0), 0.0), ((0.55, 0.5, 0.45), (-0.2, 0.42, 0.1), 0.5),
         ((0.3, 0.6, 0.25), (0.3, 0.3, -0.2), -0.3))  # size, place, turn about y  # fmt: skip
BODY = ((0.0, 0.5), (0.20, 0.5), (0.22, 0.45), (0.17, 0.34), (0.26, 0.15), (0.34, -0.1), (0.30, -0.34), (0.2, -0.45),
        (0.0, -0.45))  # the jug's profile: radius, y  # fmt: skip


def bumpy_ball() -> list[Part]:
    """Return the blob of data/synthetic, of more triangles."""
    ball = blob(ROWS, COLUMNS)
    return [(ball.vertices, ball.faces, 1)]


def hook() -> list[Part]:
    """Return a tube whose radius falls from 0.17 to 0.06."""
    t = np.linspace(0, 1, ROWS + 1)
    angle = 4.2 * t**1.3
    height = 0.9 * t**2 - 0.4 + 0.15 * np.sin(5 * t)
    curve = np.stack([0.5 * np.cos(angle), height, (0.5 - 0.3 * t) * np.sin(angle)], axis=1)
    return [tube(curve, np.interp(t, (0, 0.35, 1), (0.17, 0.11, 0.06)), 1)]


def stack() -> list[Part]:
    """Return three stacked boxes, each turned and moved."""
    return [_box(np.array(size), np.array(place, float), turn) for size, place, turn in BOXES]


def jug() -> list[Part]:
    """Return a solid of revolution with a handle on one side and a spout on another."""
    t = np.linspace(0, 1, 24)
    handle = np.stack([0.2 + 0.32 * np.sin(np.pi * t), 0.4 - 0.55 * t, 0 * t], axis=1)
    spout = np.stack([-0.05 * t, 0.02 + 0.4 * t**1.5, 0.2 + 0.36 * t], axis=1)
    body = revolve(np.array(BODY))
    tubes = tube(handle, np.full(24, 0.04), 2), tube(spout, np.linspace(0.1, 0.05, 24), 2)
    return [(body.vertices, body.faces, 1), *tubes]


def armed_chair() -> list[Part]:
    """Return the chair of data/eames, of fewer triangles, with an arm on one side."""
    arm = ((0.2, 0.62, -0.2), (0.22, 0.64, 0.15))
    post = ((0.21, 0.43, 0.1), (0.22, 0.66, 0.12))
    rods = [(*dowel(np.array(a), np.array(b), (0.018, 0.02, 0.016), 20, 12), 2) for a, b in (arm, post)]
    return [(*shell(48, 72), 1), (*legs(20, 12), 2), *rods]


SHAPES: dict[str, Callable[[], list[Part]]] = {
    "blob": bumpy_ball,
    "hook": hook,
    "stack": stack,
    "chair": armed_chair,
    "jug": jug,
}


def tube(curve: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, " n"], label: int) -> Part:
    """Return a closed tube of varying radius about a curve, its rings turned as little as possible."""
    along = np.gradient(curve, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.empty_like(curve)
    side = np.eye(3)[np.argmin(np.abs(along[0]))]
    for k, direction in enumerate(along):
        side = side - (side @ direction) * direction
        across[k] = side = side / np.linalg.norm(side)
    phi = np.arange(COLUMNS) / COLUMNS * 2 * np.pi
    circle = np.cos(phi)[:, None] * across[:, None] + np.sin(phi)[:, None] * np.cross(along, across)[:, None]
    return _grid(curve[:, None] + radius[:, None, None] * circle, curve[0], curve[-1], label)


def _grid(points: np.ndarray, top: np.ndarray, bottom: np.ndarray, label: int) -> Part:
    mesh = closed_grid(points, top, bottom)
    return mesh.vertices, mesh.faces, label


def _box(size: np.ndarray, place: np.ndarray, turn: float, side: int = 24) -> Part:
    """Return a box whose six faces are grids, turned about y."""
    u, v = (a.reshape(-1) for a in np.meshgrid(np.linspace(-0.5, 0.5, side + 1), np.linspace(-0.5, 0.5, side + 1)))
    index = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a = index[:-1, :-1]
    b = index[:-1, 1:]
    c = index[1:, :-1]
    d = index[1:, 1:]
    quad = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    for axis in range(3):
        for sign in (-1, 1):
            points = np.zeros((len(u), 3))
            points[:, axis] = sign / 2
            points[:, (axis + 1) % 3] = u
            points[:, (axis + 2) % 3] = v
            faces.append((quad if sign > 0 else quad[:, ::-1]) + len(vertices) * len(u))
            vertices.append(points)
    cos = np.cos(turn)
    sin = np.sin(turn)
    turned = np.concatenate(vertices) * size @ np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
    return turned + place, np.concatenate(faces), 1


@cache
def photographed_mesh(shape: str) -> Mesh:
    """Return the photographed mesh of a shape, with the normals and checks of a mesh that is read from a file."""
    return mesh_from_parts(SHAPES[shape](), shape)


@cache
def rough_mesh(shape: str, seed: int) -> Mesh:
    """Warp the shape of ROUGH_TRIANGLES: each vertex is moved by a smooth field, at most by WARP of the extent."""
    parts = SHAPES[shape]()
    share = ROUGH_TRIANGLES / sum(len(faces) for _, faces, _ in parts)
    coarse = [(*decimate(v, f, max(round(share * len(f)), 8)), label) for v, f, label in parts]
    vertices = np.concatenate([part[0] for part in coarse])
    extent = float(np.ptp(vertices, axis=0).max())
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 4 / extent, (4, 3))
    phases = rng.uniform(0, 2 * np.pi, 4)
    shifts = rng.normal(0, 1, (4, 3))

    def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the shift at each point."""
        return np.sin(points @ waves.T + phases) @ shifts

    scale = WARP * extent / np.linalg.norm(field(vertices), axis=1).max()
    return mesh_from_parts([(v + scale * field(v), f, label) for v, f, label in coarse], f"rough {shape}")


def mesh_from_parts(parts: list[Part], name: str, crease_deg: float = CREASE_DEG) -> Mesh:
    """Return the parts as one mesh; `name` is its name in errors."""
    first = np.cumsum([0] + [len(vertices) for vertices, _, _ in parts])
    faces = np.concatenate([faces + offset for (_, faces, _), offset in zip(parts, first)]).astype(np.int64)
    label = np.repeat([label for _, _, label in parts], [len(faces) for _, faces, _ in parts])
    soup = TriangleSoup(
        np.concatenate([v for v, _, _ in parts]), faces, label * 0, [("all",)], np.full((len(faces), 3, 3), np.nan)
    )
    return usable(soup, label, crease_deg, name)
