"""The stage on small real artifacts, with truth and without; and the verdict: its one integral, and what must hold whatever the weights are."""

import math
import shutil
from typing import get_args, get_type_hints

import msgspec
import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.evaluate.ball import ball, octahedral_light, uniform_light
from factorlib.evaluate.relighting import MEAN_SHOWN, NORMALS
from factorlib.evaluate.verdict import GOOD, POOR, VerdictInputs, ball_changes, verdict, verdict_text
from factorlib.images.exr import read_exr, write_exr
from factorlib.jsonfile import read_json
from factorlib.results.materials import Misfit, Reflectance, StandardErrors, attach_errors
from factorlib.results.metrics import Metrics, Verdict
from factorlib.results.surface_table import DetailEvidence, SurfaceTable
from factorlib.runner.verbs import NO_TRUST
from stages import evaluate
from tests.evaluate.made_artifacts import TRUE, Made, light_map, make_artifacts, paint
from tests.stages.made import ran

LINKED = {"day": ["red", "white"], "noon": ["white", "brass"], "dusk": ["red"]}


def numbers_in(value) -> list[float]:
    """Every number of nested plain containers."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else []
    return [value] if isinstance(value, int | float) else [number for each in inside for number in numbers_in(each)]


def metrics_of(folder, **made) -> dict:
    return evaluated(make_artifacts(Made(folder / "in", **made)), folder / "out")


def evaluated(inputs, out) -> dict:
    return read_json(ran(evaluate, inputs, out) / "metrics.json")


@pytest.fixture(scope="module")
def linked(tmp_path_factory):
    return metrics_of(tmp_path_factory.mktemp("linked"), seen=LINKED)


def test_every_part_is_scored_beside_its_null_in_finite_numbers(linked):
    msgspec.convert(linked, Metrics)
    numbers = numbers_in(linked)
    assert len(numbers) > 500 and all(map(math.isfinite, numbers)) and linked["reasons"] == {}
    assert linked["set"] == {"photos": 3, "materials": 3, "illuminations": 3, "components": 1}
    mean = linked["resynthesis"]["mean"]["none"]
    assert mean["estimate"]["psnr_tonemapped_db"] > mean["null"]["psnr_tonemapped_db"] + 10
    relit = linked["relit_set"]
    assert relit["pairs"] == 9 and relit["mean_psnr_db"] >= relit["worst_psnr_db"] > relit["null_mean_psnr_db"] + 5
    assert linked["light"]["mean"]["scalar_per_set"]["mirror"]["estimate"]["rmse"] < 1e-3  # only scaled, by 1.1
    assert linked["normals"]["day"]["estimate"]["median_deg"] < 0.1 < linked["normals"]["day"]["null"]["median_deg"]
    assert linked["poses"]["dusk"]["balls"]["rotation_deg"] == pytest.approx(0)


def test_a_texture_is_scored_beside_the_flat_material(tmp_path, linked):
    flat = linked["albedo"]["overall"]
    assert flat["estimate"] == flat["null"] and 0.01 < flat["null"]["median"] < flat["null"]["p90"] < 0.4
    assert set(linked["albedo"]["materials"]) == {"red", "white", "brass"}
    inputs = make_artifacts(Made(tmp_path / "in", seen=LINKED))
    folder = tmp_path / "in" / "texture"
    (folder / "photos").mkdir(parents=True)
    for photo in LINKED:  # the texture is the paint; the estimated k_d differs by one factor
        maps = read_exr(inputs["align"] / f"{photo}.exr")
        normal = np.stack([maps[f"normal.{axis}"] for axis in "xyz"], axis=-1) @ YUP_FROM_CAMERA.T
        detail = paint(normal.reshape(-1, 3)).reshape(normal.shape) * maps["object"][..., None]
        write_exr(folder / "photos" / f"{photo}.exr", {f"detail.{c}": detail[..., k] for k, c in enumerate("RGB")})
    textured = evaluated(
        msgspec.structs.replace(inputs, folders=inputs.folders | {"texture": folder}), tmp_path / "out"
    )
    scores = textured["albedo"]["overall"]
    assert scores["null"] == flat["null"] and scores["estimate"]["p90"] < 1e-5
    assert textured["albedo"]["factor"] == pytest.approx([1 / 1.04] * 3, rel=1e-5)


def test_a_held_out_photo_is_scored_apart(tmp_path, linked):
    result = metrics_of(tmp_path, seen=LINKED, held_out=("dusk",))
    assert set(result["resynthesis"]["photos"]) == {"day", "noon"} and linked["held_out"] is None
    assert set(result["held_out"]["photos"]) == {"dusk"}
    assert (
        result["held_out"]["photos"]["dusk"]["gauges"]["none"]
        == linked["resynthesis"]["photos"]["dusk"]["gauges"]["none"]
    )
    assert set(msgspec.convert(result, Metrics).photos) == {"day", "noon", "dusk"}
    (view,) = result["views"].values()  # of one red ball, which "day" shows from the same side in another light
    assert linked["views"] is None and view["visible"] > 0.5 and view["flat"] == pytest.approx(view["mean_colour"])
    assert view["predicted"] > max(view["flat"], view["nearest_photo"])


def test_a_photo_that_rejoined_is_predicted_by_the_first_solve_and_re_synthesised_by_the_second(tmp_path, linked):
    inputs = make_artifacts(Made(tmp_path / "in", seen=LINKED, held_out=("dusk",)))
    inputs.facts["dataset.light"]["dusk"]["rejoins"] = True
    folders = inputs.folders | {"shading": tmp_path / "shading", "exchange": tmp_path / "exchange"}
    shutil.copytree(inputs["solve"], tmp_path / "exchange" / "solve")
    first = read_exr(inputs["masks"] / "dusk.exr")  # the first solve predicts the photo exactly, half by each part
    (tmp_path / "shading").mkdir()
    write_exr(
        tmp_path / "shading" / "dusk.exr",
        {f"{part}.{c}": 0.5 * first[c] for part in ("diffuse", "specular") for c in "RGB"},
    )
    result = evaluated(msgspec.structs.replace(inputs, folders=folders), tmp_path / "out")
    assert result["resynthesis"] == linked["resynthesis"] and set(result["held_out"]["photos"]) == {"dusk"}
    (view,) = result["views"].values()
    known = metrics_of(tmp_path / "apart", seen=LINKED, held_out=("dusk",))["views"]["dusk"]
    assert view["predicted"] > 60 > known["predicted"]
    assert {k: v for k, v in view.items() if k != "predicted"} == {k: v for k, v in known.items() if k != "predicted"}
    photos = msgspec.convert(result, Metrics).photos
    assert photos["dusk"] == msgspec.convert(linked, Metrics).photos["dusk"]  # as it is re-synthesised
    said = (tmp_path / "out" / "verdict.txt").read_text()
    assert f"predicted to {view['predicted']:.1f} dB" in said and "is better than both" in said


def test_without_truth_re_synthesis_remains_and_the_rest_says_why(tmp_path):
    result = metrics_of(tmp_path, seen={"only": ["red"]}, truth=False)
    assert result["materials"] is result["light"] is result["relighting"] is result["relit_set"] is None
    assert set(result["reasons"].values()) == {evaluate.NO_TRUTH}
    assert result["resynthesis"]["mean"]["none"]["estimate"]["psnr_linear_db"] > 20
    assert result["verdict"]["trust"] == "good"
    assert (tmp_path / "out" / "verdict.txt").read_text().startswith("good: relit pictures are expected to reach ")


# ── The verdict: a reference for its one integral, and what must hold whatever the weights are ──────────────────────


LIGHT = octahedral_light(light_map(1))
CLEAN = VerdictInputs(
    {"red": 1e-4, "wood": 2e-4}, 1e-4, {"day": Misfit(1e-4, 0.01), "dusk": Misfit(2e-4, 0.0)}, {"day": {"chair": 1e-4}}
)
WORSE = {
    "materials": {"red": 1e-4, "wood": 0.2},
    "photos": {"day": Misfit(1e-4, 0.01), "dusk": Misfit(2e-4, 0.9)},
    "unexplained": 2.0,
    "contours": {"day": {"chair": 1e-4}, "dusk": {"stool": 0.04}},
}
UNEXPLAINED = {"day": Misfit(0.2, 0.01), "dusk": Misfit(0.5, 0.0)}
BLAMED = {"materials": "'wood'", "photos": "'dusk'", "unexplained": "'dusk'", "contours": "'stool' in 'dusk'"}


def test_clean_signs_are_good_and_each_sign_alone_can_spoil_the_trust_and_is_the_first_reason():
    assert verdict(CLEAN).trust == "good" and verdict(CLEAN).expected_relit_db > GOOD
    for name, worse in WORSE.items():
        photos = {"photos": UNEXPLAINED} if name == "unexplained" else {}
        spoilt = verdict(msgspec.structs.replace(CLEAN, **{name: worse, **photos}))
        assert spoilt.trust == NO_TRUST and spoilt.expected_relit_db < POOR, name
        assert BLAMED[name] in spoilt.reasons[0] and "'" in spoilt.next, name


def test_a_worse_sign_never_raises_what_is_expected():
    levels = np.linspace(0, 1, 6)
    for name in ("materials", "unexplained", "clipped", "contours"):
        signs = [
            VerdictInputs(
                {"red": 1e-3 + 0.1 * v * (name == "materials")},
                1e-3 + v * (name == "unexplained"),
                {"day": Misfit(1e-3, v * (name == "clipped"))},
                {"day": {"chair": 0.01 * v * (name == "contours")}},
            )
            for v in levels
        ]
        assert (np.diff([verdict(of).expected_relit_db for of in signs]) < 0).all(), name


@pytest.mark.long
def test_a_materials_error_is_the_mean_square_of_what_random_errors_of_that_size_change():
    errors = StandardErrors((0.01, 0.004, 0.004), (0.004,) * 3, 0.01)
    (result,) = ball_changes({"red": attach_errors(TRUE["red"], errors)}, {"day": LIGHT}).values()

    def shown(material: Reflectance) -> np.ndarray:
        return np.clip(ball(LIGHT, material, NORMALS) * exposure, 0, 1) ** (1 / 2.2)

    exposure = MEAN_SHOWN / ball(LIGHT, TRUE["red"], NORMALS).mean()
    rng, squares = np.random.default_rng(0), []
    for _ in range(60):
        a, b, c = rng.normal(size=3)
        moved = Reflectance(
            tuple(np.add(TRUE["red"].diffuse, np.multiply(errors.diffuse, a))),
            tuple(np.add(TRUE["red"].specular, np.multiply(errors.specular, b))),
            TRUE["red"].roughness + errors.roughness * c,
        )
        squares.append(np.mean((shown(moved) - shown(TRUE["red"])) ** 2))
    assert result == pytest.approx(np.mean(squares), rel=4 / np.sqrt(60))
    nothing = StandardErrors((0.0,) * 3, (0.0,) * 3, 0.0)
    assert ball_changes(
        {"red": attach_errors(TRUE["red"], nothing)}, {"day": LIGHT, "grey": uniform_light(np.ones(3))}
    ) == {"red": 0.0}


@pytest.mark.parametrize("overlap, surface, words", [
    (0.8, 4.0, "look at the overlay of 'dusk'"), (None, None, "look at the overlay of 'dusk'"),
    (0.99, 4.0, "a mesh that is nearer"), (0.99, 1.0, "difference picture of 'dusk'"), (0.99, None, "difference picture"),
])  # fmt: skip
def test_advice_blames_outlines_only_where_they_differ_and_then_what_photos_disagree_about(overlap, surface, words):
    inputs = msgspec.structs.replace(CLEAN, unexplained=1.0, photos=UNEXPLAINED, surface=surface)
    if overlap is not None:
        inputs = msgspec.structs.replace(inputs, overlaps={"day": {"chair": 0.5}, "dusk": {"chair": overlap}})
    result = verdict(inputs)
    assert words in result.next and ("overlay" in result.next) == words.startswith("look at the overlay")
    assert any("disagree about the surface" in why for why in result.reasons) == (surface == 4.0)
    assert result.terms == verdict(msgspec.structs.replace(CLEAN, unexplained=1.0, photos=UNEXPLAINED)).terms


def test_a_small_bright_source_is_asked_for_only_where_a_material_was_not_seen_in_one():
    uncertain = msgspec.structs.replace(CLEAN, materials=WORSE["materials"])
    assert "photo of 'wood' in light with a small bright source" in verdict(uncertain).next
    for seen, words in (({"wood"}, "photo of 'wood' in another light"), ({"red"}, "a small bright source")):
        assert words in verdict(msgspec.structs.replace(uncertain, lit_hard=frozenset(seen))).next


def test_a_surfaces_disagreement_is_the_residual_of_photos_that_had_no_part_in_what_is_kept():
    moved, painted = DetailEvidence(4.0, 9.0), DetailEvidence(1.0, 4.0)
    tables = [(SurfaceTable(True, moved, True, painted), 1.0), (SurfaceTable(True, moved, False, painted), 2.0)]
    tables += [(SurfaceTable(False, moved, False, painted), 3.0), (SurfaceTable(), None)]
    assert [table.disagreement for table, _ in tables] == [residual for _, residual in tables]


def test_the_text_begins_with_the_word_that_the_runner_looks_for():
    first, *others = verdict_text(verdict(msgspec.structs.replace(CLEAN, unexplained=2.0))).splitlines()
    assert first.startswith(NO_TRUST) and NO_TRUST in get_args(get_type_hints(Verdict)["trust"])
    assert others[0].startswith("limited by: ") and others[-1].startswith("next: ")
