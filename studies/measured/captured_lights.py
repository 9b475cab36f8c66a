"""Suns and tints of captured lights: `python -m studies.measured.captured_lights FOLDER …`.

`factorlib.inference.choices.suns` tells sunlight by share and warmth, and `factorlib.inference.model.gauge` weighs mean
tints.
"""

import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.images.light_map import maps_in, read_light_map
from studies.measured.tools import machine, markdown_table

BLUR_SHARPNESS = 1 / np.radians(5) ** 2  # λ of the blur under which the brightest direction is found, as in `suns`
STEP = 37  # one texel in so many is tried as the brightest direction
DISC = np.cos(np.radians(15))  # about that direction
NARROW = np.cos(np.radians(2.5))  # about the brightest texel: a sun has all its energy there


def describe_light(radiance: Float[np.ndarray, "h w 3"]) -> tuple[list[float], Float[np.ndarray, "3"]]:
    """Return shares of the energy near the brightest texel and in the brightest disc, the disc's warmth, and the tint.

    Warmth is the logarithm of R/B of the disc over that of the rest, and the tint the logarithm of the mean radiance.
    """
    height = min(len(radiance), 128)
    step = len(radiance) // height
    radiance = radiance.reshape(height, step, 2 * height, step, 3).mean(axis=(1, 3))
    directions = lat_long_directions(height, 2 * height).reshape(-1, 3)
    energy = (radiance * lat_long_solid_angles(height, 2 * height)[:, None, None]).reshape(-1, 3)
    total = energy.sum(0)
    trials = directions[::STEP]
    blurred = [energy.sum(1) @ np.exp(BLUR_SHARPNESS * (directions @ z - 1)) for z in trials]
    disc = energy[directions @ trials[int(np.argmax(blurred))] > DISC].sum(0)
    peak = directions[int(np.argmax(radiance.sum(2)))]
    narrow = energy[directions @ peak > NARROW].sum() / total.sum()
    red, _, blue = np.log(disc) - np.log(total - disc)
    warmth = float(red - blue)
    tint = np.log(total) - np.log(total).mean()
    return [float(narrow), float(disc.sum() / total.sum()), warmth], tint


def main() -> None:
    """Print a row for each map, and the deviation of their tints."""
    maps = maps_in([Path(word) for word in sys.argv[1:]])
    described = [describe_light(read_light_map(path)) for path in maps]
    head = ["map", "share within 2.5°", "share within 15°", "warmth", "share + warmth"]
    rows = [
        [path.stem, *(f"{value:.2f}" for value in [*values, values[1] + values[2]])]
        for path, (values, _) in zip(maps, described, strict=True)
    ]
    print(machine())
    print(markdown_table(head, sorted(rows, key=lambda row: -float(row[-1]))))
    deviations = np.std([tint for _, tint in described], axis=0)
    print("deviation of the logarithm of mean radiance, R, G, B:", ", ".join(f"{value:.2f}" for value in deviations))


if __name__ == "__main__":
    main()
