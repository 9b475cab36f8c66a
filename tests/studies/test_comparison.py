"""The comparison by its steps, and Mitsuba's part in it; the latter needs LLVM, and is skipped visibly where there is none."""

import json
import subprocess
import sys

import msgspec
import numpy as np
import pytest

from factorlib.export.environment import node_directions
from factorlib.light.latlong import sampled
from factorlib.runner.project import LIBRARY
from factorlib.runner.survey import survey
from factorlib.stage import Inputs, silent
from factorlib.tracing.variant import _fastest
from studies.core.baselines.case import Joint
from studies.core.baselines.joint import Bodies, _one_thread_with_derivatives, _pictures, optimised
from studies.core.baselines.photos import photographed
from studies.core.study import QUICK
from studies.core.world import materials_of
from studies.run.project import data_of, studies
from studies.steps.baselines import conclude, observe, score, solve, worlds
from tests.studies.made_body import case, light, photos
from tests.studies.test_run import TINY

NAME = "comparison"


@pytest.fixture
def llvm():
    if _fastest() != "llvm_ad_rgb":
        pytest.skip("Mitsuba has no derivatives without LLVM 16 or later (Debian: apt-get install libllvm19)")


def stepped(folder, name, data):
    """A case by its steps, without a runner; Mitsuba's stands still: it is given the answer of no steps."""
    facts = {f"dataset.{slice_}": data.slice(slice_, name).facts for slice_ in ("case", "worlds")}
    folders = {stage: folder / stage for stage in ("worlds", "observe", "solve", "optimise")}
    for stage in (observe, solve, score):
        out = folder / stage.__name__.rpartition(".")[2]
        out.mkdir(exist_ok=True)
        if stage is score:
            put_optimised(folder, name, facts["dataset.case"])
        stage.main(stage.Params(), Inputs(folders, facts, photo=name), out, silent)


def put_optimised(folder, name, case_):
    """A made answer in place of Mitsuba's: what takes LLVM is tested below."""
    made = {"diffuse": (0.3,) * 3, "specular": (0.1,) * 3, "roughness": 0.4}
    names = ["brick", "leaf"][: len({m for m, _ in case_["entries"]})]
    answer = {"rate": 0.01, "losses": [1.0], "flat": False, "processor": 1.0, "materials": dict.fromkeys(names, made)}
    lights = {str(li): np.ones((8, 16, 3)).tolist() for _, li in case_["entries"]}
    (home := folder / "optimise" / name).mkdir(parents=True)
    (home / "optimised.json").write_text(json.dumps(answer | {"lights": lights}))


def test_from_worlds_to_pictures(tmp_path, monkeypatch):
    from studies.catalogue import comparison

    monkeypatch.setitem(comparison.SIZES, "quick", 12)
    data = data_of(tmp_path / NAME, msgspec.structs.replace(TINY, largest=2, side=1))
    (tmp_path / "worlds").mkdir()
    worlds.main(
        worlds.Params(), Inputs({}, {"dataset.worlds": data.slice("worlds", None).facts}), tmp_path / "worlds", silent
    )
    for name in data.photos:
        stepped(tmp_path, name, data)
    gathered = {name: json.loads((tmp_path / "score" / f"{name}.json").read_text()) for name in data.photos}
    (tmp_path / "score/scores.json").write_text(json.dumps(gathered))
    (out := tmp_path / "conclude").mkdir()
    conclude.main(
        conclude.Params(),
        Inputs({"score": tmp_path / "score"}, {"dataset.study": data.slice("study", None).facts}),
        out,
        silent,
    )
    found = json.loads((out / "table.json").read_text())
    cells = {row["name"]: {m: c["spread"]["mean"] for m, c in row["cells"].items()} for row in found["rows"]}
    assert list(cells) == ["ours", "mitsuba", "intrinsic", "projective", "grey"] and found["label"]
    assert all({"novel_view", "novel_light", "processor"} <= of.keys() for of in cells.values())
    assert cells["ours"]["novel_view"] < cells["grey"]["novel_view"] and "novel_material" not in cells["projective"]
    assert {p.name for p in (out / "pictures").iterdir()} == {
        f"{kind}.png" for kind in ("novel_view", "novel_light", "novel_material")
    }


def test_a_change_of_a_baseline_or_of_the_scores_solves_nothing_again(tmp_path):
    records = survey(studies(TINY, tmp_path, "baselines"), NAME, None, []).records
    keys = {
        stage: next(record for step, record in records.items() if step.stage == stage)
        for stage in ("solve", "optimise")
    }
    for name in ("score", "projective", "intrinsic", "grey", "show"):
        assert not any(f"source:studies.core.baselines.{name}" in record for record in keys.values())
    assert (
        "source:studies.core.baselines.joint" in keys["optimise"]
        and "source:studies.core.baselines.joint" not in keys["solve"]
    )
    assert "source:stages.solve" in keys["solve"] and "source:stages.solve" not in keys["optimise"]


def test_the_rate_is_not_chosen_on_a_seed_that_is_reported():
    done = subprocess.run(
        [sys.executable, "-m", "studies.joint_rate", "--seed", "0"],
        cwd=LIBRARY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1 and "seed 0 is reported" in done.stderr and "Traceback" not in done.stderr


RENDERS = """
import sys
from tests.studies.test_comparison import errors_of_renderings
print(*errors_of_renderings(sys.argv[1]))
"""


def errors_of_renderings(folder):
    """Relative errors of what Mitsuba's scene shows of true materials in a smooth light, the light as it stands and left-right mirrored."""
    from pathlib import Path

    _one_thread_with_derivatives()
    of, truths, found = case("mitsuba", side=2, size=48), materials_of(0), []
    smooth = sampled(light(5, 8), node_directions(64, 128))
    shown = photographed(of, truths, dict.fromkeys(range(2), smooth))
    joint = Bodies(of.seed, shown, 24, Path(folder))
    joint.begin(0.01)
    true = _pictures(shown, 24, joint.mask).pairs["leaf", "light0"].radiance
    for kind in ("diffuse", "specular"):
        joint.optimiser[f"leaf {kind}"] = joint.mi.Color3f(*getattr(truths["leaf"], kind))
    joint.optimiser["leaf roughness"] = joint.mi.Float(truths["leaf"].roughness)
    for step in (1, -1):
        nodes = sampled(smooth, node_directions(16, 32))[:, ::step].astype("f4")
        joint.optimiser["light0"] = joint.mi.TensorXf(np.concatenate([nodes[:, -1:], nodes, nodes[:, :1]], axis=1))
        joint._set(joint.parameters["leaf", "light0"], ("leaf", "light0"))
        image = np.array(joint.mi.render(joint.scenes["leaf", "light0"], spp=256))
        found.append(float(np.abs(image - true)[joint.mask].mean() / true[joint.mask].mean()))
        found.append(float(np.abs(joint.light("light0", 64) / smooth[:, ::step] - 1).mean()))
    return found


@pytest.mark.long
def test_mitsubas_scene_is_the_one_that_was_photographed(llvm, tmp_path):
    """In a process of its own, for its variant is; coarse texels and samples leave a few per cent."""
    done = subprocess.run(
        [sys.executable, "-c", RENDERS, str(tmp_path)],
        cwd=LIBRARY,
        capture_output=True,
        text=True,
        check=False,
        env=environment(),
    )
    assert done.returncode == 0, done.stderr
    right, map_, mirrored, map_too = map(float, done.stdout.split())
    assert right < 0.06 and map_ < 0.06 and map_too < 0.06 and mirrored > 2 * right


def environment():
    import os

    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(LIBRARY), str(LIBRARY / "tests")])}


@pytest.mark.long
def test_the_optimisation_goes_down_the_same_way_in_every_run(llvm):
    of = case("mitsuba", side=1, size=24)
    first, again = (optimised(0, photos(of), Joint(12, 12)) for _ in range(2))
    assert (
        first.losses == again.losses and first.materials == again.materials and first.losses[-1] < 0.9 * first.losses[0]
    )
    assert not first.flat and len(first.losses) == 12 and first.processor > 0 and np.array(first.lights[0]).min() >= 0


def test_quick_and_full_ask_for_different_sizes():
    from studies.catalogue.comparison import STUDY
    from studies.core.study import FULL

    quick, full = (next(iter(STUDY.cases(scale).values())) for scale in (QUICK, FULL))
    assert (
        quick.size < full.size
        and quick.joint.steps < full.joint.steps
        and full.size % full.joint.pixels == quick.size % quick.joint.pixels == 0
    )
