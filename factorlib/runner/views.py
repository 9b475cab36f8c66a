"""Views: the results of all photos of a stage in one folder, by hard links; what build/<dataset>/<stage> names.

A view is right if its files have the stamps of the trees' own; one that is not, because somebody put another file in, or a
tree was replaced, is made anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from pathlib import Path

from factorlib.errors import InputError
from factorlib.jsonfile import json_text, read_json
from factorlib.runner.integrity import Inspector, Stamp, stamps_of
from factorlib.runner.store import Store
from factorlib.wholefile import write_text


def view_of(store: Store, inspector: Inspector, outputs: dict[str, str], gather: str | None) -> Path:
    """One folder with the files of all photos ({photo: output}), and `<photo>.json` of each gathered into `gather`."""
    target = store.views / name_of(outputs, gather)
    wanted = {name: stamp for output in outputs.values() for name, stamp in _stamps(store, inspector, output).items()}
    if not _is_right(target, inspector, wanted, store, outputs, gather):
        store.tmp.mkdir(parents=True, exist_ok=True)
        draft = store.tmp / f"view-{os.getpid()}-{target.name}"
        shutil.rmtree(draft, ignore_errors=True)
        try:
            _fill(draft, store, outputs, gather)
            store.put(draft, target, lambda: _is_right(target, inspector, wanted, store, outputs, gather))
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    return target


def name_of(outputs: dict[str, str], gather: str | None) -> str:
    """Name of a view: a hash of the trees it shows and of the file that gathers their JSON."""
    return hashlib.sha256(json.dumps([outputs, gather], sort_keys=True).encode()).hexdigest()[:32]


def gathered(store: Store, outputs: dict[str, str]) -> str:
    """One JSON text of the `<photo>.json` of every tree: {photo: content}."""
    return json_text({photo: read_json(store.tree(output) / f"{photo}.json") for photo, output in outputs.items()})


def _stamps(store: Store, inspector: Inspector, output: str) -> dict[str, Stamp]:
    return inspector.known.get(output) or stamps_of(store.tree(output))


def _is_right(
    view: Path, inspector: Inspector, wanted: dict[str, Stamp], store: Store, outputs: dict[str, str], gather: str | None
) -> bool:
    now = stamps_of(view)
    table = {gather: now.pop(gather)} if gather and gather in now else {}
    if now != wanted or bool(table) != bool(gather):
        return False
    if not gather or table == inspector.known.get(view.name):
        return True
    if (view / gather).read_bytes() != gathered(store, outputs).encode():
        return False
    inspector.remember(view.name, table)
    return True


def _fill(draft: Path, store: Store, outputs: dict[str, str], gather: str | None) -> None:
    draft.mkdir()
    for photo, output in sorted(outputs.items()):
        for name in sorted(stamps_of(store.tree(output))):
            target = draft / name
            if target.exists():
                raise InputError(f"two photos write the same file {target.name!r}", key=photo, cure="put the photo's name into it")
            target.parent.mkdir(parents=True, exist_ok=True)
            _link(store.tree(output) / name, target)
    if gather:
        write_text(draft / gather, gathered(store, outputs))
        (draft / gather).chmod(0o444)


def _link(file: Path, target: Path) -> None:
    try:
        os.link(file, target)
    except OSError:  # no hard links on this file system
        shutil.copy2(file, target)


def point(link: Path, target: Path) -> None:
    """Make `link` name the folder `target` from one moment to the next; relative, so that build/ can be moved."""
    words = os.path.relpath(target, link.parent)
    if link.is_symlink() and os.readlink(link) == words:
        return
    link.parent.mkdir(parents=True, exist_ok=True)
    draft = link.with_name(f".{link.name}.{os.getpid()}")
    draft.unlink(missing_ok=True)
    os.symlink(words, draft, target_is_directory=True)
    if link.is_dir() and not link.is_symlink():
        raise InputError("is a folder of its own, where the runner puts a link", file=link, cure="move it elsewhere")
    os.replace(draft, link)
