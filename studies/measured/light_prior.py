"""Prior on natural light, fitted to captured maps, and its likelihood of maps that it was not fitted to.

    python -m studies.measured.light_prior FOLDER… [--out factorlib/light/prior.json]

Each map is a sample. Its area means over cells of equal area (a map's own texels are too fine, and smaller toward the
poles) are the u of `factorlib.light.prior`. y_0, y_1 and y_2 are fitted each by itself, over n cells and m maps. Maps
differ in contrast as a whole: a circus has a hundred times the variance of colour of a grey studio. So each map is
drawn from Student's t of ν degrees of freedom (Lange, Little and Taylor, "Robust statistical modeling using the t
distribution", 1989), in which a map of much contrast has little weight w:

    −log L = Σ_m [log|πνK|/2 + (ν+n)/2 log(1 + d_m/ν) + log Γ(ν/2) − log Γ((ν+n)/2)],   d_m = r_mᵀ K⁻¹ r_m,   r_m = y_m
    − X β      (1) β = (Xᵀ K⁻¹ X)⁻¹ Xᵀ K⁻¹ Σ_m w_m y_m / Σ_m w_m,   w_m = (ν + n) / (ν + d_m)
    (2) ∂(−log L)/∂t = 1/2 Σ_m tr[(K⁻¹ − w_m K⁻¹ r_m r_mᵀ K⁻¹) ∂K/∂t]   (β is optimal, so its own derivative drops out)
    (3)

over t = log of variance, decay, nugget, level and ν. X holds the profile's polynomials, and for y_0 a one: its mean is
the maps' mean exposure, which is not a property of light. For the same reason the level of y_0 is not fitted but wide,
EXPOSURE_VARIANCE.
"""

import hashlib
from argparse import ArgumentParser
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.special import digamma, gammaln

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.images.light_map import maps_in, read_light_map
from factorlib.jsonfile import json_text, write_json
from factorlib.light.prior import MIX, LeaveOneOut, LightPrior, SourceMap, angles, correlation
from factorlib.reading import read_bytes

CELLS = 400  # cells of equal area, some 10° apart
EXPOSURE_VARIANCE = 100.0  # log²: a photo's exposure may be wrong by a factor e^±10
FLOOR = 1e-4  # of a map's mean radiance: what is darker than that is noise of the capture
UP = np.array([0.0, 1.0, 0.0])  # of a lat-long map
# log of variance, decay (radians), nugget, level, degrees of freedom: where the search starts, and where it must stay
START = np.log([1.0, 0.7, 0.05, 0.1, 5.0])
BOUNDS = [
    (np.log(low), np.log(high)) for low, high in ((1e-4, 1e2), (0.03, 12.0), (1e-5, 1e1), (1e-5, 1e2), (0.5, 1e4))
]
WEIGHTINGS = 10  # times that β and w are found from each other: far more than they need
DIGITS = 4  # significant ones of what is shipped

Logs = Float[np.ndarray, "3 m n"]  # y_0, y_1, y_2 of m maps in n cells


def prior_of(paths: Sequence[Path], scored: bool = True) -> LightPrior:
    """Fit the prior to the maps in some files, in the form in which the package ships it.

    scored: with its leave-one-out scores, which take most of the time
    """
    cells = fibonacci_sphere(CELLS)
    logs = log_cells(np.stack([cell_means(read_light_map(path), cells) for path in paths]))
    sources = tuple(SourceMap(path.name, hashlib.sha256(read_bytes(path, "a light map")).hexdigest()) for path in paths)
    scores = leave_one_out(logs, cells) if scored and len(paths) > 1 else None
    return round_numbers(msgspec.structs.replace(fit_prior(logs, cells), made_from=sources, leave_one_out=scores))


def cell_means(lat_long: Float[np.ndarray, "h w 3"], cells: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the mean radiance over each cell: the directions nearest to one of the unit directions `cells`.

    Raises ValueError for a map so coarse that a cell has no texel.
    """
    height, width = lat_long.shape[:2]
    cell = cKDTree(cells).query(lat_long_directions(height, width).reshape(-1, 3))[1]
    area = np.repeat(lat_long_solid_angles(height, width), width)
    total = np.bincount(cell, area, len(cells))
    if not total.all():
        raise ValueError(f"{height} × {width} texels are too few for {len(cells)} cells")
    sums = [np.bincount(cell, area * channel, len(cells)) for channel in lat_long.reshape(-1, 3).T]
    return np.stack(sums, axis=-1) / total[:, None]


def log_cells(means: Float[np.ndarray, "m n 3"]) -> Logs:
    """Return y of the mean radiances (linear Rec. 709, finite, no map black) of cells of some maps."""
    floor = FLOOR * means.mean(axis=(1, 2), keepdims=True)
    return np.einsum("kc,mnc->kmn", MIX, np.log(np.maximum(means, floor)))


def legendre(sine: Float[np.ndarray, " p"]) -> Float[np.ndarray, "p 3"]:
    """Return P_1, P_2, P_3; over the sphere their means are zero, so they leave the level alone."""
    return np.polynomial.legendre.legvander(sine, 3)[:, 1:]


def mean_of(prior: LightPrior, cells: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 n"]:
    """Return the mean of y in unit directions of the maps' frame: equation (3) of `factorlib.light.prior`."""
    return np.array(prior.profile) @ legendre(cells @ UP).T


def fit_prior(
    logs: Logs, cells: Float[np.ndarray, "n 3"], profile: bool = True, start: LightPrior | None = None
) -> LightPrior:
    """Fit the prior of greatest likelihood to `logs`, y of some maps.

    cells: unit directions of the maps' frame (+y is up)
    profile: whether the mean depends on elevation;  start: where to begin the search
    """
    numbers = []
    coefficients = []
    angle = angles(cells)
    for k in range(3):
        design = np.hstack([legendre(cells @ UP)[:, : 3 * int(profile)], np.ones((len(cells), int(k == 0)))])
        bounds = list(BOUNDS)
        begin = START.copy()
        if start is not None:
            decay = np.radians(start.decay_deg[k])
            begin = np.log([start.variance[k], decay, start.nugget[k], start.level[k], start.freedom[k]])
        if k == 0:
            begin[3] = np.log(EXPOSURE_VARIANCE)
            bounds[3] = (begin[3], begin[3])
        cost = partial(_cost, angle=angle, design=design, values=logs[k])
        best = minimize(lambda t, cost=cost: cost(t)[:2], begin, jac=True, method="L-BFGS-B", bounds=bounds).x
        numbers.append(np.exp(best))
        coefficients.append(tuple(cost(best)[2][:3].tolist()) if profile else (0.0,) * 3)
    variance, decay, nugget, level, freedom = (tuple(each.tolist()) for each in np.transpose(numbers))
    degrees = tuple(np.degrees(decay).tolist())
    size = float(np.degrees(np.sqrt(4 * np.pi / len(cells))))
    return LightPrior(variance, degrees, level, nugget, tuple(coefficients), size, freedom)


def _cost(
    t: Float[np.ndarray, "5"],
    angle: Float[np.ndarray, "n n"],
    design: Float[np.ndarray, "n q"],
    values: Float[np.ndarray, "m n"],
) -> tuple[float, Float[np.ndarray, "5"], Float[np.ndarray, " q"]]:
    """Return −log L per map, its gradient by t, and β: equations (1) to (3)."""
    variance, decay, nugget, level, freedom = np.exp(t)
    covariance = variance * correlation(angle, decay)
    count = len(angle)
    factor = cho_factor(covariance + level + nugget * np.eye(count), lower=True)
    inverse = cho_solve(factor, np.eye(count))
    beta, weight = _weighted_means(inverse, design, values, freedom)
    residual = values - design @ beta
    solved = residual @ inverse
    square = np.sum(solved * residual, axis=1)
    slope = 0.5 * (inverse - (weight[:, None] * solved).T @ solved / len(values))
    by_freedom = np.log1p(square / freedom) - weight * square / freedom  # ν
    by_freedom = by_freedom - digamma((freedom + count) / 2) + digamma(freedom / 2) + count / freedom
    gradient = [np.sum(slope * covariance), np.sum(slope * covariance * angle) / decay, nugget * np.trace(slope)]
    gradient += [level * slope.sum(), freedom * by_freedom.mean() / 2]
    return -_log_density(factor[0], square, freedom).mean(), np.array(gradient), beta


def _weighted_means(
    inverse: Float[np.ndarray, "n n"],
    design: Float[np.ndarray, "n q"],
    values: Float[np.ndarray, "m n"],
    freedom: float,
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " m"]]:
    """Return β, and the weight of each map: equation (2).

    d is quadratic in β, so what is summed over cells is summed once.
    """
    count = values.shape[1]
    weight = np.ones(len(values))
    towards = inverse @ design
    gram = design.T @ towards
    along = values @ towards
    squares = np.sum(values @ inverse * values, axis=1)
    for _ in range(WEIGHTINGS):
        beta = np.linalg.solve(gram, weight @ along / weight.sum())
        weight = (freedom + count) / (freedom + squares - 2 * along @ beta + beta @ gram @ beta)
    return beta, weight


def _log_density(
    root: Float[np.ndarray, "n n"], square: Float[np.ndarray, " m"], freedom: float
) -> Float[np.ndarray, " m"]:
    """Return the log density of Student's t: `root` is the lower Cholesky factor of K, `square` is d."""
    count = len(root)
    gammas = gammaln((freedom + count) / 2) - gammaln(freedom / 2)
    constant = gammas - count / 2 * np.log(np.pi * freedom) - np.log(np.diag(root)).sum()
    return constant - (freedom + count) / 2 * np.log1p(square / freedom)


def log_likelihood(prior: LightPrior, logs: Logs, cells: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " m"]:
    """Return the log density of y of each map under a prior, nats."""
    total = np.zeros(logs.shape[1])
    for k, residual in enumerate(logs - mean_of(prior, cells)[:, None]):
        root = np.linalg.cholesky(prior.covariance(k, cells))
        square = np.sum(solve_triangular(root, residual.T, lower=True) ** 2, axis=0)
        total += _log_density(root, square, prior.freedom[k])
    return total


def white_noise(prior: LightPrior) -> LightPrior:
    """Return another prior with independent cells; the variance of a cell, level and profile are unchanged."""
    nugget = tuple(v + n for v, n in zip(prior.variance, prior.nugget, strict=True))
    return msgspec.structs.replace(prior, variance=(0.0, 0.0, 0.0), nugget=nugget)


def leave_one_out(logs: Logs, cells: Float[np.ndarray, "n 3"]) -> LeaveOneOut:
    """Score each map under a prior fitted to the others, and under two nulls fitted to them; return the means."""
    whole = fit_prior(logs, cells)
    flat = fit_prior(logs, cells, profile=False)
    scores = []
    for m in range(logs.shape[1]):
        print(f"map {m + 1} of {logs.shape[1]} is left out", end="\r", flush=True)
        training = np.delete(logs, m, axis=1)
        held_out = logs[:, m : m + 1]
        prior = fit_prior(training, cells, start=whole)
        priors = prior, white_noise(prior), fit_prior(training, cells, profile=False, start=flat)
        scores.append([float(log_likelihood(each, held_out, cells)[0]) for each in priors])
    return LeaveOneOut(*np.mean(scores, axis=0).tolist())


def round_numbers(prior: LightPrior) -> LightPrior:
    """Round to the digits that a table needs."""

    def short(value: float | tuple) -> float | tuple:
        """Round to DIGITS digits."""
        return tuple(map(short, value)) if isinstance(value, tuple) else float(f"{value:.{DIGITS}g}")

    names = ("variance", "decay_deg", "level", "nugget", "freedom", "profile", "cell_deg")
    scores = prior.leave_one_out
    if scores:
        scores = LeaveOneOut(*(round(score, 1) for score in msgspec.structs.astuple(scores)))
    return msgspec.structs.replace(prior, **{name: short(getattr(prior, name)) for name in names}, leave_one_out=scores)


def main(folders: Sequence[Path], out: Path | None = None) -> None:
    """Fit the prior on natural light to the lat-long maps (.hdr, .exr) in some folders; print it, or write a file."""
    prior = prior_of(maps_in(folders))
    print(json_text(prior)) if out is None else write_json(out, prior)


if __name__ == "__main__":
    parser = ArgumentParser(description=main.__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, help="file to write to")
    main(**vars(parser.parse_args()))
