"""Parametrisation of a pose and a focal length by seven numbers that are nearly independent in an image."""

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.geometry.camera import Camera, Pose, rotation_of_vector
from factorlib.geometry.raster import Caster
from factorlib.meshes.mesh import Mesh

GENERATORS = np.cross(np.eye(3)[:, None], np.eye(3))  # of rotations; [k, i, j]: component j of e_k × e_i


class PoseState(msgspec.Struct, frozen=True):
    """Pose of a mesh by its rotation and the position of its centre, with the focal length.

    rotation   cam_from_object             a, b       slopes of the ray to the mesh's centre: x/z, y/z
    log_depth  of the centre, mesh units   log_focal  photo pixels
    """

    rotation: Float[np.ndarray, "3 3"]
    a: float
    b: float
    log_depth: float
    log_focal: float

    def middle(self) -> Float[np.ndarray, "3"]:
        """Return the mesh's centre in camera coordinates, mesh units."""
        return np.exp(self.log_depth) * np.array([self.a, self.b, 1.0])

    def pose(self, mesh: Mesh | Caster) -> Pose:
        """Return cam_from_object of a mesh with this centre."""
        return Pose(self.rotation, self.middle() - self.rotation @ mesh.centre)

    @property
    def focal(self) -> float:
        """Focal length, photo pixels."""
        return float(np.exp(self.log_focal))

    def camera(self, template: Camera) -> Camera:
        """Return `template` with this state's focal length."""
        return msgspec.structs.replace(template, focal=self.focal)

    def moved(self, step: Float[np.ndarray, "7"]) -> "PoseState":
        """Return the state moved by `step`: rotation vector in camera axes (3), a, b, log depth, log focal.

        A step of log focal changes depth and slopes as well, so that size and place in the image stay.
        """
        zoom = step[6]
        a = float((self.a + step[3]) * np.exp(-zoom))
        b = float((self.b + step[4]) * np.exp(-zoom))
        log_depth = float(self.log_depth + step[5] + zoom)
        return PoseState(rotation_of_vector(step[:3]) @ self.rotation, a, b, log_depth, float(self.log_focal + zoom))

    def jacobian(self, arms: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 7"]:
        """Return the derivative of image points (photo pixels) by the step of `moved`.

        `arms` are the points' offsets from the centre, in camera axes.
        """
        depth = np.exp(self.log_depth)
        focal = np.exp(self.log_focal)
        point = arms + self.middle()
        # moves of the points in camera axes by a, b, log depth, log focal, and by rotation about axis k (e_k × arm)
        shifts = depth * np.array([[1, 0, self.a, 0], [0, 1, self.b, 0], [0, 0, 1, 1]])
        turns = np.moveaxis(arms @ GENERATORS, 0, -1)
        moves = np.concatenate([turns, np.broadcast_to(shifts, (len(arms), 3, 4))], axis=-1)
        # derivative of the perspective projection; log focal also scales the image
        slope = point[:, :2] / point[:, 2:]
        result = (moves[:, :2] - slope[:, :, None] * moves[:, 2:]) * (focal / point[:, 2])[:, None, None]
        result[:, :, 6] += focal * slope
        return result


def pose_state(pose: Pose, camera: Camera, mesh: Mesh | Caster) -> PoseState:
    """Return the state of a mesh's pose, the inverse of `PoseState.pose`.

    Args:
        pose: Pose of the mesh.
        camera: Camera, for its focal length.
        mesh: The mesh, for its centre.

    Returns:
        The state.
    """
    x, y, z = pose.apply(mesh.centre[None])[0]
    return PoseState(pose.rotation, float(x / z), float(y / z), float(np.log(z)), float(np.log(camera.focal)))
