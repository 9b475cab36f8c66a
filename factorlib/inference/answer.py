"""A solution as it is written: materials with standard errors, lights and exposures in scene radiance, and what was decided."""

from __future__ import annotations

from functools import cached_property
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Float
from msgspec import UNSET, UnsetType

from factorlib.inference import uncertainty
from factorlib.inference.blocks import Block
from factorlib.inference.gauge import DETERMINED, GIVEN, RULE, UP_TO_SCALE, connected_components
from factorlib.inference.history import Solution
from factorlib.inference.lights import Light
from factorlib.inference.materials import LEAST_REFLECTANCE, Materials
from factorlib.inference.misfit import misfit
from factorlib.inference.priors import class_of
from factorlib.inference.problem import JointProblem
from factorlib.inference.uncertainty import ABSOLUTE, GAUGE, StandardErrors
from factorlib.light.lobes import Lobes
from factorlib.results import materials as table
from factorlib.results.materials import Decision, Uncertainty
from factorlib.results.solution import Earlier

LOBES_CHOSEN_BY = {
    "joint": "cells of the light prior, of which the brightest split while held-out observations gain",
    "paper": "given",
}


class Answer(msgspec.Struct, frozen=True, dict=True):
    """A solution of a problem, and where it came from.

    names:    of the materials, in the order of their numbers
    errors:   of the materials
    relative: exposure of each photo by EXIF, which the problem's radiances were divided by
    earlier:  the solution that it started from
    """

    names: list[str]
    problem: JointProblem
    solution: Solution
    errors: StandardErrors
    relative: dict[str, float]
    solver: Literal["joint", "paper"]
    earlier: Earlier | None = None

    @cached_property
    def radiance(self) -> list[Float[np.ndarray, "n 3"]]:
        """Return what all observations should show, block by block, in the block's unit."""
        return self.solution.shown(self.problem).radiance(self.solution.point)

    def material_table(self) -> table.MaterialTable:
        """The content of materials.json."""
        rows = _rows(self.solution.point.materials)
        stderr = self._errors()
        kinds = self._kinds()
        solved = {
            name: table.solved(table.Reflectance(*row), stderr[name], kind, self._given(m))
            for m, (name, row, kind) in enumerate(zip(self.names, rows, kinds, strict=True))
        }
        components = connected_components(self.problem.blocks, len(self.names))
        component = {self.names[m]: k for k, (members, _) in enumerate(components) for m in members}
        absolute = self.solution.interreflection.kept
        gauge = table.Gauge(RULE + DETERMINED * absolute + self._given_rule(), component, self._gauge_of_errors())
        return table.MaterialTable(solved, gauge, self.model())

    def _kinds(self) -> list[table.Kind | UnsetType]:
        """Return the likeliest class of each material, in the gauge of the fit; none where the solver has no classes."""
        if self.solver == "paper":
            return [UNSET] * len(self.names)
        materials = self.solution.point.materials
        errors = self.errors.materials
        relative = errors.specular.mean(1) / np.maximum(materials.specular.mean(1), LEAST_REFLECTANCE)
        specular = self.solution.materials.point.materials.specular
        rows = zip(specular, materials.roughness.tolist(), relative.tolist(), errors.roughness.tolist(), strict=True)
        return [table.Kind(*class_of(*row)) for row in rows]

    def _given_rule(self) -> str:
        """Say what is known of scale and white balance, as a sentence; empty where nothing is."""
        known = self.problem.known
        fixed = [self.names[m] for m in sorted(known.materials)]
        fixed += sorted(name for name, light in known.lights.items() if not light.scale_free)
        tinted = sorted(name for name, light in known.lights.items() if light.scale_free)
        pairs = ((GIVEN, fixed), (UP_TO_SCALE, tinted))
        return "".join(rule.format(", ".join(names)) for rule, names in pairs if names)

    def _given(self, m: int) -> list[str] | UnsetType:
        """The parts of a material that were known; UNSET where none was."""
        values = self.problem.known.materials.get(m)
        parts = zip(("diffuse", "specular", "roughness"), (0, 3, 6), strict=True)
        return UNSET if values is None else [part for part, first in parts if not np.isnan(values[first])]

    def _gauge_of_errors(self) -> str:
        return (
            GAUGE
            + ABSOLUTE * self.solution.interreflection.kept
            + uncertainty.GIVEN * bool(self.problem.known.materials or self.problem.known.lights)
        )

    def uncertainty(self) -> Uncertainty:
        """The content of uncertainty.json."""
        unexplained = misfit(self.problem, self.radiance)
        return Uncertainty(self.errors.deviation, self._errors(), self._gauge_of_errors(), *unexplained)

    def _errors(self) -> dict[str, table.StandardErrors]:
        rows = zip(self.names, _rows(self.errors.materials), strict=True)
        return {name: table.StandardErrors(*row) for name, row in rows}

    def lit(self) -> list[tuple[Block, Light]]:
        """Each illumination with its light."""
        return list(zip(self.problem.blocks, self.solution.point.lights, strict=True))

    def lights(self) -> dict[str, Lobes]:
        """Return the lobes by illumination, in scene radiance."""
        return {block.name: light.lobes.scaled(block.unit) for block, light in self.lit()}

    def exposures(self) -> dict[str, table.Channels]:
        """Factor of each photo on its light, per channel."""
        return {photo: (factor * self.relative[photo],) * 3 for photo, factor in self.found_exposures().items()}

    def found_exposures(self) -> dict[str, float]:
        """Factor of each photo beside what its EXIF says."""
        pairs = (pair for b, light in self.lit() for pair in zip(b.photos, light.log_exposure, strict=True))
        return {photo: float(np.exp(log_exposure)) for photo, log_exposure in pairs}

    def model(self) -> table.Model:
        """What was decided of the model, and by what; the pivots of tone curves in scene radiance."""
        names = self.names
        solution = self.solution
        lit = self.lit()
        started: table.Started | UnsetType = UNSET
        lights = [block.name for block, _ in lit]
        if self.earlier is not None:
            known = set(names) & set(self.earlier.table.materials), set(lights) & set(self.earlier.lights)
            started = table.Started(*map(sorted, known))
        return table.Model(
            solver=self.solver,
            lobes={block.name: len(light) for block, light in lit},
            lobes_chosen_by=LOBES_CHOSEN_BY[self.solver],
            held_out_loss=[event.held_out for event in solution.history if event.phase == "subset"],
            self_shadowing=solution.shadows.kept,
            self_shadowing_chosen_by=_tried(solution.shadows),
            interreflection=solution.interreflection.kept,
            interreflection_chosen_by=_tried(solution.interreflection),
            light_prior=self.solver == "joint",
            splitting_chosen_by=solution.splitting,
            suns_chosen_by=dict(zip(lights, solution.suns)),
            tone={
                photo: table.Tone(float(np.exp(log_tone)), block.unit * self.relative[photo])
                for block, light in lit
                for photo, log_tone in zip(block.photos, light.log_tone, strict=False)
            },
            tone_chosen_by=dict(zip(lights, solution.tone)),
            distance={block.name: 1 / light.curvature for block, light in lit if light.curvature > 0},
            distance_chosen_by=dict(zip(lights, solution.distances)),
            started_from=started,
        )


def _rows(materials: Materials) -> list[tuple[table.Channels, table.Channels, float]]:
    """Diffuse, specular and roughness of each."""
    return [((a, b, c), (d, e, f), r) for a, b, c, d, e, f, r in materials.rows().tolist()]


def _tried(decision: Decision) -> dict[str, float]:
    """The held-out losses of the models that were tried, and the margin."""
    return {k: value for k, value in msgspec.structs.asdict(decision).items() if k != "kept" and value is not None}
