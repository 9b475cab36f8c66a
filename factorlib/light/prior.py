"""What natural light looks like: log radiance over the sphere as a Gaussian process.

A photograph fixes the light from some directions well and from others hardly at all. What is known of all natural light fills the rest: neighbouring
directions are similarly bright, colour varies much less than luminance, and above is brighter than below.

    y = A u,  u = log (R, G, B) of the mean radiance of a cell of the sphere:
    y_0 = (log R + log G + log B)/3,   y_1 = log R − log G,   y_2 = log B − log G                                   (1)
    cov[y_k(a), y_k(b)] = variance_k exp(−θ_ab / decay_k) + level_k + [a = b] nugget_k,   θ_ab the angle of a and b    (2)
    mean[y_k(a)] = Σ_l profile_kl P_l(a · up),   P_l Legendre's polynomial of degree l = 1, 2, 3                       (3)

    s_k² ~ inverse gamma(ν_k/2, ν_k/2)                                                                                 (4)

is a factor of the covariance (2) of a whole map: some scenes have much contrast or much colour, others little. `covariance` and `precision` are those
at s = 1, a typical map; a solve finds s by evidence. With s integrated over, a map is drawn from Student's t of ν_k degrees of freedom.
y_0, y_1 and y_2 are independent of each other. exp(−θ/c) is positive definite on the sphere for every c > 0 (Gneiting, "Strictly and non-strictly
positive definite functions on spheres", 2013). A solve takes the mean to be nil, for it does not know what is above. `studies.measured.light_prior` finds the numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.jsonfile import read_json
from factorlib.light.lobes import squared_distances
from factorlib.reading import reading

MIX = np.array([[1 / 3, 1 / 3, 1 / 3], [1.0, -1.0, 0.0], [0.0, -1.0, 1.0]])  # A of equation (1)
SHIPPED = Path(__file__).with_name("prior.json")

Three = tuple[float, float, float]


class Source(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A map that a prior was fitted to: its file's name and the SHA-256 of its bytes."""

    name: str
    sha256: str


class LeaveOneOut(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mean log likelihood (nats) of the log radiances of all cells of a map under a prior fitted to all other maps.

    white_noise: the same variance, level and profile, but neighbours know nothing of each other;  no_profile: fitted without equation (3)
    """

    prior: float
    white_noise: float
    no_profile: float


class LightPrior(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The numbers of equations (2) and (3), each for y_0, y_1, y_2; variances are of natural logarithms.

    variance, decay_deg:  of what varies over the sphere, and the angle over which it is alike
    level:      variance of a constant that all directions share: for y_0 the unknown exposure, for y_1 and y_2 the white balance
    nugget:     variance of a cell on its own, which no neighbour knows
    profile:    coefficients of P_1, P_2, P_3 of the sine of elevation
    cell_deg:   size of the cells it was fitted at: smaller cells vary more
    freedom:    ν of equation (4): about 3 says that maps differ much in contrast, 10⁴ that they do not
    """

    variance: Three
    decay_deg: Three
    level: Three
    nugget: Three
    profile: tuple[Three, Three, Three]
    cell_deg: float
    freedom: Three = (1e4, 1e4, 1e4)
    made_from: tuple[Source, ...] = ()
    leave_one_out: LeaveOneOut | None = None

    def covariance(self, k: int, directions: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p p"]:
        """Covariance of y_k in unit `directions`, any frame: equation (2)."""
        alike = correlation(angles(directions), np.radians(self.decay_deg[k]))
        return self.variance[k] * alike + self.level[k] + self.nugget[k] * np.eye(len(directions))

    def precision(
        self, directions: Float[np.ndarray, "p 3"], factors: Sequence[float] = (1.0, 1.0, 1.0)
    ) -> tuple[Float[np.ndarray, "3p 3p"], float]:
        """Inverse covariance Q of u, and log det Q, up to what does not depend on `factors`, the s_k² of (4).

        u is log R of all `directions`, then log G, then log B:  Q = Σ_k A_kᵀ A_k ⊗ K_k⁻¹/s_k²
        """
        p = len(directions)
        log_determinant = 0.0
        precision = np.zeros((3 * p, 3 * p))
        for k, (row, factor) in enumerate(zip(MIX, factors, strict=True)):
            inverse, log_of_inverse = _inverse(self, k, directions.tobytes())
            precision = precision + np.kron(np.outer(row, row), inverse / factor)
            log_determinant += log_of_inverse - p * np.log(factor)
        return precision, float(log_determinant)

    def likeliest_factors(
        self,
        directions: Float[np.ndarray, "p 3"],
        log_radiance: Float[np.ndarray, "3 p"],
        covariance: Float[np.ndarray, "3p 3p"],
    ) -> list[float]:
        """The s_k² of a light that is known as a Gaussian, u with its covariance: one step of expectation maximisation of (4)."""
        p = len(directions)
        factors = []
        by_channel = covariance.reshape(3, p, 3, p)
        for k, (row, nu) in enumerate(zip(MIX, self.freedom, strict=True)):
            inverse = _inverse(self, k, directions.tobytes())[0]
            y = row @ log_radiance
            spread = np.einsum("c,cpdq,d->pq", row, by_channel, row)
            factors.append(float((nu + y @ inverse @ y + np.sum(inverse * spread)) / (nu + p)))
        return factors


def correlation(angle: Float[np.ndarray, "*n"], decay: float) -> Float[np.ndarray, "*n"]:
    """exp(−θ/decay), both in radians."""
    return np.exp(-angle / decay)


def angles(directions: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p p"]:
    """Radians between unit directions; by the chord, which keeps its digits where they are close."""
    return 2 * np.arcsin(np.minimum(np.sqrt(squared_distances(directions, directions)) / 2, 1))


@lru_cache(maxsize=48)  # a fit asks for those of its lights again and again
def _inverse(prior: LightPrior, k: int, directions: bytes) -> tuple[Float[np.ndarray, "p p"], float]:
    """The inverse of the covariance of y_k, exactly symmetric, and the log of the inverse's determinant."""
    matrix = prior.covariance(k, np.frombuffer(directions).reshape(-1, 3))
    inverse = np.linalg.inv(matrix)
    inverse = (inverse + inverse.T) / 2
    inverse.setflags(write=False)
    return inverse, -float(np.linalg.slogdet(matrix)[1])


def read_light_prior() -> LightPrior:
    """The prior that this package ships, which `studies.measured.light_prior` made; raises InputError where the file is damaged."""
    with reading("a light prior", SHIPPED):
        return msgspec.convert(read_json(SHIPPED), LightPrior)
