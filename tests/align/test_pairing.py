"""Parts of a mesh are matched to labels of masks by silhouettes, and what they cannot tell is not sure."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorlib.align.pairing import HIDDEN, match_parts
from factorlib.align.silhouette import Silhouette
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.meshes.mesh import Mesh, smooth

CAMERA = Camera(120, 90, 150.0, (60.0, 45.0))
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
BOX = np.array([[a, b, c] for a, b, c, d in SIDES] + [[a, c, d] for a, b, c, d in SIDES])


def boxes(*sizes_and_places):
    """A part for each box."""
    vertices = np.concatenate([CORNERS * size + place for size, place in sizes_and_places])
    faces = np.concatenate([BOX + 8 * k for k in range(len(sizes_and_places))])
    return smooth(vertices, faces, np.repeat(np.arange(1, len(sizes_and_places) + 1), len(BOX)))


LAMP = boxes(((1.0, 0.4, 0.4), (0, 1.0, 0)), ((0.15, 0.9, 0.15), (0, -0.3, 0)))
TWINS = boxes(((0.5, 0.5, 0.5), (0.5, 0, 0)), ((0.5, 0.5, 0.5), (-0.5, 0, 0)))


def seen(mesh: Mesh, labels, seed):
    """A sighting in some pose: label of each part, 0 for one that the photo does not tell from the background."""
    turn = Rotation.random(random_state=seed).as_matrix()
    label = rasterise(mesh, CAMERA, Pose(turn, np.array([0.1, 0, 5.0]) - turn @ mesh.centre)).label
    return Silhouette(np.array([0, *labels], np.int16)[label])


def test_parts_get_the_labels_that_they_were_drawn_with_in_each_photo():
    drawn = [(1, 3), (2, 3), (1, 3), (2, 3), (4, 3)]
    sightings = [seen(LAMP, labels, seed) for seed, labels in enumerate(drawn)]
    unseen = 0
    for sighting, labels, paired in zip(sightings, drawn, match_parts(LAMP, 2, sightings)):
        for label, likely, margin in zip(labels, paired.labels, paired.margins):
            shown = (sighting.label == label).sum() > 0.02 * sighting.inside.sum()
            assert (likely[0] == label and margin > 0.5) if shown else (HIDDEN in likely[:2] and margin < 0.1)
            unseen += not shown
    assert unseen == 1


def test_parts_that_look_alike_are_not_sure():
    (paired,) = match_parts(TWINS, 2, [seen(TWINS, (1, 2), 3)])
    assert max(paired.margins) < 0.1 and all(set(each) == {1, 2} for each in paired.labels)


def test_a_part_of_the_same_material_is_told_from_one_that_is_hidden():
    of_one = seen(LAMP, (1, 1), 4)
    (paired,) = match_parts(LAMP, 2, [of_one])
    assert [each[0] for each in paired.labels] == [1, 1]
    label = seen(LAMP, (1, 2), 4).label
    (paired,) = match_parts(LAMP, 2, [Silhouette(np.where(label == 2, np.int16(-1), label))])
    assert HIDDEN in paired.labels[1][:2] and paired.margins[1] < 0.1


@pytest.mark.parametrize("kinds", [3, 0])
def test_more_labels_than_parts_and_none_tell_nothing(kinds):
    label = seen(LAMP, (1, 1), 5).label
    stripes = (np.arange(label.shape[1]) % max(kinds, 1) + 1) * min(kinds, 1)
    assert match_parts(LAMP, 2, [Silhouette(np.where(label > 0, stripes, 0).astype(np.int16))]) == [None]
