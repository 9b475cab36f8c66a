"""What is asked of a key in a file that a user writes: known names, rotations, and paths, which stay in the dataset's folder, links followed."""

import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from factorlib.errors import InputError, did_you_mean
from factorlib.reading import check_plain, path_inside, reading

ROTATION_TOLERANCE = 1e-3  # largest entry of RᵀR − 1: matrices typed with four digits pass


class Refusal:
    """The file that is being checked, and the folder its paths stay in; called, it refuses a key, and so do its methods."""

    def __init__(self, file: Path, folder: Path):
        self.file, self.folder = file, folder
        self.faults: list[InputError] = []
        self.inside: dict[str, Path] = {}  # folders that have been followed and lie in it, by how they are written

    def __call__(self, key: str, fault: str, cure: str) -> NoReturn:
        raise InputError(fault, file=self.file, key=key, cure=cure)

    @contextmanager
    def noting(self) -> Iterator[None]:
        """What is refused within is kept in `faults`, and what follows is checked, too."""
        try:
            yield
        except InputError as error:
            self.faults.append(error)

    def known(self, key: str, name: str, known: Iterable[str], kind: str) -> None:
        """A name is among `known`; the nearest one is suggested."""
        if name not in (known := list(known)):
            cure = did_you_mean(name, known) if known else f"the dataset has no {kind} here"
            self(key, f"unknown {kind} {name!r}", cure)

    def once(self, key: str, names: Iterable[str], kind: str) -> None:
        """Each name of a list stands in it once."""
        first: dict[str, int] = {}
        for index, name in enumerate(names):
            if first.setdefault(name, index) != index:
                fault = f"duplicate {kind} name {name!r}"
                self(f"{key}[{index}].name", fault, f"{key}[{first[name]}] has it already: rename one")

    def rotation(self, key: str, rows: tuple) -> None:
        """Three rows are a rotation: RᵀR = 1 within ROTATION_TOLERANCE, determinant +1."""
        gram = [[sum(r[i] * r[j] for r in rows) - (i == j) for j in range(3)] for i in range(3)]
        worst = max(abs(entry) for row in gram for entry in row)
        if not worst <= ROTATION_TOLERANCE:
            fault = f"not a rotation: RᵀR differs from 1 by {worst:.3g}"
            self(key, fault, "its columns must be unit vectors at right angles (no scale)")
        a, b, c = rows
        if sum(a[i] * (b[(i + 1) % 3] * c[(i + 2) % 3] - b[(i + 2) % 3] * c[(i + 1) % 3]) for i in range(3)) < 0:
            fault = "not a rotation but a reflection (determinant −1)"
            self(key, fault, "one axis is flipped: the camera frame is x right, y down, z forward")

    def path(self, key: str, path: str, suffixes: Iterable[str], must_exist: bool = True) -> None:
        """A path of a known suffix leads to a plain file inside the folder, which may be read."""
        target = self._followed(key, path, "file")
        if target.suffix.lower() not in suffixes:
            self(key, f"{path!r} has a suffix that is not read here", f"expected one of {', '.join(suffixes)}")
        if is_there(target, key):
            self._plain(key, path, target)
        elif must_exist:
            try:
                names = [entry.name for entry in target.parent.iterdir() if entry.is_file()]
            except OSError:
                names = []
            near = did_you_mean(target.name, names)
            cure = near if near.startswith("did") else f"put it at {target}, or correct the path"
            self(key, f"there is no file {path!r}", cure)

    def subfolder(self, key: str, path: str) -> None:
        """A path leads to a folder inside the dataset's, links followed, whose files can be listed."""
        folder = self._followed(key, path, "folder")
        with reading("a folder", self.file, key):
            if not folder.is_dir():
                self(key, f"there is no folder {path!r}", "copy it there, or correct the path")
            os.scandir(folder).close()

    def file_of(self, key: str, folder: str, name: str) -> Path | None:
        """The file `name` of a folder inside the dataset's; None where there is none.  It does not lead outside either."""
        target = self._followed(key, f"{folder}/{name}", "file")
        if not is_there(target, key):
            return None
        self._plain(key, f"{folder}/{name}", target)
        return target

    def _plain(self, key: str, path: str, target: Path) -> None:
        try:
            check_plain(target, "a file", key, most_bytes=None)
        except InputError as error:
            self(key, f"{path!r} {error.found}", error.cure or "correct the path")

    def _followed(self, key: str, path: str, kind: str) -> Path:
        """Files of one folder that are no links are where that folder is, which is followed once: a set may have thousands."""
        above, _, name = path.rpartition("/")
        plain_name = name not in ("", ".", "..")
        try:
            if plain_name and above in self.inside and stat.S_ISREG(os.lstat(self.inside[above] / name).st_mode):
                return self.inside[above] / name
        except (OSError, ValueError):
            pass  # for the rest to say
        try:
            target = path_inside(self.folder, path)
            if above and plain_name:
                self.inside[above] = path_inside(self.folder, above)
            return target
        except ValueError as error:
            fault = f"{path if len(path) <= 80 else f'{path[:80]}…'!r} {error}"
            self(key, fault, f"copy the {kind} into {self.folder.resolve()} and name it relative to that folder")


def is_there(target: Path, key: str) -> bool:
    """Whether anything is there; InputError where that may not be known."""
    with reading("a file", target, key):
        try:
            os.stat(target)
        except (FileNotFoundError, NotADirectoryError):
            return False
    return True
