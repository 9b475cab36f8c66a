"""Initial fits of a solve: from mean radiances alone, from the fit of `surface`, or from an earlier solution.

Nothing   The median radiance of material m in photo i is roughly light_i · reflectance_m per channel, a rank-one matrix
          with gaps.  Its logarithm is fitted as a sum by least squares.  Exposures follow from mean radiances, and
          lights are constant.
Surface   The stage `surface` fits the same materials and lights to the meshes as they are.  A solve continues from that
          fit (`InitialFit`).
Earlier   Materials are identified by name, and lights by the name of their illumination.  Mean radiances give all
          materials, known or new, one relative scale (`mean_albedo`).  One factor per channel brings each gauge of the
          earlier solution to that scale: the geometric mean over its materials.  Its lights get the inverse factor.
          Groups that a new photo links therefore share one gauge, and new materials are on the same scale as known
          ones.  A new photo of a known light gets the exposure that explains its mean radiance.  A new light is
          constant.  A light that explains its photos worse than a constant one counts as new: it was taken again, or
          rotated, or is in other units.  The decisions on shadows and interreflection are taken over.  A
          light that is continued also keeps its suns, tone curves and distance, which are not tested again.  No prior
          pulls toward the earlier answer.
Known     Each component is brought to the scale of its known materials, which are then inserted.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from zlib import crc32

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from factorlib.inference.fit.fit import Fit, Hyperparameters, initial_fit
from factorlib.inference.model.blocks import COMPARISON_LOSS, Block
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.gauge import connected_components
from factorlib.inference.model.lights import DARKEST, TONE_RANGE, Light, UnitLobes, fibonacci_cells
from factorlib.inference.model.materials import LEAST_REFLECTANCE, SHARPNESS, Materials, Point
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.options import SolveOptions
from factorlib.results.solution import EarlierSolution

log = logging.getLogger("factorlib.inference")
BRIGHTEST_AT_START = 0.7  # reflectance of the brightest material at the start
# Start of every material.
START_ROUGHNESS = 0.4
SPECULAR_SHARE = 0.2
# With at most FEW_MATERIALS materials, a solve starts from each roughness of START_ROUGHNESSES.
FEW_MATERIALS = 2
START_ROUGHNESSES = (0.15, 0.4, 0.8)
COMPARED = 1000  # observations by which an earlier light is compared with a constant one
LEAST_RADIANCE = 1e-6  # least radiance, as a share of a block's mean

# Function of a problem and a number of cells a light; the best of its fits continues.
Start = Callable[[JointProblem, int], list[Fit]]


def start_from_photos(materials: int) -> Start:
    """Return the start from mean radiances alone; with few materials, from several roughnesses."""

    def fits(problem: JointProblem, cells: int) -> list[Fit]:
        """Return one fit per roughness, with constant lights."""
        roughness = START_ROUGHNESSES if materials <= FEW_MATERIALS else START_ROUGHNESSES[1:2]
        candidates = [starting_materials(problem.blocks, materials, value) for value in roughness]
        return [
            initial_fit(Point(candidate, [constant_light(block, candidate, cells) for block in problem.blocks]))
            for candidate in candidates
        ]

    return fits


class InitialLight(msgspec.Struct, frozen=True):
    """Light on p `rotated_cells`.

    Attributes:
        weight: Weights of the cells, RGB, in scene radiance.
        log_exposure: Log exposures of its photos.
        hyperparameters: Hyperparameters of the fit.
    """

    weight: list[list[float]]
    log_exposure: list[float]
    hyperparameters: Hyperparameters


class InitialFit(msgspec.Struct, frozen=True):
    """Materials and lights that were fitted to the meshes as they are.

    Attributes:
        materials: k_d, k_s (RGB each) and roughness, by number.
        lights: Lights by illumination.
    """

    materials: list[list[float]]
    lights: dict[str, InitialLight]

    @staticmethod
    def from_fit(fit: Fit, blocks: Sequence[Block]) -> InitialFit:
        """Return the serialisable form of a fit of these blocks.

        Its lights are infinitely far away and have no tone curves.
        """
        lights = {
            block.name: InitialLight((light.weight * block.unit).tolist(), light.log_exposure.tolist(), hyperparameters)
            for block, light, hyperparameters in zip(blocks, fit.point.lights, fit.hyperparameters, strict=True)
        }
        return InitialFit(fit.point.materials.rows().tolist(), lights)


def start_from_surface(initial: InitialFit) -> Start:
    """Return the start from a fit.

    A light with other cells or other photos than the fit's is constant.  The start then counts as a first guess, from
    which the solve descends as from mean radiances.
    """

    def fits(problem: JointProblem, cells: int) -> list[Fit]:
        """Return the fit in the units of the problem."""
        materials = Materials.from_rows(np.array(initial.materials))
        lights = [constant_light(block, materials, cells) for block in problem.blocks]
        hyperparameters = [Hyperparameters() for _ in lights]
        fitted = True
        for k, block in enumerate(problem.blocks):
            light = initial.lights.get(block.name)
            if light is None or (len(light.weight), len(light.log_exposure)) != (cells, len(block.photos)):
                fitted = False
                continue
            values = {"weight": np.array(light.weight) / block.unit, "log_exposure": np.array(light.log_exposure)}
            lights[k] = msgspec.structs.replace(lights[k], **values)
            hyperparameters[k] = light.hyperparameters
        return [Fit(Point(materials, lights), hyperparameters, fitted=fitted)]

    return fits


def insert_known(point: Point, problem: JointProblem) -> Point:
    """Return the point with known values inserted; the other unknowns of each component are scaled to match."""
    known = problem.known
    lights = list(point.lights)
    if known.is_empty:
        return point
    names = [block.name for block in problem.blocks]
    rows = point.materials.rows()
    known_rows = np.maximum(known.insert_into(point.materials).rows(), LEAST_REFLECTANCE)
    for members, illuminations in connected_components(problem.blocks, len(point.materials)):
        linked_lights = [names.index(name) for name in illuminations]
        known_lights = {i: known.lights[names[i]] for i in linked_lights if names[i] in known.lights}
        # log factor on reflectances: of the known materials, else of the known lights, else 0
        logs = [
            np.log((known_rows[m, :3] + known_rows[m, 3:6]) / (rows[m, :3] + rows[m, 3:6]))
            for m in known.known_materials(members)
        ]
        brighter = {
            i: log_mean_radiance(lights[i]) - log_mean_radiance(known_light) + np.log(problem.blocks[i].unit)
            for i, known_light in known_lights.items()
        }
        logs = (
            logs
            or [ratio - ratio.mean() * known_lights[i].scale_free for i, ratio in brighter.items()]
            or [np.zeros(3)]
        )
        factor = np.mean(logs, axis=0)  # on reflectances
        rows[list(members), :6] *= np.tile(np.exp(factor), 2)
        for i in linked_lights:
            weight = lights[i].weight / np.exp(factor)
            parts = {}
            if known_light := known_lights.get(i):
                scale = (brighter[i] - factor).mean() * known_light.scale_free - np.log(problem.blocks[i].unit)
                weight = known_light.weight * np.exp(scale)
                constraints = {"fixed": known_light.fixed, "scale_free": known_light.scale_free}
                parts = {"axis": known_light.axis, "log_sharpness": known_light.log_sharpness, **constraints}
            if names[i] in known.exposures:
                parts |= {"log_exposure": np.zeros_like(lights[i].log_exposure), "exposures_fixed": True}
            lights[i] = msgspec.structs.replace(lights[i], weight=weight, **parts)
    return Point(known.insert_into(Materials.from_rows(rows)), lights)


def log_mean_radiance(light: Light) -> Float[np.ndarray, "3"]:
    """Return the logarithm of a light's mean radiance."""
    return np.log(np.maximum(light.mean_radiance, LEAST_RADIANCE))


def start_from_earlier(earlier: EarlierSolution, names: Sequence[str]) -> Start:
    """Return the start from an earlier solution, for materials called `names`.

    Lights of the earlier solution keep their cells.
    """
    return lambda problem, cells: [initial_fit(point_from_earlier(problem, earlier, names, cells))]


def with_earlier_decisions(options: SolveOptions, earlier: EarlierSolution) -> SolveOptions:
    """Return the choices with shadows and interreflection as decided before.

    A decision counts only if both alternatives had been compared.
    """
    for name in ("self_shadowing", "interreflection"):
        if getattr(options, name) == "auto" and getattr(earlier, name):
            options = msgspec.structs.replace(options, **{name: getattr(earlier, name)})
    return options


def starting_materials(blocks: Sequence[Block], count: int, roughness: float = START_ROUGHNESS) -> Materials:
    """Return materials whose diffuse part explains the median radiances and whose specular part is grey."""
    albedo = mean_albedo(blocks, count)
    diffuse = np.maximum(albedo * (1 - SPECULAR_SHARE), 10 * LEAST_REFLECTANCE)
    specular = np.maximum(np.full((count, 3), SPECULAR_SHARE * BRIGHTEST_AT_START / 2), 10 * LEAST_REFLECTANCE)
    return Materials(diffuse, specular, np.full(count, roughness))


def mean_albedo(blocks: Sequence[Block], count: int) -> Float[np.ndarray, "m 3"]:
    """Return the relative reflectance per material and channel; the largest is `BRIGHTEST_AT_START`.

    Materials that no block shows get the median.
    """
    rows = []
    targets = []
    weight = []
    offset = count
    # one equation per photo and material: log median radiance = log reflectance + log light, weighted by √count
    for block in blocks:
        for k in range(len(block.photos)):
            for m in np.unique(block.material[block.photo == k]):
                selected = (block.material == m) & (block.photo == k)
                row = np.zeros(count + sum(len(b.photos) for b in blocks))
                row[[m, offset + k]] = 1
                rows.append(row)
                targets.append(np.log(np.maximum(np.median(block.radiance[selected], axis=0), LEAST_RADIANCE)))
                weight.append(np.sqrt(selected.sum()))
        offset += len(block.photos)
    # weighted least squares; the scale is fixed by the brightest material
    weighted = np.array(rows) * np.array(weight)[:, None]
    logs = np.linalg.lstsq(weighted, np.array(targets) * np.array(weight)[:, None], rcond=None)[0][:count]
    observed = np.array(rows)[:, :count].any(0)
    logs[~observed] = np.median(logs[observed], axis=0)
    return BRIGHTEST_AT_START * np.exp(logs - logs.max())


def constant_light(block: Block, materials: Materials, cells: int) -> Light:
    """Return the constant light that explains the mean radiance of a block's first photo.

    The exposures of the other photos explain their mean radiances.
    """
    reflectance = np.maximum((materials.diffuse + materials.specular)[block.material], LEAST_REFLECTANCE)
    logs = np.log(np.maximum(block.radiance, LEAST_RADIANCE) / reflectance)
    observed = [k for k in range(len(block.photos)) if (block.photo == k).any()]
    # log of each photo's mean radiance over reflectance
    levels = np.zeros((len(block.photos), 3))
    levels[observed] = [np.log(np.mean(np.exp(logs[block.photo == k]), axis=0)) for k in observed]
    lobes = rotated_cells(block.name, cells)
    light = Light(lobes.axis, np.log(lobes.sharpness), np.ones((cells, 3)), (levels - levels[0]).mean(1))
    return light.with_log_radiance(np.repeat(levels[0][:, None], cells, axis=1))


def rotated_cells(name: str, count: int) -> UnitLobes:
    """Return `count` even cells, rotated at random by the name of the illumination.

    The blur of the cells therefore differs from light to light.
    """
    cells = fibonacci_cells(count)
    seed = crc32(name.encode())
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return msgspec.structs.replace(cells, axis=cells.axis @ turn.T)


def refine_cells(fit: Fit, count: int, problem: JointProblem) -> Fit:
    """Return a fit with its lights on `count` cells.

    Known lights, and lights with suns or with at least `count` cells, keep their own.
    """
    lights = []
    for light, block in zip(fit.point.lights, problem.blocks, strict=True):
        if len(light) < count and not light.fixed.any() and not light.suns.any():
            cells = rotated_cells(block.name, count)
            radiance = light.lobes.radiance(cells.axis)
            lobes = {"axis": cells.axis, "log_sharpness": np.log(cells.sharpness), "weight": radiance}
            light = msgspec.structs.replace(light, **lobes).with_log_radiance(np.log(np.maximum(radiance, DARKEST)).T)
        lights.append(light)
    return fit.with_lights(lights)


def point_from_earlier(problem: JointProblem, earlier: EarlierSolution, names: Sequence[str], cells: int) -> Point:
    """Return the point from which a solve with an earlier solution starts.

    Each component of the earlier gauge is brought to the scale of `mean_albedo` by a geometric mean.  The mean is over
    its materials that a block shows, or over all of them if none is shown.

    Args:
        problem: Observations.
        earlier: Earlier solution.
        names: Names of the materials, by number.
        cells: Number of cells of a new light.
    """
    component = [earlier.table.gauge.component.get(name) for name in names]
    albedo = mean_albedo(problem.blocks, len(names))
    rows = starting_materials(problem.blocks, len(names)).rows()
    observed = {int(m) for block in problem.blocks for m in np.unique(block.material)}
    factors = {}
    for c in sorted({c for c in component if c is not None}):
        members = [m for m in range(len(names)) if component[m] == c]
        known = {m: earlier.table.materials[names[m]] for m in members}
        references = [m for m in members if m in observed] or members
        sums = np.array([np.array(known[m].diffuse) + np.array(known[m].specular) for m in references])
        factor = np.exp(np.mean(np.log(albedo[references]) - np.log(np.maximum(sums, LEAST_RADIANCE)), axis=0))
        for m, reflectance in known.items():
            rows[m] = [*(reflectance.diffuse * factor), *(reflectance.specular * factor), reflectance.roughness]
        factors[c] = factor
    materials = Materials.from_vector(rows.reshape(-1))
    lights = []
    for block in problem.blocks:
        light = constant_light(block, materials, cells)
        components = [component[m] for m in np.unique(block.material) if component[m] is not None]
        if components:
            factor = factors[max(set(components), key=lambda c: (components.count(c), -c))]
            constant = Illumination(block, light, materials, problem.operator)
            light = light_from_earlier(constant, earlier, factor)
        lights.append(light)
    return Point(materials, lights)


def light_from_earlier(constant: Illumination, earlier: EarlierSolution, factor: Float[np.ndarray, "3"]) -> Light:
    """Return the earlier light of a block, in the block's unit and the start's gauge.

    The constant light is returned if there is no earlier one, or if that explains the block worse.  A photo that the
    earlier solution lacks gets its exposure in the constant light, relative to the others.

    Args:
        constant: Block in its constant light.
        earlier: Earlier solution.
        factor: Factor on the reflectances of the earlier solution.
    """
    block = constant.block
    model = earlier.table.model
    constant_exposure = constant.light.log_exposure
    lobes = earlier.lights.get(block.name)
    exposure = np.array([np.log(np.mean(earlier.exposures.get(photo, (np.nan,) * 3))) for photo in block.photos])
    is_new = np.isnan(exposure)
    if not lobes or is_new.all():
        return constant.light
    # a new photo has its exposure in the constant light, relative to the known photos
    exposure = np.where(is_new, constant_exposure + np.mean(exposure[~is_new] - constant_exposure[~is_new]), exposure)
    # a new photo has the mean tone curve of the known ones
    tone = np.log([np.clip(model.tone[p].exponent, *TONE_RANGE) if p in model.tone else np.nan for p in block.photos])
    tone = np.where(np.isnan(tone), np.nanmean(tone), tone) if np.isfinite(tone).any() else np.zeros(0)
    light = Light(
        lobes.axis / np.linalg.norm(lobes.axis, axis=1, keepdims=True),
        np.log(np.maximum(lobes.sharpness, SHARPNESS[0])),
        np.maximum(lobes.weight, 0) / block.unit / factor * np.exp(exposure[0]),
        exposure - exposure[0],
        tone,
        model.curvature(block.name),
    )
    sample = msgspec.structs.replace(constant, block=block.subsample(COMPARED, seed=0))
    losses = [msgspec.structs.replace(sample, light=each).losses(COMPARISON_LOSS) for each in (light, constant.light)]
    if losses[0].mean() <= losses[1].mean():
        return light
    message = "illumination '%s' starts anew: a constant light explains its photos better than the earlier solution's"
    log.warning(message, block.name)
    return constant.light
