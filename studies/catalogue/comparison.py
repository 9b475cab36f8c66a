"""Comparison: does a joint solve predict photos that were not taken better than methods that do less, or do the same by other means?

Varied     the method: the stage `solve`, Mitsuba's joint optimisation, an intrinsic decomposition, projective texturing, a grey ball.
           All see the same photos, of n materials in n lights on one convex body, its normals and the camera.
Measured   pictures from another side, in lights and of materials that no photo shows, each in three gauges; errors of the materials
           and lights that a method states; the processor's time.

`python -m studies.catalogue.comparison [rate …]` tries rates of Mitsuba's optimisation on a seed that no study reports, each until its
loss is flat.  The best, by the mean of its last losses, is `studies.steps.optimise.RATE`.
"""

from __future__ import annotations

import os
import sys

from studies.study import FULL, Claim, Comparison, Scale, Setting, Study, full_matrix

LABELS = {"ours": "ours", "mitsuba": "Mitsuba", "intrinsic": "intrinsic", "projective": "projective", "grey": "grey ball"}  # fmt: skip
OTHERS = {
    "mitsuba": "Mitsuba",
    "intrinsic": "the intrinsic decomposition",
    "projective": "projective texturing",
    "grey": "a grey ball",
}
SIZES = {"full": (96, 48, 2000), "quick": (32, 16, 20)}  # pixels of photos; pixels and steps of Mitsuba's optimisation
RATES = (0.003, 0.01, 0.03, 0.1)


def case(scale: Scale, seed: int, method: str) -> Comparison:
    """All of `side` materials in as many lights, by a method."""
    size, pixels, steps = SIZES[scale.name]
    entries = tuple(full_matrix(scale.side, scale.side))
    return Comparison(seed, entries, size, scale.solve, method=method, pixels=pixels, steps=steps)


def settings(scale: Scale) -> list[Setting]:
    """A method each."""
    return [Setting(m, label, lambda seed, m=m: case(scale, seed, m)) for m, label in LABELS.items()]


def claims(scale: Scale) -> list[Claim]:
    """The joint solve against each of the others; the paper has new views and lights, against two of them."""
    what = {"view": "new views", "light": "pictures in new light", "material": "pictures of new materials"}
    asked = [(kind, method) for kind in what for method in OTHERS if (kind, method) != ("material", "projective")]
    papers = [(kind, method) for kind in ("view", "light") for method in ("intrinsic", "projective")]
    words = {pair: f"{what[pair[0]]} are predicted better than by {OTHERS[pair[1]]}" for pair in asked}
    return [Claim(f"novel_{k}", "ours", m, words[k, m], paper=(k, m) in papers) for k, m in asked]


STUDY = Study(
    name="comparison",
    title="Comparison",
    question="Does a joint solve predict photos that were not taken better than methods that do less, or do the same by other means?",
    paper="The joint solve is nearer to the truth than projective texturing and than an intrinsic decomposition (SIRFS), averaged over photos.",
    varied="method",
    measures=(
        "novel_view", "novel_light", "novel_material", "processor", "novel_view_balanced", "novel_light_balanced", "novel_material_balanced",
        "diffuse", "specular", "roughness", "mirror", "glossy", "lambertian",
    ),
    settings=settings,
    claims=claims,
    steps=("worlds", "observe", "solve", "optimise", "compare"),
    pictures="studies.steps.compare.sheets",
)  # fmt: skip


def try_rates(rates: list[float] = RATES, seed: int = 100, side: int = FULL.side) -> None:
    """Print where each rate ends, on pictures as large as the full study's."""
    import msgspec
    import numpy as np

    from studies.body import photographed
    from studies.measured.tools import table
    from studies.spheres import light_map, materials_of
    from studies.steps.optimise import FLAT, optimised

    if seed in FULL.seeds:
        sys.exit(f"error: seed {seed} is reported: choose on another one (--seed)")
    os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"  # of the lights, as in studies
    rows, of = [], case(msgspec.structs.replace(FULL, side=side), seed, "mitsuba")
    lights = {li: light_map(seed, li, FULL.light_rows, FULL.light_spp) for li in of.lights}
    for rate in rates:
        end = optimised(of, photographed(of, materials_of(seed), lights), rate)
        loss, flat = f"{np.mean(end.losses[-FLAT:]):.3g}", "yes" if end.flat else "no"
        rows.append([f"{rate:g}", loss, str(len(end.losses)), flat, f"{end.processor:.0f}"])
    print(table(["rate", "loss at the end", "steps", "flat", "processor, s"], rows))


if __name__ == "__main__":
    import typer

    typer.run(try_rates)
