"""Parts of a thing by colour, found on its visual hull and proposed as labels of the photos' masks.

A plain solid has many colours in a photo, because light comes from one side and casts shadows.  So what is clustered is
reflectance, with the light estimated along with it.  The light is at rest and the camera moves.  A patch of the surface
then keeps its diffuse radiance in all photos, and the median over photos leaves highlights out.  Patch i of part k has

    log L_i = log ρ_k + log Σ_d T_id l_d + e_i,      T_id = 4 max(n_i·ω_d, 0) V_id / D                               (1)

with l ≥ 0 the radiance from D directions ω, V their visibility on the hull, and e of one covariance, with heavy tails
(Student's t).  Given the parts, l is a robust non-negative least-squares fit; given l, parts are a mixture (EM).  Light
and reflectance may explain the same colours, so that the result depends on which is estimated first.  Each number of
parts is fitted from both starts, and the highest likelihood counts.

Number  Schwarz's criterion (BIC) decides among numbers whose parts are all distinct regions.  Two parts are distinct if
        a patch is told apart by its colour with an error of 2 %: if their means are `DISTINCT` standard deviations
        apart.  A part is a region: it holds `LEAST_AREA` of the surface, and most neighbours of its patches belong to
        it, which a line of mixed patches along an edge does not.
Pixels  A pixel has the likeliest part, by its colour under (1) and by the parts of the patches about it.  Pixels that
        are not sure get the label that leaves them out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.cluster.vq import kmeans, vq
from scipy.ndimage import gaussian_filter
from scipy.optimize import nnls
from scipy.sparse import coo_array, csr_array
from scipy.special import logsumexp

from factorlib.dataset.schema import LEFT_OUT
from factorlib.errors import InputError
from factorlib.geometry.camera import Pose
from factorlib.geometry.occlusion import Occluders, SurfacePoints
from factorlib.geometry.raster import unit
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.meshes.mesh import area_vectors
from factorlib.shapes.hull import visual_hull
from factorlib.shapes.outline import Outline, Triangles

HULL_CELLS = 64  # cells along the hull's longest side
PATCHES = 28  # patches along it
LEAST_COSINE = 0.3  # least cosine between a face and the view of a pixel that observes it
LEAST_PIXELS = 4  # pixels of a photo that observe a patch
DIRECTIONS = 200  # D of (1)
LIFT = 0.02  # start of a ray above its patch, as a share of the hull's extent: hulls are bumpy
LEAST_TRANSPORT = 1e-3  # a patch that sees less of its surroundings is hidden
LIGHT_DEVIATION = 0.3  # deviation in log radiance beyond which a patch counts less in the fit of the light
ROUNDS = 4  # fits of the light and of the parts, by turns
FIRST_ITERATIONS, LATER_ITERATIONS = 6, 2  # of the fit of the light, in the first round and in later ones
EM_STEPS = 60
FREEDOM = 4.0  # degrees of freedom of Student's t
NOISE = 0.01  # standard deviation of log radiance that every covariance contains
MOST_PARTS = 7
DISTINCT = 4.0
LEAST_AREA = 0.03
COHERENT = 0.8  # least share of a part's neighbours that belong to it
SURE = 0.7  # least probability of a pixel's part
BLUR = 0.02  # standard deviation of a pixel's place on the hull, in sizes of the mask
MISLABELLED = 0.1  # probability that a pixel's part is none of those of the patches about it
Report = Callable[[float], None]


class Patches:
    """Patches of the surface of a hull: its faces in one cell of a grid that face about the same way.

    Args:
        hull: The hull.

    Attributes:
        surface: Hull, at which rays are cast.
        number: Number of the patch of each face.
        area: Area of each patch.
        normal: Normal of each patch.
        transport: T of (1).
        borders: Length of the border between two patches, in edges.
    """

    def __init__(self, hull: Triangles):
        size = np.linalg.norm(area_vectors(hull.vertices, hull.faces), axis=1)
        centre = hull.vertices[hull.faces].mean(1)
        extent = float(np.ptp(hull.vertices, axis=0).max())
        self.surface = Occluders([hull.as_mesh()], [Pose(np.eye(3), np.zeros(3))])
        cells = np.column_stack([np.floor(centre * (PATCHES / extent)), np.rint(self.surface.normal)])
        self.number = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
        self.area = np.bincount(self.number, size)
        place, axis = (self._mean(each, size) for each in (centre, self.surface.normal))
        self.normal = axis = unit(axis)
        # T of (1) at places just outside the hull
        points = SurfacePoints(place + LIFT * extent * axis, axis, np.ones(len(place), bool))
        directions = fibonacci_sphere(DIRECTIONS)
        visible = self.surface.visibility_from(points, axis, directions).visibility > 0
        self.transport = 4 / DIRECTIONS * np.maximum(axis @ directions.T, 0) * visible
        self.borders = self._borders(hull.faces)

    def _mean(self, values: Float[np.ndarray, "f 3"], weight: Float[np.ndarray, " f"]) -> Float[np.ndarray, "p 3"]:
        """Return the weighted mean of values of faces by patch."""
        total = np.maximum(np.bincount(self.number, weight), 1e-30)
        return np.column_stack([np.bincount(self.number, weight * column) / total for column in values.T])

    def _borders(self, faces: Int[np.ndarray, "f 3"]) -> csr_array:
        """Return the number of edges between each two patches."""
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        order = np.lexsort(edges.T)
        owner = np.tile(self.number, 3)[order]
        shared = (edges[order][:-1] == edges[order][1:]).all(1) & (owner[:-1] != owner[1:])
        pairs = owner[:-1][shared], owner[1:][shared]
        half = coo_array((np.ones(len(pairs[0])), pairs), shape=(len(self.area), len(self.area)))
        return csr_array(half + half.T)

    def observe(self, outline: Outline, radiance: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "p 3"]:
        """Return the mean log radiance of each patch in a photo; NaN where too few pixels show it.

        Args:
            outline: Mask with camera and pose.
            radiance: Linear radiance of its pixels; NaN where it is clipped.
        """
        hits = self.surface.cast(outline.camera, outline.known_pose)
        rows, columns = np.nonzero((hits.face >= 0) & (outline.part > 0) & (radiance.min(2) > 0))  # False for NaN
        rays = outline.camera.rays_through(np.column_stack([columns, rows]) + 0.5)
        face = hits.face[rows, columns]
        facing = np.einsum("ni,ni->n", self.surface.normal[face] @ outline.known_pose.rotation.T, -rays)
        frontal = facing > LEAST_COSINE * np.linalg.norm(rays, axis=1)
        patch = self.number[face[frontal]]
        pixels = np.bincount(patch, minlength=len(self.area))[:, None]
        logs = np.log(radiance[rows[frontal], columns[frontal]])
        sums = np.column_stack([np.bincount(patch, column, len(self.area)) for column in logs.T])
        return np.where(pixels >= LEAST_PIXELS, sums / np.maximum(pixels, 1), np.nan)


class PatchObservations(msgspec.Struct, frozen=True):
    """Patches of a hull, and what photos show of them.

    Attributes:
        patches: Patches of the hull.
        rotations: Rotation cam_from_world of each photo.
        log_radiance: Mean log radiance of each patch in each photo; NaN where the photo does not show it.
    """

    patches: Patches
    rotations: Float[np.ndarray, "v 3 3"]
    log_radiance: Float[np.ndarray, "v p 3"]


class Parts(msgspec.Struct, frozen=True):
    """Parts of the surface, and the light.

    Attributes:
        reflectance: log ρ of each part.
        covariance: Covariance of e.
        probability: Probability of each part, by observed patch.
        log_irradiance: log Σ T l of each observed patch.
        value: Log likelihood.
    """

    reflectance: Float[np.ndarray, "k 3"]
    covariance: Float[np.ndarray, "3 3"]
    probability: Float[np.ndarray, "p k"]
    log_irradiance: Float[np.ndarray, "p 3"]
    value: float

    @property
    def criterion(self) -> float:
        """Schwarz's criterion: log likelihood − ½ (number of parameters) log (number of patches)."""
        return self.value - 0.5 * 4 * len(self.reflectance) * float(np.log(len(self.probability)))

    @property
    def least_distance(self) -> float:
        """Least distance between two parts' reflectances, in standard deviations."""
        apart = self.reflectance[:, None] - self.reflectance
        squared = np.einsum("abi,ij,abj->ab", apart, np.linalg.inv(self.covariance), apart)
        return float(np.sqrt(squared[~np.eye(len(squared), dtype=bool)].min(initial=np.inf)))


class ColouredSurface(msgspec.Struct, frozen=True):
    """Surface whose patches belong to parts.

    Attributes:
        patches: Patches of the hull.
        log_radiance: log L, the median over photos at one exposure and white balance; NaN where unknown.
        parts: Parts of the patches whose radiance is known.
    """

    patches: Patches
    log_radiance: Float[np.ndarray, "p 3"]
    parts: Parts

    @property
    def shares(self) -> Float[np.ndarray, " k"]:
        """Share of the surface of each part."""
        area = self.patches.area[is_observed(self.log_radiance)]
        return area @ self.parts.probability / area.sum()

    def label(self, outline: Outline, radiance: Float[np.ndarray, "h w 3"]) -> Int[np.ndarray, "h w"]:
        """Return the labels of a photo's pixels, from 1; 0 is background, and `LEFT_OUT` not sure.

        Args:
            outline: Mask with camera and pose.
            radiance: Linear radiance of its pixels; NaN where it is clipped.
        """
        parts = self.parts
        face = self.patches.surface.cast(outline.camera, outline.known_pose).face
        observed = is_observed(self.log_radiance)
        index = np.where(observed, np.cumsum(observed) - 1, -1)
        patch = np.where(face >= 0, index[self.patches.number[face]], -1)
        known = patch >= 0
        mask = outline.part > 0
        blur = BLUR * np.sqrt(mask.sum())
        total = np.maximum(gaussian_filter(known.astype(float), blur), 1e-9)[..., None]

        def around(values: Float[np.ndarray, "p k"]) -> Float[np.ndarray, "h w k"]:
            """Return the mean of values of the patches about each pixel."""
            return gaussian_filter(np.where(known[..., None], values[patch], 0.0), (blur, blur, 0)) / total

        prior = (1 - MISLABELLED) * around(parts.probability) + MISLABELLED / len(parts.reflectance)
        exposure = np.nanmedian(self.patches.observe(outline, radiance) - self.log_radiance, axis=0)
        residual = np.log(np.maximum(radiance, 1e-6)) - exposure - around(parts.log_irradiance)
        apart = np.nan_to_num(residual[:, :, None] - parts.reflectance)  # a clipped pixel tells no colour
        squared = np.einsum("hwki,ij,hwkj->hwk", apart, np.linalg.inv(parts.covariance), apart)
        logs = np.log(prior) - 0.5 * (FREEDOM + 3) * np.log1p(squared / FREEDOM)
        logs = gaussian_filter(logs, (1.0, 1.0, 0.0))  # neighbouring pixels decide together
        probability = np.exp(logs - logsumexp(logs, axis=-1, keepdims=True))
        label = np.where(probability.max(-1) >= SURE, probability.argmax(-1) + 1, LEFT_OUT)
        return np.where(mask, label, 0)


def observe_patches(
    outlines: Sequence[Outline], read: Callable[[str], Float[np.ndarray, "h w 3"]]
) -> PatchObservations:
    """Return the patches of the outlines' hull, and their radiance in the photos.

    Args:
        outlines: Masks with cameras and poses.
        read: Function that returns the linear radiance of a photo, by its name; NaN where it is clipped.

    Raises:
        InputError: If there are fewer than two outlines, nothing fits into all of them, or photos share no surface.
    """
    patches = Patches(visual_hull(outlines, HULL_CELLS))
    observed = np.array([patches.observe(each, read(each.photo)) for each in outlines])
    observed[:, patches.transport.sum(1) < LEAST_TRANSPORT] = np.nan
    if (np.isfinite(observed).all(2).sum(0) > 1).sum() <= MOST_PARTS:
        raise InputError("no two photos show the same surface", cure="take photos 10 to 20° from each other")
    return PatchObservations(patches, np.array([each.known_pose.rotation for each in outlines]), observed)


def find_parts(observed: PatchObservations, report: Report = lambda share: None) -> ColouredSurface:
    """Return the surface of a thing with its parts by colour, at most `MOST_PARTS`, or one.

    Args:
        observed: Patches of its hull, and what photos show of them.
        report: Called with the completed share.
    """
    log_radiance = at_one_exposure(observed.log_radiance)
    return ColouredSurface(observed.patches, log_radiance, select_parts(observed.patches, log_radiance, report))


def at_one_exposure(observed: Float[np.ndarray, "v p 3"]) -> Float[np.ndarray, "p 3"]:
    """Return the median log radiance of each patch over photos, which are brought to one exposure and white balance.

    It is NaN where fewer than two photos observe the patch.
    """
    observed = np.where(np.isfinite(observed).sum(0) > 1, observed, np.nan)
    exposure = np.zeros((len(observed), 3))
    shared = np.isfinite(observed).any(0).all(1)
    median = np.full(observed.shape[1:], np.nan)
    for _ in range(10):
        median[shared] = np.nanmedian(observed[:, shared] - exposure[:, None], axis=0)
        exposure = np.array([np.nanmedian(each[shared] - median[shared], axis=0) for each in observed])
        exposure = np.nan_to_num(exposure - np.nanmean(exposure, axis=0))
    return median


def is_observed(log_radiance: Float[np.ndarray, "p 3"]) -> Bool[np.ndarray, " p"]:
    """Return a mask of the patches whose radiance is known."""
    return np.isfinite(log_radiance).all(1)


def select_parts(patches: Patches, log_radiance: Float[np.ndarray, "p 3"], report: Report) -> Parts:
    """Return the likeliest parts that are all distinct regions, by Schwarz's criterion, the largest first.

    Args:
        patches: Patches of the hull.
        log_radiance: log L; NaN where unknown.
        report: Called with the completed share.
    """
    observed = is_observed(log_radiance)
    borders = patches.borders[observed][:, observed]
    area = patches.area[observed]
    model = PartModel(log_radiance[observed], patches.transport[observed], area / area.mean())
    parts = selected = model.fit(np.ones((len(area), 1)))
    for count in range(2, MOST_PARTS + 1):
        report((count - 1) / MOST_PARTS)
        parts = model.best_fit(count, parts)
        if are_regions(parts, borders, area) and parts.criterion > selected.criterion:
            selected = parts
    order = np.argsort(-(area @ selected.probability))
    return msgspec.structs.replace(
        selected, reflectance=selected.reflectance[order], probability=selected.probability[:, order]
    )


def are_regions(parts: Parts, borders: csr_array, area: Float[np.ndarray, " p"]) -> bool:
    """Return True if all parts are distinct, large enough and coherent."""
    label = parts.probability.argmax(1)
    inside = np.eye(len(parts.reflectance))[label]
    shares = area @ inside / area.sum()
    lengths = inside.T @ (borders @ inside)
    coherence = np.diag(lengths) / np.maximum(lengths.sum(1), 1e-30)
    large = shares.min() >= LEAST_AREA and coherence.min() >= COHERENT
    return bool(large and parts.least_distance >= DISTINCT)


class PartModel(msgspec.Struct, frozen=True):
    """Model (1) of the observed patches.

    Attributes:
        log_radiance: log L.
        transport: T.
        weight: Weight of each patch, 1 on average.
    """

    log_radiance: Float[np.ndarray, "p 3"]
    transport: Float[np.ndarray, "p d"]
    weight: Float[np.ndarray, " p"]

    @property
    def ambient(self) -> Float[np.ndarray, "p 3"]:
        """Log reflectance of the patches under ambient light, up to a common factor."""
        return self.log_radiance - np.log(self.transport.sum(1, keepdims=True))

    def best_fit(self, count: int, fewer: Parts) -> Parts:
        """Return the likeliest fit of three starts.

        They are one part of fewer parts split, and clusters under ambient light, of colour or of chroma alone.  There
        are fewer clusters where patches have fewer colours.

        Args:
            count: Largest number of parts.
            fewer: Fit of fewer parts.
        """
        residual = self.log_radiance - fewer.log_irradiance
        splits = [self.mixture(residual, self._split(residual, fewer, k)) for k in range(len(fewer.reflectance))]
        starts = [max(splits, key=lambda split: split[1])[0]]
        ambient = self.ambient
        for values in (ambient, ambient[:, :2] - ambient[:, 2:]):
            covariance = np.cov(values.T) + NOISE**2 * np.eye(values.shape[1])
            whitened = values @ np.linalg.cholesky(np.linalg.inv(covariance))
            centres, _ = kmeans(whitened, count, rng=np.random.default_rng(0))
            clusters = np.eye(len(centres))[vq(whitened, centres)[0]]
            starts.append(self.mixture(ambient, clusters)[0])
        return max((self.fit(start) for start in starts), key=lambda parts: parts.value)

    def _split(self, residual: Float[np.ndarray, "p 3"], parts: Parts, k: int) -> Float[np.ndarray, "p k+1"]:
        """Return probabilities with part k split along its direction of most variance, in standard deviations."""
        whitened = residual @ np.linalg.cholesky(np.linalg.inv(parts.covariance))
        share = parts.probability[:, k] * self.weight
        centred = whitened - np.average(whitened, axis=0, weights=share + 1e-12)
        axis = np.linalg.eigh((centred * share[:, None]).T @ centred)[1][:, -1]
        upper = centred @ axis > 0
        pair = parts.probability[:, [k]] * np.column_stack([upper, ~upper])
        return np.hstack([np.delete(parts.probability, k, axis=1), pair])

    def fit(self, probability: Float[np.ndarray, "p k"]) -> Parts:
        """Return the fit of parts and light by turns, from the probabilities of parts."""
        reflectance = np.zeros((probability.shape[1], 3))
        if reflectance.shape[0] > 1:
            weighted = probability * self.weight[:, None]
            reflectance = weighted.T @ self.ambient / np.maximum(weighted.sum(0), 1e-12)[:, None]
        irradiance = self.log_radiance - probability @ reflectance
        for number in range(ROUNDS):
            irradiance = self.fit_light(
                probability @ reflectance, irradiance, LATER_ITERATIONS if number else FIRST_ITERATIONS
            )
            residual = self.log_radiance - irradiance
            probability, value, reflectance, covariance = self.mixture(residual, probability)
        return Parts(reflectance, covariance, probability, irradiance, value)

    def fit_light(
        self, log_reflectance: Float[np.ndarray, "p 3"], start: Float[np.ndarray, "p 3"], iterations: int
    ) -> Float[np.ndarray, "p 3"]:
        """Return log Σ T l of the light that explains the patches of these reflectances.

        Relative errors are reweighted: each iteration minimises Σ w ρ' (L − T l)²/(L T l₀), with l₀ the last one.

        Args:
            log_reflectance: log ρ of each patch.
            start: log Σ T l₀.
            iterations: Number of iterations.
        """
        result = np.empty_like(self.log_radiance)
        for c in range(3):
            target = np.exp(self.log_radiance[:, c] - log_reflectance[:, c])
            predicted = np.exp(start[:, c])
            for _ in range(iterations):
                trust = 1 / (1 + np.square(np.log(target / predicted) / LIGHT_DEVIATION))
                root = np.sqrt(self.weight * trust / (target * predicted))
                A = root[:, None] * self.transport
                normal = A.T @ A
                normal[np.diag_indices_from(normal)] += 1e-5 * np.trace(normal) / len(normal)
                light = nnls(normal, A.T @ (root * target), maxiter=20 * len(normal))[0]
                predicted = np.maximum(self.transport @ light, 1e-3 * np.median(self.transport @ light))
            result[:, c] = np.log(predicted)
        return result

    def mixture(
        self, residual: Float[np.ndarray, "p 3"], probability: Float[np.ndarray, "p k"]
    ) -> tuple[Float[np.ndarray, "p k"], float, Float[np.ndarray, "k 3"], Float[np.ndarray, "3 3"]]:
        """Return probabilities, log likelihood, means and covariance of a mixture of Student's t, by EM.

        Args:
            residual: log L − log Σ T l.
            probability: Initial probabilities of parts.
        """
        trust = np.ones_like(probability)
        for _ in range(EM_STEPS):
            share = probability * self.weight[:, None]
            weighted = share * trust
            means = weighted.T @ residual / np.maximum(weighted.sum(0), 1e-12)[:, None]
            apart = residual[:, None] - means
            covariance = np.einsum("pk,pki,pkj->ij", weighted, apart, apart) / share.sum() + NOISE**2 * np.eye(3)
            squared = np.einsum("pki,ij,pkj->pk", apart, np.linalg.inv(covariance), apart)
            logs = np.log(np.maximum(share.sum(0) / share.sum(), 1e-12))
            logs = logs - 0.5 * (FREEDOM + 3) * np.log1p(squared / FREEDOM)
            logs -= 0.5 * np.linalg.slogdet(covariance)[1]
            total = logsumexp(logs, axis=1, keepdims=True)
            probability = np.exp(logs - total)
            trust = (FREEDOM + 3) / (FREEDOM + squared)
        return probability, float(self.weight @ total[:, 0]), means, covariance
