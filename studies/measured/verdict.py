"""Verdicts on results, beside the truth: `LIGHTS="FOLDER …" python -m studies.measured.verdict fit test`.

fit    26 sets: data/eames and the chairs of `studies.measured.eames_like`, half of them in captured light, twice each,
       and four sets of solids, degraded in ways of `studies.measured.degradations`.  The weights of
       `factorlib.evaluate.verdict`, but UNEXPLAINED, are fitted to them anew, and printed
test   12 others: chairs of seeds 201 to 205, the last two in captured light, twice each, and two sets of solids; their
       scores are expected with the shipped weights

A set takes some minutes.  Sets lie in build/bench/verdict, results in build/.  For each kind it prints every set, rank
correlations (Spearman), and the deviation; for `fit` also with each set left out of the fit.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.stats import spearmanr

from factorlib.evaluate.verdict import CLIPPED, CONTOUR, FLOOR, MATERIALS, UNEXPLAINED
from factorlib.images.light_map import maps_in
from studies.measured.degradations import MIXED, MIXED_SOLIDS, degrade
from studies.measured.eames_like import CAPTURED_SEEDS, SEEDS, generate_set, link_maps, split_maps
from studies.measured.tools import ROOT, environment_words, evaluate_dataset, markdown_table

PLACE = ROOT / "build/bench/verdict"
CAPTURED = (*CAPTURED_SEEDS, 204, 205)
CHAIRS = {"fit": (None, *SEEDS, *CAPTURED_SEEDS), "test": tuple(range(201, 206))}  # None: data/eames
SOLIDS = {"fit": (211, 212, 213, 214), "test": (215, 216)}
FIRST = {"fit": 0, "test": 1000}  # number of the first set
ORDER = {"fit": 5, "test": 6}  # seeds of the order of the degradations
TIMES = 2  # chairs of a base
HOPELESS = 18.0  # dB: a flat disc of the true ball's mean colour scores 17.6 to 18.6
WEIGHTS = {"materials": MATERIALS, "clipped": CLIPPED, "unexplained": UNEXPLAINED, "contour": CONTOUR}


class VerdictOnSet(NamedTuple):
    """A set: its degradations, its score in dB, the verdict, and the terms of e² without their weights."""

    degradations: str
    score: float
    trust: str
    expected_psnr: float
    terms: list[float]


def measure(kind: str) -> list[VerdictOnSet]:
    """Make the degraded sets that are missing, run the pipeline on all, and read the verdicts."""
    rng = np.random.default_rng(ORDER[kind])
    ways = [MIXED[k] for _ in range(TIMES) for k in rng.permutation(len(MIXED))]
    degraded = list(zip(CHAIRS[kind] * TIMES, ways, strict=False))
    degraded += list(zip(SOLIDS[kind], MIXED_SOLIDS, strict=False))
    sets = []
    for number, (seed, names) in enumerate(degraded):
        folder = PLACE / f"{kind}-{number}"
        if not (folder / "dataset.yaml").exists():
            degrade(base_of(seed), folder, names, FIRST[kind] + number)
        metrics = evaluate_dataset(folder)
        verdict = metrics["verdict"]
        terms = [verdict["terms"][name] / weight for name, weight in WEIGHTS.items()]
        scores = (metrics["relit_set"]["mean_psnr_db"], verdict["trust"], verdict["expected_relit_db"])
        sets.append(VerdictOnSet(", ".join(names) or "nothing", *scores, terms))
    return sets


def base_of(seed: int | None) -> Path:
    """Return the folder of the set that is degraded."""
    if seed is None:
        return ROOT / "data/eames"
    if any(seed in seeds for seeds in SOLIDS.values()):
        return generate_set(seed, kind="synthetic")
    if seed not in CAPTURED:
        return generate_set(seed)
    maps = maps_in([Path(word) for word in environment_words("LIGHTS", "folders of captured lights")])
    return generate_set(seed, link_maps(split_maps(maps, seed)[0], PLACE / f"maps-{seed}"))


def expected_psnr(weights: Float[np.ndarray, " 4"], terms: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    """Return (1) of `factorlib.evaluate.verdict`, dB."""
    return -10 * np.log10(FLOOR + terms @ weights)


def fit_weights(sets: list[VerdictOnSet]) -> Float[np.ndarray, " 4"]:
    """Fit the weights, but UNEXPLAINED, that bring the expected scores nearest to the scores; outliers count less."""
    terms, scores = (np.array([getattr(each, key) for each in sets]) for key in ("terms", "score"))
    shipped = np.array(list(WEIGHTS.values()))
    fitted = np.array([name != "unexplained" for name in WEIGHTS])

    def weights(logarithms: np.ndarray) -> np.ndarray:
        """Return all weights, from the logarithms of those that are fitted."""
        return np.where(fitted, np.exp(np.insert(logarithms, fitted.argmin(), 0.0)), shipped)

    start = np.log(shipped[fitted])
    return weights(least_squares(lambda w: expected_psnr(weights(w), terms) - scores, start, loss="soft_l1").x)


def agreement(predicted: Float[np.ndarray, " n"], sets: list[VerdictOnSet]) -> str:
    """Return rank correlations of predicted and true scores, and the deviation.

    Correlations are of all sets, and of those that are not hopeless.
    """
    score = np.array([each.score for each in sets])
    usable = score >= HOPELESS
    ranks = spearmanr(predicted, score)[0], spearmanr(predicted[usable], score[usable])[0]
    deviation = np.sqrt(np.mean((predicted - score) ** 2))
    return f"Spearman {ranks[0]:.2f}, from {HOPELESS:g} dB on {ranks[1]:.2f}, deviation {deviation:.1f} dB"


def main() -> None:
    """Print the verdicts on the kinds of sets named on the command line."""
    kinds = {kind: measure(kind) for kind in sys.argv[1:] or CHAIRS}
    for kind, sets in kinds.items():
        ranked = sorted(sets, key=lambda each: -each.expected_psnr)
        rows = [[each.degradations, f"{each.score:.1f}", f"{each.expected_psnr:.1f}", each.trust] for each in ranked]
        print(f"{kind}\n{markdown_table(['degraded by', 'relit, dB', 'expected', 'verdict'], rows)}")
        print(agreement(np.array([each.expected_psnr for each in sets]), sets))
    if sets := kinds.get("fit"):
        print("weights:", dict(zip(WEIGHTS, np.round(fit_weights(sets), 4).tolist(), strict=True)))
        left_out = [
            expected_psnr(fit_weights([*sets[:k], *sets[k + 1 :]]), np.array(s.terms)) for k, s in enumerate(sets)
        ]
        print("each set left out of the fit:", agreement(np.array(left_out), sets))


if __name__ == "__main__":
    main()
