"""Laws of albedo textures: paint that several photos show comes back, and what one photo alone shows is no evidence."""

import numpy as np
import pytest
from scipy.sparse import csc_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import spsolve

from factorlib.generate.solids import sphere
from factorlib.inference.surface import texture
from factorlib.inference.surface.texture import PULL, TextureSamples, observe_texture, select_texture, solve_texture
from factorlib.meshes import subdivision
from factorlib.meshes.subdivision import subdivided_mesh

BODY = subdivided_mesh(sphere(1.0), 0.08)
LAPLACIAN = BODY.laplacian()
PLACE = np.zeros((BODY.nodes, 3))
PLACE[BODY.node] = BODY.mesh.vertices
PAINT = np.exp(0.6 * np.stack([np.sin(3 * PLACE[:, 0]), np.cos(4 * PLACE[:, 1]), np.sin(2 * PLACE[:, 2] + 1)], 1))
FLAT = np.ones((BODY.nodes, 3))


def pixels(paint: np.ndarray, seed: int, noise: float = 0.05, count: int = 6000) -> TextureSamples:
    """Random points of half the body, as one photo shows them in a light of its own."""
    random = np.random.default_rng(seed)
    side = random.normal(size=3)
    visible = np.flatnonzero(PLACE[BODY.faces].mean(1) @ side / np.linalg.norm(side) > -0.5)
    face, share = random.choice(visible, count), random.dirichlet([1, 1, 1], count)
    rows = np.arange(count).repeat(3)
    operator = csr_array((share.reshape(-1), (rows, BODY.faces[face].reshape(-1))), (count, BODY.nodes))
    normal = operator @ PLACE
    diffuse = 0.4 * (1.2 + normal @ random.normal(size=(3, 3)) * 0.3)
    specular = random.uniform(0, 0.2, (count, 1)) * np.ones(3)
    shading = 1 + noise * random.normal(size=(count, 3))
    radiance = diffuse * (operator @ paint) * shading + specular
    cluster = np.unique(np.rint(normal / 0.3).astype(int), axis=0, return_inverse=True)[1].reshape(-1)
    return observe_texture(radiance, diffuse, specular, random.uniform(0.2, 1, count), (operator, cluster))


def test_paint_that_photos_share_comes_back_and_a_wrong_photo_hardly_counts():
    samples = [pixels(PAINT, seed) for seed in range(4)]
    factor, evidence, stiffness = select_texture(samples, LAPLACIAN)
    assert evidence.accepted and stiffness in texture.STIFFNESSES
    assert np.median(np.abs(factor / PAINT - 1)) < 0.03
    wrong = solve_texture([*samples, pixels(3 * FLAT, 9)], LAPLACIAN, stiffness)
    assert np.median(np.abs(wrong / PAINT - 1)) < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_a_plain_material_gets_no_texture_whatever_its_colour(seed):
    samples = [pixels([0.7, 1.0, 1.3] * FLAT, seed + 10 * k, noise=0.1) for k in range(4)]
    assert select_texture(samples, LAPLACIAN)[0] is None


def test_one_photo_is_no_evidence():
    factor, evidence, _ = select_texture([pixels(PAINT, 0)], LAPLACIAN)
    assert factor is None and not evidence.accepted and evidence.held_out_loss_with is None


def test_a_texture_that_is_not_solved_to_its_tolerance_is_said(monkeypatch, caplog):
    solve_texture([pixels(PAINT, 0)], LAPLACIAN, 0.1)
    assert not caplog.text
    monkeypatch.setattr(subdivision, "MOST_ITERATIONS", 2)
    solve_texture([pixels(PAINT, 0)], LAPLACIAN, 0.1)
    assert "did not converge in 2 iterations" in caplog.text


def test_the_texture_is_the_minimum_of_its_system(monkeypatch):
    monkeypatch.setattr(texture, "REWEIGHTINGS", 0)
    monkeypatch.setattr(texture, "CG_TOLERANCE", 1e-10)
    monkeypatch.setattr(subdivision, "MOST_ITERATIONS", 5000)
    samples = [pixels(PAINT, seed, count=500) for seed in (0, 1)]
    system = csc_array(0.3 * LAPLACIAN + PULL * eye_array(BODY.nodes))
    target = np.full((BODY.nodes, 3), PULL)
    for one in samples:
        weighted = one.operator.T @ diags_array(one.weight)
        system = system + weighted @ one.operator
        target += weighted @ one.ratio
    np.testing.assert_allclose(solve_texture(samples, LAPLACIAN, 0.3), spsolve(csc_array(system), target), atol=1e-6)


def test_what_no_photo_shows_continues_what_is_around():
    samples = [pixels([0.5, 1.5, 1.0] * FLAT, seed, noise=0) for seed in range(2)]
    factor = solve_texture(samples, LAPLACIAN, 1.0)
    seen = sum(one.operator.T @ one.weight for one in samples) > 0
    assert not seen.all()
    np.testing.assert_allclose(factor[~seen], np.tile([0.5, 1.5, 1.0], ((~seen).sum(), 1)), rtol=0.05)


def test_photos_of_opposite_sides_are_no_evidence_for_each_other():
    sides = []
    for sign in (1, -1):
        one = pixels(PAINT, 0)
        rows = np.flatnonzero(sign * (one.operator @ PLACE[:, 0]) > 0.3)
        sides.append(TextureSamples(one.operator[rows], one.ratio[rows], one.weight[rows], one.cluster[rows]))
    factor, evidence, _ = select_texture(sides, LAPLACIAN)
    assert factor is None and evidence.held_out_loss_with is None


def test_grazing_and_dark_pixels_count_less():
    diffuse = np.array([0.4, 0.4, 0.04])[:, None] * np.ones(3)
    operator = csr_array(np.eye(3))
    weight = observe_texture(diffuse, diffuse, 0 * diffuse, np.array([1.0, 0.1, 1.0]), (operator, np.arange(3))).weight
    assert weight[1] == pytest.approx(0.1 * weight[0]) and weight[2] < 0.6 * weight[0]


def test_a_metal_observes_no_paint():
    black, shine = np.full((3, 3), 1e-5), np.full((3, 3), 0.3)
    samples = observe_texture(2 * shine, black, shine, np.ones(3), (csr_array(np.eye(3)), np.arange(3)))
    assert (samples.weight < 1e-6).all()


def test_a_channel_too_dark_to_observe_paint_follows_the_others():
    diffuse, shine, factor = np.tile([0.5, 1e-3, 0.5], (4, 1)), np.full((4, 3), 0.05), np.array([0.5, 0.8, 1.0, 1.5])
    radiance = factor[:, None] * diffuse + shine + 0.002  # an error of the highlight
    samples = observe_texture(radiance, diffuse, shine, np.ones(4), (csr_array(np.eye(4)), np.arange(4)))
    np.testing.assert_allclose(samples.ratio, np.tile(factor[:, None], 3), atol=0.02)


def test_paint_that_nobody_sees_is_not_kept():
    samples = [pixels(PAINT**0.05, seed, noise=0.01) for seed in range(3)]
    factor, evidence, _ = select_texture(samples, LAPLACIAN)
    assert factor is None and evidence.margin > texture.CLEARLY_FOR
