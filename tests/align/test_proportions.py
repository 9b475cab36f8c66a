"""Factors of a mesh's axes: found where many photos show them, exactly 1 where nothing asks for them."""

from __future__ import annotations

import numpy as np
import pytest

from factorlib.align.proportions import BOX, Sighting, jacobian_with_shape, proportions
from factorlib.align.refine import FocalPrior
from factorlib.align.state import state_of
from factorlib.align.target import target_of
from factorlib.geometry.raster import Caster, rasterise
from factorlib.meshes.mesh import scaled
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


@pytest.mark.parametrize("mesh, off, focal_sigma", [(blob, (1.15, 1, 1), 0.0), (chair, (1, 1.12, 1), 0.1)])
def test_wrong_proportions_come_back_within_three_percent(mesh, off, focal_sigma):
    true = mesh()
    given = scaled(true, off)
    shown, truth = sightings(true, given, focal_sigma=focal_sigma)
    verdict = proportions(shown)
    wanted = 1 / np.array(off)
    assert verdict.used and np.allclose(verdict.factors, wanted / wanted.prod() ** (1 / 3), rtol=0.03)
    assert verdict.factors.prod() == pytest.approx(1) and verdict.held_out_after < 0.5 * verdict.held_out_before
    mesh, states = Caster(scaled(given, verdict.factors)), verdict.states
    assert max(error_deg(true, camera, state, mesh) for true, state in zip(truth, states) for camera in [true[1]]) < 1


@pytest.mark.parametrize("mesh", [blob, chair])
def test_an_exact_mesh_keeps_factors_of_exactly_one(mesh):
    shown, _ = sightings(mesh(), mesh())
    verdict = proportions(shown)
    assert not verdict.used and verdict.factors.tolist() == [1.0, 1.0, 1.0]
    assert all(state is one.state for state, one in zip(verdict.states, shown, strict=True))


def test_what_one_photo_alone_asks_for_is_not_used():
    other, _ = sightings(scaled(chair(), (1.15, 1, 1)), chair(), count=1, seed=21)
    verdict = proportions(other)
    assert not verdict.used and "one photo" in verdict.reason and verdict.factors.tolist() == [1.0, 1.0, 1.0]
    exact, _ = sightings(chair(), chair(), count=1)
    verdict = proportions(exact + other)
    assert not verdict.used and verdict.held_out_after > 0.8 * verdict.held_out_before


def test_image_points_move_by_the_derivative():
    rng = np.random.default_rng(0)
    caster, camera, pose = photo_of(chair(), 1)
    state = state_of(pose, camera, caster)
    points = rng.normal(size=(30, 3))

    def image(step, shape):
        moved = state.moved(step)
        return moved.camera(camera).project(points * np.exp(BOX @ shape) @ moved.rotation.T + moved.middle())

    numeric, h = np.empty((30, 2, 9)), 1e-6
    for k, step in enumerate(h * np.eye(9)):
        numeric[..., k] = (image(step[:7], step[7:]) - image(-step[:7], -step[7:])) / (2 * h)
    assert np.allclose(jacobian_with_shape(state, points @ state.rotation.T), numeric, rtol=1e-4, atol=1e-3)
