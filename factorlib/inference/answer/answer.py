"""Solution in the form that is written to files: materials with standard errors, lights, exposures and model choices.

Lights and exposures are in scene radiance.
"""

from __future__ import annotations

from functools import cached_property
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Float
from msgspec import UNSET, UnsetType

from factorlib.inference.answer import uncertainty
from factorlib.inference.answer.uncertainty import ABSOLUTE, GAUGE, MaterialErrors
from factorlib.inference.fit.fit_runner import Solution
from factorlib.inference.model.blocks import Block
from factorlib.inference.model.gauge import DETERMINED, GIVEN, RULE, UP_TO_SCALE, connected_components
from factorlib.inference.model.lights import Light
from factorlib.inference.model.material_prior import likeliest_class, material_unknowns
from factorlib.inference.model.materials import LEAST_REFLECTANCE, Materials
from factorlib.inference.model.misfit import unexplained_shares
from factorlib.inference.model.problem import JointProblem
from factorlib.light.lobes import Lobes
from factorlib.results import materials as table
from factorlib.results.materials import Decision, Uncertainty
from factorlib.results.solution import EarlierSolution

LOBES_CHOSEN_BY = {
    "joint": "cells of the light prior, of which the brightest split while the marginal likelihood rises",
    "paper": "given",
}


class Answer(msgspec.Struct, frozen=True, dict=True):
    """Solution of a problem, and where it came from.

    Attributes:
        names: Names of the materials, in the order of their numbers.
        problem: Problem that was solved.
        solution: Result of the solver.
        errors: Standard errors of the materials.
        relative: Exposure of each photo by EXIF; the problem's radiances were divided by it.
        solver: Name of the solver.
        earlier: Solution that the solve started from.
    """

    names: list[str]
    problem: JointProblem
    solution: Solution
    errors: MaterialErrors
    relative: dict[str, float]
    solver: Literal["joint", "paper"]
    earlier: EarlierSolution | None = None

    @cached_property
    def radiance(self) -> list[Float[np.ndarray, "n 3"]]:
        """Predicted radiance of all observations, block by block, in the block's unit."""
        return self.solution.effective_problem(self.problem).radiance(self.solution.point)

    def material_table(self) -> table.MaterialTable:
        """Return the content of materials.json."""
        rows = _rows(self.solution.point.materials)
        stderr = self._errors()
        kinds = self._kinds()
        solved = {
            name: table.attach_errors(table.Reflectance(*row), stderr[name], kind, self._known_parts(m))
            for m, (name, row, kind) in enumerate(zip(self.names, rows, kinds, strict=True))
        }
        if self.solver == "joint":
            for name, shares in zip(self.names, self.errors.prior_share, strict=True):
                parts = float(shares[:3].mean()), float(shares[3:6].mean()), float(shares[6])
                solved[name] = msgspec.structs.replace(solved[name], prior_share=table.PriorShares(*parts))
        components = connected_components(self.problem.blocks, len(self.names))
        component = {self.names[m]: k for k, (members, _) in enumerate(components) for m in members}
        absolute = self._is_absolute
        gauge = table.Gauge(RULE + DETERMINED * absolute + self._known_rule(), component, self._gauge_of_errors())
        return table.MaterialTable(solved, gauge, self.model())

    def _kinds(self) -> list[table.Kind | UnsetType]:
        """Return the likeliest class of each material, in the gauge of the fit.

        The class is UNSET where the solver has no classes.
        """
        if self.solver == "paper":
            return [UNSET] * len(self.names)
        materials = self.solution.point.materials
        errors = self.errors.materials
        relative = errors.specular.mean(1) / np.maximum(materials.specular.mean(1), LEAST_REFLECTANCE)
        unknowns = material_unknowns(self.solution.fit.point.materials)
        rows = zip(unknowns, relative.tolist(), errors.roughness.tolist(), strict=True)
        classes = self.problem.known.classes
        return [table.Kind(*likeliest_class(*row, classes.get(m))) for m, row in enumerate(rows)]

    def _known_rule(self) -> str:
        """Return a sentence that names what fixes scale and white balance; empty if nothing is known beforehand."""
        fixed = [self.names[m] for m in sorted(self.problem.known.materials)]
        fixed += sorted(name for name, light in self.problem.known.lights.items() if not light.scale_free)
        tinted = sorted(name for name, light in self.problem.known.lights.items() if light.scale_free)
        sentences = ((GIVEN, fixed), (UP_TO_SCALE, tinted))
        return "".join(rule.format(", ".join(names)) for rule, names in sentences if names)

    def _known_parts(self, m: int) -> list[str] | UnsetType:
        """Return the parts of a material that were known beforehand; UNSET for a material without any."""
        values = self.problem.known.materials.get(m)
        parts = zip(("diffuse", "specular", "roughness"), (0, 3, 6), strict=True)
        return UNSET if values is None else [part for part, column in parts if not np.isnan(values[column])]

    @property
    def _is_absolute(self) -> bool:
        """True if interreflection or a background fixes a scale."""
        return self.solution.interreflection.accepted or any(each.accepted for each in self.solution.backgrounds)

    def _gauge_of_errors(self) -> str:
        """Return the sentence that states the gauge of the standard errors."""
        return (
            GAUGE
            + ABSOLUTE * self._is_absolute
            + uncertainty.GIVEN * bool(self.problem.known.materials or self.problem.known.lights)
        )

    def uncertainty(self) -> Uncertainty:
        """Return the content of uncertainty.json."""
        unexplained = unexplained_shares(self.problem, self.radiance)
        return Uncertainty(self.errors.deviation, self._errors(), self._gauge_of_errors(), *unexplained)

    def _errors(self) -> dict[str, table.StandardErrors]:
        """Return the standard errors by material name."""
        rows = zip(self.names, _rows(self.errors.materials), strict=True)
        return {name: table.StandardErrors(*row) for name, row in rows}

    def illuminations(self) -> list[tuple[Block, Light]]:
        """Return each illumination with its light."""
        return list(zip(self.problem.blocks, self.solution.point.lights, strict=True))

    def lights(self) -> dict[str, Lobes]:
        """Return the lobes by illumination, in scene radiance."""
        return {block.name: light.lobes.scale(block.unit) for block, light in self.illuminations()}

    def exposures(self) -> dict[str, table.Channels]:
        """Return each photo's factor on its light, per channel."""
        return {photo: (factor * self.relative[photo],) * 3 for photo, factor in self.estimated_exposures().items()}

    def estimated_exposures(self) -> dict[str, float]:
        """Return each photo's factor on its light, relative to its EXIF exposure."""
        exposures = (
            exposure for b, light in self.illuminations() for exposure in zip(b.photos, light.log_exposure, strict=True)
        )
        return {photo: float(np.exp(log_exposure)) for photo, log_exposure in exposures}

    def model(self) -> table.Model:
        """Return the model choices and their evidence; the pivots of tone curves are in scene radiance."""
        solution = self.solution
        illuminations = self.illuminations()
        started: table.WarmStart | UnsetType = UNSET
        lights = [block.name for block, _ in illuminations]
        if self.earlier is not None:
            known = set(self.names) & set(self.earlier.table.materials), set(lights) & set(self.earlier.lights)
            started = table.WarmStart(*map(sorted, known))
        return table.Model(
            solver=self.solver,
            lobes={block.name: len(light) for block, light in illuminations},
            lobes_chosen_by=LOBES_CHOSEN_BY[self.solver],
            held_out_loss=[event.held_out for event in solution.history if event.phase == "subset"],
            self_shadowing=solution.shadows.accepted,
            self_shadowing_chosen_by=_comparison(solution.shadows),
            interreflection=solution.interreflection.accepted,
            interreflection_chosen_by=_comparison(solution.interreflection),
            light_prior=self.solver == "joint",
            splitting_chosen_by=solution.splitting,
            suns_chosen_by=dict(zip(lights, solution.suns)),
            background_chosen_by=dict(zip(lights, solution.backgrounds)),
            ground_chosen_by=dict(zip(lights, solution.grounds)),
            tone={
                photo: table.Tone(float(np.exp(log_tone)), block.unit * self.relative[photo])
                for block, light in illuminations
                for photo, log_tone in zip(block.photos, light.log_tone, strict=False)
            },
            tone_chosen_by=dict(zip(lights, solution.tone)),
            distance={block.name: 1 / light.curvature for block, light in illuminations if light.curvature > 0},
            distance_chosen_by=dict(zip(lights, solution.distances)),
            materials_fit=solution.materials.status[0] if solution.materials.status else None,
            light_fits=dict(zip(lights, solution.fit.status)),
            started_from=started,
        )


def _rows(materials: Materials) -> list[tuple[table.Channels, table.Channels, float]]:
    """Return diffuse, specular and roughness of each material."""
    return [((a, b, c), (d, e, f), r) for a, b, c, d, e, f, r in materials.rows().tolist()]


def _comparison(decision: Decision) -> dict[str, float]:
    """Return the held-out losses of the models that were compared, and the margin."""
    return {k: value for k, value in msgspec.structs.asdict(decision).items() if k != "accepted" and value is not None}
