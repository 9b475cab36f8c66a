"""Whatever is no better than its null has a sentence on the page, and nothing else has."""

from factorlib.report.template import sentences
from factorlib.results.materials import Reflectance
from factorlib.results.metrics import (
    AngleError,
    ComparedMaterial,
    Counts,
    LightError,
    LightErrors,
    MaterialError,
    MaterialErrors,
    Metrics,
    NormalError,
    PictureError,
    Relighting,
    RelitBall,
    Resynthesis,
    ScoredLight,
)

GAUGE = "channel_per_photo"
GREY = Reflectance((0.5,) * 3, (0.05,) * 3, 0.5)
VIEWS = ("mirror", "glossy", "lambertian", "map_all", "map_mirrored", "map_unmirrored")


def no_better_than_a_guess(metrics):
    return sentences("guesses.txt", metrics=metrics)


def metrics_of(error: float) -> Metrics:
    """Everything wrong by `error`, beside nulls that are wrong by 1 (and 10°, 20 dB)."""
    light = {view: ScoredLight(LightError(error, error, 10 * error), LightError(1.0, 1.0, 10.0)) for view in VIEWS}
    part = ComparedMaterial(0, GREY, GREY, *(MaterialError(e, (e, -e, e), (-e, e, e)) for e in (error, 1.0)))
    kinds = {
        "in_estimated_light": PictureError(0, 20 / error, 0),
        "in_true_light": PictureError(0, 30, 0),
        "null_grey": PictureError(0, 20, 0),
    }
    return Metrics(
        Counts(1, 1, 1, 1),
        Resynthesis({}, None, None, None),
        MaterialErrors({"0": (1.0,) * 3}, {"oak": part}, *(error,) * 6, *(1.0,) * 3),
        Relighting({"hall": {"oak": RelitBall(True, 1.0, {GAUGE: kinds})}}, {}, None),
        LightErrors({"hall": {GAUGE: light}}, {}, {"hall": 0.5}),
        {"a": NormalError(9, AngleError(10 * error, 0), AngleError(10.0, 0))},
        None,
        {},
    )


def test_what_beats_its_null_needs_no_sentence():
    assert no_better_than_a_guess(metrics_of(0.9)) == []


def test_what_its_null_beats_is_named_with_both_numbers_and_a_reason():
    light, ball, material, normals = no_better_than_a_guess(metrics_of(1.1))
    assert (
        "'hall'" in light
        and all(f"a {sphere} sphere" in light for sphere in ("mirror", "glossy", "Lambertian"))
        and "11.0°" in light
        and "mirror 50" in light
    )
    assert "'hall'" in ball and "oak" in ball
    assert "'oak'" in material and "roughness" in material and "diffuse" in material and "specular" in material
    assert normals.startswith("a: ") and "11.0°" in normals


def test_one_number_is_enough():
    found = metrics_of(0.9)
    found.light.lights["hall"][GAUGE]["map_all"] = ScoredLight(LightError(0.9, 0.9, 12.0), LightError(1.0, 1.0, 10.0))
    (sentence,) = no_better_than_a_guess(found)
    assert "12.0°" in sentence and "sphere" not in sentence


def test_without_a_truth_nothing_is_said():
    nothing = dict.fromkeys(("materials", "relighting", "light", "normals", "poses"))
    assert (
        no_better_than_a_guess(Metrics(Counts(1, 1, 1, 1), Resynthesis({}, None, None, None), **nothing, reasons={}))
        == []
    )
