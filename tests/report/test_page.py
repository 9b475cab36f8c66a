"""The page for ordinary and odd sets: whole, self-contained, the same bytes; and two results on one page."""

import base64
import json
import re
import shutil
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest
import yaml

from factorlib.images.picture import read_png
from factorlib.jsonfile import read_json, write_json
from factorlib.light.lobes import no_lobes
from factorlib.report.artifacts import STAGES
from factorlib.report.pictures import downsample
from factorlib.report.template import sentences
from factorlib.results.exchange import Exchange
from factorlib.results.lobe_table import write_lobes
from factorlib.results.materials import (
    Decision,
    FitStatus,
    Model,
    read_materials,
)
from factorlib.results.surface_table import DetailEvidence
from factorlib.results.texture_table import TextureEvidence, TextureTable
from factorlib.runner.project import LIBRARY
from factorlib.stage import Inputs
from stages import evaluate, report
from tests.evaluate.made_artifacts import Made, lobes_of, make_artifacts
from tests.stages.made import Rising, ran

LINKED = {"day": ["red", "white"], "noon": ["white", "brass"], "dusk": ["red"]}
CONTENTS = {"summary", "relight", "photos", "materials", "appearance", "lights", "errors", "solve", "poses", "cost"}  # fmt: skip
VOID = {"meta", "img", "br", "link", "input", "hr", "source"}
OURS = re.compile(r"<script( type=\"application/json\" id=\"viewer-data\")?>.*?</script>", re.DOTALL)
SVG_LEAVES = {"line", "polyline", "circle", "path", "rect"}
COST = {"seconds": 83.4, "cpu_seconds": 81.0, "memory_mb": 512.0, "machine": {"cores": 2}}
LOG = [
    {"event": "done", "stage": "solve", "photo": None, **COST},
    {"event": "done", "stage": "masks", "photo": "day", "seconds": 1.25},
    {"event": "warning", "stage": "masks", "photo": "day", "text": "photo 'day' <is> dark"},
]


class Strict(HTMLParser):
    """Collects ids, links and pictures; every element must be closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.links, self.alts = [], [], [], []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.ids += [attrs["id"]] if "id" in attrs else []
        self.links += [attrs[k] for k in ("src", "href", "srcset", "data", "action") if k in attrs]
        self.alts += [attrs.get("alt")] if tag == "img" else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        assert tag in SVG_LEAVES | VOID

    def handle_endtag(self, tag):
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"


def run(folder, log=LOG, **made) -> tuple[Inputs, str]:
    inputs = make_artifacts(Made(folder / "in", **made))
    scored = ran(evaluate, inputs, folder / "evaluate")
    (folder / "log.jsonl").write_text("\n".join(json.dumps(e) for e in log))
    inputs = msgspec.structs.replace(inputs, folders=inputs.folders | {"evaluate": scored}, log=folder / "log.jsonl")
    return inputs, page_of(inputs, folder / "report")


def page_of(inputs, out) -> str:
    ran(report, inputs, out, progress := Rising())
    assert progress.moves >= len(inputs.facts["dataset.set"]["photos"]) + 3
    return (out / "index.html").read_text(encoding="utf-8")


def parsed(html) -> Strict:
    parser = Strict()
    parser.feed(html)
    assert parser.open == []
    return parser


def test_it_is_well_formed_has_every_section_and_asks_for_nothing_outside_the_file(report_page):
    result = parsed(report_page[2])
    tables = {
        f"table-{key}"
        for key in [
            "resynthesis",
            "materials",
            "relighting",
            "unobserved",
            "light",
            "normals",
            "albedo",
            "poses",
            "views",
        ]
    }
    assert CONTENTS | tables <= set(result.ids) and len(set(result.ids)) == len(result.ids)
    files = [link for link in result.links if link.startswith("../")]  # followed, never asked for
    assert all(link.startswith(("data:image/png;base64,", "#")) for link in result.links if link not in files)
    assert all(link[1:] in result.ids for link in result.links if link.startswith("#"))
    folders = report_page[1].folders
    assert {"../export/materials.json", "../export/illumination/noon.exr", "../evaluate/metrics.json"} <= {*files}
    assert all((folders[stage] / path).is_file() for _, stage, path in (link.split("/", 2) for link in files))
    assert not re.search(r"url\(|@import|<script|<link|https?://", OURS.sub("", report_page[2]))
    scripts = "".join(m.group() for m in OURS.finditer(report_page[2]))
    assert not re.search(r"fetch\(|import\(|XMLHttpRequest|https?://|//cdn", scripts)


def test_every_picture_decodes_and_says_what_it_is(report_page, tmp_path):
    result = parsed(report_page[2])
    pictures = [link for link in result.links if link.startswith("data:")]
    # of the first screen, photos × panels, materials, balls, lights × (map, darker, truth, spheres), overlays
    assert len(pictures) == 3 + 3 * 4 + 3 + 9 + 3 * 4 + 3
    for k, uri in enumerate(pictures):
        path = tmp_path / f"{k}.png"
        path.write_bytes(base64.b64decode(uri.split(",")[1], validate=True))
        assert read_png(path).size > 0
    assert all(result.alts)


def test_the_numbers_are_those_of_the_metrics(report_page):
    metrics = read_json(report_page[0] / "evaluate" / "metrics.json")
    assert f"{metrics['resynthesis']['mean']['none']['estimate']['psnr_tonemapped_db']:.1f}" in report_page[2]
    assert f"{metrics['materials']['mean_roughness']:.3f}" in report_page[2]
    assert f"{metrics['views']['dusk']['nearest_photo']:.1f}" in report_page[2].split('id="table-views"')[1]


def test_only_the_cost_section_depends_on_the_log(report_page, tmp_path):
    _, inputs, html = report_page
    again = page_of(msgspec.structs.replace(inputs, log=None), tmp_path / "again")
    without = [re.sub(r"<!-- begin cost.*end cost -->", "", text, flags=re.DOTALL) for text in (again, html)]
    assert without[0] == without[1] and again != html
    assert "1 min 23 s" in html and "photo &#39;day&#39; &lt;is&gt; dark" in html
    figures = [
        sorted((folder / "figures").rglob("*.png")) for folder in (report_page[0] / "report", tmp_path / "again")
    ]
    assert [p.read_bytes() for p in figures[0]] == [p.read_bytes() for p in figures[1]] and len(figures[0]) == 3


@pytest.mark.parametrize(
    "odd",
    [
        {"seen": {"only": ["red"]}, "truth": False},
        {"seen": {f"p{k:02d}": ["red"] for k in range(13)}, "truth": False},
        {"seen": {"a": ["red"], "b": ["black"]}, "clip": 0.05},
    ],
    ids=["one photo, no truth", "many photos", "unlinked, mostly clipped"],
)
def test_odd_sets_give_a_whole_page(odd, tmp_path):
    inputs, html = run(tmp_path, log=[], **odd)
    assert CONTENTS <= set(parsed(html).ids) and "None" not in re.sub(r"data:[^\"]*", "", html)
    assert ("no ground truth" in html) == (not odd.get("truth", True))
    if len(odd["seen"]) == 2:
        assert "2 groups that share no material" in html and "Clipped pixels" in html
        assert html.index("2 groups that share") < html.index("Clipped pixels")  # the most harmful first
    if len(odd["seen"]) == 2:  # and a light that was not solved
        assert "</strong> in the light of a<" in html
        write_lobes(inputs["export"] / "lobes.parquet", {"a": no_lobes(), "b": lobes_of(1)})
        assert "turned half around" in page_of(inputs, tmp_path / "less")
    if len(odd["seen"]) > 1:
        return
    assert "averaged down" not in html  # a photo that was says from what size, and missing pictures are left out
    facts = read_json(inputs["masks"] / "photos.json")
    facts["only"] |= {"factor": 4, "original_size": [8000, 6000]}
    write_json(inputs["masks"] / "photos.json", facts)
    assert "averaged down 4 × 4 from 8000 × 6000 pixels" in page_of(inputs, tmp_path / "again")
    for path in [*inputs["render"].rglob("*.exr"), *inputs["align"].glob("*.png"), *inputs["solve"].glob("*.parquet")]:
        path.unlink()
    (inputs["train"] / "accuracy.json").unlink()
    parsed(page_of(inputs, tmp_path / "plain"))


def test_the_first_number_is_of_a_photo_that_was_held_out_and_reflectances_are_those_of_materials_json(
    report_page, tmp_path
):
    folder, inputs, html = report_page
    view = read_json(folder / "evaluate" / "metrics.json")["views"]["dusk"]
    summary = re.sub(r"<[^>]*>|data:[^\"]*", "", html.split('<section id="summary">')[1])
    first = re.search(
        r"(\d+\.\d) dB; the nearest photo laid over the mesh reaches (\S+) dB, and flat colours (\S+) dB", summary
    )
    assert [float(value) for value in first.groups()] == pytest.approx(
        [view[name] for name in ("predicted", "nearest_photo", "flat")], abs=0.05
    )
    assert first.start() < summary.index("Relit pictures are expected") and summary[: first.start()].count(" dB") == 0
    shutil.copytree(inputs["export"], tmp_path / "export")
    table = read_materials(tmp_path / "export" / "materials.json")
    halved = {
        name: msgspec.structs.replace(each, diffuse=tuple(0.5 * value for value in each.diffuse))
        for name, each in table.materials.items()
    }
    write_json(tmp_path / "export" / "materials.json", msgspec.structs.replace(table, materials=halved))
    facts = inputs.facts | {"dataset.set": inputs.facts["dataset.set"] | {"up": "a spirit level says so"}}
    page = page_of(
        msgspec.structs.replace(inputs, facts=facts, folders=inputs.folders | {"export": tmp_path / "export"}),
        tmp_path / "report",
    )
    assert "How up is known: a spirit level says so." in page and "How up is known" not in html
    for name, each in halved.items():
        shown = "  ".join(f"{value:.3f}" for value in each.diffuse)
        assert shown in page and "  ".join(f"{value:.3f}" for value in table.materials[name].diffuse) not in page


def test_the_two_numbers_of_a_held_out_photo_say_how_they_are_exposed(report_page):
    folder, _, html = report_page
    metrics = read_json(folder / "evaluate" / "metrics.json")
    tile = f"{metrics['views']['dusk']['predicted']:.1f}"
    other = f"{metrics['held_out']['mean']['none']['estimate']['psnr_tonemapped_db']:.1f}"
    table, views = (html.split(f'<h3 id="table-{key}">')[1] for key in ("held_out", "views"))
    assert f"<td>{other}</td>" in table and "PSNR here is at the white of the photo" in table.split("<table")[0]
    assert f"<td>{tile}</td>" in views and "The numbers at the top of the page" in views.split("<table")[0]


def test_the_cost_table_knows_every_stage_of_the_pipeline():
    stages = list(yaml.safe_load((LIBRARY / "pipeline.yaml").read_text())["stages"])
    assert [name for name in stages if name not in ("report", "recipes")] == STAGES


@pytest.mark.parametrize("accepted, words", [
    (True, "It has a sun, which holds 12 % of the light"),
    (False, "A sun was looked for and refused: it would hold 12 % of the light (it needs 7 %), in red over blue 0.5 times that "
            "of the rest (1), and the photos are 0.4 standard errors against it"),
])  # fmt: skip
def test_a_light_says_of_its_sun_what_was_found_or_why_it_was_refused(report_page, tmp_path, accepted, words):
    _, inputs, html = report_page
    assert "A sun was looked for" not in html and "It has a sun" not in html
    shutil.copytree(inputs["solve"], tmp_path / "solve")
    table = read_materials(tmp_path / "solve" / "materials.json")
    sun = Decision(accepted, 1.01, 1.0, -0.4, share=0.12, warmth=float(np.log(0.5)))
    model = msgspec.structs.replace(table.model, suns_chosen_by={"day": sun, "noon": Decision(False)})
    write_json(tmp_path / "solve" / "materials.json", msgspec.structs.replace(table, model=model))
    changed = msgspec.structs.replace(inputs, folders=inputs.folders | {"solve": tmp_path / "solve"})
    page = re.sub(r"\s+", " ", page_of(changed, tmp_path / "report"))
    assert page.count(words) == 1 and ("assume a <code>sun</code> in recipes" in page) != accepted
    parsed(page)


@pytest.mark.parametrize("kept", [True, False])
def test_paint_and_its_exchange_with_the_light_are_said(report_page, tmp_path, kept):
    _, inputs, _ = report_page
    by = DetailEvidence(held_out_loss_with=0.01, held_out_loss_without=0.03, margin=4.0)
    for name, content in {
        "texture": TextureTable({}, [TextureEvidence("ball", "red", True, 2, by)]),
        "exchange": Exchange(kept, 0.01, 0.005),
    }.items():
        (tmp_path / name).mkdir()
        write_json(tmp_path / name / f"{name}.json", content)
    folders = inputs.folders | {name: tmp_path / name for name in ("texture", "exchange")}
    page = page_of(msgspec.structs.replace(inputs, folders=folders), tmp_path / "report")
    assert "red on ball" in page and ("Materials and lights were then solved again" in page) == kept


def test_a_doubtful_pose_says_why_and_what_to_do(report_page, tmp_path):
    _, inputs, html = report_page
    shutil.copytree(inputs["align"], tmp_path / "align")
    poses = read_json(tmp_path / "align" / "poses.json")
    poses["noon"]["objects"]["balls"] |= {
        "label_agreement": 0.71, "score": 0.912, "runner_up": {**poses["noon"]["objects"]["balls"], "score": 0.905, "normal_difference_deg": 41.0},
        "doubts": ["mesh <and> mask differ"], "left_out": True, "source": "found",
    }  # fmt: skip
    write_json(tmp_path / "align" / "poses.json", poses)
    inputs = msgspec.structs.replace(inputs, folders=inputs.folders | {"align": tmp_path / "align"})
    doubtful = page_of(inputs, tmp_path / "report")
    parsed(doubtful)
    for words in ("mesh &lt;and&gt; mask differ", "left out of the solve", "0.905", "41° away", "is doubtful: &#39;balls&#39; in noon.", "<details open><summary><h2>Poses",):  # fmt: skip
        assert words in doubtful and words not in html, words
    assert "keypoints" in doubtful


# ── Pictures keep their mean, their outline and their file ──────────────────────────────────────────────────────────


@pytest.mark.parametrize("size", [(100, 60), (61, 97)])
def test_reducing_keeps_the_mean_and_a_constant(size):
    picture = np.random.default_rng(2).uniform(size=(*size, 3)).astype(np.float32)
    small = downsample(picture, 25)
    assert max(small.shape[:2]) == 25 and small.mean() == pytest.approx(picture.mean(), rel=1e-4)
    assert downsample(np.ones((*size, 1), np.float32), 25) == pytest.approx(np.ones((*small.shape[:2], 1)), rel=1e-5)
    assert downsample(picture, 200) is picture


def test_fits_that_did_not_converge_are_named():
    ends = {"room": FitStatus("converged", 2), "yard": FitStatus("limit", 2)}
    lines = sentences("choices.txt", model=Model(materials_fit=FitStatus("failed", 4), light_fits=ends))
    assert "The fit of the materials did not converge: no step lowered its objective." in lines
    assert "The fit of the light yard did not converge: its 2 allowed steps ended first." in lines
    assert not any("room" in line for line in lines)
