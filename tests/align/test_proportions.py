"""Factors of a mesh's axes: found where many photos show them, exactly 1 where nothing asks for them."""

from __future__ import annotations

import numpy as np
import pytest

from factorlib.align import proportions as module
from factorlib.align.proportions import SHAPES, Sighting, jacobian_with_shape, proportions
from factorlib.align.refine import FocalPrior
from factorlib.align.state import state_of
from factorlib.align.target import target_of
from factorlib.geometry.raster import Caster, rasterise
from factorlib.meshes.mesh import area_vectors, scaled
from tests.align.scenes import blob, chair, photo_of, true_silhouette


def sightings(true, given, count=4, focal_sigma=0.0, seed=20):
    """Photos of `true` that are said to show `given`, at the true pose of its middle; and (caster, camera, pose) of each."""
    made, truth = [], []
    for k in range(count):
        caster, camera, pose = photo_of(true, seed + k)
        target = target_of(true_silhouette(caster, camera, pose), given.labels, 200, 0.15)
        prior, start = FocalPrior(camera.focal, focal_sigma), state_of(pose, camera, given)
        made.append(Sighting(given, target, camera, prior, start))
        truth.append((caster, camera, pose))
    return made, truth


def error_deg(true, camera, state, mesh):
    """Of the normals where both meshes are seen, degrees."""
    there, here = rasterise(*true), rasterise(mesh, state.camera(camera), state.pose(mesh))
    both = (there.label > 0) & (here.label > 0)
    cosine = np.clip(np.sum(there.normal[both] * here.normal[both], axis=1), -1, 1)
    return float(np.rad2deg(np.median(np.arccos(cosine))))


@pytest.mark.parametrize(
    "mesh, off, focal_sigma", [(blob, (1.15, 1, 1), 0.0), (chair, (1, 1, 0.88), 0.0), (chair, (1, 1.12, 1), 0.1)]
)
def test_wrong_proportions_come_back_within_three_percent(mesh, off, focal_sigma):
    true = mesh()
    given = scaled(true, off)
    shown, truth = sightings(true, given, focal_sigma=focal_sigma)
    verdict = proportions(shown)
    wanted = 1 / np.array(off)
    assert verdict.used and np.allclose(verdict.fitted.factors, wanted / wanted.prod() ** (1 / 3), rtol=0.03)
    assert verdict.fitted.factors.prod() == pytest.approx(1) and verdict.held_out_after < 0.5 * verdict.held_out_before
    mesh, states = Caster(scaled(given, verdict.fitted.factors)), verdict.fitted.states
    assert max(error_deg(true, camera, state, mesh) for true, state in zip(truth, states) for camera in [true[1]]) < 1


@pytest.mark.parametrize("mesh", [blob, chair])
def test_an_exact_mesh_keeps_factors_of_exactly_one(mesh):
    shown, _ = sightings(mesh(), mesh())
    verdict = proportions(shown)
    assert not verdict.used and verdict.fitted.factors.tolist() == [1.0, 1.0, 1.0]
    assert all(state is one.state for state, one in zip(verdict.fitted.states, shown, strict=True))


def test_what_one_photo_alone_asks_for_is_not_used():
    other, _ = sightings(scaled(chair(), (1.15, 1, 1)), chair(), count=1, seed=21)
    verdict = proportions(other)
    assert not verdict.used and "one photo" in verdict.reason and verdict.fitted.factors.tolist() == [1.0, 1.0, 1.0]
    exact, _ = sightings(chair(), chair(), count=1)
    verdict = proportions(exact + other)
    assert not verdict.used and verdict.held_out_after > 0.8 * verdict.held_out_before


def test_photos_are_judged_by_factors_that_they_had_no_say_in(monkeypatch):
    shown, _ = sightings(chair(), scaled(chair(), (1.15, 1, 1)), count=5)
    fit, judge, fits, judged = module.fitted, module.unexplained, [], []

    def spied_fit(ones, steps):
        fits.append((ones, fit(ones[:1], 1).factors))
        return module.Fitted(fits[-1][1], [one.state for one in ones])

    def spied_judge(one, factors, steps):
        judged.append((one, factors))
        return judge(one, factors, 1)

    monkeypatch.setattr(module, "fitted", spied_fit)
    monkeypatch.setattr(module, "unexplained", spied_judge)
    proportions(shown)
    for one, factors in judged:
        assert all(one is not other for ones, of in fits if of is factors for other in ones)
    assert sum(factors.tolist() != [1.0] * 3 for _, factors in judged) == len(shown)


def test_image_points_move_by_the_derivative():
    rng = np.random.default_rng(0)
    caster, camera, pose = photo_of(chair(), 1)
    state = state_of(pose, camera, caster)
    points = rng.normal(size=(30, 3))

    def image(step, shape):
        moved = state.moved(step)
        return moved.camera(camera).project(points * np.exp(SHAPES @ shape) @ moved.rotation.T + moved.middle())

    numeric, h = np.empty((30, 2, 9)), 1e-6
    for k, step in enumerate(h * np.eye(9)):
        numeric[..., k] = (image(step[:7], step[7:]) - image(-step[:7], -step[7:])) / (2 * h)
    assert np.allclose(jacobian_with_shape(state, points @ state.rotation.T), numeric, rtol=1e-4, atol=1e-3)


def test_normals_of_a_scaled_mesh_are_normal_to_it():
    mesh = scaled(blob(), (1.3, 0.8, 1.1))
    area = area_vectors(mesh.vertices, mesh.faces)
    cosine = np.sum(mesh.normals[mesh.faces[:, 0]] * area, axis=1) / np.linalg.norm(area, axis=1)
    assert cosine.mean() > 0.99
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1)
