"""The user study: a simulated viewer drives the page in a browser, and its saved files are analysed.

The viewer prefers the candidate of lower DSSIM, and says so in the page's address: the page marks all that it saves.
"""

import csv
import io
import json
import re
import subprocess
import sys

import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.images.picture import write_png
from factorlib.jsonfile import write_json
from factorlib.runner.project import LIBRARY
from studies.measured.viewer import CHROMIUM, opened
from studies.steps.compare import Shot
from studies.study import QUICK
from studies.user_study.__main__ import digest, trials
from studies.user_study.__main__ import html as html_of
from studies.user_study.analysis import Answer, Answers, analysed, csv_text, figure, paragraph, read_answers

MATERIALS = ("brick", "leaf", "gold")
WORDS = "prefers the lower DSSIM"
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine (Debian: apt-get install chromium): no browser opens the page"
)


@pytest.fixture(scope="module")
def scores(tmp_path_factory):
    """As the comparison's last step writes them: ours is better in all pictures but those of gold."""
    folder = tmp_path_factory.mktemp("compare")
    for number, (method, error) in enumerate({"ours": 0.05, "intrinsic": 0.2}.items()):
        (home := folder / f"{method}-seed0").mkdir()
        kinds = ("novel_view", "novel_light", "novel_material")
        shots = [Shot(kind, m, k, "front") for k, m in enumerate(MATERIALS) for kind in kinds]
        for of in shots:
            for suffix, colour in {"": 40 * of.light + 10 + 20 * number, "-truth": 40 * of.light + 5}.items():
                write_png(home / f"{of.name}{suffix}.png", np.full((24, 24, 3), colour, np.uint8))
        scored = [(of, 0.4 if (of.material, method) == ("gold", "ours") else error) for of in shots]
        write_json(home / "shots.json", scored)
    return folder


@pytest.fixture(scope="module")
def html(scores, tmp_path_factory):
    file = tmp_path_factory.mktemp("page") / "index.html"
    file.write_text(html_of(trials(scores, QUICK, 40)))
    return file


# ── the page ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_questions_are_of_new_views_and_new_light_and_spread_evenly(scores):
    every, few = trials(scores, QUICK, 40), trials(scores, QUICK, 3)
    assert len(every) == 6 and not any("novel_material" in t.name for t in every)
    assert [t.name.split("-")[1] for t in few] == list(MATERIALS) and digest(few) != digest(every)


def test_the_page_stands_alone_and_names_no_method_to_the_eye(html):
    text = html.read_text()
    assert "http" not in text and text.count("<script") == 2
    visible = re.sub(r"<(script|style).*?</\1>", "", text, flags=re.DOTALL)
    assert not re.search("ours|intrinsic|solve", visible)


def save(browser, button, folder):
    with browser.expect_download() as waiting:
        browser.click(button)
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return path


@needs_chromium
def test_a_simulated_viewer_answers_and_is_marked_as_one(html, tmp_path):
    with opened(html) as (browser, complaints):
        browser.goto(f"{html.as_uri()}#simulated={WORDS.replace(' ', '%20')}")
        browser.reload()
        assert browser.inner_text("#simulated") == f"simulated: {WORDS}"
        browser.click("#begin")
        pictures = {
            p[side]: p["dssim"][k]
            for p in browser.evaluate("data.pictures")
            for k, side in enumerate(("ours", "other"))
        }
        for k in range(browser.evaluate("data.pictures.length")):
            browser.wait_for_function(f"ready && results.answers.length === {k}")
            left, right = (pictures[browser.get_attribute(f"#{side} img", "src")] for side in ("left", "right"))
            side = "left" if left < right else "right"
            browser.click(f"#{side}") if k % 2 else browser.keyboard.press(f"Arrow{side.capitalize()}")
        browser.wait_for_selector("#end:not([hidden])")
        file, table = (save(browser, f"#{kind}", tmp_path) for kind in ("json", "csv"))
        assert [c for c in complaints if not c.startswith("blob:")] == []
    (answers,) = read_answers([file])
    assert answers.simulated == WORDS and len(answers.answers) == answers.asked == 6
    assert all(a.for_ours == ("gold" not in a.picture) for a in answers.answers)
    rows = list(csv.DictReader(table.open()))
    assert [(r["picture"], r["ours"], r["chosen"]) for r in rows] == [
        (a.picture, a.ours, a.chosen) for a in answers.answers
    ]
    assert {(r["simulated"], r["participant"]) for r in rows} == {(WORDS, answers.participant)}


@needs_chromium
def test_order_and_sides_are_the_seeds_and_sides_are_fair(html):
    with opened(html) as (browser, _):
        script = "(seed) => drawn(data.pictures, seed).map((q) => [q.picture.name, q.ours])"
        first, again, *others = (browser.evaluate(script, seed) for seed in (7, 7, *range(300)))
        names = sorted(p["name"] for p in browser.evaluate("data.pictures"))
        assert first == again and sorted(name for name, _ in first) == names
        left = np.mean([side == "left" for drawn in others for _, side in drawn])
        assert left == pytest.approx(0.5, abs=0.05) and len({drawn[0][0] for drawn in others}) == 6


# ── the analysis ─────────────────────────────────────────────────────────────────────────────────────────────────────


def participant(number, preferred, **changes):
    """A person who chose ours in the pictures of `preferred`, of four."""
    given = [Answer(f"p{k}", "left", "left" if k in preferred else "right", 900.0) for k in range(4)]
    fields = {"page": "0" * 16, "participant": f"{number:016x}", "simulated": "", "asked": 4, "answers": given}
    return Answers(format=1, seed=number, **fields | changes)


def written(folder, *people):
    files = [folder / f"{k}.json" for k in range(len(people))]
    for file, answers in zip(files, people, strict=True):
        write_json(file, answers)
    return files


def test_shares_and_standard_errors():
    """Shares of three people: 1, 1/2, 3/4; s = 1/4."""
    of = analysed([participant(0, {0, 1, 2, 3}), participant(1, {0, 1}), participant(2, {0, 1, 2})])
    assert of.overall.share == pytest.approx(0.75) and of.overall.error == pytest.approx(0.25 / 3**0.5)
    assert [s.share for s in of.pictures] == pytest.approx([1, 1, 2 / 3, 1 / 3])
    assert of.pictures[2].error == pytest.approx((2 / 9 / 3) ** 0.5) and of.overall.for_ours == 9
    alone = analysed([participant(0, {0})])
    assert alone.overall.error is None and "no conclusion" in paragraph(alone)


def test_simulated_answers_stay_marked_in_all_that_is_made_of_them():
    of = analysed([participant(k, {0, 1}, simulated="a coin") for k in range(3)])
    assert all(row["simulated"] == "a coin" for row in csv.DictReader(io.StringIO(csv_text(of))))
    assert "simulated: a coin" in figure(of) and "250" not in paragraph(of)
    assert paragraph(of).startswith("**simulated: a coin**")


ANSWER = {"picture": "p0", "ours": "left", "chosen": "left", "milliseconds": 1}


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"format": 2}, "format 2"),
        ({"answers": []}, "0 answers to 4 questions"),
        ({"answers": [ANSWER | {"chosen": "up"}]}, "Invalid enum value 'up'"),
        ({"answers": [ANSWER] * 4}, "two answers to one picture"),
        ({"extra": 1}, "not a file of answers"),
    ],
)
def test_a_changed_file_is_said(tmp_path, changes, said):
    (file,) = written(tmp_path, participant(0, {0}))
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        read_answers([file])
    assert caught.value.file == file and caught.value.cure


def test_the_analysis_is_a_command(tmp_path):
    files = written(tmp_path, *(participant(k, {0, 1, 2}, simulated="a coin") for k in range(3)))
    line = [sys.executable, "-m", "studies.user_study", "analyse"]
    for names, code, said in ((files, 0, "75.0 %"), ([tmp_path / "none.json"], 1, "none.json")):
        words = [*line, *map(str, names), "--out", str(tmp_path / "out")]
        done = subprocess.run(words, cwd=LIBRARY, capture_output=True, text=True, check=False)
        assert done.returncode == code and said in done.stdout + done.stderr and "Traceback" not in done.stderr
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"shares.csv", "figure.svg", "paragraph.md"}
