"""A pose and a focal length as the search moves them: seven numbers that hardly depend on each other in an image."""

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.geometry.camera import Camera, Pose, rotation_of_vector
from factorlib.geometry.raster import Caster
from factorlib.meshes.mesh import Mesh

TURNS = np.cross(np.eye(3)[:, None], np.eye(3))  # [k, i, j]: component j of e_k × e_i


class State(msgspec.Struct, frozen=True):
    """Where the middle of a mesh is and how it is turned.

    rotation   cam_from_object             a, b       slopes of the ray to the mesh's centre: x/z, y/z
    log_depth  of the centre, mesh units   log_focal  photo pixels
    """

    rotation: Float[np.ndarray, "3 3"]
    a: float
    b: float
    log_depth: float
    log_focal: float

    def middle(self) -> Float[np.ndarray, "3"]:
        """The mesh's centre in camera coordinates, mesh units."""
        return np.exp(self.log_depth) * np.array([self.a, self.b, 1.0])

    def pose(self, mesh: Mesh | Caster) -> Pose:
        """cam_from_object of a mesh with this centre."""
        return Pose(self.rotation, self.middle() - self.rotation @ mesh.centre)

    def camera(self, like: Camera) -> Camera:
        """`like` with this state's focal length."""
        return msgspec.structs.replace(like, focal=float(np.exp(self.log_focal)))

    def moved(self, step: Float[np.ndarray, "7"]) -> "State":
        """Return the state moved by (turn about camera axes 3, a, b, log depth, log focal); the focal length takes the depth along, so that
        the size and place in the image stay."""
        zoom, (a, b) = step[6], (self.a + step[3], self.b + step[4])
        slopes = float(a * np.exp(-zoom)), float(b * np.exp(-zoom))
        logs = float(self.log_depth + step[5] + zoom), float(self.log_focal + zoom)
        return State(rotation_of_vector(step[:3]) @ self.rotation, *slopes, *logs)

    def jacobian(self, arms: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 7"]:
        """Derivative of the image points (photo pixels) of points at `arms` from the centre (camera axes), by `moved`."""
        depth, focal = np.exp(self.log_depth), np.exp(self.log_focal)
        point = arms + self.middle()
        shifts = depth * np.array([[1, 0, self.a, 0], [0, 1, self.b, 0], [0, 0, 1, 1]])  # by a, b, log depth, log focal
        turns = np.moveaxis(arms @ TURNS, 0, -1)  # about axis k: e_k × arm
        moves = np.concatenate([turns, np.broadcast_to(shifts, (len(arms), 3, 4))], axis=-1)
        slope = point[:, :2] / point[:, 2:]
        result = (moves[:, :2] - slope[:, :, None] * moves[:, 2:]) * (focal / point[:, 2])[:, None, None]
        result[:, :, 6] += focal * slope
        return result


def state_of(pose: Pose, camera: Camera, mesh: Mesh | Caster) -> State:
    """The state of a pose of a mesh.  `State.pose` undoes it."""
    x, y, z = pose.apply(mesh.centre[None])[0]
    return State(pose.rotation, float(x / z), float(y / z), float(np.log(z)), float(np.log(camera.focal)))
