"""A data set that means harm reads and writes nothing outside its folder, runs no code and forges no report.

With `test_damaged_files` these are the promises of docs/security.md; what is given to make is in `test_commands`.
"""

from __future__ import annotations

import json
import os
import re

import msgspec
import pytest
import torch
import yaml
from PIL import Image

from factorlib.checkpoint import Checkpoint
from factorlib.dataset.read import read_dataset
from factorlib.errors import InputError
from factorlib.recipe.read import read_recipe
from factorlib.runner import verbs
from factorlib.runner.dataset_state import survey
from factorlib.runner.project import LIBRARY, Project, photo_sets
from factorlib.validation import Validation
from tests.faults.battered import call
from tests.faults.good import DATASET, TRUTH, edited, make_set, put
from tests.report.test_page import page_of, run

EVIL_HTML = "<script>alert(1)</script><img src=x onerror=alert(2)>"
EVIL_ANSI = "\x1b]0;owned\x07\x1b[2J\x1b[31mall is well\r\u202e"
CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
PATHS = {  # every path that dataset.yaml and truth.yaml may hold, and the suffix it has
    ("photos", 0, "image"): ".png", ("photos", 1, "masks"): ".png", ("photos", 0, "masks", "red"): ".png",
    ("photos", 0, "objects", 0, "mask"): ".png", ("meshes", "vase", "file"): ".ply", ("truth",): ".yaml",
    ("cameras", "colmap"): "", ("cameras", "transforms"): ".json", ("cameras", "bop"): "",
    ("illumination", "hall"): ".exr", ("normals", "room"): ".exr",
}  # fmt: skip


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """The good data set, and beside it a secret, links to it, and what leads nowhere."""
    folder = make_set(tmp_path_factory.mktemp("outside") / "set")
    (folder / "circle").symlink_to("circle")
    (folder.parent / "secret").mkdir()
    for suffix in {*PATHS.values()}:
        if suffix:
            put(folder.parent / f"secret{suffix}", "secret")
            os.mkfifo(folder / f"pipe{suffix}")
        for link in (
            f"link{suffix}",
            f"m/link{suffix}",
        ):  # in m/ the mesh lies, so that its folder was followed already
            (folder / link).symlink_to(folder.parent / f"secret{suffix}")
        (folder / f"twice{suffix}").symlink_to(f"link{suffix}")
    (folder / "up").symlink_to(folder.parent)
    return folder


def refused(folder, spec=DATASET, truth=TRUTH) -> InputError:
    put(folder / "dataset.yaml", yaml.safe_dump(spec))
    put(folder / "truth.yaml", yaml.safe_dump(truth))
    with pytest.raises(InputError) as caught:
        read_dataset(folder)
    assert caught.value.cure and caught.value.file and len(str(caught.value)) < 1000
    return caught.value


# ── it reads nothing outside itself, and nothing that never ends ─────────────────────────────────────────────────────

OUT, NOWHERE = "outside the dataset", "no path that can be followed"
WAYS = {
    "../secret{}": OUT, "m/../../secret{}": OUT, "{folder}/../secret{}": OUT, "link{}": OUT, "m/link{}": OUT, "twice{}": OUT,
    "up/secret{}": OUT, "circle/a{}": NOWHERE, "x\0y{}": NOWHERE, "é" * 200 + "{}": NOWHERE,
    "z/" * 4000 + "{}": NOWHERE, "pipe{}": "is a pipe, not a file|there is no folder|no folder",
}  # fmt: skip


def test_no_path_leads_out_or_nowhere(good):
    """Above, absolute, by a link, a link to a link or a folder that is one; in circles, or longer than names may be."""
    for place, (way, words) in ((place, each) for place in PATHS for each in WAYS.items()):
        path = way.format(PATHS[place], folder=good)
        if place[0] not in TRUTH:
            error = refused(good, edited(DATASET, *place, value=path))
            assert error.key == ".".join(map(str, place)).replace(".0", "[0]").replace(".1", "[1]")
        elif words == OUT:  # what is not there of a truth is a warning
            error = refused(good, truth=edited(TRUTH, *place, value=path))
        else:
            continue
        assert re.search(words, error.found), (place, way, error)


def test_a_given_folder_and_a_recipe_open_no_pipe_and_no_device(tmp_path):
    dataset = read_dataset(make_set(tmp_path / "set"))
    for kind in ("pipe", "device"):
        given = tmp_path / kind
        given.mkdir()
        for name in ("poses.json", "odd.obj", "odd.hdr", "odd.json"):
            os.mkfifo(given / name) if kind == "pipe" else (given / name).symlink_to("/dev/zero")
        with pytest.raises(InputError, match=f"is a {kind}"):
            survey(Project(LIBRARY, photo_sets()), "synthetic", ["align"], [f"align.poses={given}"])
        for text in ("mesh: odd.obj\nkind: insert", "kind: relight\nlights: [odd.hdr]"):
            with pytest.raises(InputError, match="there is no file"):
                read_recipe(put(given / "own.yaml", text), dataset)


# ── it writes nothing outside build/ ─────────────────────────────────────────────────────────────────────────────────

NAMES = [
    "../up", "a/b", ".", "", "a\0b", "a b", "~", "$(touch x)", "é", "a\n", "CON:", EVIL_HTML, "\x1b[31m", "n" * 101,
]  # fmt: skip
NAMED = [("photos", 0, "name"), ("photos", 0, "illumination"), ("photos", 0, "objects", 0, "name"), ("materials", 0)]


def test_names_that_become_names_of_files_are_plain_words_of_100_characters(good):
    for place, name in ((place, name) for place in NAMED for name in NAMES):
        error = refused(good, edited(DATASET, *place, value=name))
        assert error.key and not CONTROL.search(str(error).replace("\n", "")), (place, name)


def test_a_run_writes_nothing_but_results(linked, tmp_path):
    """Of the stage that reads what a stranger sends, over a data set whose folder has an odd name."""
    odd = make_set(tmp_path / "it's $(touch pwned) <b>&amp; `touch pwned`")
    before = {path: path.lstat().st_mtime_ns for path in (*tmp_path.rglob("*"), *linked.root.iterdir())}
    assert verbs.make(linked, verbs.Wish(str(odd), ["masks"])) == 0
    after = {path: path.lstat().st_mtime_ns for path in (*tmp_path.rglob("*"), *linked.root.iterdir())}
    assert {path: at for path, at in after.items() if path != linked.build} == before
    assert (linked.build / odd.name / "masks" / "photos.json").exists()


# ── it runs no code ──────────────────────────────────────────────────────────────────────────────────────────────────


class Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_a_checkpoint_and_text_in_a_photo_are_never_run(tmp_path, caplog):
    torch.save({"a": Bomb(tmp_path / "pwned")}, tmp_path / "a.pt")
    assert Checkpoint(tmp_path / "a.pt").load() is None and "cannot be read" in caplog.text
    folder, exif = make_set(tmp_path / "set"), Image.Exif()
    for tag in (0x010E, 0x010F, 0x0110, 0x013B, 0x8298):
        exif[tag] = f"$(touch {tmp_path}/pwned) `touch {tmp_path}/pwned` {EVIL_HTML} {EVIL_ANSI}"
    Image.new("RGB", (16, 12), (90, 80, 70)).save(folder / "7.png", exif=exif)
    assert Validation(read_dataset(folder)).faults("photo", "hall", {}, folder) == []
    assert not (tmp_path / "pwned").exists()


# ── it forges no report ──────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("verb, of", [("validate", "name"), ("masks", "name"), ("validate", "key")])
def test_no_name_of_a_file_and_no_key_moves_the_cursor_or_sets_a_colour(linked, tmp_path, capfd, verb, of):
    folder = make_set(tmp_path / "set")
    put(folder / f"x{EVIL_ANSI}.png", "none")
    key, value = ("image", f"x{EVIL_ANSI}.png") if of == "name" else (f"key{EVIL_ANSI}", EVIL_ANSI)
    put(folder / "dataset.yaml", yaml.safe_dump(edited(DATASET, "photos", 0, key, value=value)))
    last = call(linked, verb, "--dataset", str(folder))
    text = f"{last}{''.join(capfd.readouterr())}"
    assert not CONTROL.search(text) and "Traceback" not in text and "\\x1b[31mall is well" in text


def test_names_and_warnings_are_text_in_the_report(tmp_path):
    text = f"{EVIL_HTML}{EVIL_ANSI}.jpg: its colour profile is {EVIL_HTML!r}"
    inputs, usual = run(tmp_path, log=[], seen={"day": ["red"], "noon": ["red"]})
    facts = {**inputs.facts, "dataset.set": {**inputs.facts["dataset.set"], "name": EVIL_HTML}}
    put(tmp_path / "log.jsonl", json.dumps({"event": "warning", "stage": "masks", "photo": "day", "text": text}))
    page = page_of(msgspec.structs.replace(inputs, facts=facts), tmp_path / "evil")
    assert "<script>alert" not in page and "<img src=x" not in page and page.count("&lt;script&gt;alert(1)") >= 3
    assert page.count("<script") == usual.count("<script")
