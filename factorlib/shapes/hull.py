"""Visual hull: the largest body that fits into all outlines (Laurentini 1994), for known cameras.

    f(x) = min over photos of (pixels that x lies inside the outline) · (its depth / focal length)

f is negative outside the hull. It is sampled on a grid. Surface nets (Gibson 1998) mesh the surface f = 0: each cell
that the surface crosses gets a vertex, the mean of the points where it crosses the cell's edges. The mesh is closed if
f is negative on the grid's border. It is then smoothed without shrinking (Taubin 1995), as far as its outlines allow: a
hull has ridges where outlines meet, which real bodies seldom have. A face belongs to the part that most photos show
there.
"""

from collections.abc import Callable, Sequence
from itertools import count

import msgspec
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize_scalar
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from factorlib.align.silhouette import Silhouette, bounding_box, labelled_iou, make_target
from factorlib.errors import InputError
from factorlib.geometry.raster import Caster, rasterise
from factorlib.meshes.mesh import area_vectors
from factorlib.shapes.outline import FREE, Outline, Triangles

COARSE_CELLS = 32  # cells of the longest side of the first grid, which locates the body
LEAST_SHARE = 0.02  # share of the largest piece's faces: smaller pieces are removed
SMOOTHINGS = (10, 40, 160, 640)  # rounds of smoothing; the most that keep the outlines are taken
SMOOTHED_AWAY = 0.004  # overlap (IoU) that smoothing may cost
SLAB = 1 << 18  # number of points evaluated at once
LEAST_Z = 1e-6  # least depth in front of a camera
SAMPLES = 40  # of `agreement` and `hull_box`: pixels a side, and depths of each pixel's ray
OTHERS = 24  # most outlines that one is compared with in `agreements`
MARGIN = 1.2  # extent of the examined part of a photo, in those of its outline
FOCALS = (0.7, 5.0)  # range of `focal_by_hull`, in units of the photo's longer side
TRIALS = 16  # most focal lengths that are tried

Points = Float[np.ndarray, "n 3"]


def visual_hull(
    outlines: Sequence[Outline], cells: int, parts: int = 1, report: Callable[[float], None] = lambda share: None
) -> Triangles:
    """Compute the visual hull in the object's frame.

    Args:
        outlines: Outlines, all with poses.
        cells: Number of grid cells along the longest side.
        parts: Number of parts of the object.
        report: Called with the completed share, from 0 to 1.

    Returns:
        The mesh with its parts and its overlap with the outlines.

    Raises:
        InputError: If there are fewer than two outlines, or nothing fits into all of them.
    """
    if len(outlines) < 2:
        fault = f"{'only one photo' if outlines else 'no photo'} with a known camera shows it"
        cure = (
            "a hull needs at least two such photos, better ten: estimate cameras with `cameras: {sfm: true}` where "
            "photos overlap, or use lathe or primitive"
        )
        raise InputError(fault, cure=cure)
    middle, radius = _bounding_ball(outlines)
    low = middle - radius
    high = middle + radius
    # sample f on a coarse grid to locate the body, then on a fine one about it
    for size in (COARSE_CELLS, cells):
        origin, step, shape = grid_over(low, high, size)
        field = _sample(outlines, origin, step, shape, report)
        least = -step if size == COARSE_CELLS != cells else 0  # the coarse grid also keeps parts thinner than a cell
        inside = np.argwhere(field > least)
        if not len(inside):
            cure = (
                "check that masks and cameras belong to the same photos; give pixels of whatever hides the object the "
                "label 255"
            )
            raise InputError("no body fits into the outlines of all photos", cure=cure)
        low = origin + step * (inside.min(axis=0) - 1)
        high = origin + step * (inside.max(axis=0) + 1)
    body = _smooth_mesh(field, origin, step, outlines)
    return msgspec.structs.replace(body, part=_vote_parts(body.vertices, body.faces, outlines, parts))


def grid_over(
    low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], cells: int
) -> tuple[Float[np.ndarray, "3"], float, Int[np.ndarray, "3"]]:
    """Return the first point, the step and the shape of a grid that exceeds a box, with so many cells along it."""
    step = float((high - low).max()) / cells
    shape = np.ceil((high - low) / step).astype(int) + 3
    return (low + high) / 2 - step * (shape - 1) / 2, step, shape


def consensus_box(
    outlines: Sequence[Outline], dissenting: int
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the least and highest corner of the body that all but some outlines hold.

    Raises:
        InputError: There is none, all photos see the object from the same side, or one has it behind its camera.
    """
    middle, radius = _bounding_ball(outlines, dissenting)
    origin, step, shape = grid_over(middle - radius, middle + radius, COARSE_CELLS)
    points = origin + step * np.indices(tuple(shape.tolist())).reshape(3, -1).T
    inside = points[signed_distance(outlines, points, dissenting) > -step]
    if not len(inside):
        raise InputError("no body fits into the outlines of most photos")
    return inside.min(axis=0) - step, inside.max(axis=0) + step


def hull_surface(field: Float[np.ndarray, "x y z"], step: float) -> tuple[Points, Int[np.ndarray, "f 3"]]:
    """Mesh the surface f = 0 of a sampled field in grid units; there are no faces if nothing is inside."""
    if not (field > 0).any():
        return np.empty((0, 3)), np.empty((0, 3), int)
    vertices, faces = surface_nets(fill_ambiguous(np.pad(field, 1, constant_values=-step)))
    return vertices - 1, faces


def _smooth_mesh(
    field: Float[np.ndarray, "x y z"], origin: Float[np.ndarray, "3"], step: float, outlines: Sequence[Outline]
) -> Triangles:
    """Mesh the surface f = 0 of a sampled field and smooth it in stages; take the last stage that keeps the overlap.

    Args:
        field: Samples of f.
        origin: Place of the first sample.
        step: Distance of samples.
        outlines: Outlines, all with poses.

    Returns:
        The mesh with its overlap.
    """
    vertices, faces = _remove_small_pieces(*hull_surface(field, step))
    mesh = trimesh.Trimesh(origin + step * vertices, faces, process=False)
    smoothed = []
    for more in np.diff(SMOOTHINGS, prepend=0):
        trimesh.smoothing.filter_taubin(mesh, iterations=int(more))
        body = Triangles(np.array(mesh.vertices), faces)
        smoothed.append(msgspec.structs.replace(body, overlap=overlap(body, outlines)))
    return [each for each in smoothed if each.overlap >= smoothed[0].overlap - SMOOTHED_AWAY][-1]


def overlap(shape: Triangles, outlines: Sequence[Outline]) -> float:
    """Return the mean IoU of a shape with the outlines; all must have poses."""
    caster = Caster(shape.as_mesh())
    overlaps = []
    for outline in outlines:
        target = make_target(outline.view, (1,), 200)
        whole = Silhouette(np.where(target.silhouette.label > 0, 1, target.silhouette.label))
        maps = rasterise(caster, target.window(outline.camera.focal), outline.known_pose)
        overlaps.append(labelled_iou(whole, maps.label))
    return float(np.mean(overlaps))


def hull_overlap(outlines: Sequence[Outline]) -> float:
    """Return the overlap of a coarse hull with its outlines, 0 if nothing fits.

    It is high if the cameras move with the objects that the outlines show.
    """
    try:
        return visual_hull(outlines, COARSE_CELLS).overlap
    except InputError:
        return 0.0


def _bounding_ball(outlines: Sequence[Outline], dissenting: int = 0) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the point nearest to the rays through the outlines' centres, and a radius about it.

    The radius is the least extent of an outline, projected back to that point; `dissenting` extents may be less.
    """
    normal_matrix = np.zeros((3, 3))
    right = np.zeros(3)
    rays = []
    for outline in outlines:
        rotation = outline.known_pose.rotation
        centre = -rotation.T @ outline.known_pose.translation
        ray = rotation.T @ outline.camera.rays_through(outline.middle[None])[0]
        ray /= np.linalg.norm(ray)
        # normal equations of the point nearest to all rays: Σ (I − d dᵀ)(x − c) = 0
        across = np.eye(3) - np.outer(ray, ray)
        normal_matrix = normal_matrix + across
        right = right + across @ centre
        rays.append((centre, ray))
    if np.linalg.cond(normal_matrix) > 1e8:
        raise InputError("all photos see it from the same side", cure="add photos from other sides: a hull needs them")
    middle = np.linalg.solve(normal_matrix, right)
    radii = []
    for outline, (centre, ray) in zip(outlines, rays, strict=True):
        depth = float((middle - centre) @ ray)
        if depth <= 0:
            raise InputError(
                f"the object lies behind the camera of photo '{outline.photo}'",
                cure="check that its mask and its camera belong to the same photo",
            )
        radii.append(depth * bounding_box(outline.view.silhouette)[2] / outline.camera.focal)
    return middle, sorted(radii)[dissenting]


def signed_distance(outlines: Sequence[Outline], points: Points, dissenting: int = 0) -> Float[np.ndarray, " n"]:
    """Return the signed distance f at points of the object's frame, in its units; behind a camera is outside.

    Args:
        outlines: Outlines, all with poses.
        points: The points.
        dissenting: Number of outlines that may have a point farther outside than f.
    """
    least = np.full((dissenting + 1, len(points)), np.inf)  # the least ones, in order
    for outline in outlines:
        x, y, z = outline.known_pose.apply(points).T
        depth = np.maximum(z, LEAST_Z)
        inner = outline.inner(outline.camera.project(np.column_stack([x, y, depth])))
        inner = np.minimum(inner, FREE) * depth / outline.camera.focal
        inner = np.where(z > LEAST_Z, inner, -1.0)
        for rank in range(dissenting + 1):
            least[rank], inner = np.minimum(least[rank], inner), np.maximum(least[rank], inner)
    return least[-1]


def agreements(outlines: Sequence[Outline]) -> list[float]:
    """Return the agreement of each outline with others, of which a third may be wrong.  All need poses.

    The others are all, or where there are more than `OTHERS`, so many of them, evenly by their order.

    Raises:
        InputError: All photos see the object from the same side, or one has it behind its camera.
    """
    step = max(-(-(len(outlines) - 1) // OTHERS), 1)
    others = ([*outlines[k + 1 :], *outlines[:k]][::step] for k in range(len(outlines)))
    return [agreement(outline, each, len(each) // 3) for outline, each in zip(outlines, others)]


def agreement(outline: Outline, others: Sequence[Outline], dissenting: int = 0) -> float:
    """Return the IoU of an outline with the silhouette of the hull of others.

    Args:
        outline: The outline.
        others: Outlines of other photos.
        dissenting: Number of others that need not contain the hull.

    Raises:
        InputError: The others see the object from the same side, or one has it behind its camera.
    """
    extent = MARGIN * bounding_box(outline.view.silhouette)[2]
    pixels = outline.middle + extent * (_sample_grid() - 0.5)
    hull = _shows_hull(outline, others, pixels, dissenting)
    mask = outline.inner(pixels) > 0
    return float((hull & mask).sum() / max((hull | mask).sum(), 1))


def hull_box(outline: Outline, others: Sequence[Outline]) -> Float[np.ndarray, "2 2"] | None:
    """Return the least and largest x and y, in pixels, at which a photo shows the hull of others; None if nowhere.

    Raises:
        InputError: The others see the object from the same side, or one has it behind its camera.
    """
    size = np.array([outline.camera.width, outline.camera.height])
    pixels = size * _sample_grid()
    inside = pixels[_shows_hull(outline, others, pixels)]
    return np.array([inside.min(axis=0), inside.max(axis=0)]) if len(inside) else None


def _sample_grid() -> Float[np.ndarray, "n 2"]:
    """Return the centres of SAMPLES × SAMPLES cells of the unit square."""
    places = (np.arange(SAMPLES) + 0.5) / SAMPLES
    return np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)


def _shows_hull(
    outline: Outline, others: Sequence[Outline], pixels: Float[np.ndarray, "n 2"], dissenting: int = 0
) -> Bool[np.ndarray, " n"]:
    """Return the pixels of a photo whose rays meet the hull of others."""
    pose = outline.known_pose
    middle, radius = _bounding_ball(others, dissenting)
    # points on the rays of the pixels, in the object's frame, and whether any of a ray is in the hull
    depths = pose.apply(middle[None])[0, 2] + MARGIN * radius * np.linspace(-1, 1, SAMPLES)
    points = outline.camera.rays_through(pixels)[:, None] * depths[:, None]
    distance = signed_distance(others, ((points - pose.translation) @ pose.rotation).reshape(-1, 3), dissenting)
    return np.any(distance.reshape(len(pixels), SAMPLES) > -MARGIN * radius / SAMPLES, axis=1)


def focal_by_hull(
    outlines: Callable[[float], Sequence[Outline]], longest: int, report: Callable[[float], None] = lambda share: None
) -> float:
    """Return the focal length, common to all photos, at which the hull fills their outlines best.

    Args:
        outlines: Outlines by focal length, pixels.
        longest: Longer side of the photos, pixels.
        report: Called with the completed share, from 0 to 1.

    Raises:
        InputError: If there is no hull at any of them.
    """
    steps = count()

    def misfit(log: float) -> float:
        """Return the negative overlap for a log focal length."""
        report(min(next(steps) / TRIALS, 1.0))
        return -hull_overlap(outlines(float(np.exp(log))))

    bounds = np.log(longest * np.array(FOCALS))
    best = minimize_scalar(misfit, bounds=bounds, method="bounded", options={"maxiter": TRIALS})
    if best.fun == 0:
        cure = "write it as `fl_x`, with `w` and `h`"
        raise InputError("there is no focal length, and no hull that tells it: no body fits the masks", cure=cure)
    return float(np.exp(best.x))


def _sample(
    outlines: Sequence[Outline], origin: np.ndarray, step: float, shape: np.ndarray, report: Callable[[float], None]
) -> Float[np.ndarray, "x y z"]:
    """Sample f on a grid."""
    field = np.empty(int(np.prod(shape)))
    for start in range(0, len(field), SLAB):
        index = np.stack(np.unravel_index(np.arange(start, min(start + SLAB, len(field))), shape), axis=-1)
        field[start : start + SLAB] = signed_distance(outlines, origin + step * index)
        report(start / len(field))
    return field.reshape(shape)


def surface_nets(field: Float[np.ndarray, "x y z"]) -> tuple[Points, Int[np.ndarray, "f 3"]]:
    """Mesh the surface field = 0 in grid units, by surface nets; faces point toward lower values.

    The mesh is closed if the field is not positive on the grid's border.
    """
    cells = np.array(field.shape) - 1
    inside = field > 0
    total = np.zeros((*cells, 3))
    count = np.zeros(cells)
    quads = []
    for axis in range(3):
        other_axes = [k for k in range(3) if k != axis]
        first = tuple(slice(0, -1) if k == axis else slice(None) for k in range(3))
        second = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        crossed = np.argwhere(inside[first] != inside[second])
        a = field[first][tuple(crossed.T)]
        b = field[second][tuple(crossed.T)]
        # crossing of each edge, by linear interpolation; each of the four cells about the edge averages its crossings
        crossing = crossed.astype(float)
        crossing[:, axis] += a / (a - b)
        around = []
        for down in ((0, 0), (1, 0), (1, 1), (0, 1)):
            cell = crossed.copy()
            cell[:, other_axes] -= down
            valid = ((cell >= 0) & (cell < cells)).all(axis=1)
            np.add.at(total, tuple(cell[valid].T), crossing[valid])
            np.add.at(count, tuple(cell[valid].T), 1)
            around.append(np.where(valid, np.ravel_multi_index(np.clip(cell, 0, cells - 1).T, cells), -1))
        corner = np.stack(around, axis=1)
        # orient the quads; for axis y the other axes are x, z, which are left-handed
        corner = np.where(((a > 0) == (axis == 1))[:, None], corner[:, ::-1], corner)
        quads.append(corner[(corner >= 0).all(axis=1)])
    quad = np.concatenate(quads)
    used, index = np.unique(quad, return_inverse=True)
    quad = index.reshape(-1, 4)
    used_cells = np.unravel_index(used, cells)
    vertices = total[used_cells] / count[used_cells][:, None]
    return vertices, np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])


def fill_ambiguous(field: Float[np.ndarray, "x y z"]) -> Float[np.ndarray, "x y z"]:
    """Fill grid points so that no edge of the net has four faces.

    That happens where two opposite corners of a square are inside and the other two outside.
    """
    field = field.copy()
    least = np.abs(field[field > 0]).min()
    while True:
        filled = False
        for axis in range(3):
            slices = np.moveaxis(field, axis, 0)
            inside = slices > 0
            # corners of each square, in order
            a = inside[:, :-1, :-1]
            b = inside[:, 1:, :-1]
            c = inside[:, 1:, 1:]
            d = inside[:, :-1, 1:]
            first_diagonal = a & c & ~b & ~d
            second_diagonal = b & d & ~a & ~c
            slices[:, 1:, :-1][first_diagonal] = least
            slices[:, :-1, :-1][second_diagonal] = least
            filled |= bool((first_diagonal | second_diagonal).any())
        if not filled:
            return field


def _remove_small_pieces(vertices: Points, faces: Int[np.ndarray, "f 3"]) -> tuple[Points, Int[np.ndarray, "f 3"]]:
    """Remove small pieces beside the largest one."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(edges)), edges.T), shape=(len(vertices), len(vertices)))
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    sizes = np.bincount(piece)
    used, index = np.unique(faces[sizes[piece] >= LEAST_SHARE * sizes.max()], return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def _vote_parts(
    vertices: Points, faces: Int[np.ndarray, "f 3"], outlines: Sequence[Outline], parts: int
) -> Int[np.ndarray, " f"]:
    """Return the part of each face, by majority among the photos that see it.

    A face that no photo sees gets the votes of the nearest visible face.
    """
    votes = np.zeros((len(faces), parts), int)
    if parts > 1:
        area = area_vectors(vertices, faces)
        caster = Caster(Triangles(vertices, faces).as_mesh())
        centre = vertices[faces].mean(axis=1)
        for outline in outlines:
            hits = caster.cast(outline.camera, outline.known_pose)
            point = outline.known_pose.apply(centre)
            facing = np.einsum("nd,nd->n", area @ outline.known_pose.rotation.T, point) < 0
            # faces toward the camera that lie on the first surface hit, within their own size
            x, y = np.floor(outline.camera.project(np.where(point[:, 2:] > LEAST_Z, point, 1.0))).astype(int).T
            height, width = outline.part.shape
            near = np.flatnonzero(facing & (point[:, 2] > LEAST_Z) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
            pixel = y[near], x[near]
            reach = 2 * np.sqrt(np.linalg.norm(area[near], axis=1))
            visible = (np.abs(hits.depth[pixel] - point[near, 2]) <= reach) & (outline.part[pixel] > 0)
            np.add.at(votes, (near[visible], outline.part[pixel][visible] - 1), 1)
        has_votes = votes.any(axis=1)
        if has_votes.any():
            votes[~has_votes] = votes[has_votes][cKDTree(centre[has_votes]).query(centre[~has_votes])[1]]
    return votes.argmax(axis=1)
