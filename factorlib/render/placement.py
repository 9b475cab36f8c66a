"""Placement of a new object on the ground of a photo, inside the picture and clear of the photo's objects.

Two meshes intersect if an edge of one crosses a triangle of the other, or if one lies within the other.  A new object
that would intersect an existing one moves along the ground.  It moves to the nearest place where it is free and at
least half of it is visible.  One whose place nobody asked for also moves if the picture's border would cut it, to where
all of it is in the picture.  Candidate places form a lattice on the ground with a spacing of a tenth of the object's
height. If none within eight heights is free, a coarser lattice follows.
"""

from collections.abc import Callable, Iterator

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.geometry import open3d as o3d
from factorlib.geometry.camera import rotation_of_vector
from factorlib.geometry.ground import Plane
from factorlib.geometry.raster import Caster
from factorlib.meshes.mesh import Mesh
from factorlib.render.ground import height_over, rotation_between
from factorlib.render.photo_scene import PhotoScene, PlacedMesh
from factorlib.tracing.scene import rigid

RADIUS = 8.0  # radius of the ground about the new object, in its heights
GAP = 0.15  # gap between the objects, in heights of the new one
STEP = 0.1  # spacing of candidate places, in heights
COARSER = 8  # factor on spacing and radius if the first lattice has no free place
ENOUGH = 500  # vertices of the new object that are tested for visibility
LEAST_VISIBLE = 0.5  # least share of the new object's vertices that are visible at the place it is moved to
CUT = "The picture's border cuts the new object: make it smaller (`size`), or name another place, `at: [x, y]`."


class Spot(msgspec.Struct, frozen=True):
    """Place of a new object on the ground, in the world, and its height."""

    plane: Plane
    point: Float[np.ndarray, "3"]
    height: float


def spot_beside(
    scene: PhotoScene, plane: Plane, neighbour: PlacedMesh, relative_height: float, slenderness: float
) -> Spot:
    """Return the place beside an object, on the side with more room in the picture.

    Args:
        scene: the photo's scene
        plane: the ground
        neighbour: the object to stand beside
        relative_height: height of the new object over the neighbour's
        slenderness: width of the new object over its height
    """
    # candidates on both sides of the neighbour, along the picture's x axis in the plane
    height = relative_height * height_over(plane, neighbour)
    right = np.array([1.0, 0.0, 0.0]) - plane.normal[0] * plane.normal
    right /= np.linalg.norm(right)
    across = neighbour.vertices @ right
    foot = plane.onto(neighbour.vertices.mean(axis=0)[None])[0]
    foot = foot + ((across.min() + across.max()) / 2 - foot @ right) * right
    away = (np.ptp(across) / 2 + (slenderness / 2 + GAP) * height) * right
    spots = [foot + side * away for side in (1.0, -1.0)]
    others = [each for each in scene.objects if each is not neighbour]

    def room(point: Float[np.ndarray, "3"]) -> float:
        """Return the distance in pixels to the picture's border or to another object's middle, whichever is less."""
        x, y = scene.camera.project(point @ YUP_FROM_CAMERA)
        width = scene.camera.width
        middles = [each.vertices.mean(axis=0) @ YUP_FROM_CAMERA for each in others]
        distances = [abs(scene.camera.project(middle)[0] - x) for middle in middles]
        return min([x, width - x, scene.camera.height - y, *distances])

    return Spot(plane, max(spots, key=room), height)


def unproject_spot(
    scene: PhotoScene, plane: Plane, neighbour: PlacedMesh, pixel: tuple[float, float], relative_height: float
) -> Spot:
    """Return the place on the ground that a pixel shows.

    Args:
        scene: the photo's scene
        plane: the ground
        neighbour: the object whose height is the reference
        pixel: position in the scene's camera, in pixels
        relative_height: height of the new object over the neighbour's

    Raises:
        InputError: The pixel lies above the horizon.
    """
    ray = scene.camera.rays_through(np.array([pixel])) @ YUP_FROM_CAMERA
    point = plane.hit(ray)[0]
    if not np.isfinite(point).all():
        raise InputError(
            f"pixel {pixel} shows no ground: it lies above the horizon", key="at", cure="name a pixel below the horizon"
        )
    return Spot(plane, point, relative_height * height_over(plane, neighbour))


def standing_mesh(
    name: str, mesh: Mesh, materials: tuple[str, ...], up: Float[np.ndarray, "3"], turn_deg: float, spot: Spot
) -> PlacedMesh:
    """Return a mesh standing on a spot.

    Args:
        name: name of the object
        mesh: the mesh, in its own frame
        materials: names by label, from 1
        up: unit upward direction in the mesh's frame
        turn_deg: angle about the ground's normal, in degrees
        spot: place and height
    """
    # turn `up` onto the normal, then about it; scale to the height; put the lowest point on the spot
    toward = rotation_between(up, spot.plane.normal)
    rotation = rotation_of_vector(np.radians(turn_deg) * spot.plane.normal) @ toward
    vertices = mesh.vertices @ rotation.T
    along = vertices @ spot.plane.normal
    scale = spot.height / np.ptp(along)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    foot = middle + (along.min() - middle @ spot.plane.normal) * spot.plane.normal
    return PlacedMesh(name, mesh, materials, rigid(scale * rotation, spot.point - scale * foot))


class Solid(Caster):
    """Mesh of an object in the world, for intersection tests against others."""

    def __init__(self, placed: PlacedMesh):
        self.name = placed.name
        self.vertices = placed.vertices
        super().__init__(msgspec.structs.replace(placed.mesh, vertices=self.vertices))
        faces = self.mesh.faces
        edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
        self.start = self.vertices[edges[:, 0]]
        self.along = self.vertices[edges[:, 1]] - self.start
        # one vertex of each connected component
        graph = coo_array((np.ones(len(edges)), edges.T), shape=(len(self.vertices),) * 2)
        piece = connected_components(graph, directed=False)[1][faces[:, 0]]
        self.pieces = self.vertices[faces[np.unique(piece, return_index=True)[1], 0]]
        used = self.vertices[np.unique(faces)]
        self.box = used.min(axis=0), used.max(axis=0)

    def crosses(self, start: Float[np.ndarray, "n 3"], along: Float[np.ndarray, "n 3"]) -> np.ndarray:
        """Return a mask of the segments from `start` to `start + along` that cross the surface."""
        # Only segments whose boxes meet the mesh's are cast, in units of the mesh's radius.
        low = start + np.minimum(along, 0)
        high = start + np.maximum(along, 0)
        crossed = ((low <= self.box[1]) & (high >= self.box[0])).all(axis=1)
        rays = np.column_stack([(start[crossed] - self.centre) / self.radius, along[crossed] / self.radius])
        hits = self.scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)), nthreads=1)
        crossed[crossed] = hits["t_hit"].numpy() < 1
        return crossed

    def contains(self, points: Float[np.ndarray, "n 3"]) -> bool:
        """Return True if one of the points lies within the mesh; an open mesh contains nothing."""
        query = o3d.core.Tensor(((points - self.centre) / self.radius).astype(np.float32))
        return not self.mesh.open and bool(self.scene.compute_occupancy(query, nthreads=1, nsamples=3).numpy().any())

    def intersects(self, other: "Solid", move: Float[np.ndarray, "3"]) -> bool:
        """Return True if the mesh, moved by `move`, intersects another."""
        if (self.box[0] + move > other.box[1]).any() or (self.box[1] + move < other.box[0]).any():
            return False
        return bool(
            other.crosses(self.start + move, self.along).any()
            or self.crosses(other.start - move, other.along).any()
            or other.contains(self.pieces + move)
            or self.contains(other.pieces - move)
        )


class FreeSpace:
    """Search for a place on the ground near a spot where a new object is free and visible."""

    def __init__(self, scene: PhotoScene, new: PlacedMesh, spot: Spot):
        self.camera = scene.camera
        self.spot = spot
        self.new = Solid(new)
        self.others = [Solid(each) for each in scene.objects]

    def intersected(self, move: Float[np.ndarray, "3"] = np.zeros(3)) -> Iterator[str]:
        """Yield the names of what the moved object would intersect: objects, or the camera."""
        yield from (f"'{other.name}'" for other in self.others if self.new.intersects(other, move))
        if self.new.contains(-move[None]):
            yield "the camera"

    def visible_shares(self, move: Float[np.ndarray, "3"] = np.zeros(3), every: int = 1) -> tuple[float, float]:
        """Return the shares of the moved object's vertices that are in the picture, and that are also unoccluded.

        Only every `every`-th vertex is tested.
        """
        points = self.new.vertices[::every] + move
        inside = points[self._in_picture(points)]
        hidden = [other.crosses(np.zeros_like(inside), inside) for other in self.others]
        return len(inside) / len(points), float((~np.any(hidden, axis=0)).sum()) / len(points)

    def nearest_move(self, whole: bool = False) -> Float[np.ndarray, "3"] | None:
        """Return the shortest move to a place where the object is free and visible; None if there is none.

        Only places within RADIUS count where all of the object must be in the picture (`whole`).
        """
        plane = self.spot.plane
        every = max(1, len(self.new.vertices) // ENOUGH)
        # lattice of moves on the ground, nearest first
        reach = np.arange(-round(RADIUS / STEP), round(RADIUS / STEP) + 1) * STEP * self.spot.height
        lattice = np.stack(np.meshgrid(reach, 0.0, reach, indexing="ij"), axis=-1).reshape(-1, 3)
        distance = np.linalg.norm(lattice, axis=1)
        order = np.argsort(distance, kind="stable")[: (distance <= RADIUS * self.spot.height).sum()]
        finest = lattice[order] @ rotation_between(np.array([0.0, 1.0, 0.0]), plane.normal).T
        for moves in (finest,) if whole else (finest, COARSER * finest):
            for move in moves[self._in_picture(self.spot.point + moves)]:
                if whole and not self._in_picture(self.new.vertices + move).all():
                    continue
                if self.visible_shares(move, every)[1] >= LEAST_VISIBLE and not any(self.intersected(move)):
                    return move
        return None

    def pixel_text(self, move: Float[np.ndarray, "3"], factor: int) -> str:
        """Return the pixel where the moved object touches the ground, as a recipe writes it.

        `factor` is the number of the photo's pixels per pixel of the scene's camera.
        """
        x, y = factor * self.camera.project((self.spot.point + move) @ YUP_FROM_CAMERA)
        return f"`at: [{x:.0f}, {y:.0f}]`"

    def _in_picture(self, points: Float[np.ndarray, "n 3"]) -> np.ndarray:
        """Return a mask of the points of the world that project into the picture."""
        points = points @ YUP_FROM_CAMERA
        ahead = points[:, 2] > 0
        pixel = self.camera.project(np.where(ahead[:, None], points, 1.0))
        return ahead & ((pixel >= 0) & (pixel <= [self.camera.width, self.camera.height])).all(axis=1)


def free_placement(
    scene: PhotoScene, stand: Callable[[Spot], PlacedMesh], spot: Spot, is_requested: bool, factor: int = 1
) -> tuple[PlacedMesh, Spot, str]:
    """Place a new object where it intersects none of the photo's objects and is visible.

    Args:
        scene: the photo's scene
        stand: places the object on a spot
        spot: the requested spot
        is_requested: True if the recipe names the spot
        factor: pixels of the photo per pixel of the scene's camera

    Returns:
        The object, its spot, and sentences about the displacement and its reason, and about a cut by the picture's
        border (empty if it is whole and did not move).

    Raises:
        InputError: There is no free place, or the object would be invisible at the place that the recipe names.
    """
    new = stand(spot)
    space = FreeSpace(scene, new, spot)
    intersected = list(space.intersected())
    inside, visible = space.visible_shares()
    is_free = not intersected and visible > 0
    stays = is_free and (is_requested or inside == 1)
    move = None if stays else space.nearest_move(whole=True)
    if is_free and move is None:
        return new, spot, CUT if inside < 1 else ""
    reason = "it would be hidden behind other objects" if inside else "it would be outside the picture"
    if intersected:
        reason = f"it would intersect {' and '.join(intersected)}"
    elif is_free:
        reason = "the picture's border would cut it"
    move = space.nearest_move() if move is None else move
    if move is None:
        cure = "name another photo, object or place"
        for share in (0.5, 0.25, 0.125):
            small = msgspec.structs.replace(spot, height=share * spot.height)
            smaller = FreeSpace(scene, stand(small), small)
            if (move := smaller.nearest_move()) is not None:
                cure = f"make it smaller: at {share} of its size it fits at {smaller.pixel_text(move, factor)}"
                break
        fault = f"the new object has no free place in the picture: {reason}"
        raise InputError(fault, key="at" if is_requested else "size", cure=cure)
    place = space.pixel_text(move, factor)
    if is_requested and not intersected:
        raise InputError(f"the new object is invisible: {reason}", key="at", cure=f"the nearest free place is {place}")
    free = msgspec.structs.replace(spot, point=spot.point + move)
    heights = np.linalg.norm(move) / spot.height
    moved = f"The new object was moved by {heights:.1f} of its heights, to {place}, because {reason}."
    return stand(free), free, moved if space.visible_shares(move)[0] == 1 else f"{moved} {CUT}"
