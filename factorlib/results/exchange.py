"""Result of the stage `exchange`, and the results that it replaces where it solved again."""

from collections.abc import Mapping
from pathlib import Path

import msgspec

from factorlib.jsonfile import read_result
from factorlib.stage import Inputs

FILE = "exchange.json"
REPLACED = ("solve", "shading", "texture")


class Exchange(msgspec.Struct, frozen=True):
    """Decision on the exchange of paint and light.

    Attributes:
        kept: True if the new textures are used; False also where no texture was kept, and nothing was tried
        loss_before: mean loss of held-out photos under the kept textures, before the exchange
        loss_after: the same after it
    """

    kept: bool
    loss_before: float | None = None
    loss_after: float | None = None


def with_exchange(inputs: Inputs) -> Inputs:
    """Return the inputs with the results of `solve`, `shading` and `texture` that the exchange replaced."""
    return msgspec.structs.replace(inputs, folders=exchanged_folders(inputs.folders))


def exchanged_folders(folders: Mapping[str, Path]) -> dict[str, Path]:
    """Return folders of stages, with those of the exchange in place of the results that it replaced."""
    folder = folders.get("exchange")
    replaced = {name: folder / name for name in REPLACED if folder is not None and (folder / name).is_dir()}
    return {**folders, **replaced}


def read_exchange(folder: Path | None) -> Exchange:
    """Read the decision in a result folder of `exchange`; without one nothing was tried.  InputError if it is none."""
    if folder is None or not (folder / FILE).exists():
        return Exchange(False)
    return read_result(folder / FILE, Exchange, "exchange")
