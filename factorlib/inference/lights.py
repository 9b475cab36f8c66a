"""A light: log radiance on cells of the sphere, and the exposures and tone curves (`factorlib.images.tone`) of its photos.

A cell is a lobe w·exp(λ(ω·z − 1)).  Its width 1/√λ is half the distance between neighbouring cells, so that equal weights make a nearly
constant light:

    λ = 1 / (WIDTH · spacing)²,      w = peak · exp(u),      Σ_q peak_q exp(λ_q(z_p·z_q − 1)) ≈ 1                    (1)

With n cells on the sphere the spacing is √(4π/n), and n/(2λ) = 2π WIDTH² of them overlap in any direction, so that peak = PEAK =
1/(2π WIDTH²) for n of any size; where larger cells meet smaller ones it differs.  So u is the log radiance of a cell of any size.  A cell
splits into about four: those of the 4n even cells that lie nearer to it than to others, distances counted in spacings.  So neighbours
that split leave no gaps, and splitting changes a light only by what the larger cells had blurred.

A sun is a lobe as narrow as its disc.  Its peak is that of a sun which lights a surface that faces it as much as a sky of radiance 1 does.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.images import tone
from factorlib.light.lobes import SUN, Lobes, lobe_integral

WIDTH = 0.5  # of a cell, in spacings: equal weights are a constant light to 2 % (RMS); wider ones blur a sun more than materials do
PEAK = 1 / (2 * np.pi * WIDTH**2)
SCALINGS = 5  # iterations for peaks: five make split cells constant to 3 % (RMS), more of them reach 2.7 % at best
SUN_PEAK = np.pi / float(lobe_integral(np.array([SUN]))[0])
DARKEST = 1e-12  # weight below which a lobe counts as dark, for its logarithm
TONE = (0.6, 1.7)  # range of the exponents of tone curves
NEAR_BOUNDS = 0.8  # of the logarithms of that range: the exponents of cameras lie well within


class UnitLobes(msgspec.Struct, frozen=True):
    """p lobes exp(λ(ω·z − 1)) of weight one.

    axis: z, unit, in the frame of the illumination;  sharpness: λ > 0;  curvature: of `factorlib.light.distance`, one over their distance
    """

    axis: Float[np.ndarray, "p 3"]
    sharpness: Float[np.ndarray, " p"]
    curvature: float = 0.0

    def __len__(self) -> int:
        return len(self.sharpness)


def even_cells(count: int) -> UnitLobes:
    """`count` cells of one size, equation (1)."""
    return UnitLobes(fibonacci_sphere(count), np.full(count, count / (4 * np.pi * WIDTH**2)))


class Light(msgspec.Struct, frozen=True):
    """p lobes w·exp(λ(ω·z − 1)) of one illumination and the log exposures of its f photos (the first is 0).

    log_tone: log exponents of the photos' tone curves (`images.tone`); none where the photos are taken to be linear
    curvature: one over the light's distance (`factorlib.light.distance`); 0: infinitely far away
    held: cells whose radiance is known (`factorlib.inference.known`), which no step moves; empty: none;  scale_free: it is known but for one factor
    exposures_held: whether the exposures are known
    """

    axis: Float[np.ndarray, "p 3"]  # unit, in the illumination's frame
    log_sharpness: Float[np.ndarray, " p"]
    weight: Float[np.ndarray, "p 3"]  # in the illumination's own radiance unit
    log_exposure: Float[np.ndarray, " f"]
    log_tone: Float[np.ndarray, " f"] = msgspec.field(default_factory=lambda: np.zeros(0))
    curvature: float = 0.0
    held: Bool[np.ndarray, " p"] = msgspec.field(default_factory=lambda: np.zeros(0, bool))
    scale_free: bool = False
    exposures_held: bool = False

    def __len__(self) -> int:
        return len(self.log_sharpness)

    @property
    def free(self) -> Bool[np.ndarray, " p"]:
        """Which cells are to be found."""
        return ~self.held if len(self.held) else np.ones(len(self), bool)

    @property
    def sharpness(self) -> Float[np.ndarray, " p"]:
        """λ of each lobe."""
        return np.exp(self.log_sharpness)

    @property
    def suns(self) -> Bool[np.ndarray, " p"]:
        """Which lobes are no cells but suns: those that are as narrow as one."""
        return self.lobes.suns

    @property
    def spacing(self) -> Float[np.ndarray, " p"]:
        """Radians between a cell and its neighbours: the first of (1)."""
        return 1 / (WIDTH * np.sqrt(self.sharpness))

    @property
    def lobes(self) -> Lobes:
        """Return the light without exposures, tone curves and distance."""
        return Lobes(self.axis, self.sharpness, self.weight)

    @property
    def unit_lobes(self) -> UnitLobes:
        """Return the lobes without their weights."""
        return UnitLobes(self.axis, self.sharpness, self.curvature)

    @property
    def log_radiance(self) -> Float[np.ndarray, "3 p"]:
        """u of each cell, channel by channel: equation (1)."""
        return np.log(np.maximum(self.weight.T, DARKEST) / self.peaks)

    @property
    def peaks(self) -> Float[np.ndarray, " p"]:
        """Each cell's weight where radiance is 1: the last of (1), by iterating peak ← peak/√(Σ peak·overlap); SUN_PEAK of a sun."""
        axis = self.axis[~self.suns]
        peaks = np.full(len(self), PEAK)[~self.suns]
        all_ = np.full(len(self), SUN_PEAK)
        overlap = np.exp(self.sharpness[~self.suns] * (axis @ axis.T - 1))
        for _ in range(SCALINGS):
            peaks /= np.sqrt(overlap @ peaks)
        all_[~self.suns] = peaks
        return all_

    @property
    def unit_energy(self) -> Float[np.ndarray, " p"]:
        """Energy of each lobe over 2π, were its weight one; steradians."""
        return lobe_integral(self.sharpness) / (2 * np.pi)

    @property
    def energy(self) -> Float[np.ndarray, "p 3"]:
        """Energy of each lobe over 2π, in the illumination's radiance unit times steradians."""
        return self.weight * self.unit_energy[:, None]

    @property
    def unknowns(self) -> int:
        """The number of unknowns of a step: log radiances of free cells, free exposures, tone exponents, the factor on what is held."""
        return 3 * int(self.free.sum()) + self.free_exposures + len(self.log_tone) + self.scale_free

    @property
    def free_exposures(self) -> int:
        """How many exposures are to be found: those of all photos but the first, or none."""
        return 0 if self.exposures_held else len(self.log_exposure) - 1

    def with_log_radiance(self, u: Float[np.ndarray, "3 p"]) -> Light:
        """Return the same cells with other radiances."""
        return msgspec.structs.replace(self, weight=(self.peaks * np.exp(u)).T)

    def with_lobes(self, lobes: UnitLobes, weight: Float[np.ndarray, "q 3"]) -> Light:
        """Return the light with q more lobes, the last."""
        return msgspec.structs.replace(
            self,
            axis=np.vstack([self.axis, lobes.axis]),
            log_sharpness=np.append(self.log_sharpness, np.log(lobes.sharpness)),
            weight=np.vstack([self.weight, weight]),
        )

    def take(self, which: Bool[np.ndarray, " p"] | slice) -> Light:
        """Return the light of some of its lobes."""
        lobes = {name: getattr(self, name)[which] for name in ("axis", "log_sharpness", "weight")}
        return msgspec.structs.replace(self, **lobes)

    def brightest(self, count: int, spacing: float) -> Bool[np.ndarray, " p"]:
        """The `count` cells that hold most energy, of those that are farther than `spacing` radians from their neighbours."""
        energy = np.where(self.spacing > spacing, self.energy.sum(1), 0.0)
        return np.isin(np.arange(len(self)), np.argsort(-energy, kind="stable")[:count]) & (energy > 0)

    def split(self, which: Bool[np.ndarray, " p"]) -> Light:
        """The light with each cell of `which` replaced by smaller ones of its radiance, which follow all others: see the head of the module."""
        count = np.where(which, np.rint(self.sharpness * 4 * np.pi * WIDTH**2), 0).astype(int)
        parents = [np.zeros(0, int)]
        finer = [UnitLobes(np.zeros((0, 3)), np.zeros(0))]
        for n in np.unique(count[which]).tolist():
            cells = even_cells(4 * n)
            own = np.flatnonzero(count == n)
            near = cells.axis[(cells.axis @ self.axis[own].T).max(1) > 1 - 2 * 4 * np.pi / n]  # within two spacings
            nearest = np.argmin(self.sharpness * (1 - near @ self.axis.T), axis=1)
            parents.append(nearest[count[nearest] == n])
            finer.append(UnitLobes(near[count[nearest] == n], np.full(len(parents[-1]), cells.sharpness[0])))
        parent = np.concatenate(parents)
        u = self.log_radiance
        kept = ~np.isin(np.arange(len(self)), parent)
        light = msgspec.structs.replace(
            self,
            axis=np.vstack([self.axis[kept], *(cells.axis for cells in finer)]),
            log_sharpness=np.log(np.concatenate([self.sharpness[kept], *(cells.sharpness for cells in finer)])),
            weight=np.zeros((kept.sum() + len(parent), 3)),
        )
        return light.with_log_radiance(np.hstack([u[:, kept], u[:, parent]]))

    def with_curves(self) -> Light:
        """Return the light with a tone curve for each photo, the identity."""
        return msgspec.structs.replace(self, log_tone=np.zeros_like(self.log_exposure))

    @property
    def beyond_cameras(self) -> bool:
        """Whether the exponent of a tone curve has run near the bounds of what cameras do."""
        low, high = NEAR_BOUNDS * np.log(TONE)
        return bool(((self.log_tone < low) | (self.log_tone > high)).any())

    def exponents(self, photo: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 1"]:
        """The exponent of the photo of each of n observations."""
        return np.exp(self.log_tone)[photo][:, None]

    def toned(self, linear: Float[np.ndarray, "n c"], photo: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n c"]:
        """What the photos show of linear radiance: their tone curves, the identity where the light has none."""
        return tone.curve(np.maximum(linear, 0.0), self.exponents(photo)) if len(self.log_tone) else linear

    def slope_at(
        self, radiance: Float[np.ndarray, "n c"], photo: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n c"] | float:
        """Derivative of what a photo shows by linear radiance, where it shows `radiance`."""
        if len(self.log_tone) == 0:
            return 1.0
        g = self.exponents(photo)
        return tone.slope(tone.inverse(radiance, g), g)
