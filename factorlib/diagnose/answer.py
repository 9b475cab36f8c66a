"""A solution as it is written: materials with standard errors, lights and exposures in scene radiance, and what was decided."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import msgspec
import numpy as np

from factorlib.diagnose.uncertainty import ABSOLUTE, GAUGE, StandardErrors
from factorlib.light.lobes import Lobes
from factorlib.model.components import connected_components
from factorlib.model.gauge import DETERMINED, RULE
from factorlib.model.materials import Materials
from factorlib.model.problem import JointProblem
from factorlib.results import materials as table
from factorlib.results.materials import Uncertainty
from factorlib.results.solution import Earlier
from factorlib.solve.evidence import Evidence
from factorlib.solve.history import Solution

LOBES_CHOSEN_BY = {
    "bundle": "cells of the light prior, of which the brightest split while held-out observations gain",
    "few_lobes": "held-out loss per round, see convergence.parquet",
    "paper": "given",
}


class Answer(msgspec.Struct, frozen=True):
    """A solution of a problem, and where it came from.

    names:    of the materials, in the order of their numbers
    relative: exposure of each photo by EXIF, which the problem's radiances were divided by
    earlier:  the solution that it started from
    """

    names: list[str]
    problem: JointProblem
    solution: Solution
    relative: dict[str, float]
    solver: Literal["bundle", "few_lobes", "paper"]
    earlier: Earlier | None = None

    def material_table(self, errors: StandardErrors) -> table.MaterialTable:
        """The content of materials.json."""
        materials, stderr = _rows(self.solution.point.materials), _errors(self.names, errors)
        solved = {
            name: table.solved(table.Reflectance(*row), stderr[name])
            for name, row in zip(self.names, materials, strict=True)
        }
        components = connected_components(self.problem.blocks, len(self.names))
        component = {self.names[m]: k for k, (members, _) in enumerate(components) for m in members}
        absolute = self.solution.interreflection.kept
        gauge = table.Gauge(RULE + DETERMINED * absolute, component, GAUGE + ABSOLUTE * absolute)
        return table.MaterialTable(solved, gauge, self.model())

    def uncertainty(self, errors: StandardErrors) -> Uncertainty:
        """The content of uncertainty.json."""
        return Uncertainty(
            errors.deviation, _errors(self.names, errors), GAUGE + ABSOLUTE * self.solution.interreflection.kept
        )

    def lights(self) -> dict[str, Lobes]:
        """By illumination, in scene radiance."""
        lights = zip(self.problem.blocks, self.solution.point.lights, strict=True)
        return {block.name: Lobes(light.axis, light.sharpness, light.weight * block.unit) for block, light in lights}

    def exposures(self) -> dict[str, table.Channels]:
        """Factor of each photo on its light, per channel."""
        return {photo: (factor * self.relative[photo],) * 3 for photo, factor in self.found_exposures().items()}

    def found_exposures(self) -> dict[str, float]:
        """Factor of each photo beside what its EXIF says."""
        lights = zip(self.problem.blocks, self.solution.point.lights, strict=True)
        return {
            photo: float(np.exp(light.log_exposure[k]))
            for block, light in lights
            for k, photo in enumerate(block.photos)
        }

    def model(self) -> table.Model:
        """What was decided of the model, and by what."""
        names, solution, blocks = self.names, self.solution, self.problem.blocks
        return table.Model(
            solver=self.solver,
            lobes={block.name: len(light) for block, light in zip(blocks, solution.point.lights, strict=True)},
            lobes_chosen_by=LOBES_CHOSEN_BY[self.solver],
            held_out_loss=[event.held_out for event in solution.history if event.phase in ("round", "subset")],
            specular={name: not bool(solution.lambertian[m]) for m, name in enumerate(names)},
            specular_chosen_by=_by_name(names, solution.specular),
            self_shadowing=solution.shadows.kept,
            self_shadowing_chosen_by=_losses(solution.shadows),
            interreflection=solution.interreflection.kept,
            interreflection_chosen_by=_losses(solution.interreflection),
            light_prior=self.solver == "bundle",
            splitting_chosen_by=[_decision(one) for one in solution.splitting],
            tone=self.tone(),
            tone_chosen_by=_by_name([block.name for block in blocks], solution.tone),
            started_from=self.started_from(),
        )

    def tone(self) -> dict[str, table.Tone]:
        """Tone curves of the photos that have one; the pivot in scene radiance."""
        return {
            photo: table.Tone(float(np.exp(log_tone)), block.unit * self.relative[photo])
            for block, light in zip(self.problem.blocks, self.solution.point.lights, strict=True)
            for photo, log_tone in zip(block.photos, light.log_tone, strict=False)
        }

    def started_from(self) -> table.Started | msgspec.UnsetType:
        """What the earlier solution knew of this problem."""
        if self.earlier is None:
            return msgspec.UNSET
        materials = set(self.names) & set(self.earlier.table.materials)
        return table.Started(
            sorted(materials), sorted({block.name for block in self.problem.blocks} & set(self.earlier.lights))
        )


def _rows(materials: Materials) -> list[tuple[list[float], list[float], float]]:
    """Diffuse, specular and roughness of each."""
    return list(zip(materials.diffuse.tolist(), materials.specular.tolist(), materials.roughness.tolist(), strict=True))


def _errors(names: Sequence[str], errors: StandardErrors) -> dict[str, table.StandardErrors]:
    return {name: table.StandardErrors(*row) for name, row in zip(names, _rows(errors.materials), strict=True)}


def _losses(evidence: Evidence) -> dict[str, float]:
    """The held-out losses of the models that were tried, and the margin."""
    names = ("held_out_loss_with", "held_out_loss_without", "margin")
    return {name: value for name in names if (value := getattr(evidence, name)) is not None}


def _decision(evidence: Evidence) -> table.Decision:
    return table.Decision(evidence.kept, evidence.held_out_loss_with, evidence.held_out_loss_without, evidence.margin)


def _by_name(names: Sequence[str], evidence: Sequence[Evidence]) -> dict[str, table.Decision]:
    chosen = zip(names, evidence, strict=False)
    return {name: _decision(one) for name, one in chosen}
