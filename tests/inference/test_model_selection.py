"""What is in the model is decided by what is held out: shadows, bounces, tone curves, distances of lights, the start."""

from functools import cache

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorlib.geometry.sphere import NO_OCCLUDER, fibonacci_sphere, occluder_codes
from factorlib.images.tone import curve
from factorlib.inference.answer.identifiability import unlikely_curves
from factorlib.inference.answer.uncertainty import Posterior, estimate_uncertainty
from factorlib.inference.choices import model_selection, suns
from factorlib.inference.choices.model_selection import (
    CLEARLY_AGAINST,
    CLEARLY_FOR,
    CURVATURES,
    LEAST_LOSS,
    LEAST_TONE_GAIN,
    LIGHTS_ONLY,
    VERY_STRONG,
    Losses,
    compare_models,
    held_out_losses,
    log_bayes_factors,
    near_share,
    select_distances,
    select_effects,
    select_tone_curves,
    simultaneous_margin,
)
from factorlib.inference.choices.suns import select_suns
from factorlib.inference.fit.fit import FitSchedule, reliable_observations
from factorlib.inference.fit.fit_runner import FitRunner
from factorlib.inference.fit.start import start_from_photos
from factorlib.inference.joint_solver import solve
from factorlib.inference.model.blocks import FIT_LOSS, Noise
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.gauge import BRIGHTEST
from factorlib.inference.model.interreflection import bounced_light
from factorlib.inference.model.materials import Point
from factorlib.inference.model.observed import blocks_of_observations
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.options import SolveOptions
from factorlib.scenes.joint_problems import MATERIALS, factor_between, sphere_normals
from factorlib.urm.observations import Observations
from tests.inference.made import bowls, none_held_out, rough_light
from tests.inference.made_lights import OPERATOR, PRIOR, begun, drawn, on_even_cells, photographed, spheres

QUICK = SolveOptions(cells=60, splittings=0, observations=300)
OF_SHAPES = msgspec.structs.replace(QUICK, cells=36, observations=180, tone="off")  # shadows and bounces
# an exponent that all photos share is known less
MANY = msgspec.structs.replace(QUICK, observations=1000)


def solved(blocks, choices=QUICK, **others):
    choices = msgspec.structs.replace(choices, **others)
    return solve(JointProblem(blocks, OPERATOR), start_from_photos(len(MATERIALS)), choices)


# ── shadows and bounces, on bowls ────────────────────────────────────────────────────────────────────────────────────


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
def test_materials_of_bowls_are_better_with_self_shadowing_and_the_solve_finds_that_out():
    shaded = [blocks_of_observations(bowls(f"room{i}", rough_light(20 + i)), Noise(0.02, 0.02))[0] for i in range(2)]
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


def test_shadows_that_are_none_are_given_up():
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


@pytest.mark.long
def test_curves_are_found_and_spare_the_materials_by_evidence_that_held_out_losses_fall():
    curved = [through(data, exponent) for data, exponent in zip(rooms(size=20), (1.3, 0.8, 1.0), strict=True)]
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


def test_models_that_predict_the_same_are_equal_evidence(monkeypatch):
    """Neither gets more descent than the other: shadows of nothing, lights at any distance of one point, tone curves that are left out, and
    suns that are none."""
    problem = JointProblem(rooms(), OPERATOR)
    fit = FitRunner().fit("trial", problem, begun(problem, 60), FitSchedule(descents=(1,)))
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


# ── The standard by which models are compared: laws of (1), and how rarely chance passes it ──────────


def made(seed: int, lights: int, gain: float = 0.0, rows: int = 60, clusters_of: int = 12) -> tuple[Losses, Losses]:
    """Squared residuals of two models, the richer better by a factor 1 + gain; a light each with its own scale."""
    rng, without, richer, clusters = np.random.default_rng(seed), [], [], []
    for _ in range(lights):
        number = rng.integers(0, clusters_of, rows)
        shared, scale = rng.chisquare(3, clusters_of)[number], rng.lognormal(0, 1)
        both = [scale * (shared + rng.chisquare(2, rows)) / factor for factor in (1.0, 1 + gain)]
        without.append(both[0])
        richer.append(both[1])
        clusters.append(np.unique(number, return_inverse=True)[1])
    return Losses(without, clusters), Losses(richer, clusters)


ANY = {"seed": st.integers(0, 10_000), "lights": st.integers(1, 5), "gain": st.floats(-0.5, 2)}
FEW_EXAMPLES = settings(max_examples=25, deadline=None, derandomize=True)


@FEW_EXAMPLES
@given(**ANY, factor=st.floats(0.5, 1000))
def test_models_swapped_change_the_sign_and_the_order_of_lights_and_the_scale_of_a_light_nothing(factor, **how):
    without, richer = made(**how)
    one, other = compare_models(without, richer, CLEARLY_FOR), compare_models(richer, without, CLEARLY_FOR)
    assert one.margin == pytest.approx(-other.margin, rel=1e-9, abs=1e-9)
    assert one.held_out_loss_with == other.held_out_loss_without
    assert one.held_out_loss_without == other.held_out_loss_with

    def scaled(losses, which):
        return Losses([factor * v if k in which else v for k, v in enumerate(losses.values)], losses.clusters)

    turned = (Losses(losses.values[::-1], losses.clusters[::-1]) for losses in (without, richer))
    assert compare_models(*turned, CLEARLY_FOR).margin == pytest.approx(one.margin, rel=1e-9)
    for which in ({0}, set(range(5))):
        result = compare_models(scaled(without, which), scaled(richer, which), CLEARLY_FOR).margin
        assert result == pytest.approx(one.margin, rel=0.01, abs=1e-3)


def test_nothing_held_out_decides_nothing():
    nothing, (one, better) = np.zeros(0), made(0, 1, gain=1.0)
    numbers = nothing.astype(int)
    for least in (CLEARLY_FOR, CLEARLY_AGAINST):
        result = compare_models(Losses([nothing], [numbers]), Losses([nothing], [numbers]), least)
        assert not result.accepted and result.margin is None and result.held_out_loss_with is None
    both = [Losses([nothing, *of.values], [numbers, *of.clusters]) for of in (one, better)]
    assert compare_models(*both, CLEARLY_FOR).margin == pytest.approx(compare_models(one, better, CLEARLY_FOR).margin)


@pytest.mark.parametrize("lights, clusters", [(3, 12), (1, 3)])
def test_chance_is_rarely_evidence_though_residuals_are_alike(lights, clusters):
    """Of one distribution more than two standard errors are found about one time in forty; each by its own, not by clusters, far more often."""
    kept, singly = [], []
    for seed in range(400):
        rng, (same, _) = np.random.default_rng(seed), made(seed, lights, rows=240, clusters_of=clusters)
        err = [
            np.exp(0.3 * rng.normal(size=(2, clusters))) for _ in same.values
        ]  # alike within a cluster, not between models
        both = [
            Losses([v * e[k][c] for v, e, c in zip(same.values, err, same.clusters, strict=True)], same.clusters)
            for k in (0, 1)
        ]
        kept.append(compare_models(*both, CLEARLY_FOR).accepted)
        alone = [Losses(of.values, [np.arange(len(v)) for v in of.values]) for of in both]
        singly.append(compare_models(*alone, CLEARLY_FOR).accepted)
    assert np.mean(kept) < 0.05 and np.mean(singly) > 3 * np.mean(kept), (np.mean(kept), np.mean(singly))


def test_each_light_counts_relative_to_itself():
    """The third light is explained badly, and a little worse by the richer model: its sum would outweigh what the others gain."""
    one, other = np.array([0.5, 1.5]), np.array([1.0, 2.0, 3.0, 2.0])
    without, richer = [one, one, 100 * other], [one / 2, one / 2, 101 * other]
    assert sum(losses.sum() for losses in richer) > sum(losses.sum() for losses in without)
    numbers = [np.arange(len(v)) for v in without]
    result = compare_models(Losses(without, numbers), Losses(richer, numbers), CLEARLY_FOR)
    assert (
        result.accepted and not compare_models(Losses(richer, numbers), Losses(without, numbers), CLEARLY_FOR).accepted
    )
    logarithms = np.log([[1, 1, 200], [0.5, 0.5, 202]]) @ [0.25, 0.25, 0.5]  # by their counts
    np.testing.assert_allclose([result.held_out_loss_without, result.held_out_loss_with], np.exp(logarithms), rtol=1e-3)
    exact, numbers = np.full(5, 1e-9), [np.arange(5)]
    noisy = exact * np.array([1.0, 2.0, 3.0, 1.0, 2.0])
    assert (
        compare_models(Losses([2 * noisy], numbers), Losses([noisy], numbers), CLEARLY_FOR).held_out_loss_with
        < 2 * LEAST_LOSS
    )


def test_losses_are_those_of_held_out_observations_or_of_all():
    problem, true = photographed(0, 2, cells=30, size=8)
    for some in (problem, problem.with_blocks([none_held_out(b) for b in problem.blocks])):
        result = held_out_losses(some, Point(MATERIALS, true))
        for values, clusters, block in zip(result.values, result.clusters, some.blocks, strict=True):
            assert len(values) == len(clusters) == (block.held_out.sum() or len(block))
    worse = msgspec.structs.replace(MATERIALS, diffuse=2 * MATERIALS.diffuse)
    richer, without = (held_out_losses(problem, Point(materials, true)) for materials in (MATERIALS, worse))
    assert compare_models(without, richer, CLEARLY_FOR).accepted
