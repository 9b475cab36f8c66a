"""The paper's patterns as data sets on disk; the table of real sets."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from factorlib.dataset.read import read_dataset
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.images.exr import read_rgb_exr
from factorlib.images.picture import read_png
from factorlib.meshes.read import read_mesh
from factorlib.results.metrics import PhotoErrors, PictureError, Resynthesis, ScoredPicture
from studies import sets
from studies.measured import real_sets


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Two materials in one light, one of them in a second, of twice the radiance."""
    folder = tmp_path_factory.mktemp("sets") / "pair"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sets, "light_map", lambda seed, number, *size: np.ones((16, 32, 3), np.float32) * (1 + number))
        sets.write_set(folder, 0, [(0, 0), (5, 0), (5, 1)])
    return folder


def test_meshes_at_the_given_poses_lie_under_the_masks(written):
    """Read as the stages read them."""
    dataset = read_dataset(written)
    spec = dataset.spec
    assert {p.name: [o.name for o in p.objects] for p in spec.photos} == {
        "photo0": ["brick", "tile"],
        "photo1": ["tile"],
    }
    for photo in spec.photos:
        label, radiance = read_png(written / photo.masks)[..., 0], read_rgb_exr(written / photo.image)
        camera = Camera(*label.shape[::-1], photo.camera.focal_px, tuple(photo.camera.principal_point))
        files = [(spec.meshes[obj.mesh], obj) for obj in photo.objects]
        meshes = [read_mesh(written / file.file, spec.materials, file.material, obj.materials) for file, obj in files]
        poses = [Pose(np.array(obj.pose.rotation), np.array(obj.pose.translation)) for obj in photo.objects]
        said = label < 255
        assert (rasterise(meshes, camera, poses).label[said] == label[said]).all() and (label[said] > 0).sum() > 5000
        assert (radiance[label == 0] == 0).all()


def test_twice_the_light_is_twice_the_radiance(written):
    """Of the tile, but for noise and for which normals its two bodies show."""
    first, second = (read_rgb_exr(written / f"photos/photo{k}.exr") for k in range(2))
    tile = read_png(written / "masks/photo0.png")[..., 0] == 2
    assert np.median(second[second.max(-1) > 0], axis=0) == pytest.approx(2 * np.median(first[tile], axis=0), rel=0.05)


def test_a_set_that_there_is_not_is_answered_with_those_there_are(tmp_path):
    with pytest.raises(InputError, match="docksta"):
        sets.main(tmp_path, which="dockta")


def test_a_real_sets_rows_give_photos_and_the_mean_beside_flat_colours():
    scored = ScoredPicture(PictureError(1.0, 15.47, 0.34357), PictureError(1.0, 13.39, 0.347734))
    seen = PhotoErrors(1.0, 4, 0, 0, 0, 0, None, {}, {"none": scored}, {})
    nothing_counts = msgspec.structs.replace(seen, gauges=None)
    metrics = SimpleNamespace(resynthesis=Resynthesis({"a": seen, "b": nothing_counts}, {"none": scored}, 1.0, 1.0))
    cells = [".344", ".348", "15.5", "13.4"]
    assert real_sets.rows_of("x", metrics) == [["x: a", *cells], ["x: mean", *cells]]
