"""The contact sheet: every photo, its labels and its meshes, in one picture."""

import re

from factorlib.contact_sheet import HEAD, MARGIN, MESH_SIDE, write_sheet
from factorlib.images.picture import read_png
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets
from tests.faults import sample
from tests.refusal import refusal


def test_validate_writes_a_row_for_each_photo_with_its_labels_and_meshes_always_the_same(tmp_path, capsys):
    (tmp_path / "pipeline.yaml").write_text((LIBRARY / "pipeline.yaml").read_text())
    (tmp_path / "stages").symlink_to(LIBRARY / "stages")
    folder = sample.make_set(tmp_path / "data" / "set")
    project, sheet, reports = Project(tmp_path, photo_sets()), tmp_path / "build" / "set" / "sheet.png", []
    assert verbs.validate(project, str(folder), [], sheet=True) == 0 and "contact sheet" in capsys.readouterr().out
    write_sheet(folder, tmp_path / "again.png", lambda k, total: reports.append((k, total)))
    assert sheet.read_bytes() == (tmp_path / "again.png").read_bytes() and reports == [(k, 4) for k in range(4)]
    file = folder / "dataset.yaml"  # the same, as far as it goes, of one that is not finished
    file.write_text(re.sub("masks: .*", 'masks: "?"', file.read_text(), count=1))
    refusal("left open", verbs.validate, project, str(folder), [], sheet=True)
    unfinished = read_png(sheet)
    assert len(unfinished) == len(read_png(tmp_path / "again.png")) + HEAD and (unfinished != 255).any()
    (tmp_path / "again.png").replace(sheet)
    assert read_png(sheet).shape == (
        2 * HEAD + 2 * MARGIN + 2 * (MESH_SIDE + HEAD + MARGIN),
        2 * (sample.W + MARGIN) + 2 * (MESH_SIDE + MARGIN),
        3,
    )
