"""Validation of files before anything runs: photos against masks, meshes against parts, and files of recipes.

The checks are those that stages make first, by the same functions, and the consistency of materials in masks and
dataset.yaml.  Of a photo, header and pixels are checked (`OpenPhoto.check_pixels`).  The runner loads this
module by name, as it loads stages.  It knows no science, and a run with nothing to do must not import any.
"""

import logging
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from factorlib.dataset.check import MESHES, instance_materials, mirror_balls
from factorlib.dataset.schema import Dataset, MeshInstance, PhotoEntry
from factorlib.errors import InputError
from factorlib.evaluate.comparison_gauge import material_components
from factorlib.evaluate.truth import read_true_albedo, read_true_light, read_true_normals
from factorlib.images.light_map import read_light_map
from factorlib.images.photo import open_photo
from factorlib.images.scanlines import MOST_MEGAPIXELS, check_pixels, check_values
from factorlib.labels.label_image import check_materials, describe_specks, read_labels, read_object_indices
from factorlib.meshes.read_mesh import part_labels, read_mesh, read_parts
from factorlib.meshes.triangle_soup import Limits
from factorlib.recipe.kinds import is_light_file
from factorlib.yamlfile import convert

log = logging.getLogger("factorlib.validation")
Check = Callable[[], object]
AT_ONCE = 8  # number of photos that are open, and perhaps decoded as a whole, together
NOT_ROUND = 0.02  # largest variation of a ball's radius, relative


class Validation:
    """Checker of the files of one dataset, which checks each file once."""

    def __init__(self, dataset: Dataset):
        self.dataset = dataset
        self.spec = dataset.spec
        self.file = dataset.folder.joinpath
        self._done: set[str] = set()
        self._parts = cache(read_parts)
        self._pixels: list[Check] = []
        self._seen: set[int] = set()  # labels in masks

    def faults(self, requests: Iterable[tuple[str, str | None, dict[str, Any], Path]]) -> list[InputError]:
        """Return the faults of the files that slices name, except those checked before.

        A request is the name of a slice; that of a photo, or None for all; the parameters of the stage that takes the
        slice; and the file that gives them, for errors.
        """
        checks: dict[str, Check] = {}
        for request in requests:
            for name, check in self._checks(*request):
                checks.setdefault(name, check)
        faults = []
        for name, check in checks.items():
            faults += _faults([check]) if name not in self._done else []
            faults += self._pixel_faults() if len(self._pixels) == AT_ONCE else []
        self._done |= checks.keys()
        return faults + self._pixel_faults()

    def _pixel_faults(self) -> list[InputError]:
        """Read the pixels of photos that were opened, each in a thread, and return their faults in order."""
        with ThreadPoolExecutor() as threads:
            faults = list(chain.from_iterable(threads.map(lambda check: _faults([check]), self._pixels)))
        self._pixels.clear()
        return faults

    def recipe_faults(self, files: dict[str, Path]) -> list[InputError]:
        """Return the faults of the light and mesh files that a recipe names.

        `files` are the paths by the names in the recipe.  Tables of materials are checked when the recipe is read.
        """
        lights = [partial(read_light_map, path) for path in files.values() if is_light_file(path.name)]
        return _faults([*lights, *(partial(read_parts, p) for p in files.values() if p.suffix.lower() in MESHES)])

    def cautions(self) -> list[str]:
        """Return warnings of materials that no mask shows, and of lights in groups without a shared material.

        Brightness and colour cannot be compared between such groups.
        """
        names = self.spec.distinct_materials
        unseen = [repr(name) for k, name in enumerate(names, 1) if self._seen and k not in self._seen]
        cautions = [f"no mask shows {', '.join(unseen)}: remove it, or it is guessed"] if unseen else []
        by_light: dict[str, set[str]] = {}
        for photo in self.spec.photos:
            by_light.setdefault(photo.light, set()).update(
                *(instance_materials(obj, self.spec) for obj in photo.objects)
            )
        component = material_components({light: sorted(names) for light, names in by_light.items() if names})
        if (groups := len(set(component.values()))) < 2:
            return cautions
        lights = sorted(light for light, names in by_light.items() if names)
        members = [[light for light in lights if component[min(by_light[light])] == k] for k in range(groups)]
        return [
            *cautions,
            f"the lights fall into {groups} groups that share no material ({'; '.join(map(', '.join, members))}): "
            "brightness and colour cannot be compared between them. "
            "A photo that shows a material of each would link them",
        ]

    def _checks(
        self, slice_: str, photo: str | None, params: dict[str, Any], settings: Path
    ) -> Iterator[tuple[str, Check]]:
        entries = self.spec.photos if photo is None else [self.dataset.photo(photo)]
        if slice_ == "photo":
            most = convert(params.get("most_megapixels", MOST_MEGAPIXELS), float, settings, "most_megapixels")
            yield from ((f"photo {entry.name}", partial(self._photo, entry, most)) for entry in entries)
        elif slice_ == "objects":
            limits = convert(params.get("limits", {}), Limits, settings, "limits")
            for obj in (obj for entry in entries for obj in entry.objects):
                if (file := self.spec.meshes[obj.mesh].file) is None:
                    continue
                yield f"mesh {obj.mesh} {obj.materials}", partial(self._object, obj, file, limits)
        elif slice_ == "known":
            for name, light in self.spec.known.illumination.items():
                key = f"known.illumination.{name}"
                if isinstance(light, str):
                    yield f"light {light}", partial(read_light_map, self.file(light), key)
                else:
                    ball = next(mirror_balls(self.spec, name, light))[1]
                    yield f"ball {name}", partial(self._ball, ball, f"{key}.chrome")
        elif slice_ == "truth" and self.dataset.truth is not None:
            for name, path in self.dataset.truth.illumination.items():
                yield f"light {path}", partial(read_true_light, self.file(path), name)
            for name, path in self.dataset.truth.normals.items():
                yield f"normals {name}", partial(self._true_map, "normals", name, self.file(path), read_true_normals)
            for name, path in self.dataset.truth.albedo.items():
                yield f"albedo {name}", partial(self._true_map, "albedo", name, self.file(path), read_true_albedo)

    def _ball(self, obj: MeshInstance, key: str) -> None:
        """Check that a mirror ball is round: its vertices are equally far from the centre of its bounding box."""
        if (file := self.spec.meshes[obj.mesh].file) is None:
            return
        part_materials = self.spec.meshes[obj.mesh].part_materials
        points = read_mesh(self.file(file), self.spec.distinct_materials, part_materials, obj.materials).vertices
        radius = np.linalg.norm(points - (points.min(0) + points.max(0)) / 2, axis=1)
        if np.ptp(radius) > NOT_ROUND * radius.max():
            raise InputError(
                f"its vertices are {radius.min():.3g} to {radius.max():.3g} from its middle: it is not a ball",
                file=self.file(file),
                key=key,
                cure="name a ball, or use `primitive: ball`",
            )

    def _true_map(
        self, group: str, name: str, path: Path, read: Callable[[Path, str, tuple[int, int]], object]
    ) -> None:
        check_values(path, key=f"{group}.{name}")
        height, width = open_photo(self.file(self.dataset.photo(name).image), f"photos[{name}].image").size
        read(path, name, (width, height))

    def _photo(self, entry: PhotoEntry, most_megapixels: float) -> None:
        key = f"photos[{entry.name}]"
        path = self.file(entry.image)
        opened = open_photo(path, f"{key}.image")
        size = opened.size
        check_pixels(size, most_megapixels, path, f"{key}.image")
        check_values(path, most_megapixels, f"{key}.image")
        self._pixels.append(partial(opened.check_pixels, path, f"{key}.image"))
        labels = read_labels(entry.masks, self.file, self.spec.materials, size, entry.image, f"{key}.masks")
        self._seen.update(np.flatnonzero(np.bincount(labels.label.ravel())).tolist())
        file = self.file(entry.masks if isinstance(entry.masks, str) else next(iter(entry.masks.values())))
        if specks := describe_specks(labels.label > 0):
            log.warning("%s: %s.masks: %s", file, key, specks)
        object_masks = [(obj.name, obj.mask) for obj in entry.objects]
        objects = read_object_indices(object_masks, self.file, size, f"{key}.objects")
        object_materials = [(obj.name, instance_materials(obj, self.spec)) for obj in entry.objects]
        check_materials(labels, objects, object_materials, self.spec.distinct_materials, file, f"{key}.objects")

    def _object(self, obj: MeshInstance, relative: str, limits: Limits) -> None:
        """Check the parts of a mesh file, which is read once if it can be."""
        file = self.file(relative)
        names = self.spec.meshes[obj.mesh].part_materials
        part_labels(self._parts(file, limits), self.spec.distinct_materials, names, obj.materials, file)


def _faults(checks: Iterable[Check]) -> list[InputError]:
    faults = []
    for check in checks:
        try:
            check()
        except InputError as error:
            faults.append(error)
    return faults
