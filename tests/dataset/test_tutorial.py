"""docs/tutorial.md, step 2: what it says to write makes the data set of `make new` the one that it was made of."""

import re

import msgspec

from factorlib.dataset.read import read_dataset
from factorlib.newset import new_dataset
from factorlib.runner.project import LIBRARY
from factorlib.yamlfile import parse_yaml

EAMES = LIBRARY / "data" / "eames"
OTHERS = {"kitchen": {"chair": "yellow"}, "patio": {"chair": "black"}, "terrace": {"white_chair": "white"}}


def test_step_2_as_it_stands(tmp_path):
    text = (LIBRARY / "docs" / "tutorial.md").read_text()
    step = text.partition("## 2.")[2].partition("## 3.")[0]
    top, entries = (parse_yaml(block) for block in re.findall(r"```yaml\n(.*?)```", step, re.DOTALL))
    missing = new_dataset(tmp_path / "mychairs", EAMES / "photos", EAMES / "masks", EAMES / "meshes")
    assert all(line in step for line in missing)  # as the page says
    file = tmp_path / "mychairs" / "dataset.yaml"
    begun = parse_yaml(file.read_text())
    photos = {photo["name"]: photo for photo in begun["photos"]}
    for entry in entries:
        kept = {**entry, "objects": [{k: v for k, v in obj.items() if k != "materials"} for obj in entry["objects"]]}
        assert kept == photos[entry["name"]]  # only `materials` was added
        photos[entry["name"]] = entry
    for photo, shells in OTHERS.items():
        for obj in photos[photo]["objects"]:
            obj |= {"materials": {"shell": shells[obj["name"]]}} if obj["name"] in shells else {}
    file.write_bytes(msgspec.json.encode({**begun, **top, "photos": list(photos.values())}))  # YAML, too
    assert shells_of(read_dataset(file)) == shells_of(read_dataset(EAMES))


def shells_of(dataset):
    """The materials of every photo's shells, whatever the objects are called."""
    spec = dataset.spec
    default = {name: mesh.parts for name, mesh in spec.meshes.items()}
    shells = {p.name: sorted((default[o.mesh] | o.materials)["shell"] for o in p.objects) for p in spec.photos}
    return spec.materials, msgspec.to_builtins(spec.meshes), dict(sorted(shells.items()))
