"""Turns of normals: derivatives against differences, the step against a dense system, what is found or refused, and which nodes are under pixels."""

import msgspec
import numpy as np
import pytest
import trimesh
from scipy.linalg import block_diag

from factorlib.generate.solids import sphere
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.inference.fit.fit import Fit, FitSchedule, Hyperparameters, fit_problem, light_likelihood
from factorlib.inference.fit.start import start_from_photos
from factorlib.inference.model.blocks import FIT_LOSS
from factorlib.inference.model.materials import Point
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.surface import surface_turns
from factorlib.inference.surface.surface_detail import (
    DetailTrial,
    estimate_surface,
)
from factorlib.inference.surface.surface_turns import (
    LARGEST_TURN,
    LEAST_VIEW_COSINE,
    PULL_SHARE,
    Detail,
    LightTerms,
    Stiffness,
    SurfacePositions,
    Surfaces,
    attach_pixels,
    linearise_light,
    solve_detail,
    zero_detail,
)
from factorlib.meshes import subdivision
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.subdivision import SubdividedMesh, subdivided_mesh
from factorlib.results.poses import ObjectPose, pose_fields
from factorlib.scenes.joint_problems import MATERIALS
from tests.inference.made import in_units_of, photos_in_a_wrong_light
from tests.inference.made_lights import PRIOR, begun, drawn, light_of, on_even_cells, photographed, spheres

TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]  # the object's axes in the camera's frame
COUNTS = Hyperparameters(2.0)


def surfaces(subdivisions: int = 3) -> Surfaces:
    """A ball of radius 1, no finer than the icosphere."""
    solid = trimesh.creation.icosphere(subdivisions)
    vertices, faces, label = np.array(solid.vertices), np.array(solid.faces), np.ones(len(solid.faces), np.int16)
    return Surfaces(
        {"ball": SubdividedMesh(Mesh(vertices, faces, vertices, label), np.arange(len(vertices)), faces, 2.0)}
    )


def attached_to(normal: np.ndarray, body: Surfaces) -> SurfacePositions:
    """Points of the ball by their normals: at each the nearest triangle, whose corners count by their nearness."""
    (one,) = body.meshes.values()
    place, rotation = np.zeros((one.nodes, 3)), TURN
    place[one.node] = one.mesh.vertices
    face = ((normal @ rotation) @ place[one.faces].mean(1).T).argmax(1)
    share = np.exp(30 * (np.einsum("nd,nkd->nk", normal @ rotation, place[one.faces[face]]) - 1))
    return SurfacePositions(
        one.faces[face], share / share.sum(1, keepdims=True), np.tile(rotation, (len(normal), 1, 1))
    )


def wrong(normal: np.ndarray, size: float) -> np.ndarray:
    """Normals of a ball with dents: turned by the gradient of a function of the place."""
    x = normal @ TURN
    slope = np.stack([np.cos(4 * x[:, 0] + 1), np.sin(5 * x[:, 1]), np.cos(3 * x[:, 2] - 2 * x[:, 0])], 1) @ TURN.T
    moved = normal + size * (slope - normal * np.sum(slope * normal, 1, keepdims=True))
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def with_wrong_normals(problem: JointProblem, size: float) -> JointProblem:
    """What the photos show is as it was; the mesh has dents that the object has not."""
    return problem.with_blocks([msgspec.structs.replace(b, normal=wrong(b.normal, size)) for b in problem.blocks])


@pytest.mark.parametrize("kind", ["clipped", "bounced", "hidden"])
def test_slopes_are_those_of_the_forward_model(kind):
    one, body = photos_in_a_wrong_light(kind), surfaces()
    at, random = attached_to(one.block.normal, body), np.random.default_rng(0)
    turn, log_factor = random.normal(size=(2, body.nodes, 3))
    part = linearise_light(one, COUNTS, PRIOR, at, body.nodes)
    own = light_likelihood(one, COUNTS, PRIOR, True).illumination
    residual = own.block.residuals(own.predict().radiance)
    weight = one.root_weights(residual, FIT_LOSS, COUNTS.temperature)
    after, before = (
        msgspec.structs.replace(one, block=Detail(s * turn, s * log_factor).apply_to(one.block, at)).residuals()
        for s in (1e-3, -1e-3)
    )
    inside = np.sum(one.block.normal * one.block.view, 1) > 0.2
    both = np.concatenate([turn.reshape(-1), log_factor.reshape(-1)])
    expected, given = weight * (after - before) / 2e-3, (part.slopes @ both).reshape(-1, 3)
    assert np.abs(expected).max() > 1  # there is something to compare
    error = np.linalg.norm((given - expected)[inside]) / np.linalg.norm(expected[inside])
    assert error < 0.03, error


def dented(size: float) -> tuple[DetailTrial, list[LightTerms]]:
    """A ball whose mesh has dents, in three lights that are at their optimum, and the lights linearised on the mesh."""
    problem, body = spheres([on_even_cells(drawn(100 + k, 120)) for k in range(3)], size=13, seed=1), surfaces()
    given = with_wrong_normals(problem, size).with_all_fitted()
    start, schedule = begun(given), FitSchedule(light_steps=20, materials_fixed=True)
    fit = fit_problem(given, start, PRIOR, schedule)
    at = [attached_to(block.normal, body) for block in problem.blocks]
    trial = DetailTrial(given, fit, body, at, PRIOR)
    return trial, trial.linearise(zero_detail(body.nodes), fit)


def test_the_change_by_a_small_detail_is_that_of_lights_fitted_anew():
    trial, parts = dented(0.05)
    nodes, random = trial.surfaces.nodes, np.random.default_rng(2)
    detail = Detail(*(3e-3 * random.normal(size=(2, nodes, 3))))
    again = fit_problem(trial.with_detail(detail), trial.fit, PRIOR, FitSchedule(light_steps=20, materials_fixed=True))

    def least(problem: JointProblem, fit: Fit) -> list[float]:
        """The minimum of φ of each light, without determinants."""
        pairs = zip(problem.illuminations(fit.point), fit.hyperparameters, strict=True)
        return [light_likelihood(*pair, PRIOR, True).gradient().value for pair in pairs]

    expected = np.subtract(least(trial.with_detail(detail), again), least(trial.problem, trial.fit))
    given = [part.change(detail) for part in parts]
    assert np.abs(expected).max() > 0.2
    np.testing.assert_allclose(given, expected, atol=0.08 * np.abs(expected).max())


@pytest.mark.parametrize("stiffness", [Stiffness(50.0), Stiffness(50.0, 20.0), Stiffness(None, 20.0)])
def test_a_step_is_that_of_the_dense_system_of_detail_and_lights(stiffness, monkeypatch):
    # the accuracy in use leaves what lights explain as well: all factors together
    monkeypatch.setattr(surface_turns, "CG_TOLERANCE", 1e-7)
    monkeypatch.setattr(subdivision, "MOST_ITERATIONS", 2000)
    problem, _, body = *photographed(2, 2, size=9), surfaces(1)
    problem = with_wrong_normals(problem, 0.1)
    fit, random = begun(problem), np.random.default_rng(1)
    start = Detail(0.02 * random.normal(size=(body.nodes, 3)), 0.02 * random.normal(size=(body.nodes, 3)))
    parts = [
        linearise_light(one, COUNTS, PRIOR, attached_to(one.block.normal, body), body.nodes)
        for one in problem.illuminations(fit.point)
    ]
    rough = body.laplacian().toarray() + PULL_SHARE * np.eye(body.nodes)
    prior = block_diag(*((a or 0) * np.kron(rough, np.eye(3)) for a in (stiffness.turn, stiffness.factor)))
    free = np.repeat([stiffness.turn is not None, stiffness.factor is not None], 3 * body.nodes)
    before = np.concatenate([start.turn.reshape(-1), start.log_factor.reshape(-1)])
    v, prior = int(free.sum()), prior[np.ix_(free, free)]
    sizes = [one.light.unknowns for one in problem.illuminations(fit.point)]
    system, gradient = np.zeros((v + sum(sizes),) * 2), np.zeros(v + sum(sizes))
    system[:v, :v], gradient[:v] = prior, prior @ before[free]
    first = v
    for part, one, size in zip(parts, problem.illuminations(fit.point), sizes, strict=True):
        own = slice(first, first + size)
        J = part.slopes.toarray()[:, free]
        U = np.stack([part.residual_change(e) for e in np.eye(size)], axis=1)
        likelihood = light_likelihood(one, COUNTS, PRIOR, True)
        residual = likelihood.illumination.block.residuals(likelihood.illumination.predict().radiance)
        r = (residual * one.root_weights(residual, FIT_LOSS, COUNTS.temperature)).reshape(-1)
        Q, u = likelihood.precision, one.light.log_radiance.reshape(-1)
        system[:v, :v] += J.T @ J
        system[:v, own], system[own, :v], system[own, own] = J.T @ U, U.T @ J, U.T @ U + Q
        gradient[:v] += J.T @ r
        gradient[own] = U.T @ r + Q @ u
        first += size
    expected = before.copy()
    expected[free] -= np.linalg.solve(system, gradient)[:v]
    given = solve_detail(parts, body.laplacian(), stiffness, start)
    given = np.concatenate([given.turn.reshape(-1), given.log_factor.reshape(-1)])
    assert np.linalg.norm(given - expected) < 0.02 * np.linalg.norm(expected - before)
    assert np.array_equal(given[~free], before[~free])


def test_turned_normals_are_unit_bounded_and_never_leave_the_viewer():
    random, body = np.random.default_rng(0), surfaces()
    normal = random.normal(size=(500, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    view = np.tile([0.0, 0.0, 1.0], (500, 1))
    normal[:, 2] = np.abs(normal[:, 2]) + LEAST_VIEW_COSINE
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    at = attached_to(normal, body)
    after = at.turn_normals(normal, view, random.normal(size=(body.nodes, 3)))
    np.testing.assert_allclose(np.linalg.norm(after, axis=1), 1)
    assert (np.sum(after * normal, 1) > 1 / np.hypot(1, LARGEST_TURN) - 1e-9).all() and (
        after[:, 2] >= LEAST_VIEW_COSINE
    ).all()
    np.testing.assert_allclose(at.turn_normals(normal, view, np.zeros((body.nodes, 3))), normal)
    nowhere = msgspec.structs.replace(at, share=np.zeros_like(at.share))
    np.testing.assert_allclose(nowhere.turn_normals(normal, view, np.ones((body.nodes, 3))), normal)


def errors(normals: np.ndarray, true: np.ndarray) -> float:
    """Median angle in degrees."""
    return float(np.median(np.degrees(np.arccos(np.clip(np.sum(normals * true, 1), -1, 1)))))


@pytest.mark.long
def test_of_two_meshes_the_one_with_dents_is_moved_and_the_exact_one_stays():
    true = [on_even_cells(drawn(100 + k, 120)) for k in range(3)]
    problem, (one,) = spheres(true, size=18, seed=1), surfaces().meshes.values()
    body, given, at = Surfaces({"dented": one, "exact": one}), [], []
    for block in problem.blocks:
        exact = block.material == block.material.max()
        assert 0 < exact.sum() < len(block)
        given.append(
            msgspec.structs.replace(block, normal=np.where(exact[:, None], block.normal, wrong(block.normal, 0.15)))
        )
        own = attached_to(block.normal, surfaces())
        at.append(msgspec.structs.replace(own, node=own.node + one.nodes * exact[:, None]))
    what = estimate_surface(problem.with_blocks(given), body, at, start_from_photos(3))
    assert what.evidence.accepted and set(what.displacements) == {"dented"}
    turn = body.turns_from_displacements(what.displacements)
    assert turn[body.node_mask({"dented"})].any() and not turn[body.node_mask({"exact"})].any()
    for block, shown, own in zip(problem.blocks, given, at, strict=True):
        dented = block.material < block.material.max()
        after = own.turn_normals(shown.normal, shown.view, turn)
        assert errors(after[dented], block.normal[dented]) < 0.7 * errors(shown.normal[dented], block.normal[dented])
        np.testing.assert_allclose(after[~dented], shown.normal[~dented], atol=1e-12)


@pytest.mark.long
def test_patina_is_found_in_three_lights_and_is_not_taken_for_dents():
    true = [on_even_cells(drawn(k, 120)) for k in range(3)]
    body, problem = surfaces(), spheres(true, size=13)
    (one,) = body.meshes.values()
    log_factor = 0.4 * np.sin(4 * one.mesh.vertices[:, 0]) * np.cos(3 * one.mesh.vertices[:, 1] + 1)
    log_factor = log_factor[:, None] * [1.0, 0.8, -0.5]
    painted = Detail(np.zeros((body.nodes, 3)), log_factor)
    at = [attached_to(block.normal, body) for block in problem.blocks]
    clean = problem.with_blocks(
        [msgspec.structs.replace(b, inverse_sigma=np.ones_like(b.inverse_sigma)) for b in problem.blocks]
    )
    point = Point(MATERIALS, in_units_of(problem.blocks, true))
    shown = clean.with_blocks([painted.apply_to(b, a) for b, a in zip(clean.blocks, at, strict=True)]).radiance(point)
    plain = clean.radiance(point)
    blocks = [
        msgspec.structs.replace(b, radiance=b.radiance * y / np.maximum(x, 1e-9))
        for b, x, y in zip(problem.blocks, plain, shown, strict=True)
    ]
    what = estimate_surface(problem.with_blocks(blocks), body, at, start_from_photos(3))
    assert what.painted.accepted
    seen = np.bincount(np.concatenate([of.node.reshape(-1) for of in at]), minlength=body.nodes) > 0
    assert min(np.corrcoef(what.log_factors["ball"][seen, c], log_factor[seen, c])[0, 1] for c in range(3)) > 0.8


def sharp(seed: int):
    """A room with three lamps, each narrower than a cell."""
    random = np.random.default_rng(seed)
    axis = np.vstack([[0.0, 0.0, 1.0], random.normal(size=(3, 3)) + [0.0, 0.0, -1.0]])
    weight = np.array([0.4, *random.uniform(20, 60, 3)])[:, None] * random.lognormal(0, 0.1, (4, 3))
    return light_of(axis, [1e-4, 400.0, 800.0, 200.0], weight)


@pytest.mark.long
@pytest.mark.parametrize("lights, shown", [(3, (0, 1, 2)), (5, (1,)), (3, (1, 2))])
@pytest.mark.parametrize("seed", range(2))
def test_an_exact_surface_stays_in_sharp_lights(lights, shown, seed):
    """Cells blur what is sharper than they are, and turned normals must not take that up."""
    problem, body = spheres([sharp(10 * seed + k) for k in range(lights)], shown=shown, size=22, noise=0.1), surfaces()
    at = [attached_to(block.normal, body) for block in problem.blocks]
    what = estimate_surface(problem, body, at, start_from_photos(3))
    assert not what.evidence.accepted and not what.displacements


# ── Nodes under pixels: they are where the pixel's ray meets the mesh, in the frame of the object's pose, whichever s


CAMERA = Camera(60, 50, 80.0, (30.0, 25.0))


def ball(offset=0.0) -> Mesh:
    """A ball of radius 1 beside its origin."""
    whole = sphere(1.0)
    return msgspec.structs.replace(whole, vertices=whole.vertices + [offset, 0, 0])


def entry(pose: Pose) -> ObjectPose:
    """An entry of poses.json."""
    return ObjectPose(**pose_fields(pose))


def test_pixels_of_two_objects_know_their_nodes_and_their_pose():
    random = np.random.default_rng(0)
    turns = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(2)]
    turns = [turn * np.sign(np.linalg.det(turn)) for turn in turns]
    poses = [Pose(turns[0], np.array([-1.2, 0, 5.0])), Pose(turns[1], np.array([1.3, 0.2, 6.0]))]
    meshes = {"apple": ball(), "pear": ball(0.3)}
    maps = rasterise([meshes["apple"], meshes["pear"]], CAMERA, poses)
    surfaces = Surfaces({name: subdivided_mesh(mesh) for name, mesh in meshes.items()})
    objects = {"a": ("apple", entry(poses[0])), "b": ("pear", entry(poses[1]))}
    y, x = np.nonzero(maps.object >= 0)
    at = attach_pixels(np.column_stack([x, y]), maps.object[y, x], CAMERA, objects, surfaces)
    place = np.zeros((surfaces.nodes, 3))
    for name, own in surfaces.meshes.items():
        place[surfaces.first_nodes[name] + own.node] = own.mesh.vertices
    points = np.einsum("nk,nkd->nd", at.share, place[at.node])
    for number, (pose, name) in enumerate(zip(poses, meshes), start=1):
        rows = (maps.object[y, x] == number) & at.share.any(1)
        assert rows.sum() > 100 and (at.node[rows] >= surfaces.first_nodes[name]).all()
        np.testing.assert_allclose(pose.apply(points[rows])[:, 2], maps.depth[y, x][rows], atol=1e-4)
        np.testing.assert_allclose(at.share[rows].sum(1), 1)
        np.testing.assert_allclose(at.frame[rows], np.broadcast_to(pose.rotation, (rows.sum(), 3, 3)))
    assert not at.share[maps.object[y, x] == 0].any()
