"""Laws of the choice of lights: another side tells more than more of the same, and sides are those of the mesh."""

from collections import Counter

import msgspec
import numpy as np

from factorlib.dataset.schema import Intrinsics, MeshEntry, MeshInstance, ObjectsSlice
from factorlib.geometry.camera import rotation_of_vector
from factorlib.inference.surface.aligned_photo import AlignedPhoto
from factorlib.inference.surface.light_selection import count_by_side, select_lights
from factorlib.results.poses import CameraEntry, ObjectPose, PhotoPoses
from tests.inference.made import observations_from_front

FRONT, BACK = ("jug", "clay", 0), ("jug", "clay", 5)


def test_another_side_and_another_material_tell_more_than_the_same_again():
    front, more, back = Counter({FRONT: 2000}), Counter({FRONT: 5000}), Counter({BACK: 200})
    foot = Counter({("jug", "glaze", 0): 300})
    counts = {"a": front, "b": more, "c": back, "d": foot}
    assert select_lights(counts, 3) == ["b", "c", "d"]
    assert select_lights(dict(reversed(counts.items())), 3) == ["b", "c", "d"]
    assert select_lights(counts, 9) == ["a", "b", "c", "d"]
    assert select_lights({"q": front, "p": front}, 1) == ["p"]


def test_sides_are_those_of_the_mesh():
    """A mesh and a camera that turn together show the same side; one that turns alone shows another."""
    view = np.tile(np.float32([0, 0, -1]), (50, 1))
    seen = observations_from_front(view, np.ones((50, 3), "f4"), np.zeros(50, int), ("clay",), "a")
    objects = ObjectsSlice(Intrinsics(), [MeshInstance("one", "jug")], {"jug": MeshEntry("jug.obj", material="clay")})
    turn = rotation_of_vector(np.array([0.3, 1.2, 0.4]))

    def counts(rotation, view):
        pose = ObjectPose(tuple(map(tuple, rotation.tolist())), (0.0, 0.0, 4.0))
        photo = AlignedPhoto(None, objects, PhotoPoses(CameraEntry(500.0, (50.0, 50.0)), {"one": pose}))
        return count_by_side(photo, msgspec.structs.replace(seen, view=view))

    first = counts(np.eye(3), view)
    assert list(first.values()) == [50] and {key[:2] for key in first} == {("jug", "clay")}
    assert counts(turn, view @ turn.T) == first != counts(turn, view)
