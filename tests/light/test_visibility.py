"""The seen share of lobes: laws, and quadrature with many directions."""

import numpy as np
import pytest
import torch

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.light.visibility import cosine_weights, highlight_weights, kernel, seen_share

RNG = np.random.default_rng(4)


def unit(*shape):
    v = torch.from_numpy(RNG.normal(size=(*shape, 3)))
    return v / v.norm(dim=-1, keepdim=True)


def points():
    """Unit normals and views at most 80° from them."""
    normals = unit(30)
    views = normals + 0.9 * unit(30)
    return normals, views / views.norm(dim=-1, keepdim=True)


def directions(count=256):
    return torch.from_numpy(fibonacci_sphere(count))


def behind(edge, d):
    """Visibility of points that do not see beyond a plane edge: n points, k directions."""
    return (d @ edge.T > 0).T.double()


def weights_of(part, normals, views, d, roughness=0.4):
    if part == "diffuse":
        return cosine_weights(normals, d)
    return highlight_weights(normals, views, d, roughness)


PARTS = pytest.mark.parametrize("part", ["diffuse", "specular"])


@PARTS
def test_who_sees_everything_sees_all_of_every_lobe_and_shares_lie_between_none_and_all(part):
    (normals, views), d = points(), directions()
    lobes = kernel(d, unit(50), torch.logspace(-1, 3.3, 50).double())
    weights, some = weights_of(part, normals, views, d), torch.from_numpy((RNG.random((30, 256)) > 0.5).astype(float))
    np.testing.assert_array_equal(seen_share(torch.ones(30, 256).double(), weights, lobes), 1)
    share = seen_share(some, weights_of(part, normals, views, d, 0.1), lobes)
    assert share.min() >= 0 and share.max() <= 1 + 1e-12


def test_constant_light_is_seen_through_the_cosine_weighted_open_part_of_the_hemisphere():
    """A plane edge tilted by t from the normal leaves (1 + cos t)/2 of the cosine-weighted hemisphere."""
    normals, d = unit(40), directions(1024)
    tilt = torch.linspace(0, 1.5, 40).double()[:, None]
    across = torch.linalg.cross(normals, unit(40))
    edge = torch.cos(tilt) * normals + torch.sin(tilt) * across / across.norm(dim=1, keepdim=True)
    share = seen_share(behind(edge, d), cosine_weights(normals, d), kernel(d, unit(1), torch.tensor([1e-3]).double()))
    np.testing.assert_allclose(share, (1 + torch.cos(tilt)) / 2, atol=0.02)
