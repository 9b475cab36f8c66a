"""Error of a rendered set, solved by `solve` with one part of the model switched off: writes <case>.json."""

from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from factorlib.dataset.read_dataset import read_dataset
from factorlib.images.exr import read_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.results.lobe_table import read_lobes
from factorlib.results.materials import Reflectance, read_materials
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import read_observations
from studies.recovery_errors import ROWS, light_errors, material_errors
from studies.steps import Params
from studies.steps.solve import run_solve

GAUGE = "channel_per_photo"  # of lights: what no photo tells is taken out
CHANGES = {  # of the observations
    "": lambda o: o,
    "sure": lambda o: msgspec.structs.replace(o, confidence=None, weight=np.ones(len(o), o.weight.dtype)),
    "dropped": lambda o: o.take(~o.clipped.any(axis=1)),
}


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Solve a rendered set without one part of the model, compare with the truth, and write the scores."""
    case = inputs.facts["dataset.case"]
    home = inputs["rendered_sets"] / str(case["seed"])
    dataset = read_dataset(home / "data")
    photos = sorted((home / "urm").glob("*.parquet"))
    tables = {file.stem: CHANGES[case["change"]](read_observations(file)) for file in photos}
    with TemporaryDirectory() as folder:
        run_solve(tables, case["solve"], inputs, Path(folder), progress)
        answer = read_materials(Path(folder) / "materials.json")
        lobes = read_lobes(Path(folder) / "lobes.parquet")
    materials = {n: m.reflectance for n, m in answer.materials.items()}
    truths = {n: Reflectance(m.diffuse, m.specular, m.roughness) for n, m in dataset.truth.materials.items()}
    lights = {name: lat_long_of_lobes(light, ROWS, 2 * ROWS) for name, light in lobes.items()}
    maps = {name: read_rgb_exr(dataset.folder / dataset.truth.illumination[name]) for name in lights}
    score = material_errors(materials, truths, dict.fromkeys(materials, 0)) | light_errors(lights, maps, GAUGE)
    write_json(out / f"{inputs.photo}.json", score)
