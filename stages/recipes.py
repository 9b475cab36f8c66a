"""Pictures of one recipe; `factorlib.render.recipe_pictures` lists the files."""

from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.meshes.read_mesh import CREASE_DEG
from factorlib.recipe.kinds import recipe_of
from factorlib.render.recipe_pictures import draw
from factorlib.render.solved_set import SolvedSet
from factorlib.results.exchange import with_exchange
from factorlib.stage import Inputs, Progress


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of mesh reading; the recipe defines the pictures."""

    crease_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = CREASE_DEG
    """Crease angle, in degrees: an edge whose two triangles differ by more in their normals stays sharp."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Render the pictures of one recipe."""
    draw(recipe_of(inputs.facts["recipe"]), SolvedSet(with_exchange(inputs), params.crease_deg), out, progress)
