"""Fitting the light prior to captured maps: maximum likelihood, and how well it foresees maps it was not fitted to.

Each map is a sample. Its area means over cells of equal area (a map's own texels are too fine, and smaller toward the poles) are the u of
`factorlib.light.prior`. y_0, y_1 and y_2 are independent, so each is fitted by itself, over n cells and m maps:

    −log L = m/2 log|2πK| + 1/2 Σ_m r_mᵀ K⁻¹ r_m,   r_m = y_m − X β,   β = (Xᵀ K⁻¹ X)⁻¹ Xᵀ K⁻¹ mean_m(y_m)            (1)
    ∂(−log L)/∂t = 1/2 tr[(m K⁻¹ − Σ_m K⁻¹ r_m r_mᵀ K⁻¹) ∂K/∂t]   (β is optimal, so its own derivative drops out)      (2)

over t = log of variance, decay, nugget and level. X holds the profile's polynomials, and for y_0 a one: its mean is the maps' mean exposure, which is
no property of light. For the same reason the level of y_0 is not fitted but wide, EXPOSURE_VARIANCE.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.light.prior import MIX, LeaveOneOut, LightPrior, angles, correlation, legendre

EXPOSURE_VARIANCE = 100.0  # log²: a photo's exposure may be wrong by a factor e^±10
FLOOR = 1e-4  # of a map's mean radiance: what is darker than that is noise of the capture
UP = np.array([0.0, 1.0, 0.0])  # of a lat-long map
# log of variance, decay (radians), nugget, level: where the search starts, and where it must stay
START = np.log([1.0, 0.7, 0.05, 0.1])
BOUNDS = [(np.log(low), np.log(high)) for low, high in ((1e-4, 1e2), (0.03, 12.0), (1e-5, 1e1), (1e-5, 1e2))]
DIGITS = 4  # significant ones of what is shipped

Logs = Float[np.ndarray, "3 m n"]  # y_0, y_1, y_2 of m maps in n cells
Progress = Callable[[int, int], None]


def cell_means(lat_long: Float[np.ndarray, "h w 3"], cells: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Mean radiance over each cell: the directions nearest to one of the unit directions `cells`.

    Raises ValueError for a map so coarse that a cell has no texel.
    """
    height, width = lat_long.shape[:2]
    cell = cKDTree(cells).query(lat_long_directions(height, width).reshape(-1, 3))[1]
    area = np.repeat(lat_long_solid_angles(height, width), width)
    total = np.bincount(cell, area, len(cells))
    if not total.all():
        raise ValueError(f"{height} × {width} texels are too few for {len(cells)} cells")
    return np.stack([np.bincount(cell, area * channel, len(cells)) for channel in lat_long.reshape(-1, 3).T], axis=-1) / total[:, None]


def log_cells(means: Float[np.ndarray, "m n 3"]) -> Logs:
    """y of the mean radiances (linear Rec. 709, finite, no map black) of cells of some maps."""
    floor = FLOOR * means.mean(axis=(1, 2), keepdims=True)
    return np.einsum("kc,mnc->kmn", MIX, np.log(np.maximum(means, floor)))


def fitted(logs: Logs, cells: Float[np.ndarray, "n 3"], profile: bool = True, start: LightPrior | None = None) -> LightPrior:
    """The prior of greatest likelihood of `logs`, y of some maps in unit directions `cells` of the maps' frame (+y is up).

    profile: whether the mean depends on elevation;  start: where to begin the search
    """
    found = [_fitted_one(k, logs[k], cells, profile, START if start is None else _log_parameters(start, k)) for k in range(3)]
    (variance, decay, nugget, level), coefficients = np.exp([t for t, _ in found]).T, [b for _, b in found]
    return LightPrior(
        tuple(variance.tolist()), tuple(np.degrees(decay).tolist()), tuple(level.tolist()), tuple(nugget.tolist()),
        tuple(tuple(b.tolist()) for b in coefficients), cell_deg=float(np.degrees(np.sqrt(4 * np.pi / len(cells)))),
    )  # fmt: skip


def _log_parameters(prior: LightPrior, k: int) -> Float[np.ndarray, "4"]:
    return np.log([prior.variance[k], np.radians(prior.decay_deg[k]), prior.nugget[k], prior.level[k]])


def _fitted_one(
    k: int, values: Float[np.ndarray, "m n"], cells: Float[np.ndarray, "n 3"], profile: bool, start: Float[np.ndarray, "4"]
) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "3"]]:
    """Logs of variance, decay, nugget and level of y_k, and its profile."""
    exposure = [np.ones(len(cells))] if k == 0 else []
    design = np.stack([*(legendre(cells @ UP).T if profile else []), *exposure], axis=-1) if profile or exposure else np.zeros((len(cells), 0))
    bounds, start = list(BOUNDS), start.copy()
    if k == 0:
        start[3] = np.log(EXPOSURE_VARIANCE)
        bounds[3] = (start[3], start[3])
    angle = angles(cells)
    best = minimize(lambda t: _cost(t, angle, design, values)[:2], start, jac=True, method="L-BFGS-B", bounds=bounds)
    coefficients = _cost(best.x, angle, design, values)[2]
    return best.x, coefficients[:3] if profile else np.zeros(3)


def _cost(
    t: Float[np.ndarray, "4"], angle: Float[np.ndarray, "n n"], design: Float[np.ndarray, "n q"], values: Float[np.ndarray, "m n"]
) -> tuple[float, Float[np.ndarray, "4"], Float[np.ndarray, " q"]]:
    """−log L per map without its constant, its gradient by t, and β: equations (1) and (2)."""
    variance, decay, nugget, level = np.exp(t)
    alike = variance * correlation(angle, decay)
    count = len(angle)
    factor = cho_factor(alike + level + nugget * np.eye(count), lower=True)
    inverse = cho_solve(factor, np.eye(count))
    weighted = inverse @ design
    beta = np.linalg.solve(design.T @ weighted, weighted.T @ values.mean(axis=0))
    residual = values - design @ beta
    solved = residual @ inverse
    cost = np.log(np.diag(factor[0])).sum() + 0.5 * np.sum(solved * residual) / len(values)
    slope = 0.5 * (inverse - solved.T @ solved / len(values))
    return cost, np.array([np.sum(slope * alike), np.sum(slope * alike * angle) / decay, nugget * np.trace(slope), level * slope.sum()]), beta


def log_likelihood(prior: LightPrior, logs: Logs, cells: Float[np.ndarray, "n 3"], up: Float[np.ndarray, "3"] | None) -> Float[np.ndarray, " m"]:
    """Log density of y of each map under a prior, nats."""
    residual = logs - prior.mean(cells, up)[:, None]
    return sum(_log_density(prior.covariance(k, cells), residual[k]) for k in range(3))


def _log_density(covariance: Float[np.ndarray, "n n"], residual: Float[np.ndarray, "m n"]) -> Float[np.ndarray, " m"]:
    factor = cho_factor(covariance, lower=True)
    square = np.einsum("mn,nm->m", residual, cho_solve(factor, residual.T))
    return -0.5 * square - np.log(np.diag(factor[0])).sum() - 0.5 * len(covariance) * np.log(2 * np.pi)


def white_noise(prior: LightPrior) -> LightPrior:
    """The same variance of a cell, level and profile, but cells are independent."""
    nugget = tuple(v + n for v, n in zip(prior.variance, prior.nugget, strict=True))
    return msgspec.structs.replace(prior, variance=(0.0, 0.0, 0.0), nugget=nugget)


def leave_one_out(logs: Logs, cells: Float[np.ndarray, "n 3"], progress: Progress = lambda done, total: None) -> LeaveOneOut:
    """Each map under a prior fitted to the others, and under two nulls fitted to them."""
    whole, flat = fitted(logs, cells), fitted(logs, cells, profile=False)
    maps, scores = logs.shape[1], []
    for m in range(maps):
        progress(m, maps)
        rest, one = np.delete(logs, m, axis=1), logs[:, m : m + 1]
        prior = fitted(rest, cells, start=whole)
        priors = prior, white_noise(prior), fitted(rest, cells, profile=False, start=flat)
        scores.append([float(log_likelihood(each, one, cells, UP)[0]) for each in priors])
    progress(maps, maps)
    return LeaveOneOut(*np.mean(scores, axis=0).tolist())


def rounded(prior: LightPrior) -> LightPrior:
    """To the digits that a table needs."""

    def short(value: float) -> float:
        return float(f"{value:.{DIGITS}g}")

    names = ("variance", "decay_deg", "level", "nugget")
    numbers = {name: tuple(map(short, getattr(prior, name))) for name in names}
    profile = tuple(tuple(map(short, each)) for each in prior.profile)
    scores = prior.leave_one_out and LeaveOneOut(*(round(score, 1) for score in msgspec.structs.astuple(prior.leave_one_out)))
    return msgspec.structs.replace(prior, **numbers, profile=profile, cell_deg=short(prior.cell_deg), leave_one_out=scores)
