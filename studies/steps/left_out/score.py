"""How far the predicted chairs of a photo are from the photo: writes <case>.json and chairs-<case>.png, the photo's above the predicted."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from factorlib.images.picture import write_png
from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import read_observations
from studies.core.left_out.case import LeftOutCase
from studies.core.left_out.photos import flat_colour
from studies.core.left_out.score import Chair, Image, chair_of, predicted, score_of

LEGS = "wood"  # in all photos


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: a metric that can be tuned is none."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Predict, compare, and lay side by side."""
    case = msgspec.convert(inputs.facts["dataset.case"], LeftOutCase)
    seen = {file.stem: read_observations(file) for file in sorted((inputs["photos"] / "urm").glob("*.parquet"))}
    materials = list(seen[case.photo].materials)
    chairs = [chair_of(inputs["photos"], case.photo, shell, materials) for shell in case.shells]

    def image(shell: str, chair: Chair) -> Image:
        """What the case predicts."""
        if case.prediction == "flat":
            return np.broadcast_to(flat_colour(seen, case.photo, shell, LEGS), chair.truth.shape)
        observed = case.prediction == "observed"
        solved = inputs["whole"] if observed else inputs["solve"] / inputs.photo / shell
        return predicted(inputs["photos"], solved, chair, materials, bounces=observed)

    images = [image(shell, chair) for shell, chair in zip(case.shells, chairs, strict=True)]
    write_json(out / f"{inputs.photo}.json", score_of(chairs, images))
    pairs = [
        np.concatenate([chair.cut_out(chair.truth), chair.cut_out(found)])
        for chair, found in zip(chairs, images, strict=True)
    ]
    height = max(len(pair) for pair in pairs)
    padded = [np.pad(pair, ((0, height - len(pair)), (0, 0), (0, 0)), constant_values=255) for pair in pairs]
    write_png(out / f"chairs-{inputs.photo}.png", np.concatenate(padded, axis=1))
