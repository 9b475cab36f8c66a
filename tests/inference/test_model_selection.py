"""What is in the model is decided by what is held out: shadows, bounces, tone curves, distances of lights, the start."""

from functools import cache

import msgspec
import numpy as np
import pytest

from factorlib.geometry.sphere import NO_OCCLUDER, fibonacci_sphere, occluder_codes
from factorlib.images.tone import curve
from factorlib.inference import model_selection, suns
from factorlib.inference.blocks import FIT_LOSS, Noise
from factorlib.inference.fit import FitSchedule, reliable_observations
from factorlib.inference.fit_runner import FitRunner
from factorlib.inference.forward import Illumination
from factorlib.inference.gauge import BRIGHTEST
from factorlib.inference.identifiability import unlikely_curves
from factorlib.inference.interreflection import bounced_light
from factorlib.inference.joint_solver import solve
from factorlib.inference.materials import Point
from factorlib.inference.model_selection import (
    CLEARLY_FOR,
    CURVATURES,
    LEAST_TONE_GAIN,
    LIGHTS_ONLY,
    VERY_STRONG,
    Losses,
    compare_models,
    log_bayes_factors,
    near_share,
    select_distances,
    select_effects,
    select_tone_curves,
    simultaneous_margin,
)
from factorlib.inference.observed import blocks_of_observations
from factorlib.inference.options import SolveOptions
from factorlib.inference.problem import JointProblem
from factorlib.inference.start import start_from_photos
from factorlib.inference.suns import select_suns
from factorlib.inference.uncertainty import Posterior, estimate_uncertainty
from factorlib.scenes.joint_problems import MATERIALS, factor_between, sphere_normals
from factorlib.urm.observations import Observations
from tests.inference.made import bowls, none_held_out, rough_light
from tests.inference.made_lights import OPERATOR, PRIOR, begun, drawn, on_even_cells, spheres

QUICK = SolveOptions(cells=60, splittings=0, observations=300)
OF_SHAPES = msgspec.structs.replace(QUICK, cells=36, observations=180, tone="off")  # shadows and bounces
# an exponent that all photos share is known less
MANY = msgspec.structs.replace(QUICK, observations=1000)


def solved(blocks, choices=QUICK, **others):
    choices = msgspec.structs.replace(choices, **others)
    return solve(JointProblem(blocks, OPERATOR), start_from_photos(len(MATERIALS)), choices)


# ── shadows and bounces, on bowls ────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def shaded():
    return [blocks_of_observations(bowls(f"room{i}", rough_light(20 + i)), Noise(0.02, 0.02))[0] for i in range(2)]


def lit_bowls(name, seed) -> Observations:
    """A bowl and a ball of each material, all bounces within a bowl as (1) has them: the fixed point of what it sends itself."""
    observed, normals, d = bowls(name, rough_light(seed), size=12, count=256), sphere_normals(12), fibonacci_sphere(256)
    exits = -normals[:, None] + 2 * (normals @ d.T)[..., None] * d
    facing = occluder_codes(np.zeros(exits.shape[0] * 256, int), -exits.reshape(-1, 3)).reshape(-1, 256)
    codes = np.vstack([facing + 64 * (k // 2) for k in range(6)])
    observed = msgspec.structs.replace(
        observed, occluder=np.where(observed.visibility == 0, codes, NO_OCCLUDER).astype(np.uint16)
    )
    radiance = observed.radiance
    for _ in range(8):
        bounced = bounced_light(observed, radiance)
        kd, ks = MATERIALS.diffuse[observed.material], MATERIALS.specular[observed.material]
        radiance = observed.radiance + kd * bounced[:, :3] + ks * bounced[:, 3:]
    return msgspec.structs.replace(observed, radiance=radiance)


@cache
def lit_rooms(seed: int) -> list[Observations]:
    return [lit_bowls(f"room{i}", seed + i) for i in range(2)]


@pytest.fixture(scope="module")
def lit():
    return [blocks_of_observations(observed, Noise(0.02, 0.02))[0] for observed in lit_rooms(20)]


@pytest.mark.long
def test_materials_of_bowls_are_better_with_self_shadowing_and_the_solve_finds_that_out(shaded):
    error = {}
    for choice in ("off", "auto"):
        solution = solved(shaded, OF_SHAPES, self_shadowing=choice)
        result = solution.point.materials
        factor = factor_between(result, MATERIALS)
        off = result.diffuse * factor / MATERIALS.diffuse - 1, result.roughness - MATERIALS.roughness
        error[choice] = [np.abs(each).mean() for each in off]
    assert solution.shadows.accepted and solution.shadows.margin > CLEARLY_FOR
    assert solution.shadows.held_out_loss_with < 0.5 * solution.shadows.held_out_loss_without
    assert error["auto"][0] < 0.5 * error["off"][0], error
    assert error["auto"][1] < error["off"][1] + 0.01, error


def test_the_solve_finds_out_that_bowls_light_themselves_and_how_bright_they_are(lit):
    error = {}
    for choice in ("off", "auto"):
        solution = solved(lit, OF_SHAPES, self_shadowing="on", interreflection=choice)
        off = solution.point.materials.diffuse / MATERIALS.diffuse - 1  # absolute: no factor is taken out
        error[choice] = np.abs(off).mean()
    assert solution.interreflection.accepted and solution.interreflection.log_bayes_factor > VERY_STRONG
    assert error["auto"] < 0.5 * error["off"], error


def hull(seen: Observations) -> Observations:
    """What a mesh without hollows says of the same photos: all surfaces bulge toward the viewer, and only what rises above the horizon of a
    shallow dish is hidden, by the same surfaces."""
    shallow = seen.normal * [-0.4, -0.4, 1.0]
    hidden = (seen.visibility == 0) & (fibonacci_sphere(seen.visibility.shape[1])[:, 2] > -0.3)
    return msgspec.structs.replace(
        seen,
        normal=(shallow / np.linalg.norm(shallow, axis=1, keepdims=True)).astype(seen.normal.dtype),
        visibility=np.where(hidden, 0, 255).astype(np.uint8),
        occluder=np.where(hidden, seen.occluder, NO_OCCLUDER).astype(np.uint16),
    )


def test_bounces_of_a_hull_without_hollows_do_not_darken_the_materials():
    blocks = [blocks_of_observations(hull(observed), Noise(0.02, 0.02))[0] for observed in lit_rooms(20)]
    solution = solved(blocks, OF_SHAPES)
    assert not solution.interreflection.accepted, solution.interreflection
    assert solution.point.materials.diffuse.max() > 0.5 * MATERIALS.diffuse.max()


def test_shadows_that_are_none_are_given_up(shaded):
    rng = np.random.default_rng(0)
    open_ = spheres([on_even_cells(drawn(k, 80)) for k in range(2)], size=10).blocks

    def hiding(visibility):
        how = {"directions": np.stack([fibonacci_sphere(96)])}
        return [msgspec.structs.replace(b, visibility=visibility(b).astype(np.uint8), **how) for b in open_]

    wrong = hiding(lambda b: 255 * (rng.random((len(b), 96)) < 0.5))
    few = {"cells": 24, "observations": 150, "tone": "off"}
    result = solved(wrong, **few)
    assert not result.shadows.accepted and result.shadows.log_bayes_factor < -VERY_STRONG
    assert solved(wrong, **few, self_shadowing="on").shadows.accepted


# ── tone curves ──────────────────────────────────────────────────────────────────────────────────────────────────────


def rooms(photos=1, size=12):
    rng = np.random.default_rng(3)
    exposures = [np.concatenate([[0.0], rng.normal(0, 0.5, photos - 1)]) for _ in range(3)]
    lights = [on_even_cells(drawn(30 + k, 60), e, name=f"room{k}") for k, e in enumerate(exposures)]
    return spheres(lights, size=size, noise=0.05).blocks


def through(data, *exponents):
    """What cameras with tone curves make of it, one exponent a photo."""
    radiance = curve(data.radiance, np.array(exponents)[data.photo][:, None])
    return msgspec.structs.replace(data, radiance=radiance, inverse_sigma=1 / np.hypot(0.05, 0.05 * radiance))


def exponents_of(solution):
    return [np.exp(light.log_tone) for light in solution.point.lights]


def error_of(solution):
    result = solution.point.materials
    return np.abs(result.diffuse * factor_between(result, MATERIALS) - MATERIALS.diffuse).max()


@pytest.fixture(scope="module")
def curved():
    return [through(data, exponent) for data, exponent in zip(rooms(size=20), (1.3, 0.8, 1.0), strict=True)]


@pytest.mark.long
def test_curves_are_found_and_spare_the_materials_by_evidence_that_held_out_losses_fall(curved):
    result, without = (solved(curved, MANY, tone=tone) for tone in ("auto", "off"))
    exponents = [float(e[0]) if len(e) else 1.0 for e in exponents_of(result)]
    off = np.log(exponents) - np.log((1.3, 0.8, 1.0))
    assert (
        np.ptp(off) < 0.02 and abs(off.mean()) < 0.08
    )  # what all photos share, a light of more contrast nearly explains
    assert all(len(e) == 0 for e in exponents_of(without))
    assert error_of(result) < 0.4 * error_of(without), (error_of(result), error_of(without))
    assert [one.accepted for one in result.tone][:2] == [True, True]
    for one in result.tone:
        assert one.accepted == (
            one.margin > simultaneous_margin(3)
            and one.held_out_loss_without > (1 + LEAST_TONE_GAIN) * one.held_out_loss_with
        )


@pytest.mark.long
def test_photos_of_one_light_have_a_curve_each():
    blocks = [through(data, 1.0, 1.3) if k == 0 else data for k, data in enumerate(rooms(photos=2, size=14))]
    off = np.log(exponents_of(solved(blocks, MANY))[0]) - np.log((1.0, 1.3))
    assert np.ptp(off) < 0.02 and abs(off.mean()) < 0.08  # the mean as above


def test_a_curve_that_no_camera_has_is_not_believed():
    """What else is wrong would be explained by an exponent at its bounds."""
    blocks = [through(data, 3.0) if k == 0 else data for k, data in enumerate(rooms())]
    solution = solved(blocks, cells=40, observations=200)
    assert len(exponents_of(solution)[0]) == 0
    (one, *_) = solution.tone
    assert one.held_out_loss_with < 0.8 * one.held_out_loss_without and not one.accepted


def test_an_exponent_near_its_bounds_is_named():
    point = Point(MATERIALS, [on_even_cells(np.zeros((3, 30)), log_tone=np.log([g])) for g in (1.2, 1.65)])
    (sentences,) = unlikely_curves(JointProblem(rooms()[:2], OPERATOR), point)
    assert "room1" in sentences and "1.6" in sentences


# ── what is compared, and from where ─────────────────────────────────────────────────────────────────────────────────


def test_without_held_out_observations_shadows_stay_and_tone_curves_are_not_tried(lit):
    """They would be judged by the observations that they were fitted to; marginal likelihoods need none."""
    result = solved([none_held_out(block) for block in lit], QUICK, cells=24, observations=100)
    assert result.shadows.accepted and result.shadows.margin is None
    assert result.interreflection.log_bayes_factor is not None
    assert not any(one.accepted for one in result.tone) and result.splitting == []


def test_without_interreflection_the_gauge_is_fixed_though_surfaces_light_each_other(lit):
    result = solved(lit, QUICK, cells=24, observations=100, interreflection="off")
    assert (result.point.materials.diffuse + result.point.materials.specular).max() == pytest.approx(BRIGHTEST)


@pytest.fixture(scope="module")
def begun_rooms():
    problem = JointProblem(rooms(), OPERATOR)
    return problem, FitRunner().fit("trial", problem, begun(problem, 60), FitSchedule(descents=(1,)))


def test_models_that_predict_the_same_are_equal_evidence(begun_rooms, monkeypatch):
    """Neither gets more descent than the other: shadows of nothing, lights at any distance of one point, tone curves that are left out, and
    suns that are none."""
    problem, fit = begun_rooms
    open_ = {
        "visibility": lambda b: np.full((len(b), 96), 255, np.uint8),
        "directions": lambda b: fibonacci_sphere(96)[None],
    }
    shaded, central = (
        problem.with_blocks(
            [msgspec.structs.replace(b, **{name: of(b) for name, of in columns.items()}) for b in problem.blocks]
        )
        for columns in (open_, {"place": lambda b: np.zeros((len(b), 3))})
    )
    shadows = select_effects(shaded, [fit], QUICK, FitRunner()).shadows
    assert shadows.accepted and shadows.log_bayes_factor == pytest.approx(0, abs=1e-6)
    guess = msgspec.structs.replace(fit, fitted=False)
    assert select_effects(shaded, [guess], QUICK, FitRunner()).shadows.log_bayes_factor == pytest.approx(0, abs=1e-6)
    for decision in select_distances(central, fit, QUICK, FitRunner()).evidence:
        assert decision.log_bayes_factor == pytest.approx(0, abs=1e-6)

    class WithoutCurves(FitRunner):
        def fit(self, phase, model, start, schedule):
            straight = [msgspec.structs.replace(light, log_tone=np.zeros(0)) for light in start.point.lights]
            return super().fit(phase, model, start.with_lights(straight), schedule)

    for decision in select_tone_curves(problem, fit, QUICK, WithoutCurves()).evidence:
        assert decision.margin == pytest.approx(0, abs=1e-6)
    monkeypatch.setattr(suns, "replace_brightest", lambda one, sharpness: msgspec.structs.replace(one.light))
    for decision in select_suns(problem, fit, FitRunner()).evidence:
        assert decision.margin == pytest.approx(0, abs=1e-6)


def test_what_is_held_out_judges_the_choices_and_is_fitted_after_them(monkeypatch):
    """Else a light would have holes there."""
    fit, fitted = FitRunner.fit, {}

    def recorded(self, phase, problem, *how):
        fitted.setdefault(phase, set()).add(problem.none_held_out)
        return fit(self, phase, problem, *how)

    monkeypatch.setattr(FitRunner, "fit", recorded)
    solve(JointProblem(rooms(), OPERATOR), start_from_photos(3), QUICK)
    assert fitted == {
        "no shadows": {False},
        "tone curves": {False},
        "splitting": {True},
        "materials and lights": {True},
        "lights": {True},
        "suns": {True},
    }


def test_one_cluster_is_no_evidence():
    """Its losses have no standard error: a change of 0.05 % had a margin of 5e8."""
    one, other = (Losses([np.full(20, value)], [np.zeros(20, int)]) for value in (1.0005, 1.0))
    assert not compare_models(one, other, CLEARLY_FOR).accepted


def test_few_materials_start_from_several_roughnesses_and_many_from_one():
    problem = JointProblem(rooms(), OPERATOR)
    assert [len(start_from_photos(n)(problem, 30)) for n in (3, 40)] == [1, 1]
    fits = start_from_photos(2)(problem.with_blocks([block.take(block.material < 2) for block in problem.blocks]), 30)
    points = [fit.point for fit in fits]
    assert len({float(p.materials.roughness[0]) for p in points}) == 3 and {len(p.lights[0]) for p in points} == {30}


# ── distances of lights ──────────────────────────────────────────────────────────────────────────────────────────────


def photographed_at(*curvatures):
    """Spheres as far apart as they are large, in lights of these curvatures."""
    rng, blocks = np.random.default_rng(5), []
    lights = [on_even_cells(drawn(50 + k, 60)) for k in range(len(curvatures))]
    for data, light, c in zip(spheres(lights, size=16).blocks, lights, curvatures, strict=True):
        middle = np.array([[-1.2, 0, 0], [0.6, 0, 1], [0.6, 0, -1]])[data.material]
        data = msgspec.structs.replace(data, place=middle + 0.6 * data.normal)
        clean = (
            Illumination(data, msgspec.structs.replace(light, curvature=c), MATERIALS, OPERATOR).radiance() / data.unit
        )
        inverse_sigma = 1 / np.hypot(0.02, 0.02 * clean)
        noisy = clean + 0.3 * rng.normal(size=clean.shape) / inverse_sigma
        blocks.append(msgspec.structs.replace(data, radiance=np.maximum(noisy, 0), inverse_sigma=inverse_sigma))
    return blocks


@pytest.mark.long
def test_near_lights_are_found_and_spare_the_materials_and_far_ones_stay_far():
    blocks = photographed_at(0.2, 0.0, 0.2)
    result, far = (solved(blocks, MANY, tone="off", distance=distance) for distance in ("auto", "off"))
    assert [one.accepted for one in result.distances] == [True, False, True]
    assert [light.curvature for light in result.point.lights] == [0.2, 0, 0.2]
    assert all(one.accepted == (one.log_bayes_factor > VERY_STRONG) for one in result.distances)
    assert [light.curvature for light in far.point.lights] == [0, 0, 0]
    assert error_of(result) < 0.5 * error_of(far), (error_of(result), error_of(far))


def test_a_light_that_is_far_is_tried_at_one_distance_alone():
    class Counting(FitRunner):
        def fit(self, phase, model, start, schedule):
            tried.append({light.curvature for light in start.point.lights})
            return super().fit(phase, model, start, schedule)

    tried = []
    problem = JointProblem([none_held_out(block) for block in photographed_at(0.0)], OPERATOR)
    (decision,) = select_distances(problem, begun(problem, 60), QUICK, Counting()).evidence
    assert decision.log_bayes_factor < 0 and tried == [{0.0}, {CURVATURES[0]}]


def test_the_error_of_a_log_bayes_factor_is_a_jackknife_over_clusters():
    """Each cluster is left out in turn, and the rest stands for all."""
    problem = JointProblem([none_held_out(block) for block in photographed_at(0.2)], OPERATOR)
    far, run = begun(problem, 60), FitRunner(prior=PRIOR)
    near = far.with_lights([msgspec.structs.replace(light, curvature=0.2) for light in far.point.lights])
    fits = [run.fit("distances", problem, fit, LIGHTS_ONLY) for fit in (far, near)]
    ((factor,), (error,)) = log_bayes_factors(problem, *fits)
    (block,) = problem.blocks
    number, temperature = block.clusters(), fits[0].hyperparameters[0].temperature
    losses = [FIT_LOSS.evaluate(problem.residuals(fit.point)[0]).sum(1) / temperature for fit in fits]
    clusters = np.unique(number)
    rest = [len(clusters) / (len(clusters) - 1) * (losses[0] - losses[1])[number != k].sum() / 2 for k in clusters]
    assert factor == (fits[0].light_values[0] - fits[1].light_values[0]) / 2
    assert error == pytest.approx(np.sqrt((len(clusters) - 1) * np.var(rest)), rel=1e-3)


def test_a_near_light_that_few_clusters_ask_for_stays_far(monkeypatch):
    problem = JointProblem([none_held_out(block) for block in photographed_at(0.2)], OPERATOR)
    start = begun(problem, 60)
    (near,) = select_distances(problem, start, QUICK, FitRunner()).evidence
    scattered = model_selection.log_bayes_factors
    monkeypatch.setattr(model_selection, "log_bayes_factors", lambda *fits: scattered(*fits) * [[1.0], [100.0]])
    (doubtful,) = select_distances(problem, start, QUICK, FitRunner()).evidence
    assert near.accepted and not doubtful.accepted and near.log_bayes_factor == doubtful.log_bayes_factor


def test_how_near_a_light_comes_follows_the_evidence_without_a_jump():
    shares = [near_share(VERY_STRONG + t) for t in np.linspace(-9, 20, 2901)]
    assert shares[0] == near_share(VERY_STRONG) == 0 and shares[-1] == pytest.approx(1)
    assert (np.diff(shares) >= 0).all() and np.diff(shares).max() < 0.01


def test_standard_errors_are_relative_to_the_reflectances_of_the_answer():
    """The answer is in another gauge than the fit of the materials, and a factor per channel changes no relative error."""
    problem = JointProblem(rooms(), OPERATOR)
    # a prior of more contrast than the shipped one, which is that of the errors as well
    prior = msgspec.structs.replace(PRIOR, variance=tuple(4 * v for v in PRIOR.variance))
    solution = solve(problem, start_from_photos(len(MATERIALS)), QUICK, FitRunner(prior=prior))
    answer, fitted = solution.point.materials, solution.fit.point.materials
    assert np.abs(np.log(answer.specular / fitted.specular)).max() > 0.02  # the gauges differ
    errors, maps = estimate_uncertainty(solution, problem, QUICK)
    problem = problem.with_all_fitted()
    sample = reliable_observations(problem).subsample(solution.observations, QUICK.seed)
    own = Posterior(sample, solution.materials, prior).with_prior()[1].materials
    for name in ("diffuse", "specular"):
        relative = getattr(errors.materials, name) / getattr(answer, name)
        np.testing.assert_allclose(relative, getattr(own, name) / getattr(fitted, name), rtol=1e-9)
    of_lights = Posterior(problem.subsample(solution.light_observations, QUICK.seed), solution.fit, prior)
    for name, errors_of_light in of_lights.relative_standard_errors().items():
        np.testing.assert_allclose(maps[name], errors_of_light)
