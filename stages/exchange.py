"""Second pass: the solve once more, with the paint that was found and with the photo that was predicted first.

`texture` estimates paint in lights that were estimated without it, so lights and specular parts explain some of the
paint.  Where a texture is kept, the solve continues with the textures as detail of the surface and with its choices of
the model.  The photos are shaded in these lights, and the kept textures are estimated again, no softer.  The exchange
is kept if the textures then predict photos better that they were not estimated from.

A photo that only the first solve left out (`LightSlice.rejoins`) takes part in this one, which continues the first
with its choices of the model.  Textures and surface detail stay those of the other photos: they were decided on these.
If no texture is kept, or the exchange is not, the solve continues without paint.

Writes exchange.json.  If the solve continued, the folders `solve`, `shading` and, with paint, `texture` are new results
of these stages, which replace theirs (`factorlib.results.exchange`).
"""

import logging
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from logging.handlers import MemoryHandler
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

import stages.shading
import stages.solve
import stages.texture
from factorlib.dataset.schema import LightSlice, with_all_rejoined
from factorlib.images.exr import write_exr
from factorlib.jsonfile import write_json
from factorlib.results.exchange import FILE, REPLACED, Exchange
from factorlib.results.surface_table import BEGINNING
from factorlib.results.surface_table import FILE as SURFACE
from factorlib.results.texture_table import TextureTable, read_table
from factorlib.stage import Inputs, Progress, part_of, silent
from factorlib.urm.extract import read_geometry

SHARES = (0.6, 0.75)  # shares of the time at which the solve and the shading end
LIBRARY = logging.getLogger("factorlib")
USED = ("normal.", "detail.")  # prefixes of the channels of a surface that the solve reads


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the stages that run again; pipeline.yaml takes them from these stages (`params_of`)."""

    solve: stages.solve.Params = stages.solve.Params()
    """Parameters of the solve."""
    shading: stages.shading.Params = stages.shading.Params()
    """Parameters of the shading."""
    texture: stages.texture.Params = stages.texture.Params()
    """Parameters of the textures."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Solve, shade and paint again where a texture is kept or a photo rejoins; keep paint if it predicts better."""
    before = read_table(inputs["texture"])
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    decision = Exchange(False)
    if params.solve.solver == "paper":  # its materials are uniform, and it continues no solution
        write_json(out / FILE, decision)
        return
    rejoining = any(light.rejoins for light in lights.values())
    half = 0.5 if before.longest and rejoining else 0  # of the work, where it may take two solves
    if before.longest:
        with held_back() as warnings:
            solve_again(params, inputs, out, part_of(progress, 0, half or 1), before)
        losses = [held_out_loss(table, before) for table in (before, read_table(out / "texture"))]
        decision = Exchange(losses[1] < losses[0], *losses)
        for warning in warnings if decision.kept else ():
            LIBRARY.handle(warning)
        if not decision.kept:
            for name in REPLACED:
                shutil.rmtree(out / name)
    if not decision.kept and rejoining:
        solve_again(params, inputs, out, part_of(progress, half, 1))
    write_json(out / FILE, decision)


@contextmanager
def held_back() -> Iterator[list[logging.LogRecord]]:
    """Collect the library's warnings instead of handling them: those of a rejected exchange are about no result."""
    collector = MemoryHandler(sys.maxsize, flushLevel=sys.maxsize, flushOnClose=False)
    handlers, propagate = LIBRARY.handlers, LIBRARY.propagate
    LIBRARY.handlers, LIBRARY.propagate = [collector], False
    try:
        yield collector.buffer
    finally:
        LIBRARY.handlers, LIBRARY.propagate = handlers, propagate


def solve_again(
    params: Params, inputs: Inputs, out: Path, progress: Progress, before: TextureTable | None = None
) -> None:
    """Solve all photos with the textures as detail of the surface, shade in the new lights, and paint again.

    The choices of the solve stay, and the kept textures become no softer.

    Args:
        params: Parameters of the stages.
        inputs: Inputs of the stage.
        out: Folder to write to.
        progress: Called with the completed work, its total and the current activity.
        before: Textures; None to solve and shade without paint.
    """
    for name in REPLACED if before else REPLACED[:-1]:
        (out / name).mkdir()
    lights = with_all_rejoined(msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice]))
    first, second = SHARES
    with TemporaryDirectory() as folder:
        painted = {"surface": paint_surface(inputs, Path(folder), list(lights))} if before else {}
        continued = with_folders(inputs, start=inputs["solve"], **painted)
        facts = {**inputs.facts, "dataset.light": msgspec.to_builtins(lights)}
        continued = msgspec.structs.replace(continued, facts=facts)
        stages.solve.main(params.solve, continued, out / "solve", part_of(progress, 0, first), decided=True)
    solved = with_folders(inputs, solve=out / "solve")

    def shade(name: str) -> None:
        """Write the shading of a photo."""
        facts = {**inputs.facts, "dataset.light": msgspec.to_builtins(lights[name])}
        one = msgspec.structs.replace(solved, photo=name, facts=facts)
        stages.shading.main(params.shading, one, out / "shading", silent)
        progress(first, 1, f"{name}: shading")

    inputs.map(shade, list(lights))
    if before:
        shaded = with_folders(solved, shading=out / "shading")
        stages.texture.main(params.texture, shaded, out / "texture", part_of(progress, second, 1), before)


def paint_surface(inputs: Inputs, folder: Path, photos: list[str]) -> Path:
    """Write a result of `surface` into a folder, with the textures as its detail; return the folder."""
    surface = inputs.folders.get("surface")
    (folder / "photos").mkdir()
    for file in (SURFACE, BEGINNING):
        if surface is not None and (surface / file).is_file():
            shutil.copy(surface / file, folder / file)
    for name in photos:
        channels = read_geometry(inputs["align"], surface, name, inputs["texture"])
        used = {channel: values for channel, values in channels.items() if channel.startswith(USED)}
        write_exr(folder / "photos" / f"{name}.exr", used)
    return folder


def held_out_loss(table: TextureTable, kept: TextureTable) -> float:
    """Return the mean loss of held-out photos under the textures of a table, over those that `kept` keeps."""
    keys = {(each.mesh, each.material) for each in kept.textures if each.kept}
    losses = [each.by.held_out_loss_with for each in table.textures if (each.mesh, each.material) in keys]
    return sum(loss or 0.0 for loss in losses) / len(keys)


def with_folders(inputs: Inputs, **folders: Path) -> Inputs:
    """Return the inputs with other folders of some stages."""
    return msgspec.structs.replace(inputs, folders={**inputs.folders, **folders})
