"""Statistics of natural light: log radiance over the sphere as a Gaussian process.

A photograph determines the light well from some directions and hardly at all from others.  The statistics of natural
light fill in the rest.  Neighbouring directions are similarly bright, colour varies much less than luminance, and light
from above is brighter than light from below.

    y = A u,  u = log (R, G, B) of the mean radiance of a cell of the sphere:
    y_0 = (log R + log G + log B)/3,   y_1 = log R − log G,   y_2 = log B − log G                                   (1)
    cov[y_k(a), y_k(b)] = variance_k exp(−θ_ab / decay_k) + level_k + [a = b] nugget_k,
                          with θ_ab the angle of a and b                                                             (2)
    mean[y_k(a)] = Σ_l profile_kl P_l(a · up),   P_l Legendre's polynomial of degree l = 1, 2, 3                     (3)

    s_k² ~ inverse gamma(ν_k/2, ν_k/2)                                                                               (4)

s_k² is a factor on the covariance (2) of a whole map: some scenes have much contrast or much colour, others little.
`covariance` and `precision` hold for s = 1, a typical map; a solve estimates s by evidence.  With s integrated out, a
map follows Student's t with ν_k degrees of freedom.

y_0, y_1 and y_2 are independent of each other.  exp(−θ/c) is positive definite on the sphere for every c > 0 (Gneiting,
"Strictly and non-strictly positive definite functions on spheres", 2013).  A solve sets the mean to zero, because it
does not know which direction is up.  `studies.measured.light_prior` fits the numbers.
"""

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


class SourceMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Map that a prior was fitted to.

    Attributes:
        name: Name of its file.
        sha256: SHA-256 of its bytes.
    """

    name: str
    sha256: str


class LeaveOneOut(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mean log likelihood, in nats, of all cells of a map under a prior fitted to all other maps.

    Attributes:
        prior: Log likelihood under the prior of equations (1) to (3).
        white_noise: The same with independent neighbours; variance, level and profile are unchanged.
        no_profile: The same, fitted without equation (3).
    """

    prior: float
    white_noise: float
    no_profile: float


class LightPrior(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of equations (2) and (3), each for y_0, y_1 and y_2.

    Variances are of natural logarithms.

    Attributes:
        variance: Variance of the part that varies over the sphere.
        decay_deg: Angle over which that part is correlated, degrees.
        level: Variance of a constant shared by all directions: for y_0 the exposure, for y_1 and y_2 the white balance.
        nugget: Variance of a single cell that is independent of its neighbours.
        profile: Coefficients of P_1, P_2 and P_3 of the sine of elevation.
        cell_deg: Size of the cells of the fitted maps, degrees; smaller cells vary more.
        freedom: ν of equation (4): about 3 where maps differ much in contrast, 10⁴ where they do not.
        made_from: Maps that the parameters were fitted to.
        leave_one_out: Cross-validated log likelihoods.
    """

    variance: Three
    decay_deg: Three
    level: Three
    nugget: Three
    profile: tuple[Three, Three, Three]
    cell_deg: float
    freedom: Three = (1e4, 1e4, 1e4)
    made_from: tuple[SourceMap, ...] = ()
    leave_one_out: LeaveOneOut | None = None

    def covariance(self, k: int, directions: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p p"]:
        """Return the covariance of y_k in unit `directions`, equation (2).

        The directions may be in any frame.
        """
        correlations = correlation(angles(directions), np.radians(self.decay_deg[k]))
        return self.variance[k] * correlations + self.level[k] + self.nugget[k] * np.eye(len(directions))

    def precision(
        self, directions: Float[np.ndarray, "p 3"], factors: Sequence[float] = (1.0, 1.0, 1.0)
    ) -> tuple[Float[np.ndarray, "3p 3p"], float]:
        """Return the inverse covariance Q of u, and log det Q.

        u is log R of all `directions`, then log G, then log B, and Q = Σ_k A_kᵀ A_k ⊗ K_k⁻¹/s_k².  The log determinant
        is that of the channels y_k, which is the same: the mix of R, G and B has determinant ±1.
        """
        p = len(directions)
        log_determinant = 0.0
        precision = np.zeros((3 * p, 3 * p))
        # Q = Σ_k A_kᵀ A_k ⊗ K_k⁻¹/s_k²
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
        """Return the likeliest factors s_k² of a light's covariance, by one step of expectation maximisation.

        The posterior of the light's u is Gaussian.

        The prior on s_k² is (4).

        Args:
            directions: Unit vectors of the p cells.
            log_radiance: Mean of u, by channel.
            covariance: Covariance of u, channel by channel.
        """
        p = len(directions)
        factors = []
        by_channel = covariance.reshape(3, p, 3, p)
        for k, (row, nu) in enumerate(zip(MIX, self.freedom, strict=True)):
            inverse = _inverse(self, k, directions.tobytes())[0]
            y = row @ log_radiance
            # covariance of y_k, then s_k² = (ν + yᵀK⁻¹y + tr K⁻¹ cov)/(ν + p)
            spread = np.einsum("c,cpdq,d->pq", row, by_channel, row)
            factors.append(float((nu + y @ inverse @ y + np.sum(inverse * spread)) / (nu + p)))
        return factors


def correlation(angle: Float[np.ndarray, "*n"], decay: float) -> Float[np.ndarray, "*n"]:
    """Return exp(−θ/decay), both angles in radians."""
    return np.exp(-angle / decay)


def angles(directions: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p p"]:
    """Return the angles between unit directions, radians.

    They are computed from the chord, which keeps its digits where directions are close.
    """
    return 2 * np.arcsin(np.minimum(np.sqrt(squared_distances(directions, directions)) / 2, 1))


@lru_cache(maxsize=48)  # a fit needs the matrices of its lights repeatedly
def _inverse(prior: LightPrior, k: int, directions: bytes) -> tuple[Float[np.ndarray, "p p"], float]:
    """Return the inverse of the covariance of y_k, exactly symmetric, and its log determinant."""
    matrix = prior.covariance(k, np.frombuffer(directions).reshape(-1, 3))
    inverse = np.linalg.inv(matrix)
    inverse = (inverse + inverse.T) / 2
    inverse.setflags(write=False)
    return inverse, -float(np.linalg.slogdet(matrix)[1])


def read_light_prior() -> LightPrior:
    """Read the prior that the package ships.

    `studies.measured.light_prior` made it.

    Raises:
        InputError: If the file is damaged.
    """
    with reading("a light prior", SHIPPED):
        return msgspec.convert(read_json(SHIPPED), LightPrior)
