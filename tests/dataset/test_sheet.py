"""The contact sheet: every photo, its labels and its meshes, in one picture."""

import numpy as np

from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.images.picture import read_png
from factorlib.meshes.mesh import Mesh
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets
from factorlib.sheet import HEAD, MARGIN, MESH_SIDE, SIDE, drawn, write_sheet

EAMES = LIBRARY / "data" / "eames"


def test_a_row_for_each_photo_with_its_labels_and_meshes(tmp_path):
    done = []
    write_sheet(EAMES, tmp_path / "sheet.png", lambda k, total: done.append((k, total)))
    sheet = read_png(tmp_path / "sheet.png")
    row = MESH_SIDE + HEAD + MARGIN
    assert sheet.shape == (
        HEAD + 2 * MARGIN + 6 * max(row, 180 + HEAD + MARGIN),
        2 * (240 + MARGIN) + 2 * (MESH_SIDE + MARGIN),
        3,
    )
    assert SIDE == 320 and done == [(k, 12) for k in range(12)]
    write_sheet(EAMES, tmp_path / "again.png")
    assert (tmp_path / "sheet.png").read_bytes() == (tmp_path / "again.png").read_bytes()


def test_a_mesh_is_drawn_upright_in_the_colours_of_its_labels():
    """Label 1 above, label 2 below, and 1 on the right (+x) of its own half as well as on the left."""
    corners = np.array([[-1, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 1], [4, 1, 0]], np.int32)
    mesh = Mesh(corners, faces, np.tile([0, 0, 1.0], (6, 1)), np.array([1, 1, 2, 2], np.int16), open=True)
    picture = drawn(mesh, np.array([[255, 255, 255], [200, 0, 0], [0, 0, 200]], np.uint8))
    middle = MESH_SIDE // 2
    above, below = picture[middle - 20, middle], picture[middle + 20, middle]
    assert above[0] > 150 > above[2] and below[2] > 150 > below[0]
    assert (picture[0, 0] == 255).all()
    assert (
        rasterise(mesh, Camera(8, 8, 8.0, (4, 4)), Pose(np.diag([1.0, -1, -1]), np.array([0, 0, 4.0]))).label[3, 4] == 1
    )


def checkout(folder):
    (folder / "data").mkdir()
    (folder / "pipeline.yaml").write_text((LIBRARY / "pipeline.yaml").read_text())
    (folder / "stages").symlink_to(LIBRARY / "stages")
    return Project(folder, photo_sets())


def test_validate_writes_it_only_when_asked(tmp_path, capsys):
    project = checkout(tmp_path)
    assert verbs.validate(project, str(EAMES), []) == 0 and not (tmp_path / "build" / "eames" / "sheet.png").exists()
    assert verbs.validate(project, str(EAMES), [], sheet=True) == 0
    assert (tmp_path / "build" / "eames" / "sheet.png").is_file() and "contact sheet" in capsys.readouterr().out
