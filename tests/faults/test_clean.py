"""`make clean` takes what the runner made and nothing else, whatever its arguments are."""

import os
import shutil
from pathlib import Path

import pytest

from factorlib.errors import InputError
from factorlib.runner import verbs
from tests.runner import toy
from tests.runner.toy import files_of, write

NO_NAMES = [
    "",
    "/",
    "//",
    ".",
    "..",
    "./",
    "../",
    "../..",
    "store",
    "bench",
    "studies",
    "compare",
    "data/..",
    "build/store",
    "x\0y",
    "x" * 256,
]


@pytest.fixture(scope="module")
def made_once(tmp_path_factory):
    made = toy.make_project(tmp_path_factory.mktemp("toy") / "root")
    assert verbs.make(made, verbs.Wish("set")) == 0
    return made


@pytest.fixture
def project(made_once, tmp_path, monkeypatch):
    """The toy with everything current, in a checkout with a .git, the user standing in it, and a folder beside the results."""
    made = toy.copy(made_once, tmp_path / "checkout")
    write(made.root / ".git" / "HEAD", "ref: refs/heads/main")
    write(made.build / "bench" / "times.json", "{}")
    write(made.build / "mine" / "notes.txt", "not the runner's")
    monkeypatch.chdir(made.root)
    return made


def everything(project):
    """Every path of the checkout, but for the locks that tell who is using the store."""
    paths = (Path(folder) / name for folder, names, files in os.walk(project.root) for name in names + files)
    return sorted(str(p) for p in paths if p.name != "door.lock" and p != project.build / "store" / "tmp")


def clean(project, dataset):
    try:
        return verbs.clean(project, dataset)
    except InputError as error:
        return str(error)


@pytest.mark.parametrize("word", NO_NAMES)
def test_what_is_no_name_deletes_nothing(project, word):
    before = everything(project)
    said = clean(project, word)
    assert isinstance(said, str) and "DATASET" in said
    assert everything(project) == before


@pytest.mark.parametrize(
    "word", ["mine", "data", "nowhere", "elsewhere/set", "/nowhere/set", "../set", "data/elsewhere/../../set", "stages"]
)
def test_a_name_that_has_no_results_of_its_own_deletes_nobody_elses(project, word):
    before = everything(project)
    clean(project, word)
    assert everything(project) == before


def test_a_folder_elsewhere_of_the_same_name_is_refused(project, tmp_path):
    shutil.copytree(project.root / "data" / "set", tmp_path / "other" / "set")
    before = everything(project)
    assert "holds the results of" in clean(project, str(tmp_path / "other" / "set"))
    assert everything(project) == before


@pytest.mark.parametrize("word", ["set", "data/set", "./data/set/", "data/../data/set"])
def test_links_and_marks_go_and_results_stay_in_the_store(project, word, capsys):
    trees = files_of(project.build / "store" / "trees")
    assert clean(project, word) == 0
    assert not (project.build / "set").exists() and files_of(project.build / "store" / "trees") == trees
    assert capsys.readouterr().out == "deleted build/set\n"


def test_results_of_a_dataset_that_is_gone_go_by_its_name_and_by_its_path(project, tmp_path):
    for word in ("set", str(project.root / "data" / "set")):
        again = toy.copy(project, tmp_path / f"again{len(word)}")
        shutil.rmtree(again.root / "data" / "set")
        assert (
            clean(again, word.replace(str(project.root), str(again.root))) == 0 and not (again.build / "set").exists()
        )


def test_a_dataset_without_results_is_no_error(project, capsys):
    write(project.root / "data" / "new" / "a.txt", "text")
    assert clean(project, "new") == 0 and "nothing to delete" in capsys.readouterr().out


def test_what_a_user_put_beside_the_results_stays_and_is_named(project, capsys):
    write(project.build / "set" / "notes.txt", "mine")
    assert clean(project, "set") == 0
    assert [p.name for p in (project.build / "set").iterdir()] == ["notes.txt"]
    said = capsys.readouterr().out
    assert (
        "deleted build/set/total\n" in said
        and "deleted build/set/dataset.txt\n" in said
        and "left    build/set/notes.txt" in said
    )


def test_no_link_is_followed(project, tmp_path):
    write(tmp_path / "precious" / "photo.txt", "p")
    for link in ("errors", "album"):
        (project.build / "set" / link).symlink_to(tmp_path / "precious")
    (project.build / "set" / "log.jsonl").unlink()
    (project.build / "set" / "log.jsonl").symlink_to(tmp_path / "precious" / "photo.txt")
    assert clean(project, "set") == 0 and clean(project, None) == 0
    assert files_of(tmp_path / "precious") == {"photo.txt": b"p"}
    assert (project.build / "set" / "album").is_symlink()


def test_a_home_that_is_a_link_is_not_taken(project, tmp_path):
    (project.build / "set").rename(tmp_path / "moved")
    (project.build / "set").symlink_to(tmp_path / "moved")
    before = files_of(tmp_path / "moved")
    assert "is a link" in clean(project, "set") and clean(project, None) == 0
    assert files_of(tmp_path / "moved") == before


def test_without_a_name_the_store_and_every_home_go_and_nothing_else(project, capsys):
    outside = [
        p
        for p in everything(project)
        if not p.startswith(str(project.build / "set")) and not p.startswith(str(project.build / "store"))
    ]
    assert clean(project, None) == 0
    assert everything(project) == outside
    said = capsys.readouterr().out.splitlines()
    assert said == ["deleted build/set", "deleted build/store", "left    build/bench", "left    build/mine"]


@pytest.mark.parametrize("word", NO_NAMES)
@pytest.mark.parametrize("verb", ["make", "show_plan", "show_status", "validate"])
def test_every_verb_refuses_what_is_no_name(project, word, verb):
    before = everything(project)
    with pytest.raises(InputError) as caught:
        verbs.validate(project, word, []) if verb == "validate" else getattr(verbs, verb)(project, verbs.Wish(word))
    assert "DATASET" in str(caught.value) and everything(project) == before


@pytest.mark.parametrize("name", ["../up", ".", "a/b", "", "Store x", "log.jsonl", "errors"])
def test_a_stage_whose_name_leads_elsewhere_is_refused(project, name):
    write(project.root / "pipeline.yaml", toy.PIPELINE + f"  ? {name!r}\n  : {{}}\n")
    with pytest.raises(InputError, match="stage"):
        verbs.show_graph(project, False)


def test_a_gathered_file_that_leads_elsewhere_is_refused(project):
    write(project.root / "pipeline.yaml", toy.PIPELINE.replace("gather: sizes.json", "gather: ../../sizes.json"))
    with pytest.raises(InputError, match="gathered file"):
        verbs.show_graph(project, False)
