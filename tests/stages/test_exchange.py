"""The stage `exchange`: it solves with the paint if that predicts better, and with the photo that rejoins."""

import logging
import shutil

import msgspec
import numpy as np
import pytest

import stages.solve
from factorlib.dataset.schema import LightSlice, solved_photos
from factorlib.images.exr import read_exr
from factorlib.jsonfile import read_result, write_json
from factorlib.light.lobes import Lobes
from factorlib.results.exchange import FILE, REPLACED, Exchange, with_exchange
from factorlib.results.lobe_table import read_lobes, write_lobes
from factorlib.results.texture_table import TextureTable, read_table
from factorlib.stage import Inputs
from stages import exchange, shading
from tests.stages.made import Rising, ran
from tests.stages.test_texture import TURNS, photographed, run, stripes


def mirrored(light: Lobes) -> Lobes:
    """The light from the other side."""
    return msgspec.structs.replace(light, axis=light.axis * [-1, 1, 1])


@pytest.fixture(scope="module")
def painted(tmp_path_factory):
    """Inputs whose lights are those of other photos, with the textures in these, and the folder of the true solution."""
    folder = tmp_path_factory.mktemp("exchange")
    inputs = photographed(folder / "set", stripes)
    shutil.copytree(inputs["solve"], folder / "true")
    true = read_lobes(folder / "true" / "lobes.parquet")
    write_lobes(inputs["solve"] / "lobes.parquet", {name: mirrored(light) for name, light in true.items()})
    for name in TURNS:
        facts = inputs.facts | {"dataset.light": inputs.facts["dataset.light"][name]}
        one = msgspec.structs.replace(inputs, facts=facts, photo=name)
        ran(shading, one, inputs["shading"])
    texture = run(inputs, folder / "texture")
    assert read_table(texture).longest
    return msgspec.structs.replace(inputs, folders=inputs.folders | {"texture": texture}), folder / "true"


def exchanged(monkeypatch, tmp_path, inputs: Inputs, solution) -> Inputs:
    """The inputs of the stages after an exchange whose solve gives a solution that is known."""

    def solve(params, given, out, progress, decided):
        """Copy the solution; it continues the earlier one, and the surface that it is given has the paint."""
        assert decided and given["start"] == inputs["solve"]
        logging.getLogger("factorlib.inference").warning("of this solution")
        for name in TURNS:
            surface, paint = (read_exr(given[s] / "photos" / f"{name}.exr") for s in ("surface", "texture"))
            normal = read_exr(given["align"] / f"{name}.exr")["normal.x"]
            assert np.array_equal(surface["detail.G"], paint["detail.G"]) and np.array_equal(
                surface["normal.x"], normal
            )
        shutil.copytree(solution, out, dirs_exist_ok=True)

    monkeypatch.setattr(stages.solve, "main", solve)
    ran(exchange, inputs, tmp_path)
    return with_exchange(msgspec.structs.replace(inputs, folders=inputs.folders | {"exchange": tmp_path}))


def test_lights_that_explain_the_paint_better_replace_all_three_results(monkeypatch, tmp_path, painted, caplog):
    inputs, true = painted
    after = exchanged(monkeypatch, tmp_path, inputs, true)
    decision = read_result(tmp_path / FILE, Exchange, "exchange")
    assert decision.kept and decision.loss_after < decision.loss_before
    assert {name: after[name] for name in REPLACED} == {name: tmp_path / name for name in REPLACED}
    assert (after["solve"] / "lobes.parquet").read_bytes() == (true / "lobes.parquet").read_bytes()
    pictures = [read_exr(each["shading"] / "b.exr")["diffuse.G"] for each in (inputs, after)]
    assert not np.allclose(*pictures)
    assert caplog.messages.count("of this solution") == 1


def test_where_nothing_is_predicted_better_all_stays(monkeypatch, tmp_path, painted, caplog):
    inputs, _ = painted
    after = exchanged(monkeypatch, tmp_path, inputs, inputs["solve"])
    assert not read_result(tmp_path / FILE, Exchange, "exchange").kept
    assert [path.name for path in tmp_path.iterdir()] == [FILE]
    assert after.folders == inputs.folders | {"exchange": tmp_path}
    assert not caplog.messages


@pytest.mark.parametrize("textured", [True, False])
def test_a_photo_that_rejoins_is_solved_with_the_others_from_their_answer_without_paint_that_is_not_kept(
    monkeypatch, tmp_path, painted, textured
):
    inputs, _ = painted
    lights = inputs.facts["dataset.light"] | {
        "b": inputs.facts["dataset.light"]["b"] | {"held_out": True, "rejoins": True}
    }
    inputs = msgspec.structs.replace(inputs, facts=inputs.facts | {"dataset.light": lights})
    solves = []

    def solve(params, given, out, progress, decided):
        """Give back the solution from which it starts."""
        photos = solved_photos(msgspec.convert(given.facts["dataset.light"], dict[str, LightSlice]))
        solves.append((photos, given.folders.get("surface"), decided))
        progress(0, 1)
        shutil.copytree(given["start"], out, dirs_exist_ok=True)

    monkeypatch.setattr(stages.solve, "main", solve)
    if not textured:
        (tmp_path / "plain").mkdir()
        write_json(tmp_path / "plain" / "texture.json", TextureTable())
        inputs = msgspec.structs.replace(inputs, folders=inputs.folders | {"texture": tmp_path / "plain"})
    out = ran(exchange, inputs, tmp_path / "out", Rising())
    assert not read_result(out / FILE, Exchange, "exchange").kept
    assert solves[-1] == (list(TURNS), None, True) and len(solves) == 1 + textured
    after = with_exchange(msgspec.structs.replace(inputs, folders=inputs.folders | {"exchange": out}))
    changed = {name for name in REPLACED if after[name] != inputs[name]}
    assert changed == {"solve", "shading"} and {p.stem for p in (out / "shading").iterdir()} == set(TURNS)


@pytest.mark.parametrize("kept, solver", [(False, "joint"), (True, "paper")])
def test_nothing_is_solved_again_without_a_texture_or_by_the_papers_solver(tmp_path, painted, kept, solver):
    inputs, _ = painted
    if not kept:
        (tmp_path / "plain").mkdir()
        write_json(tmp_path / "plain" / "texture.json", TextureTable())
        inputs = msgspec.structs.replace(inputs, folders=inputs.folders | {"texture": tmp_path / "plain"})
    out = ran(exchange, inputs, tmp_path / "out", solve=stages.solve.Params(solver=solver))
    assert read_result(out / FILE, Exchange, "exchange") == Exchange(False)
    assert [path.name for path in out.iterdir()] == [FILE]
