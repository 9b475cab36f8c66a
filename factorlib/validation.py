"""What can be seen of files before anything runs: photos against their masks, meshes against their parts, what recipes name.

These are the checks that the stages make of what they read first, by the same functions; of photos only headers are read.
The runner loads this module by its name, as it loads stages: it knows no science, and a run with nothing to do must not
pay for any.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from factorlib.dataset.check import MESHES
from factorlib.dataset.schema import Dataset, MeshEntry, ObjectEntry, PhotoEntry
from factorlib.errors import InputError
from factorlib.evaluate.truth import read_true_light, read_true_normals
from factorlib.images.header import check_values
from factorlib.images.light_map import read_light_map
from factorlib.images.limits import MOST_MEGAPIXELS, check_pixels
from factorlib.images.photo import open_photo
from factorlib.labels import read_labels, read_objects
from factorlib.meshes.limits import Limits
from factorlib.meshes.parts import part_labels
from factorlib.meshes.read import read_parts
from factorlib.recipe.schema import is_light_file
from factorlib.yamlfile import convert

Check = Callable[[], object]


class Validation:
    """The files of one dataset, each looked at once."""

    def __init__(self, dataset: Dataset):
        self.dataset, self.folder = dataset, dataset.folder
        self._done: set[str] = set()
        self._parts: dict[str, list[tuple[str, ...]] | InputError] = {}

    def faults(self, slice_: str, photo: str | None, params: dict[str, Any], settings: Path) -> list[InputError]:
        """What is wrong with the files that a slice names, of one photo or of all; what was looked at before is left out.

        params: given to the stage that takes the slice, in the file `settings` or instead of what stands there
        """
        found = []
        for what, check in self._checks(slice_, photo, params, settings):
            if what in self._done:
                continue
            self._done.add(what)
            try:
                check()
            except InputError as error:
                found.append(error)
        return found

    def recipe_faults(self, files: dict[str, Path]) -> list[InputError]:
        """What is wrong with the lights and meshes that a recipe names: files by how it writes them; tables were read with it."""
        found = []
        for path in files.values():
            try:
                if is_light_file(path.name):
                    check_values(path, MOST_MEGAPIXELS)
                    read_light_map(path)
                elif path.suffix.lower() in MESHES:
                    read_parts(path)
            except InputError as error:
                found.append(error)
        return found

    def _checks(
        self, slice_: str, photo: str | None, params: dict[str, Any], settings: Path
    ) -> Iterator[tuple[str, Check]]:
        spec = self.dataset.spec
        entries = spec.photos if photo is None else [self.dataset.photo(photo)]
        if slice_ == "photo":
            most = convert(params.get("most_megapixels", MOST_MEGAPIXELS), float, settings, "most_megapixels")
            yield from ((f"photo {entry.name}", partial(self._photo, entry, most)) for entry in entries)
        elif slice_ == "objects":
            limits = convert(params.get("limits", {}), Limits, settings, "limits")
            for obj in (obj for entry in entries for obj in entry.objects):
                yield f"mesh {obj.mesh} {obj.materials}", partial(self._object, obj, spec.meshes[obj.mesh], limits)
        elif slice_ == "truth" and self.dataset.truth is not None:
            for name, path in self.dataset.truth.illumination.items():
                yield f"light {path}", partial(self._light, name, path)
            for name, path in self.dataset.truth.normals.items():
                yield f"normals {name}", partial(self._normals, name, path)

    def _light(self, name: str, path: str) -> None:
        check_values(self._file(path), MOST_MEGAPIXELS, f"illumination.{name}")
        read_true_light(self._file(path), name)

    def _normals(self, name: str, path: str) -> None:
        check_values(self._file(path), MOST_MEGAPIXELS, f"normals.{name}")
        size = open_photo(self._file(self.dataset.photo(name).image), f"photos[{name}].image").size
        read_true_normals(self._file(path), name, size[::-1])

    def _photo(self, entry: PhotoEntry, most_megapixels: float) -> None:
        key, path = f"photos[{entry.name}]", self._file(entry.image)
        size = open_photo(path, f"{key}.image").size
        check_pixels(size, most_megapixels, path, f"{key}.image")
        check_values(path, most_megapixels, f"{key}.image")
        read_labels(entry.masks, self._file, self.dataset.spec.materials, size, entry.image, f"{key}.masks")
        read_objects([(obj.name, obj.mask) for obj in entry.objects], self._file, size, f"{key}.objects")

    def _object(self, obj: ObjectEntry, mesh: MeshEntry, limits: Limits) -> None:
        file = self._file(mesh.file)
        part_labels(self._parts_of(mesh.file, limits), self.dataset.spec.materials, mesh.made_of, obj.materials, file)

    def _parts_of(self, name: str, limits: Limits) -> list[tuple[str, ...]]:
        """The parts of a mesh file, which is read once; if it cannot be, that is said again for every object."""
        if name not in self._parts:
            try:
                self._parts[name] = read_parts(self._file(name), limits)
            except InputError as error:
                self._parts[name] = error
        if isinstance(found := self._parts[name], InputError):
            raise found
        return found

    def _file(self, name: str) -> Path:
        return self.folder / name
