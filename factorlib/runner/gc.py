"""Taking away: results no dataset's last run needs, and a dataset's results."""

from __future__ import annotations

import shutil
from pathlib import Path

import msgspec

from factorlib.runner.project import Home, Project
from factorlib.runner.store import Store
from factorlib.runner.tenancy import alone


class Freed(msgspec.Struct, frozen=True):
    results: int
    bytes: int


def collect(project: Project) -> Freed:
    """Delete every result that is not current for some dataset; refused while a run goes on."""
    store = Store(project.build / "store")
    with alone(store):
        homes = [Home(path) for path in project.build.glob("*") if path.is_dir() and path.name != "store"]
        keys = {key for home in homes for key in home.keys().values()}
        trees = {entry.output for key in keys if (entry := store.entry(key))}
        views = {Path(link.readlink()).name for home in homes for link in home.folder.glob("*") if link.is_symlink()}
        unused = [p for p in store.keys.glob("*") if p.stem not in keys or p.suffix != ".json"]
        dead = [p for p in store.trees.glob("*") if p.name not in trees] + [p for p in store.views.glob("*") if p.name not in views]
        rest = (
            [p for p in store.logs.glob("*") if p.stem not in keys or p.suffix != ".jsonl"]
            + list(store.locks.glob("*"))
            + list(store.unfinished.glob("*"))
        )
        dead += list(store.damaged.glob("*"))
        freed = sum(_size(path) for path in dead if path.parent in (store.trees, store.damaged))  # views only link to trees
        for path in unused + dead + rest:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    return Freed(len(unused), freed)


def clean(project: Project, home: Home | None) -> None:
    """Delete a dataset's results (those in the store go with the next gc), or all of build/."""
    store = Store(project.build / "store")
    if not project.build.exists():
        return
    with alone(store):
        if home is None:
            for path in project.build.iterdir():
                if path.name in ("studies", "bench"):
                    continue
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        elif home.folder.exists():
            shutil.rmtree(home.folder)


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
