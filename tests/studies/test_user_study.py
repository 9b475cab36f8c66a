"""The user study: a simulated viewer drives the page in a browser, and its saved files are analysed.

The viewer prefers the candidate of lower DSSIM with a stated probability, and says so in the page's address: the page marks all that it saves.
"""

import csv
import io
import json
import re
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.viewer import CHROMIUM, opened
from factorlib.errors import InputError
from factorlib.images.picture import write_png
from factorlib.jsonfile import write_json
from factorlib.runner.project import LIBRARY
from studies.steps.compare import Asked, ScoredShot
from studies.study import QUICK
from studies.user_study.__main__ import digest, trials
from studies.user_study.__main__ import html as page
from studies.user_study.analysis import Answer, Answers, analysed, csv_text, figure, paragraph, read_answers

MATERIALS = ("brick", "leaf", "gold")
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine (Debian: apt-get install chromium): no browser opens the page"
)


def png(path, colour):
    write_png(path, np.full((24, 24, 3), colour, np.uint8))


@pytest.fixture(scope="module")
def scores(tmp_path_factory):
    """As the study's step `score` writes them: ours is better in all pictures but those of gold."""
    folder = tmp_path_factory.mktemp("score")
    for number, (method, error) in enumerate({"ours": 0.05, "intrinsic": 0.2}.items()):
        home = folder / f"{method}-seed0"
        home.mkdir()
        shots = []
        for k, material in enumerate(MATERIALS):
            for kind in ("novel_view", "novel_light", "novel_material"):
                asked = Asked(kind, material, k, "front", 0)
                shots.append(ScoredShot(asked, 0.4 if material == "gold" and method == "ours" else error))
                png(home / f"{asked.name}.png", 40 * k + 10 + 20 * number)
                png(home / f"{asked.name}-truth.png", 40 * k + 5)
        write_json(home / "shots.json", shots)
    return folder


@pytest.fixture(scope="module")
def html(scores, tmp_path_factory):
    file = tmp_path_factory.mktemp("page") / "index.html"
    file.write_text(page(trials(scores, QUICK, 40)))
    return file


# ── the page ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_questions_are_of_new_views_and_new_light_and_spread_evenly(scores):
    every = trials(scores, QUICK, 40)
    assert len(every) == 6 and not any("novel_material" in t.name for t in every)
    few = trials(scores, QUICK, 3)
    assert [t.name.split("-")[1] for t in few] == list(MATERIALS) and digest(few) != digest(every)


def test_the_page_stands_alone_and_names_no_method_to_the_eye(html):
    text = html.read_text()
    assert "http" not in text and text.count("<script") == 2
    visible = re.sub(r"<(script|style).*?</\1>", "", text, flags=re.DOTALL)
    assert not re.search("ours|intrinsic|solve", visible)


def viewed(html, folder, probability, seed):
    """Saved files of a simulated viewer who prefers the lower DSSIM with that probability."""
    rng = np.random.default_rng(seed)
    words = f"prefers the lower DSSIM with probability {probability:g}"
    with opened(html) as (browser, complaints):
        browser.goto(f"{html.as_uri()}#simulated={words.replace(' ', '%20')}")
        browser.reload()
        assert browser.inner_text("#simulated") == f"simulated: {words}"
        browser.click("#begin")
        pictures = {p["ours"]: p["dssim"][0] for p in browser.evaluate("data.pictures")}
        pictures |= {p["other"]: p["dssim"][1] for p in browser.evaluate("data.pictures")}
        for k in range(browser.evaluate("data.pictures.length")):
            browser.wait_for_function(f"ready && results.answers.length === {k}")
            left, right = (pictures[browser.get_attribute(f"#{side} img", "src")] for side in ("left", "right"))
            side = "left" if (left < right) == (rng.random() < probability) else "right"
            if k % 2:
                browser.click(f"#{side}")
            else:
                browser.keyboard.press(f"Arrow{side.capitalize()}")
        browser.wait_for_selector("#end:not([hidden])")
        saved = [save(browser, f"#{kind}", folder) for kind in ("json", "csv")]
        assert [c for c in complaints if not c.startswith("blob:")] == []
    return saved


def save(browser, button, folder):
    with browser.expect_download() as waiting:
        browser.click(button)
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return path


@needs_chromium
def test_a_simulated_viewer_answers_and_is_marked_as_one(html, tmp_path):
    file, table = viewed(html, tmp_path, 1.0, 0)
    (answers,) = read_answers([file])
    assert (
        answers.simulated == "prefers the lower DSSIM with probability 1" and len(answers.answers) == answers.asked == 6
    )
    assert all(a.for_ours == ("gold" not in a.picture) for a in answers.answers)
    rows = list(csv.DictReader(table.open()))
    assert [(r["picture"], r["ours"], r["chosen"]) for r in rows] == [
        (a.picture, a.ours, a.chosen) for a in answers.answers
    ]
    assert {r["simulated"] for r in rows} == {answers.simulated} and {r["participant"] for r in rows} == {
        answers.participant
    }


@needs_chromium
def test_a_browser_that_a_program_drives_is_marked_even_where_it_says_nothing(html):
    with opened(html) as (browser, _):
        assert browser.evaluate("results.simulated") == "a program drives the browser" and browser.is_visible(
            "#simulated"
        )


@needs_chromium
def test_a_phone_needs_no_scrolling_sideways(html):
    with opened(html, viewport={"width": 360, "height": 740}) as (browser, complaints):
        browser.click("#begin")
        browser.wait_for_function("ready")
        assert browser.evaluate("document.documentElement.scrollWidth") <= 360 and complaints == []
        assert all(browser.locator(f"#{side}").bounding_box()["x"] >= 0 for side in ("left", "right"))


@needs_chromium
def test_order_and_sides_are_the_seeds_and_sides_are_fair(html):
    with opened(html) as (browser, _):
        script = "(seed) => drawn(data.pictures, seed).map((q) => [q.picture.name, q.ours])"
        first, again, others = (
            browser.evaluate(script, 7),
            browser.evaluate(script, 7),
            [browser.evaluate(script, s) for s in range(300)],
        )
        assert first == again and sorted(name for name, _ in first) == sorted(
            p["name"] for p in browser.evaluate("data.pictures")
        )
        left = np.mean([side == "left" for drawn in others for _, side in drawn])
        assert left == pytest.approx(0.5, abs=0.05) and len({name for drawn in others for name, _ in drawn[:1]}) == 6


@needs_chromium
def test_keys_before_the_first_question_and_their_repeats_answer_nothing(html):
    with opened(html) as (browser, _):
        browser.keyboard.press("ArrowLeft")
        browser.click("#begin")
        browser.wait_for_function("ready")
        browser.keyboard.down("ArrowLeft")
        browser.wait_for_function("ready && results.answers.length === 1")
        browser.keyboard.down("ArrowLeft")  # without up: a repeat
        browser.wait_for_timeout(200)
        assert browser.evaluate("results.answers.length") == 1


# ── the analysis ─────────────────────────────────────────────────────────────────────────────────────────────────────


def participant(number, preferred, simulated="", **changes):
    """A person who chose ours in the pictures of `preferred`, of four."""
    given = [Answer(f"p{k}", "left", "left" if k in preferred else "right", 900.0) for k in range(4)]
    fields = {
        "page": "0" * 16,
        "participant": f"{number:016x}",
        "seed": number,
        "simulated": simulated,
        "asked": 4,
        "answers": given,
    }
    return Answers(format=1, **fields | changes)


def written(folder, *found):
    files = [folder / f"{k}.json" for k in range(len(found))]
    for file, answers in zip(files, found, strict=True):
        write_json(file, answers)
    return files


def test_shares_and_standard_errors():
    """Shares of three people: 1, 1/2, 3/4; s = 1/4."""
    found = analysed([participant(0, {0, 1, 2, 3}), participant(1, {0, 1}), participant(2, {0, 1, 2})])
    assert found.overall.share == pytest.approx(0.75) and found.overall.error == pytest.approx(0.25 / 3**0.5)
    assert [s.share for s in found.pictures] == pytest.approx([1, 1, 2 / 3, 1 / 3])
    assert found.pictures[2].error == pytest.approx((2 / 9 / 3) ** 0.5) and found.overall.for_ours == 9


def test_the_papers_own_numbers_come_out():
    """One answer each of 250 people, 86.5 % for ours: a standard error of 2.1 or 2.2 %."""
    people = [
        participant(
            k, {0} if k < 216 else set(), answers=[Answer("p0", "left", "left" if k < 216 else "right", 1.0)], asked=1
        )
        for k in range(250)
    ]
    found = analysed(people)
    assert 100 * found.overall.share == pytest.approx(86.4) and 2.1 < 100 * found.overall.error < 2.2
    assert "No difference is shown" in paragraph(found) and "250 participants" in paragraph(found)


def test_one_person_has_no_standard_error():
    found = analysed([participant(0, {0})])
    assert found.overall.error is None and "no conclusion" in paragraph(found)


def test_simulated_answers_stay_marked_in_all_that_is_made_of_them():
    found = analysed([participant(k, {0, 1}, simulated="a coin") for k in range(3)])
    assert all(row["simulated"] == "a coin" for row in csv.DictReader(io.StringIO(csv_text(found))))
    assert (
        "simulated: a coin" in figure(found)
        and paragraph(found).startswith("**simulated: a coin**")
        and "250" not in paragraph(found)
    )


MALFORMED = {
    "no JSON": ("{", "not a file of answers"),
    "another file": ('{"a": 1}', "not a file of answers"),
    "a list": ("[]", "not a file of answers"),
}


@pytest.mark.parametrize("content, said", MALFORMED.values(), ids=list(MALFORMED))
def test_what_is_no_file_of_answers_is_said(tmp_path, content, said):
    (file := tmp_path / "a.json").write_text(content)
    with pytest.raises(InputError, match=said) as caught:
        read_answers([file])
    assert caught.value.file == file and caught.value.cure


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"format": 2}, "format 2"),
        ({"answers": []}, "0 answers to 4 questions"),
        ({"answers": [{"picture": "p0", "ours": "left", "chosen": "up", "milliseconds": 1}]}, "Invalid enum value 'up'"),
        ({"answers": [{"picture": "p0", "ours": "left", "chosen": "left", "milliseconds": 1}] * 4}, "two answers to 'p0'"),
        ({"participant": "me"}, "participant"),
        ({"extra": 1}, "unknown field `extra`"),
    ],
)  # fmt: skip
def test_a_changed_file_is_said(tmp_path, changes, said):
    (file,) = written(tmp_path, participant(0, {0}))
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    with pytest.raises(InputError, match=re.escape(said)):
        read_answers([file])


@pytest.mark.parametrize(
    "second, said",
    [
        (participant(0, {1}), "the same participant"),
        (participant(1, {1}, page="1" * 16), "other pictures"),
        (participant(1, {1}, simulated="a coin"), "who answered differs"),
    ],
)
def test_files_that_do_not_belong_together_are_said(tmp_path, second, said):
    with pytest.raises(InputError, match=said):
        read_answers(written(tmp_path, participant(0, {0}), second))


def command(*words):
    return subprocess.run(
        [sys.executable, "-m", "studies.user_study", *words], cwd=LIBRARY, capture_output=True, text=True, check=False
    )


def test_the_analysis_is_a_command(tmp_path):
    files = written(tmp_path, *(participant(k, {0, 1, 2}, simulated="a coin") for k in range(3)))
    done = command("analyse", *map(str, files), "--out", str(tmp_path / "out"))
    assert done.returncode == 0 and "75.0 %" in done.stdout and "simulated: a coin" in done.stdout, done.stderr
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "shares.csv",
        "analysis.json",
        "figure.svg",
        "paragraph.md",
    }
    wrong = command("analyse", str(tmp_path / "none.json"))
    assert wrong.returncode == 1 and "none.json" in wrong.stderr and "Traceback" not in wrong.stderr
