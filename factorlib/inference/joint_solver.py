"""Joint solve: one reflectance per material and one light per illumination, from all photos at once.

effects     Held-out observations choose shadows, and marginal likelihoods interreflection
            (`factorlib.inference.choices.model_selection`).
background  Marginal likelihoods choose the lights whose prior also uses the surroundings that photos show
            (`factorlib.inference.model.background`).
tone        Held-out observations choose tone curves.
distances   Marginal likelihoods choose distances of lights.
ground      Shadows on the ground are observations of a light too, where they lie as the objects say.  They are modelled
            as those of an infinitely distant light, so they do not choose distances.
materials   The 24 cells with most of a light's energy split in about four while the log Bayes factor for that is very
            strong (`factorlib.inference.choices.splitting`).  In a light blurred by large cells, materials come out too
            smooth.  Then materials and lights are fitted together to observations with reliable normals
            (`factorlib.inference.fit.fit`).  From here on held-out observations are fitted too: left out, they would
            leave holes in the lights.
prior       Each material is estimated again under the prior on materials, with the errors of the model in its
            covariance (`factorlib.inference.answer.material_posterior`).
lights      Given the materials, lights are fitted to observations of any confidence.
suns        Each light is compared with one that has a sun in place of its brightest cells
            (`factorlib.inference.choices.suns`).

Every step is a function of the previous state, and `FitRunner` saves each state (`factorlib.inference.fit.fit_runner`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from factorlib.inference.answer.uncertainty import Posterior
from factorlib.inference.choices.model_selection import (
    TRIAL_CELLS,
    select_backgrounds,
    select_distances,
    select_effects,
    select_grounds,
    select_tone_curves,
)
from factorlib.inference.choices.splitting import split_cells
from factorlib.inference.choices.suns import select_suns
from factorlib.inference.fit.fit import LIGHT_TEMPERATURE, Fit, FitSchedule, reliable_observations
from factorlib.inference.fit.fit_runner import FitRunner, Solution, SolveState
from factorlib.inference.fit.start import Start, insert_known, refine_cells
from factorlib.inference.model.gauge import fix_gauge
from factorlib.inference.model.materials import Point
from factorlib.inference.model.normal_errors import normal_errors, with_normal_errors
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.options import SolveOptions
from factorlib.results.materials import Decision, Model

REFINED = FitSchedule(light_steps=2, descents=(0,), materials_fixed=True)
MATERIALS = FitSchedule(descents=(5, 4))
# Where the model explains the fitted observations closely, errors of few observations matter: k_d of data/synthetic is
# 13 % wrong with 1,000, 2.6 % with 4,000 and 1.0 % with 8,000.
OBSERVATION_FACTOR = 8  # factor on the number of observations there
# Mean robust loss of a fitted value below which it does: 0.1 to 0.45 on exact sets, 0.86 on data/eames.
SMALL_LOSS = 0.5
LIGHTS = FitSchedule(
    descents=(0, 2, 2), least_temperature=0.1, temperature_factor=LIGHT_TEMPERATURE, materials_fixed=True
)


class SolveRequest(msgspec.Struct, frozen=True):
    """Input of a joint solve: the problem, its initial fits, the options and the runner.

    Attributes:
        problem: All observations, fitted and held out.
        starts: Initial fits of the first trial, of which the best one continues.
        options: Options of the user.
        run: Runner of the fits.
    """

    problem: JointProblem
    starts: list[Fit]
    options: SolveOptions
    run: FitRunner

    def reliable_problem(self, state: SolveState) -> JointProblem:
        """Return the observations with reliable normals, under the chosen effects."""
        return state.effective_problem(reliable_observations(self.problem))

    def reliable_sample(self, state: SolveState, observations: int) -> JointProblem:
        """Return that many observations of a light with reliable normals, with errors of normals as at the state."""
        return with_normal_errors(
            self.reliable_problem(state).subsample(observations, self.options.seed), state.fit.point
        )

    def light_problem(self, state: SolveState) -> JointProblem:
        """Return the observations of any confidence that lights are fitted to, under the chosen effects."""
        return state.light_sample(self.problem, self.options.seed)


def solve(
    problem: JointProblem,
    start: Start,
    options: SolveOptions = SolveOptions(),
    run: FitRunner | None = None,
    decided: Model | None = None,
) -> Solution:
    """Solve the problem and return the answer, in the gauge of `factorlib.inference.model.gauge`.

    Args:
        problem: Observations and model.
        start: Maker of the initial fits.
        options: Options of the user.
        run: Runner that saves states and reports events; None for one without a file.
        decided: Choices of the solution that `start` continues, which are not made again; None to make them.
    """
    run = run or FitRunner()
    if decided:
        options = msgspec.structs.replace(options, splittings=0)
    request = SolveRequest(problem, initial_fits(problem, start, options), options, run)
    state = SolveState(request.starts[0], request.starts[0])
    if decided:
        state = with_choices(state, decided, [block.name for block in problem.blocks])
    else:
        state = run.run_steps(CHOICES, request, state)
    request = msgspec.structs.replace(request, problem=problem.with_all_fitted())
    state = run.run_steps(CONTINUED_FITS if decided else FITS, request, state)
    if decided:
        state = msgspec.structs.replace(state, splitting=decided.splitting_chosen_by)
    answer = fix_gauge(state.fit.point, state.effective_problem(problem).blocks, problem.known)
    point = Point(problem.known.insert_into(answer.materials), answer.lights)
    steps = {name: getattr(state, name) for name in SolveState.__struct_fields__}
    return Solution(**steps, point=point, history=run.history, prior=run.prior)


def initial_fits(problem: JointProblem, start: Start, options: SolveOptions) -> list[Fit]:
    """Return the initial fits from which the choice of shadows starts."""
    problem = reliable_observations(problem)
    fits = start(problem, min(TRIAL_CELLS, options.cells))
    return [msgspec.structs.replace(fit, point=insert_known(fit.point, problem)) for fit in fits]


def with_choices(state: SolveState, model: Model, lights: Sequence[str]) -> SolveState:
    """Return the state with the choices of an earlier solution for the lights of these names."""
    by_light = {
        "backgrounds": model.background_chosen_by,
        "grounds": model.ground_chosen_by,
        "tone": model.tone_chosen_by,
        "distances": model.distance_chosen_by,
        "suns": model.suns_chosen_by,
    }
    return msgspec.structs.replace(
        state,
        shadows=Decision(model.self_shadowing, **model.self_shadowing_chosen_by),
        interreflection=Decision(model.interreflection, **model.interreflection_chosen_by),
        **{name: [decisions[light] for light in lights if light in decisions] for name, decisions in by_light.items()},
    )


def choose_effects(request: SolveRequest, state: SolveState) -> SolveState:
    """Choose by evidence whether shadows and interreflection are modelled."""
    problem = reliable_observations(request.problem)
    return select_effects(problem, request.starts, request.options, request.run)


def choose_backgrounds(request: SolveRequest, state: SolveState) -> SolveState:
    """Choose by marginal likelihood the lights that are also observed by the surroundings that photos show."""
    problem = reliable_observations(request.problem).with_effects(
        state.shadows.accepted, state.interreflection.accepted
    )
    selection = select_backgrounds(problem.keep_grounds([]), state.fit, request.options, request.run)
    return state.with_fit(selection.fit, backgrounds=selection.evidence)


def choose_tone(request: SolveRequest, state: SolveState) -> SolveState:
    """Choose by held-out observations which lights get tone curves, and fit them."""
    selection = select_tone_curves(request.reliable_problem(state), state.fit, request.options, request.run)
    return state.with_fit(selection.fit, tone=selection.evidence)


def choose_distances(request: SolveRequest, state: SolveState) -> SolveState:
    """Choose by marginal likelihood which lights are at a finite distance, and fit their distances."""
    selection = select_distances(request.reliable_problem(state), state.fit, request.options, request.run)
    return state.with_fit(selection.fit, distances=selection.evidence)


def choose_grounds(request: SolveRequest, state: SolveState) -> SolveState:
    """Choose the lights that are also observed by shadows on the ground."""
    problem = request.problem.with_effects(state.shadows.accepted, state.interreflection.accepted)
    return msgspec.structs.replace(state, grounds=select_grounds(problem, state.fit, request.options))


def fit_materials(request: SolveRequest, state: SolveState) -> SolveState:
    """Fit materials and lights to observations with reliable normals.

    Lights have `SolveOptions.cells` cells, of which some split.  If the model then explains the observations closely,
    more of them are fitted.  Cells may split again, because they were asked given the materials of before.
    """
    options, run = request.options, request.run
    observations = options.observations
    sample = request.reliable_sample(state, observations)
    fit = run.fit("splitting", sample, refine_cells(state.fit, options.cells, sample), REFINED)
    fit, evidence = split_cells("splitting", sample, fit, options.splittings, run)
    fit = run.fit("materials and lights", sample, fit, MATERIALS)
    if options.splittings and sample.fitted_loss(fit.point) < SMALL_LOSS:
        observations = OBSERVATION_FACTOR * observations
        sample = request.reliable_sample(state.with_fit(fit), observations)
        fit, further = split_cells("more observations", sample, fit, options.splittings, run)
        fit = run.fit("more observations", sample, fit, MATERIALS)
        evidence += further
    return msgspec.structs.replace(state.with_fit(fit, splitting=evidence), observations=observations)


def apply_prior(request: SolveRequest, state: SolveState) -> SolveState:
    """Combine the fitted materials with the prior on materials, by the errors of the model."""
    sample = request.reliable_sample(state, state.observations)
    request.run.enter("prior")
    materials, errors = Posterior(sample, state.fit, request.run.prior).with_prior()
    fit = msgspec.structs.replace(state.fit, point=Point(materials, state.fit.point.lights))
    return msgspec.structs.replace(state, fit=fit, errors=errors)


def fit_lights(request: SolveRequest, state: SolveState) -> SolveState:
    """Fit the lights to observations of any confidence, with the materials fixed."""
    errors = normal_errors(request.light_problem(state), state.fit.point)
    state = msgspec.structs.replace(state, light_errors=errors)
    fit = request.run.fit("lights", request.light_problem(state), state.fit, LIGHTS)
    return msgspec.structs.replace(state, fit=fit)


def choose_suns(request: SolveRequest, state: SolveState) -> SolveState:
    """Replace the brightest cells of a light by a sun where that explains its observations better."""
    selection = select_suns(request.light_problem(state), state.fit, request.run)
    return msgspec.structs.replace(state, fit=selection.fit, suns=selection.evidence)


Steps = dict[str, Callable[[SolveRequest, SolveState], SolveState]]
CHOICES: Steps = {
    "effects": choose_effects,
    "background": choose_backgrounds,
    "tone": choose_tone,
    "distances": choose_distances,
    "ground": choose_grounds,
}
FITS: Steps = {
    "materials": fit_materials,
    "prior": apply_prior,
    "lights": fit_lights,
    "suns": choose_suns,
}
CONTINUED_FITS: Steps = {name: FITS[name] for name in ("materials", "prior", "lights")}
