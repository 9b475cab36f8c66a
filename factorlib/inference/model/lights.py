"""Light of one illumination: log radiance on cells of the sphere, with exposures and tone curves of its photos.

Tone curves are those of `factorlib.images.tone`.  A cell is a lobe w·exp(λ(ω·z − 1)).  Its width 1/√λ is half the
distance between neighbouring cells, so that equal weights make a nearly constant light:

    λ = 1 / (WIDTH · spacing)²,      w = peak · exp(u),      Σ_q peak_q exp(λ_q(z_p·z_q − 1)) ≈ 1                   (1)

With n cells on the sphere the spacing is √(4π/n).  Then n/(2λ) = 2π WIDTH² cells overlap in any direction, so that peak
= PEAK = 1/(2π WIDTH²) for n of any size.  It differs where larger cells meet smaller ones.  u is therefore the log
radiance of a cell of any size.

A cell splits into about four: those of the 4n even cells that lie nearer to it than to others, with distances in
spacings.  Neighbours that split together leave no gaps, and splitting changes a light only where larger cells had
blurred it.

A sun is a lobe as narrow as the sun's disc.  Its peak gives a surface that faces it the irradiance of a sky of radiance
1.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.images import tone
from factorlib.light.lobes import SUN, Lobes, lobe_energy

# Width of a cell in spacings.  Equal weights are a constant light to 2 % (RMS); wider cells blur a sun more than
# materials do.
WIDTH = 0.5
PEAK = 1 / (2 * np.pi * WIDTH**2)  # weight of a cell of radiance 1
SCALINGS = 5  # iterations for peaks: five make split cells constant to 3 % (RMS), more reach 2.7 % at best
SUN_PEAK = np.pi / float(lobe_energy(np.array([SUN]))[0])
DARKEST = 1e-12  # weight below which a lobe counts as dark, for its logarithm
TONE_RANGE = (0.6, 1.7)  # range of the exponents of tone curves
NEAR_BOUNDS = 0.8  # share of the logarithms of that range: exponents of cameras lie well within


class UnitLobes(msgspec.Struct, frozen=True):
    """Set of p lobes exp(λ(ω·z − 1)) of weight one.

    Attributes:
        axis: z, unit, in the frame of the illumination.
        sharpness: λ > 0.
        curvature: One over the distance of the lobes (`factorlib.light.distance`).
    """

    axis: Float[np.ndarray, "p 3"]
    sharpness: Float[np.ndarray, " p"]
    curvature: float = 0.0

    def __len__(self) -> int:
        return len(self.sharpness)


def fibonacci_cells(count: int) -> UnitLobes:
    """Return lobes of weight one for `count` cells of equal size, spread evenly over the sphere, by (1)."""
    return UnitLobes(fibonacci_sphere(count), np.full(count, count / (4 * np.pi * WIDTH**2)))


class Light(msgspec.Struct, frozen=True):
    """Light of one illumination: p lobes w·exp(λ(ω·z − 1)) and the log exposures of its f photos.

    Attributes:
        axis: z of each lobe.
        log_sharpness: log λ of each lobe.
        weight: w of each lobe, per channel.
        log_exposure: Log exposure of each photo; the first is 0.
        log_tone: Log exponents of the photos' tone curves (`images.tone`); empty for linear photos.
        curvature: One over the light's distance (`factorlib.light.distance`); 0 for infinitely far away.
        fixed: Mask of the cells of known radiance (`factorlib.inference.model.known`); empty for none.
        scale_free: True if the radiance of these cells is known up to one factor.
        exposures_fixed: True if the exposures are known.
        turns: η, turns of normals in standard deviations (`factorlib.inference.model.normal_errors`); empty for sure
            normals.
    """

    axis: Float[np.ndarray, "p 3"]  # unit, in the illumination's frame
    log_sharpness: Float[np.ndarray, " p"]
    weight: Float[np.ndarray, "p 3"]  # in the illumination's own radiance unit
    log_exposure: Float[np.ndarray, " f"]
    log_tone: Float[np.ndarray, " f"] = msgspec.field(default_factory=lambda: np.zeros(0))
    curvature: float = 0.0
    fixed: Bool[np.ndarray, " p"] = msgspec.field(default_factory=lambda: np.zeros(0, bool))
    scale_free: bool = False
    exposures_fixed: bool = False
    turns: Float[np.ndarray, " q"] = msgspec.field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.log_sharpness)

    @property
    def free(self) -> Bool[np.ndarray, " p"]:
        """Mask of the cells that are to be estimated."""
        return ~self.fixed if len(self.fixed) else np.ones(len(self), bool)

    @property
    def sharpness(self) -> Float[np.ndarray, " p"]:
        """Sharpness λ of each lobe."""
        return np.exp(self.log_sharpness)

    @property
    def suns(self) -> Bool[np.ndarray, " p"]:
        """Mask of the lobes that are suns: they are as narrow as the sun, and not cells."""
        return self.lobes.suns

    @property
    def spacing(self) -> Float[np.ndarray, " p"]:
        """Angle between a cell and its neighbours, radians, by the first equation of (1)."""
        return 1 / (WIDTH * np.sqrt(self.sharpness))

    @property
    def lobes(self) -> Lobes:
        """Lobes of the light, without exposures, tone curves and distance."""
        return Lobes(self.axis, self.sharpness, self.weight)

    @property
    def unit_lobes(self) -> UnitLobes:
        """Lobes of the light, without their weights."""
        return UnitLobes(self.axis, self.sharpness, self.curvature)

    @property
    def log_radiance(self) -> Float[np.ndarray, "3 p"]:
        """Log radiance u of each cell, channel by channel, by (1)."""
        return np.log(np.maximum(self.weight.T, DARKEST) / self.peaks)

    @property
    def peaks(self) -> Float[np.ndarray, " p"]:
        """Weight of each cell at radiance 1, the last equation of (1); SUN_PEAK for a sun.

        It comes from `SCALINGS` iterations of peak ← peak/√(Σ peak·overlap).
        """
        axis = self.axis[~self.suns]
        peaks = np.full(len(self), PEAK)[~self.suns]
        result = np.full(len(self), SUN_PEAK)
        overlap = np.exp(self.sharpness[~self.suns] * (axis @ axis.T - 1))
        for _ in range(SCALINGS):
            peaks /= np.sqrt(overlap @ peaks)
        result[~self.suns] = peaks
        return result

    @property
    def energy(self) -> Float[np.ndarray, "p 3"]:
        """Integral of each lobe over the sphere, in the illumination's radiance unit times steradians."""
        return self.weight * lobe_energy(self.sharpness)[:, None]

    @property
    def mean_radiance(self) -> Float[np.ndarray, "3"]:
        """Mean radiance over the sphere."""
        return self.energy.sum(0) / (4 * np.pi)

    @property
    def unknowns(self) -> int:
        """Number of a step's unknowns.

        They are log radiances of free cells, turns of normals, free exposures, tone exponents, and the factor on fixed
        cells where it is free.
        """
        return self.integrated + self.free_exposures + len(self.log_tone) + self.scale_free

    @property
    def integrated(self) -> int:
        """Number of the unknowns that Laplace's approximation integrates out, the first ones: cells and turns."""
        return 3 * int(self.free.sum()) + len(self.turns)

    @property
    def free_exposures(self) -> int:
        """Number of exposures that are to be estimated: all photos' but the first's, or none."""
        return 0 if self.exposures_fixed else len(self.log_exposure) - 1

    def with_log_radiance(self, u: Float[np.ndarray, "3 p"]) -> Light:
        """Return the same cells with log radiance `u`."""
        return msgspec.structs.replace(self, weight=(self.peaks * np.exp(u)).T)

    def with_turns(self, count: int) -> Light:
        """Return the light with this number of turns, which are 0 if it had another number."""
        return self if len(self.turns) == count else msgspec.structs.replace(self, turns=np.zeros(count))

    def with_lobes(self, lobes: UnitLobes, weight: Float[np.ndarray, "q 3"]) -> Light:
        """Return the light with q more lobes, which come last."""
        return msgspec.structs.replace(
            self,
            axis=np.vstack([self.axis, lobes.axis]),
            log_sharpness=np.append(self.log_sharpness, np.log(lobes.sharpness)),
            weight=np.vstack([self.weight, weight]),
        )

    def brightest_cells(self, count: int, spacing: float) -> Bool[np.ndarray, " p"]:
        """Return a mask of the `count` cells with most energy.

        Only cells farther than `spacing` radians from their neighbours count.
        """
        energy = np.where(self.spacing > spacing, self.energy.sum(1), 0.0)
        return np.isin(np.arange(len(self)), np.argsort(-energy, kind="stable")[:count]) & (energy > 0)

    def split(self, selected: Bool[np.ndarray, " p"]) -> Light:
        """Return the light with each selected cell replaced by smaller cells of its radiance.

        The smaller cells follow all others.  The module docstring states the rule.  The light must have no fixed cells.
        """
        count = np.where(selected, np.rint(self.sharpness * 4 * np.pi * WIDTH**2), 0).astype(int)
        parents = [np.zeros(0, int)]
        finer = [UnitLobes(np.zeros((0, 3)), np.zeros(0))]
        for n in np.unique(count[selected]).tolist():
            cells = fibonacci_cells(4 * n)
            parents_of_size = np.flatnonzero(count == n)
            # even cells near a splitting cell; each one replaces the cell that is nearest in spacings
            candidates = cells.axis[
                (cells.axis @ self.axis[parents_of_size].T).max(1) > 1 - 2 * 4 * np.pi / n
            ]  # within two spacings
            nearest = np.argmin(self.sharpness * (1 - candidates @ self.axis.T), axis=1)
            parents.append(nearest[count[nearest] == n])
            finer.append(UnitLobes(candidates[count[nearest] == n], np.full(len(parents[-1]), cells.sharpness[0])))
        parent = np.concatenate(parents)
        u = self.log_radiance
        unsplit = ~np.isin(np.arange(len(self)), parent)
        light = msgspec.structs.replace(
            self,
            axis=np.vstack([self.axis[unsplit], *(cells.axis for cells in finer)]),
            log_sharpness=np.log(np.concatenate([self.sharpness[unsplit], *(cells.sharpness for cells in finer)])),
            weight=np.zeros((unsplit.sum() + len(parent), 3)),
        )
        return light.with_log_radiance(np.hstack([u[:, unsplit], u[:, parent]]))

    @property
    def implausible_tone(self) -> bool:
        """True if the exponent of a tone curve is near the bounds of real cameras."""
        low, high = NEAR_BOUNDS * np.log(TONE_RANGE)
        return bool(((self.log_tone < low) | (self.log_tone > high)).any())

    def exponents(self, photo: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 1"]:
        """Return the tone exponent of each observation's photo."""
        return np.exp(self.log_tone)[photo][:, None]

    def apply_tone(self, linear: Float[np.ndarray, "n c"], photo: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n c"]:
        """Return the tone curves applied to linear radiance; the identity for a light without curves."""
        return tone.curve(np.maximum(linear, 0.0), self.exponents(photo)) if len(self.log_tone) else linear

    def tone_slope(
        self, radiance: Float[np.ndarray, "n c"], photo: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n c"] | float:
        """Return the slope of each observation's tone curve where the curve's value is `radiance`."""
        if len(self.log_tone) == 0:
            return 1.0
        g = self.exponents(photo)
        return tone.slope(tone.inverse(radiance, g), g)
