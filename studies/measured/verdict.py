"""Verdicts on results, beside the truth that they do not know.

`python -m studies.measured.verdict fit test`, with LIGHTS="FOLDER …" of captured maps:

fit    44 sets: data/eames and seeds 111 to 120 of `studies.measured.eames_like`, from 116 on in captured light, four
       times each, spoilt in ways of `studies.measured.degradations`.  The weights of `factorlib.evaluate.verdict` are
       fitted to them anew, and printed
test   20 others of seeds 201 to 205, the last two in captured light, each way once: what is expected with the weights
       as they stand

Sets lie in build/bench/verdict, results in build/.  Printed of each that is named: every set, rank correlations
(Spearman), and the deviation; of `fit` also with each set left out of the fit.  Expected and true scores of all that
are named are in build/bench/verdict/calibration.csv.
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
from factorlib.wholefile import write_text
from studies.measured.degradations import MIXED, spoilt
from studies.measured.eames_like import drawn, folder_of, made
from studies.measured.tools import ROOT, evaluated, needed, table

PLACE = ROOT / "build/bench/verdict"
CAPTURED = (116, 117, 118, 119, 120, 204, 205)
SEEDS = {"fit": (None, *range(111, 121)), "test": tuple(range(201, 206))}  # None: data/eames
FIRST = {"fit": 0, "test": 1000}  # number of the first set
ORDER = {"fit": 5, "test": 6}  # seeds of the order in which ways to spoil are dealt
TIMES = 4  # a base
HOPELESS = 18.0  # dB: a flat disc of the true ball's mean colour scores 17.6 to 18.6
WEIGHTS = {"materials": MATERIALS, "clipped": CLIPPED, "unexplained": UNEXPLAINED, "contour": CONTOUR}


class Judged(NamedTuple):
    """A set: how it was spoilt, its score in dB, the verdict, and the terms of e² without their weights."""

    spoilt_by: str
    score: float
    trust: str
    expected: float
    signs: list[float]


def judged(which: str) -> list[Judged]:
    """Make the sets that are not there, run the pipeline on them, and read what came out."""
    rng = np.random.default_rng(ORDER[which])
    ways = []
    seeds = SEEDS[which]
    while len(ways) < TIMES * len(seeds):
        ways += [MIXED[k] for k in rng.permutation(len(MIXED))]
    sets = []
    for number in range(TIMES * len(seeds)):
        folder = PLACE / f"{which}-{number}"
        if not (folder / "dataset.yaml").exists():
            spoilt(base_of(seeds[number % len(seeds)]), folder, ways[number], FIRST[which] + number)
        metrics = evaluated(folder)
        verdict = metrics["verdict"]
        signs = [verdict["terms"][name] / weight for name, weight in WEIGHTS.items()]
        sets.append(
            Judged(
                ", ".join(ways[number]) or "nothing",
                metrics["relit_set"]["mean_psnr_db"],
                verdict["trust"],
                verdict["expected_relit_db"],
                signs,
            )
        )
    return sets


def base_of(seed: int | None) -> Path:
    """Return the folder of the set that is spoilt."""
    if seed is None:
        return ROOT / "data/eames"
    if seed not in CAPTURED:
        return made(seed)
    maps = maps_in([Path(word) for word in needed("LIGHTS", "folders of captured lights")])
    return made(seed, folder_of(drawn(maps, seed)[0], PLACE / f"maps-{seed}"))


def expected(weights: Float[np.ndarray, " 4"], signs: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    """Return (1) of `factorlib.evaluate.verdict`, dB."""
    return -10 * np.log10(FLOOR + signs @ weights)


def fitted(sets: list[Judged]) -> Float[np.ndarray, " 4"]:
    """Fit the weights that bring the expected scores nearest to the scores; outliers count less."""
    signs = np.array([one.signs for one in sets])
    scores = np.array([one.score for one in sets])
    start = np.log(list(WEIGHTS.values()))
    return np.exp(least_squares(lambda w: expected(np.exp(w), signs) - scores, start, loss="soft_l1").x)


def told(sets: list[Judged]) -> str:
    """Return every set in a table, and how well scores are foreseen."""
    rows = [
        [one.spoilt_by, f"{one.score:.1f}", f"{one.expected:.1f}", one.trust]
        for one in sorted(sets, key=lambda s: -s.expected)
    ]
    foreseen = np.array([one.expected for one in sets])
    return f"{table(['spoilt by', 'relit, dB', 'expected', 'verdict'], rows)}\n{agreement(foreseen, sets)}"


def agreement(foreseen: Float[np.ndarray, " n"], sets: list[Judged]) -> str:
    """Return rank correlations of foreseen and true scores, and the deviation.

    Correlations are of all sets, and of those that are not hopeless.
    """
    score = np.array([one.score for one in sets])
    some = score >= HOPELESS
    ranks = spearmanr(foreseen, score)[0], spearmanr(foreseen[some], score[some])[0]
    deviation = np.sqrt(np.mean((foreseen - score) ** 2))
    return f"Spearman {ranks[0]:.2f}, from {HOPELESS:g} dB on {ranks[1]:.2f}, deviation {deviation:.1f} dB"


def main() -> None:
    """Print what came out of each kind of sets that is named, and write the scores of all."""
    kinds = {name: judged(name) for name in sys.argv[1:] or SEEDS}
    for name, sets in kinds.items():
        print(f"{name}\n{told(sets)}")
    if sets := kinds.get("fit"):
        print("weights:", dict(zip(WEIGHTS, np.round(fitted(sets), 4).tolist(), strict=True)))
        rest = [expected(fitted([*sets[:k], *sets[k + 1 :]]), np.array([one.signs]))[0] for k, one in enumerate(sets)]
        print("each set left out of the fit:", agreement(np.array(rest), sets))
    lines = [f"{name},{one.expected:.3f},{one.score:.3f}" for name, sets in kinds.items() for one in sets]
    write_text(PLACE / "calibration.csv", "\n".join(["kind,expected_db,true_db", *lines, ""]))


if __name__ == "__main__":
    main()
