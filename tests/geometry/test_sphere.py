"""Sets of directions are even; mirrors and cells are where they should be."""

import numpy as np
import pytest

from factorlib.geometry.sphere import fibonacci_directions, fibonacci_sphere, mirror_directions


@pytest.mark.parametrize("lattice", [fibonacci_directions, fibonacci_sphere])
def test_directions_cover_the_sphere(lattice):
    directions = lattice(300)
    cosine = directions @ directions.T - 2 * np.eye(300)
    nearest = np.rad2deg(np.arccos(cosine.max(axis=1)))
    assert nearest.min() > 7 and nearest.max() < 14


def test_a_mirror_shows_what_lies_as_far_beyond_the_normal():
    rng = np.random.default_rng(0)
    normal, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 20, 3)))
    mirror = mirror_directions(normal, view)
    assert np.allclose(np.linalg.norm(mirror, axis=1), 1) and np.allclose(
        np.sum(mirror * normal, 1), np.sum(view * normal, 1)
    )
    assert np.allclose(mirror_directions(normal, mirror), view)
