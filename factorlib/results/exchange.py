"""Result of the stage `exchange`, and the results that it replaces where it is kept."""

import msgspec

from factorlib.stage import Inputs

FILE = "exchange.json"
REPLACED = ("solve", "shading", "texture")


class Exchange(msgspec.Struct, frozen=True):
    """Decision on the exchange of paint and light.

    Attributes:
        kept: True if the new results are used; False also where no texture was kept, and nothing was tried
        loss_before: mean loss of held-out photos under the kept textures, before the exchange
        loss_after: the same after it
    """

    kept: bool
    loss_before: float | None = None
    loss_after: float | None = None


def with_exchange(inputs: Inputs) -> Inputs:
    """Return the inputs with the results of `solve`, `shading` and `texture` that the exchange replaced."""
    folder = inputs.folders.get("exchange")
    replaced = {name: folder / name for name in REPLACED if folder is not None and (folder / name).is_dir()}
    return msgspec.structs.replace(inputs, folders={**inputs.folders, **replaced})
