"""Given poses, cameras and masks that contradict the photo are refused or reported, never taken in silence or by raw warnings."""

import logging
import warnings

import numpy as np
import pytest

from factorlib.align.given import check_before_camera, warn_of_camera
from factorlib.errors import InputError
from factorlib.geometry.camera import Pose
from tests.align.scenes import blob
from tests.stages.test_align import run, step


def given(tmp_path, translation, **options):
    inputs, *_ = step(tmp_path, blob(), blob(), pose_given=True, **{"focal": 300.0, "source": "dataset"} | options)
    inputs.facts["dataset.objects"]["objects"][0]["pose"]["translation"] = [float(x) for x in translation]
    return inputs


@pytest.mark.parametrize("focal", [{"focal": 300.0}, {"focal": None, "source": None}])
@pytest.mark.parametrize("z", [-5.0, -1e6, -0.2])
def test_a_pose_behind_the_camera(tmp_path, z, focal):
    with warnings.catch_warnings(), pytest.raises(InputError, match="is not before the camera") as caught:
        warnings.simplefilter("error")
        run(tmp_path, given(tmp_path, (0, 0, z), **focal))
    assert caught.value.key == "photos[a].objects[chair].pose" and "OpenGL" in caught.value.cure


def test_a_pose_around_the_camera(tmp_path, caplog):
    with warnings.catch_warnings(), caplog.at_level(logging.WARNING, "factorlib.align"):
        warnings.simplefilter("error")
        run(tmp_path, given(tmp_path, (0, 0, 0.5)))
    assert "vertices behind the camera" in caplog.text and "a: chair: its pose (dataset)" in caplog.text


def test_a_pose_of_a_source_names_the_source(tmp_path):
    mesh = blob()
    with pytest.raises(InputError) as caught:
        check_before_camera(mesh, Pose(np.eye(3), np.array([0, 0, -9.0])), "hall", "vase", "colmap")
    assert caught.value.key == "cameras.colmap: hall: vase"


def test_a_material_that_no_object_has(tmp_path, caplog):
    def edit(label):
        label[:20, :30] = 2
        return label

    inputs, *_ = step(tmp_path, blob(), blob(), pose_given=True, focal=300.0, source="dataset", edit=edit)
    inputs.facts["dataset.materials"].append("wood")
    with caplog.at_level(logging.WARNING, "factorlib.align"):
        run(tmp_path, inputs)
    assert "material 'wood' has 600 pixels in the mask, but no object of the photo has it" in caplog.text
    assert "material 'white'" not in caplog.text


@pytest.mark.parametrize(
    "focal, centre, words",
    [
        (800.0, (-1.0, 240.0), ["principal point (-1, 240) lies outside"]),
        (800.0, (320.0, 1e6), ["lies outside"]),
        (1.0, (320.0, 240.0), ["field of view of 179.6°"]),
        (1e7, (320.0, 240.0), ["field of view"]),
        (800.0, (320.0, 240.0), []),
        (None, (0.0, 480.0), []),
    ],
)
def test_a_camera_that_few_photos_have(caplog, focal, centre, words):
    with caplog.at_level(logging.WARNING, "factorlib.align"):
        warn_of_camera(focal, centre, (640, 480), "hall")
    assert all(word in caplog.text for word in words) and len(caplog.records) == len(words)
