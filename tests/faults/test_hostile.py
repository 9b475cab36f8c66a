"""A data set that means harm: it reads and writes nothing outside itself, runs no code, fills no memory, forges no report.

The promises of docs/security.md that no other module of this folder tests.  Each tries the thing itself.
"""

from __future__ import annotations

import ast
import copy
import json
import os
import re
import struct
import subprocess
import sys
import time

import msgspec
import numpy as np
import pytest
import torch
import yaml
from faults.test_validate import make_set
from PIL import Image

from factorlib.checkpoint import Checkpoint
from factorlib.errors import InputError
from factorlib.images.exr import write_exr, write_rgb_exr
from factorlib.recipe.read import read_recipe
from factorlib.runner import verbs
from factorlib.runner.display import printable
from factorlib.runner.project import LIBRARY, Project, photo_sets
from factorlib.runner.survey import survey
from factorlib.validation import Validation
from factorlib.yamlfile import load_yaml
from tests.report.test_page import page_of, run

EVIL_HTML = "<script>alert(1)</script><img src=x onerror=alert(2)>"
EVIL_ANSI = "\x1b]0;owned\x07\x1b[2J\x1b[31mall is well\r\u202e"
CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
RUNS = ["!!python/object/apply:os.system ['touch {0}']", "!!python/object/new:os.system ['touch {0}']", "!!python/name:os.system", "!!python/module:os", "!code 'import os'"]
PLACES = {
    "image": ("photos", 0, "image"), "masks": ("photos", 0, "masks"), "masks of a material": ("photos", 0, "masks", "red"),
    "mask of an object": ("photos", 0, "objects", 0, "mask"), "mesh": ("meshes", "solid", "file"), "truth": ("truth",),
    "colmap": ("cameras", "colmap"), "transforms": ("cameras", "transforms"), "bop": ("cameras", "bop"),
}  # fmt: skip
SUFFIX = {"mesh": ".obj", "truth": ".yaml", "transforms": ".json", "colmap": "", "bop": ""}
OF_TRUTH = {"light": ("illumination", "p0"), "normals": ("normals", "p0")}
WAYS = ("above", "above and back", "absolute", "a link to a file", "a link to a folder", "a link to a link")


@pytest.fixture
def folder(tmp_path):
    """A good data set, and beside it a secret."""
    (tmp_path / "outside").mkdir()
    return make_set(tmp_path / "set")


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """This project with a build/ of its own."""
    root = tmp_path_factory.mktemp("project")
    for name in ("pipeline.yaml", "stages", "factorlib", "recipes"):
        (root / name).symlink_to(LIBRARY / name)
    (root / "data").mkdir()
    return Project(root, photo_sets())


def edit(folder, place, value, file="dataset.yaml"):
    spec = yaml.safe_load((folder / file).read_text()) if (folder / file).exists() else {}
    at = spec
    for step in place[:-1]:
        at[step] = at[step] if isinstance(at, list) or isinstance(at.get(step), dict | list) else {}
        at = at[step]
    at[place[-1]] = value
    (folder / file).write_text(yaml.safe_dump(spec))


def led_out(folder, way, suffix):
    """A path that leads to a secret beside the data set."""
    secret = folder.parent / "outside" / f"secret{suffix}"
    secret.write_text("secret") if suffix else secret.mkdir()
    for link, target in (("file", secret), ("folder", secret.parent), ("twice", folder / f"file{suffix}")):
        (folder / f"{link}{suffix if link != 'folder' else ''}").symlink_to(target)
    return {
        "above": f"../outside/secret{suffix}", "above and back": f"meshes/../../outside/secret{suffix}", "absolute": str(secret),
        "a link to a file": f"file{suffix}", "a link to a folder": f"folder/secret{suffix}", "a link to a link": f"twice{suffix}",
    }[way]  # fmt: skip


def refused(folder):
    with pytest.raises(InputError) as caught:
        photo_sets().read(folder)
    assert "outside the dataset" in caught.value.found and caught.value.cure, caught.value
    return caught.value


# ── it reads nothing outside itself ──────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("place", PLACES)
def test_no_path_of_dataset_yaml_leads_out(folder, place, way):
    edit(folder, PLACES[place], led_out(folder, way, SUFFIX.get(place, ".png")))
    refused(folder)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("place", OF_TRUTH)
def test_no_path_of_a_truth_leads_out(folder, place, way):
    edit(folder, ("truth",), "truth.yaml")
    edit(folder, OF_TRUTH[place], led_out(folder, way, ".exr"), "truth.yaml")
    refused(folder)


def test_a_dataset_yaml_that_is_a_link_out_is_refused(folder):
    (folder / "dataset.yaml").rename(folder.parent / "outside" / "dataset.yaml")
    (folder / "dataset.yaml").symlink_to(folder.parent / "outside" / "dataset.yaml")
    refused(folder)
    (folder / "dataset.yaml").unlink()
    (folder / "dataset.yaml").symlink_to("/etc/passwd")
    assert "root:" not in str(refused(folder))


def test_a_link_within_the_dataset_is_no_way_out(folder):
    (folder / "again.jpg").symlink_to(folder / "p0.jpg")
    edit(folder, PLACES["image"], "again.jpg")
    assert photo_sets().read(folder).photos == ["p0", "p1"]


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_a_given_folder_with_a_pipe_or_a_device_does_not_hang(tmp_path, kind):
    os.mkfifo(tmp_path / "poses.json") if kind == "pipe" else (tmp_path / "poses.json").symlink_to("/dev/zero")
    with pytest.raises(InputError, match=f"is a {kind}"):
        survey(Project(LIBRARY, photo_sets()), "synthetic", ["align"], [f"align.poses={tmp_path}"])


@pytest.mark.parametrize("field", ["mesh: {0}.obj\nkind: insert", "kind: relight\nlights: [{0}.hdr]", "kind: transfer\nmaterials: {{red: oak}}\ntable: {0}.json"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_a_recipe_opens_no_pipe_and_no_device(folder, field, kind):
    for suffix in (".obj", ".hdr", ".json"):
        path = folder / f"odd{suffix}"
        os.mkfifo(path) if kind == "pipe" else path.mkdir() if kind == "folder" else path.symlink_to("/dev/zero")
    (folder / "own.yaml").write_text(field.format("odd"))
    from factorlib.dataset.read import read_dataset

    with pytest.raises(InputError, match="there is no file"):
        read_recipe(folder / "own.yaml", read_dataset(folder))


# ── it writes nothing outside build/ ─────────────────────────────────────────────────────────────────────────────────

NAMES = ["../up", "/up", "a/b", ".", "..", "", "a\0b", "a b", "~", "$(touch x)", "é", "a\n", "CON:", EVIL_HTML, "\x1b[31m"]
NAMED = {
    "photo": ("photos", 0, "name"), "illumination": ("photos", 0, "illumination"), "object": ("photos", 0, "objects", 0, "name"), "material": ("materials", 0),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("place", NAMED)
def test_names_that_become_names_of_files_are_plain_words(folder, place, name):
    edit(folder, NAMED[place], name)
    with pytest.raises(InputError) as caught:
        photo_sets().read(folder)
    assert caught.value.key and not CONTROL.search(str(caught.value).replace("\n", ""))


def test_a_mesh_is_called_by_a_plain_word(folder):
    spec = yaml.safe_load((folder / "dataset.yaml").read_text())
    for name in NAMES:
        changed = copy.deepcopy(spec)
        changed["meshes"][name] = changed["meshes"].pop("solid")
        changed["photos"][0]["objects"][0]["mesh"] = name
        (folder / "dataset.yaml").write_text(yaml.safe_dump(changed))
        with pytest.raises(InputError):
            photo_sets().read(folder)


def test_a_run_writes_nothing_but_results(project, folder):
    """Of the stage that reads what a stranger sends, over a data set whose folder has an odd name."""
    odd = folder.rename(folder.parent / "it's $(touch pwned) <b>&amp; `touch pwned`")
    before = {path: path.lstat().st_mtime_ns for path in odd.parent.rglob("*")}
    assert verbs.make(project, verbs.Wish(str(odd), ["masks"])) == 0
    assert {path: path.lstat().st_mtime_ns for path in odd.parent.rglob("*")} == before
    assert (project.build / odd.name / "masks" / "photos.json").exists()
    assert sorted(path.name for path in project.root.iterdir()) == ["build", "data", "factorlib", "pipeline.yaml", "recipes", "stages"]


# ── it runs no code ──────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("text", RUNS)
@pytest.mark.parametrize("file", ["dataset.yaml", "truth.yaml", "recipe.yaml"])
def test_no_tag_of_yaml_runs(folder, tmp_path, file, text):
    pwned = tmp_path / "pwned"
    (folder / file).write_text(f"format: 1\nkind: view\nmaterials: {text.format(pwned)}\n")
    with pytest.raises(InputError):
        load_yaml(folder / file)
    assert not pwned.exists()


FORBIDDEN = {"eval", "exec", "compile", "__import__", "system", "popen", "spawnl", "execv", "unsafe_load", "full_load", "load_all"}
ALLOWED = {"re.compile", "torch.compile", "platform.system"}
MODULES = {"pickle", "marshal", "shelve", "dill", "joblib", "cloudpickle"}
EXCEPTIONS = {
    "factorlib/checkpoint.py": {"pickle"},  # names the exception of what refuses to run code; torch.load is below
    "factorlib/parcel.py": {"pickle", "cloudpickle"},  # what the processes of one run send each other over a cluster, never a file of a data set
}


def test_the_source_calls_nothing_that_runs_what_it_reads():
    found = []
    for path in (p for part in ("factorlib", "stages") for p in (LIBRARY / part).rglob("*.py")):
        name = str(path.relative_to(LIBRARY))
        for node in ast.walk(ast.parse(path.read_text())):
            found += [f"{name}: {what}" for what in _dangers(node) if what not in EXCEPTIONS.get(name, ())]
    assert not found


def _dangers(node):
    if isinstance(node, ast.Import | ast.ImportFrom):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
        return [name for name in names if name.partition(".")[0] in MODULES]
    if not isinstance(node, ast.Call):
        return []
    text, words = ast.unparse(node.func), {word.arg: ast.unparse(word.value) for word in node.keywords}
    bare = text.rpartition(".")[2]
    danger = bare in FORBIDDEN and text not in ALLOWED
    danger |= text == "torch.load" and words.get("weights_only") != "True"
    danger |= text == "yaml.load" or words.get("shell") == "True" or words.get("allow_pickle") == "True" or text in ("np.load", "numpy.load")
    return [text] if danger else []


class Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_a_checkpoint_that_would_run_code_is_not_loaded(tmp_path, caplog):
    torch.save({"a": Bomb(tmp_path / "pwned")}, tmp_path / "a.pt")
    assert Checkpoint(tmp_path / "a.pt").load() is None
    assert not (tmp_path / "pwned").exists() and "cannot be read" in caplog.text


def test_text_in_a_photo_and_in_a_mesh_is_never_run_and_never_opened(folder, tmp_path):
    """EXIF, a comment of PNG, an .mtl with paths and commands."""
    pwned = tmp_path / "pwned"
    exif = Image.Exif()
    for tag in (0x010E, 0x010F, 0x0110, 0x013B, 0x8298):
        exif[tag] = f"$(touch {pwned}) `touch {pwned}` {EVIL_HTML} {EVIL_ANSI}"
    Image.new("RGB", (24, 18), (90, 80, 70)).save(folder / "p0.jpg", exif=exif)
    (folder / "a.mtl").write_text(f"newmtl red\nmap_Kd |touch {pwned}\nmap_Ks ../../../../etc/passwd\n")
    data = photo_sets().read(folder)
    assert [fault for slice_ in ("photo", "objects") for fault in data.faults(slice_, None, {}, folder)] == []
    assert not pwned.exists()


# ── it fills no memory ───────────────────────────────────────────────────────────────────────────────────────────────


def widened(path, width, height):
    """An EXR whose header promises another size; it is long enough to be believed."""
    content = path.read_bytes()
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        at = content.index(name) + len(name) + 4
        content = content[:at] + struct.pack("<4i", 0, 0, width - 1, height - 1) + content[at + 16 :]
    path.write_bytes(content)
    with open(path, "r+b") as stream:
        stream.truncate(50_000_000)


def huge(folder, name, width=60_000, height=30_000):
    write_rgb_exr(folder / name, np.ones((18, 24, 3)))
    widened(folder / name, width, height)
    return name


def said_at_once(check):
    begin = time.process_time()
    found = check()
    assert time.process_time() - begin < 5
    assert found and all("million values" in fault.found or "megapixels" in fault.found for fault in found), found


def test_a_photo_of_a_gigapixel_or_of_a_thousand_channels_is_refused_by_its_header(folder):
    edit(folder, PLACES["image"], huge(folder, "huge.exr"))
    said_at_once(lambda: photo_sets().read(folder).faults("photo", "p0", {}, folder))
    channels = {name: np.zeros((18, 24)) for name in ("B", *(f"C{k:03}" for k in range(900)), "G", "R")}
    write_exr(folder / "deep.exr", channels)
    widened(folder / "deep.exr", 2000, 1500)
    edit(folder, PLACES["image"], "deep.exr")
    edit(folder, PLACES["masks"], "p0.png")
    said_at_once(lambda: photo_sets().read(folder).faults("photo", "p0", {}, folder))


def test_a_true_map_of_a_gigapixel_is_refused_by_its_header(folder):
    edit(folder, ("truth",), "truth.yaml")
    for place in OF_TRUTH.values():
        edit(folder, place, huge(folder, f"{place[0]}.exr"), "truth.yaml")
    said_at_once(lambda: photo_sets().read(folder).faults("truth", None, {}, folder))


def test_a_light_of_a_recipe_of_a_gigapixel_is_refused_by_its_header(folder):
    from factorlib.dataset.read import read_dataset

    said_at_once(lambda: Validation(read_dataset(folder)).recipe_faults({"l.exr": folder / huge(folder, "l.exr")}))


# ── it forges no report ──────────────────────────────────────────────────────────────────────────────────────────────


def hostile(folder):
    """Its paths, its parts and its notes hold what terminals and browsers would obey."""
    for path in ("image", "mesh"):
        name = f"x{EVIL_ANSI}{EVIL_HTML.replace('/', '')}{SUFFIX.get(path, '.jpg')}"
        edit(folder, PLACES[path], name)
        (folder / name).write_bytes(b"none")
    return folder


VERBS = (["validate"], ["plan"], ["status"], ["masks"], ["why", "masks"], ["all"])


@pytest.mark.parametrize("words", VERBS, ids=" ".join)
def test_no_name_of_a_file_moves_the_cursor_or_sets_a_colour(project, folder, words):
    hostile(folder)
    command = [sys.executable, "-m", "factorlib", *words, "--dataset", str(folder)]
    environment = {**os.environ, "FACTORLIB_ROOT": str(project.root), "PYTHONPATH": str(LIBRARY)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert not CONTROL.search(done.stdout + done.stderr) and "Traceback" not in done.stderr
    assert "\\x1b[31mall is well" in done.stdout + done.stderr or words[0] in ("plan", "status", "why")


def test_no_warning_and_no_unknown_key_does(project, folder):
    edit(folder, ("truth",), f"gone{EVIL_ANSI}.yaml")
    edit(folder, ("photos", 0, f"key{EVIL_ANSI}"), f"value{EVIL_ANSI}")
    command = [sys.executable, "-m", "factorlib", "validate", "--dataset", str(folder)]
    environment = {**os.environ, "FACTORLIB_ROOT": str(project.root), "PYTHONPATH": str(LIBRARY)}
    for _ in range(2):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
        assert "\\x1b" in done.stderr and not CONTROL.search(done.stdout + done.stderr), done.stderr
        spec = yaml.safe_load((folder / "dataset.yaml").read_text())
        spec["photos"][0] = {key: value for key, value in spec["photos"][0].items() if not key.startswith("key")}
        (folder / "dataset.yaml").write_text(yaml.safe_dump(spec))  # then the truth that is gone is a warning


def test_text_that_a_terminal_may_be_shown_stays_as_it_is():
    for text in ("kitchen: µ σ² ≥ 1 …\n  ┃ 40 %", "日本 é ñ 🙂", ""):
        assert printable(text) == text
    assert not CONTROL.search(printable(EVIL_ANSI)) and printable(printable(EVIL_ANSI)) == printable(EVIL_ANSI)


def test_help_is_shown_on_plain_streams():
    done = subprocess.run([sys.executable, "-m", "factorlib", "--help"], cwd=LIBRARY, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "validate" in done.stdout and not done.stderr


def test_names_and_warnings_are_text_in_the_report(tmp_path):
    """The data set's folder and the warnings of a run may be called anything."""
    log = [{"event": "warning", "stage": "masks", "photo": "day", "text": f"{EVIL_HTML}{EVIL_ANSI}.jpg: its colour profile is {EVIL_HTML!r}"}]
    inputs, usual = run(tmp_path, log=[], seen={"day": ["red", "white"], "noon": ["white", "brass"], "dusk": ["red"]})
    facts = {**inputs.facts, "dataset.set": {**inputs.facts["dataset.set"], "name": EVIL_HTML}}
    (tmp_path / "log.jsonl").write_text("\n".join(json.dumps(line) for line in log))
    page = page_of(msgspec.structs.replace(inputs, facts=facts), tmp_path / "evil")
    assert "<script>alert" not in page and "<img src=x" not in page and page.count("&lt;script&gt;alert(1)") >= 3
    assert page.count("<script") == usual.count("<script")


def test_numbers_come_from_results_and_never_from_the_set(folder):
    """A truth cannot say what it is compared to, nor dataset.yaml what was solved: keys that no reader knows are refused."""
    for place in (("results",), ("materials_solved",), ("photos", 0, "metrics")):
        before = (folder / "dataset.yaml").read_text()
        edit(folder, place, {"red": 1})
        with pytest.raises(InputError):
            photo_sets().read(folder)
        (folder / "dataset.yaml").write_text(before)


