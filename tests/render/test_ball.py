"""Balls: their frame, and which of their normals a photo shows."""

import numpy as np

from factorlib.geometry.sphere import ball_normals
from factorlib.light.lobes import Lobes
from factorlib.reflection import reflection_operator
from factorlib.render.ball import ball, observed_cells
from factorlib.render.reflect import Reflector
from factorlib.results.materials import Reflectance

LAMBERTIAN = Reflectance((0.5, 0.5, 0.5), (0.0, 0.0, 0.0), 0.5)


def brightest(axis) -> tuple[float, float]:
    """Row and column of the brightest pixel of a ball lit from `axis`, from −1 to 1."""
    lobe = Lobes(np.array([axis]) / np.linalg.norm(axis), np.array([50.0]), np.ones((1, 3)))
    picture = ball(Reflector(reflection_operator("closed_form"), lobe), LAMBERTIAN, 32)
    return tuple((i + 0.5) / 16 - 1 for i in np.unravel_index(picture[..., 0].argmax(), (32, 32)))


def test_light_comes_from_the_side_it_is_on():
    row, column = brightest((1.0, 0.0, -1.0))  # camera frame: from the right and from the viewer
    assert column > 0.5 and abs(row) < 0.2
    row, column = brightest((0.0, -1.0, -1.0))  # from above
    assert row < -0.5 and abs(column) < 0.2


def test_observed_cells_are_where_the_normals_are_without_holes():
    normals = ball_normals(20)[0] * (1, -1, -1)  # in the camera's frame
    right = normals[normals[:, 0] > 0.1]
    cells = observed_cells(right, 64)
    assert not cells[:, :32].any()
    assert cells[24:40, 38:60].all()
    assert not observed_cells(right[:0], 64).any()
