"""The page for ordinary and odd sets: whole, self-contained, the same bytes, and drawn by a browser."""

from __future__ import annotations

import base64
import json
import re
import shutil
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest

from factorlib.images.picture import read_png
from factorlib.jsonfile import read_json, write_json
from factorlib.stage import Inputs, silent
from stages import evaluate, report
from studies.measured.viewer import CHROMIUM, opened
from tests.evaluate.made_artifacts import Made, make_artifacts

CONTENTS = {
    "summary",
    "relight",
    "photos",
    "materials",
    "appearance",
    "reflectance",
    "lights",
    "errors",
    "solve",
    "poses",
    "training",
    "cost",
}
VOID = {"meta", "img", "br", "link", "input", "hr", "source"}
OURS = re.compile(r"<script( type=\"application/json\" id=\"viewer-data\")?>.*?</script>", re.DOTALL)
SVG_LEAVES = {"line", "polyline", "circle", "path", "rect"}
LOG = [
    {
        "event": "done",
        "stage": "solve",
        "photo": None,
        "seconds": 83.4,
        "cpu_seconds": 81.0,
        "memory_mb": 512.0,
        "machine": {"cores": 2},
    },
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
    scored = folder / "evaluate"
    scored.mkdir()
    evaluate.main(evaluate.Params(), inputs, scored, silent)
    (folder / "log.jsonl").write_text("\n".join(json.dumps(e) for e in log))
    inputs = msgspec.structs.replace(inputs, folders=inputs.folders | {"evaluate": scored}, log=folder / "log.jsonl")
    return inputs, page_of(inputs, folder / "report")


def page_of(inputs, out) -> str:
    out.mkdir()
    report.main(report.Params(), inputs, out, silent)
    return (out / "index.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    inputs, html = run(folder, seen={"day": ["red", "white"], "noon": ["white", "brass"], "dusk": ["red"]})
    return folder, inputs, html


def parsed(html) -> Strict:
    parser = Strict()
    parser.feed(html)
    assert parser.open == []
    return parser


def test_it_is_well_formed_and_has_every_section(made):
    found = parsed(made[2])
    assert CONTENTS <= set(found.ids) and len(set(found.ids)) == len(found.ids)
    tables = ("resynthesis", "materials", "relighting", "unobserved", "light", "normals", "poses")
    assert {f"table-{key}" for key in tables} <= set(found.ids)


def test_nothing_outside_the_file_is_asked_for(made):
    found = parsed(made[2])
    assert all(link.startswith(("data:image/png;base64,", "#")) for link in found.links)
    assert not re.search(r"url\(|@import|<script|<link|https?://", OURS.sub("", made[2]))
    assert not re.search(
        r"fetch\(|import\(|XMLHttpRequest|https?://|//cdn", "".join(m.group() for m in OURS.finditer(made[2]))
    )
    assert all(link[1:] in found.ids for link in found.links if link.startswith("#"))


def test_every_picture_decodes_and_says_what_it_is(made, tmp_path):
    found = parsed(made[2])
    pictures = [link for link in found.links if link.startswith("data:")]
    # photos × panels, materials, balls, measured and solved maps, lights × (map, darker, truth, spheres), overlays
    assert len(pictures) == 3 * 4 + 3 + 9 + 5 + 9 + 3 * 4 + 3
    for k, uri in enumerate(pictures):
        path = tmp_path / f"{k}.png"
        path.write_bytes(base64.b64decode(uri.split(",")[1], validate=True))
        assert read_png(path).size > 0
    assert all(found.alts)


def test_observed_pairs_are_ringed_and_the_others_not(made):
    balls = re.findall(r'<img class="ball([ a-z]*)" alt="(\w+) in the light of (\w+), (\w+)"', made[2])
    assert {(m, p) for css, m, p, _ in balls if "seen" in css} == {
        ("red", "day"), ("white", "day"), ("white", "noon"), ("brass", "noon"), ("red", "dusk")
    }  # fmt: skip
    assert all(("seen" in css) == (said == "observed") for css, _, _, said in balls)


def test_the_numbers_are_those_of_the_metrics(made):
    metrics = json.loads((made[0] / "evaluate" / "metrics.json").read_text())
    assert f"{metrics['resynthesis']['mean']['none']['estimate']['psnr_tonemapped_db']:.1f}" in made[2]
    assert f"{metrics['materials']['mean_roughness']:.3f}" in made[2]


def test_bins_of_the_networks_error_stand_in_order(made):
    section = made[2].split('id="training"')[1]
    order = [
        section.index(f">{name}</th>")
        for name in ("specular", "sharpness", "0.3 to 3", "3 to 30", "30 to 300", "diffuse")
    ]
    assert order == sorted(order) and "0.20 %" in section


def test_error_by_what_is_asked_and_the_training_curve_are_drawn(made):
    section = made[2].split('id="training"')[1].split('id="cost"')[0]
    plots = re.findall(r'<svg class="plot".*?</svg>', section)
    assert [set(re.findall(r'class="label"[^>]*>([^<]*)<', p)) for p in plots] == [
        {"sharpness", "relative error, %"}, {"training step", "relative error, %"}
    ]  # fmt: skip
    assert all(f">{name}</text>" in plots[0] for name in ("0.3 to 3", "3 to 30", "30 to 300"))
    assert plots[1].count("<polyline") == 4 and "diffuse, 95th percentile" in section


def test_only_the_cost_section_depends_on_the_log(made, tmp_path):
    _, inputs, html = made
    again = page_of(msgspec.structs.replace(inputs, log=None), tmp_path / "again")

    def without_cost(text):
        return re.sub(r"<!-- begin cost.*end cost -->", "", text, flags=re.DOTALL)

    assert without_cost(again) == without_cost(html) and again != html
    assert "1 min 23 s" in html and "photo &#39;day&#39; &lt;is&gt; dark" in html
    figures = [inputs.folders["evaluate"].parent / "report" / "figures", tmp_path / "again" / "figures"]
    assert [p.read_bytes() for p in sorted(figures[0].rglob("*.png"))] == [
        p.read_bytes() for p in sorted(figures[1].rglob("*.png"))
    ]


@pytest.mark.parametrize(
    "odd",
    [
        {"seen": {"only": ["red"]}, "truth": False},
        {"seen": {f"p{k:02d}": ["red"] for k in range(14)}, "truth": False},
        {"seen": {"a": ["red"], "b": ["black"]}, "clip": 0.05},
    ],
    ids=["one photo, no truth", "many photos", "unlinked, mostly clipped"],
)
def test_odd_sets_give_a_whole_page(odd, tmp_path):
    _, html = run(tmp_path, log=[], **odd)
    found = parsed(html)
    assert CONTENTS <= set(found.ids) and "None" not in re.sub(r"data:[^\"]*", "", html)
    assert ("no ground truth" in html) == (not odd.get("truth", True))
    if len(odd["seen"]) == 2:
        assert "2 groups that share no material" in html and "are clipped" in html


def test_missing_pictures_are_left_out_not_fatal(tmp_path):
    inputs, _ = run(tmp_path, seen={"day": ["red"]})
    for path in [*inputs["render"].rglob("*.exr"), *inputs["align"].glob("*.png"), *inputs["solve"].glob("*.parquet")]:
        path.unlink()
    (inputs["train"] / "accuracy.json").unlink()
    parsed(page_of(inputs, tmp_path / "plain"))


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine: the page is not looked at by a browser")
@pytest.mark.parametrize("width", [1300, 520])
def test_a_browser_draws_it(made, tmp_path, width):
    shot = tmp_path / "page.png"
    with opened(made[0] / "report" / "index.html", viewport={"width": width, "height": 2000}) as (page, complaints):
        page.screenshot(path=shot)
    assert not complaints
    pixels = read_png(shot)[..., :3].astype(int)
    background = pixels[5, 5]
    drawn = np.abs(pixels - background).max(axis=-1) > 40
    assert drawn.mean() > 0.03  # something is there
    assert not drawn[:, -4:].any()  # and nothing runs over the right edge
    assert (np.ptp(pixels, axis=-1) > 60).any()  # pictures are in colour


def test_a_doubtful_pose_says_why_and_what_to_do(made, tmp_path):
    _, inputs, html = made
    shutil.copytree(inputs["align"], tmp_path / "align")
    poses = json.loads((tmp_path / "align" / "poses.json").read_text())
    poses["noon"]["objects"]["balls"] |= {
        "label_agreement": 0.71, "score": 0.912, "runner_up": {**poses["noon"]["objects"]["balls"], "score": 0.905, "normal_difference_deg": 41.0},
        "doubts": ["mesh <and> mask differ"], "left_out": True, "source": "refined", "scale": [1.0, 1.05, 0.952],
    }  # fmt: skip
    (tmp_path / "align" / "poses.json").write_text(json.dumps(poses))
    doubtful = page_of(
        msgspec.structs.replace(inputs, folders=inputs.folders | {"align": tmp_path / "align"}), tmp_path / "report"
    )
    parsed(doubtful)
    for words in ("mesh &lt;and&gt; mask differ", "left out of the solve", "0.905", "41° away", "noon: &#39;balls&#39; is left out",
                  "pose of an earlier result, the mesh's axes times 1.000, 1.050, 0.952"):  # fmt: skip
        assert words in doubtful and words not in html, words
    assert "keypoints" in doubtful


def test_a_photo_that_was_averaged_down_says_from_what_size(tmp_path):
    inputs, whole = run(tmp_path, seen={"day": ["red", "white"]})
    assert "averaged down" not in whole
    facts = read_json(inputs["masks"] / "photos.json")
    facts["day"] |= {"factor": 4, "original_size": [8000, 6000]}
    write_json(inputs["masks"] / "photos.json", facts)
    assert "averaged down 4 × 4 from 8000 × 6000 pixels" in page_of(inputs, tmp_path / "again")
