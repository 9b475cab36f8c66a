"""A lens's distortion is undone: against the picture that a pinhole takes of the same thing."""

import numpy as np
import pytest

from factorlib.dataset.schema import Intrinsics
from factorlib.errors import InputError
from factorlib.images.lens import Undistorted, radial_lens
from factorlib.images.photo import Photo

W, H = 90, 60
CAMERA = Intrinsics(focal_px=140.0, principal_point=(86.0, 64.0), distortion=(-0.2, 0.05))
LENS = radial_lens(CAMERA, 2, W, H)


def scene(points):
    """What a pinhole shows at image points: three smooth channels."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([2 + np.sin(x / 9), 2 + np.cos(y / 7), 2 + np.sin((x + y) / 11)], axis=-1)


def pixels(height=H, width=W):
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)


def taken():
    """The photo that the lens takes of the scene; one pixel is clipped, another is no number."""
    radiance = scene(LENS.undistorted(pixels().reshape(-1, 2)).reshape(H, W, 2)).astype("f4")
    clipped, finite = np.zeros((H, W, 3), bool), np.ones((H, W), bool)
    clipped[30, 40, 1], finite[20, 20] = True, False
    return Photo(radiance, clipped, finite, None, W, H, "linear")


def test_it_is_the_picture_of_a_pinhole_and_says_where_it_has_none():
    straight = Undistorted(LENS, H, W)
    photo = straight.photo(taken())
    assert np.abs(photo.radiance - scene(pixels()))[photo.finite].max() < 0.02
    bent = np.abs(taken().radiance - scene(pixels())).max()
    assert bent > 0.3, "the lens is one that matters"
    (y, x), (v, u) = (np.argwhere(of).mean(0) + 0.5 for of in (photo.clipped[..., 1], straight.inside & ~photo.finite))
    np.testing.assert_allclose(LENS.distorted(np.array([[x, y], [u, v]])), [[40.5, 30.5], [20.5, 20.5]], atol=0.6)
    barrel = radial_lens(Intrinsics(focal_px=140.0, distortion=(0.2, 0.0)), 2, W, H)
    edge = Undistorted(barrel, H, W)
    assert not edge.inside[0, 0] and edge.inside[H // 2, W // 2]
    assert not edge.nearest(np.ones((H, W), bool))[~edge.inside].any()


def test_points_go_there_and_back_and_the_distortion_is_the_one_that_is_written_down():
    points = pixels()[::9, ::9].reshape(-1, 2)
    np.testing.assert_allclose(LENS.undistorted(LENS.distorted(points)), points, atol=1e-6)
    slopes = (points - [43.0, 32.0]) / 70.0
    r2 = np.square(slopes).sum(1, keepdims=True)
    np.testing.assert_allclose(LENS.distorted(points), [43, 32] + 70 * slopes * (1 - 0.2 * r2 + 0.05 * r2**2))


def test_coefficients_of_no_lens_are_refused_and_no_distortion_is_no_lens():
    folded = radial_lens(Intrinsics(focal_px=140.0, distortion=(-3.0, 0.0)), 2, W, H)
    with pytest.raises(InputError, match="map two rays"):
        folded.check(W, H, "dataset.yaml", "photos[a].camera.distortion")
    LENS.check(W, H, "dataset.yaml", "photos[a].camera.distortion")
    assert radial_lens(None, 1, W, H) is None and radial_lens(Intrinsics(focal_px=140.0), 1, W, H) is None
