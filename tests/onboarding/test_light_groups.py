"""Laws of the kind of light: what a light changes is told from paint, exposures, noise and highlights."""

import numpy as np
import pytest

from factorlib.geometry.camera import rotation_of_vector
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.onboarding.light_groups import kind_of_light

NORMAL = fibonacci_sphere(800)
TURNS = [rotation_of_vector(np.array([0.3 * np.sin(k), 0.6 * k, 0.2 * np.cos(k)])) for k in range(10)]


def irradiance(normal: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """A sky and a lamp that is twice as bright."""
    return 1.0 + 0.4 * normal[:, 1] + 2.0 * np.maximum(normal @ toward, 0)


def photographed(kind: str, gloss: float) -> np.ndarray:
    """Log radiance of painted patches that face the camera, with exposures, noise and highlights of the lamp."""
    rng = np.random.default_rng(0)
    paint = rng.choice([0.0, -1.2], len(NORMAL))
    rows = []
    for k, turn in enumerate(TURNS):
        toward = {"world": np.array([0.6, 0.7, 0.4]), "camera": turn.T @ [0.6, -0.7, -0.4]}.get(kind)
        toward = rotation_of_vector(np.array([1.0, 2.0 * k, 0.5])) @ [0.8, 0.6, 0.0] if toward is None else toward
        view = turn.T @ [0.0, 0.0, -1.0]
        half = (toward + view) / np.linalg.norm(toward + view)
        shine = gloss * np.exp(80 * (NORMAL @ half - 1)) * np.exp(-paint)
        radiance = np.exp(paint + rng.normal()) * (irradiance(NORMAL, toward) + shine)
        rows.append(np.where(NORMAL @ view > 0.3, np.log(radiance) + 0.05 * rng.normal(size=len(NORMAL)), np.nan))
    return np.array(rows)


@pytest.mark.parametrize("kind", ["world", "camera", "photo"])
@pytest.mark.parametrize("gloss", [0.0, 2.0])
def test_a_light_is_at_rest_fixed_to_the_camera_or_that_of_one_photo(kind, gloss):
    found, spread = kind_of_light(photographed(kind, gloss), NORMAL, np.array(TURNS))
    assert found == kind and (spread < 0.05) == (kind == "world")
