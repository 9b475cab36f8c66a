"""The contact sheet: every photo, its labels and its meshes, in one picture."""

import re

import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.images.picture import read_png
from factorlib.meshes.mesh import Mesh
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets
from factorlib.sheet import HEAD, MARGIN, MESH_SIDE, drawn, write_sheet
from tests.faults import good


def test_a_mesh_is_drawn_upright_in_the_colours_of_its_labels():
    """Label 1 above, label 2 below, as the mesh lies in its file: +y up."""
    corners = np.array([[-1, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 1], [4, 1, 0]], np.int32)
    mesh = Mesh(corners, faces, np.tile([0, 0, 1.0], (6, 1)), np.array([1, 1, 2, 2], np.int16), open=True)
    picture = drawn(mesh, np.array([[255, 255, 255], [200, 0, 0], [0, 0, 200]], np.uint8))
    middle = MESH_SIDE // 2
    above, below = picture[middle - 20, middle], picture[middle + 20, middle]
    assert above[0] > 150 > above[2] and below[2] > 150 > below[0]
    assert (picture[0, 0] == 255).all()


def test_validate_writes_a_row_for_each_photo_with_its_labels_and_meshes_always_the_same(tmp_path, capsys):
    (tmp_path / "pipeline.yaml").write_text((LIBRARY / "pipeline.yaml").read_text())
    (tmp_path / "stages").symlink_to(LIBRARY / "stages")
    folder = good.make_set(tmp_path / "data" / "set")
    project, sheet, done = Project(tmp_path, photo_sets()), tmp_path / "build" / "set" / "sheet.png", []
    assert verbs.validate(project, str(folder), [], sheet=True) == 0 and "contact sheet" in capsys.readouterr().out
    write_sheet(folder, tmp_path / "again.png", lambda k, total: done.append((k, total)))
    assert sheet.read_bytes() == (tmp_path / "again.png").read_bytes() and done == [(k, 4) for k in range(4)]
    file = folder / "dataset.yaml"  # the same, as far as it goes, of one that is not finished
    file.write_text(re.sub("masks: .*", 'masks: "?"', file.read_text(), count=1))
    with pytest.raises(InputError, match="left open"):
        verbs.validate(project, str(folder), [], sheet=True)
    unfinished = read_png(sheet)
    assert len(unfinished) == len(read_png(tmp_path / "again.png")) and (unfinished != 255).any()
    (tmp_path / "again.png").replace(sheet)
    height = HEAD + 2 * MARGIN + 2 * (MESH_SIDE + HEAD + MARGIN)
    assert read_png(sheet).shape == (height, 2 * (good.W + MARGIN) + 2 * (MESH_SIDE + MARGIN), 3)
