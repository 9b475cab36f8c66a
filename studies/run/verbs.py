"""What the command line does: one study, or all, and the page of those that are done."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from factorlib.jsonfile import read_json
from factorlib.runner import verbs
from factorlib.wholefile import replace_file
from studies.catalogue.contents import STUDIES
from studies.core.study import FULL, QUICK
from studies.run.project import FINISHED, Studies, studies


def make(project: Studies, names: list[str], force: bool = False, settings: list[str] | None = None) -> int:
    """Run studies as far as anything must run; their results and the page are under `project.build` afterwards.

    settings: where their steps run, as `executor=dask`

    A study that fails holds up no other.  Returns the exit code of the first that failed, 0 where none did.
    """
    codes = [_make(project, name, force, settings or []) for name in names]
    return next((code for code in codes if code), 0)


def _make(studies_: Studies, name: str, force: bool, settings: list[str]) -> int:
    project = studies(studies_.scale, studies_.root, STUDIES[name].kind)
    if project.scale.name == "quick":
        print(f"{name}: quick: one seed, smallest sets: no conclusion")
    code = verbs.make(project, verbs.Wish(name, settings=settings, force=force))
    if code == 0:
        home = project.build / name
        for file in FINISHED:
            replace_file(home / file, (home / "conclude" / file).read_bytes())
        copy_pictures(home / "conclude" / "pictures", home / "pictures")
        print(f"  study: {project.shown(home / 'figure.svg')}")
        print(f"  page: {project.shown(write_page(project))}")
    return code


def forget(project: Studies, names: list[str]) -> int:
    """Forget the results of studies of a scale; `collect` frees what they took.  Returns 0."""
    for name in names:
        home = project.build / name
        copy_pictures(home / "nothing", home / "pictures")
        for file in FINISHED:
            (home / file).unlink(missing_ok=True)
        if (home / "pictures").is_dir():
            (home / "pictures").rmdir()
        verbs.clean(project, name)
    if project.build.is_dir():
        write_page(project)
    return 0


def collect(agreed: Callable[[], bool]) -> int:
    """Show which results no study names any more, and delete them where that is `agreed`.  Returns 0."""
    for project in (studies(FULL), studies(QUICK)):
        if (project.build / "store").is_dir():
            print(f"{project.shown(project.build)}:")
            verbs.collect(project, agreed)
    return 0


def copy_pictures(found: Path, home: Path) -> None:
    """The pictures of a study, and no others, in its own folder."""
    wanted = {file.name: file.read_bytes() for file in sorted(found.glob("*.png"))}
    for file in set(home.glob("*")) - {home / name for name in wanted}:
        file.unlink()
    for name, data in wanted.items():
        home.mkdir(exist_ok=True)
        replace_file(home / name, data)


def write_page(project: Studies) -> Path:
    """index.html of all studies of this scale that are done."""
    folders = [folder for name in STUDIES if (folder := project.build / name) and (folder / "table.json").is_file()]
    found = [(read_json(folder / "table.json"), folder) for folder in folders]
    page = import_module("studies.report.page").page(found)  # by its name: a run with nothing to do must not pay for it
    replace_file(project.build / "index.html", page.encode())
    return project.build / "index.html"
