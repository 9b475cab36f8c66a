"""Pictures that a recipe asks for; `factorlib.render.drawing` says which files."""

from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.meshes.read import CREASE_DEG
from factorlib.recipe.schema import recipe_of
from factorlib.render.drawing import draw
from factorlib.render.solved_set import SolvedSet
from factorlib.stage import Inputs, Progress


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How meshes are read; what pictures show stands in the recipe."""

    crease_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = CREASE_DEG
    """Angle, in degrees, between the normals of two triangles above which the edge between them stays sharp."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Make the pictures of one recipe."""
    draw(recipe_of(inputs.facts["recipe"]), SolvedSet(inputs, params.crease_deg), out, progress)
